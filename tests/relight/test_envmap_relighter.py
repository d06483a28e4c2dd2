"""EnvMapRelighter and GBuffer: against the path tracer without shadows, caches, gradients, pixels, refusals."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.ops import mesh

SKY = ptt.Environment.sun_sky(radius=15.0)


@pytest.fixture(scope="module")
def ball() -> ptt.Scene:
    return ptt.Scene.from_mesh(*mesh.sphere_mesh(3), name="ball", material=ptt.blinn_phong(0.3, 0.5, 20.0))


@pytest.fixture(scope="module")
def rotation() -> ptt.LightRotation:
    return ptt.LightRotation.build(32, 16)


@pytest.fixture()
def relighter(ball: ptt.Scene, rotation: ptt.LightRotation) -> ptt.EnvMapRelighter:
    return ptt.EnvMapRelighter(ball, rotation, views=32)


def facing(scene: ptt.Scene) -> Tensor:
    assert scene.camera is not None
    return (scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.1


def truth(scene: ptt.Scene, light: ptt.Environment, materials: dict[str, ptt.Material]) -> Tensor:
    assert scene.camera is not None
    wo = scene.camera.toward(scene.points)
    points = reference.vertex_points(scene)
    return reference.unshadowed(scene, light, materials, points, wo, samples=1024).mean


@pytest.mark.parametrize(
    ("material", "bound"),
    [
        (ptt.lambert((0.2, 0.5, 0.8)), 0.015),
        (ptt.blinn_phong(0.2, 0.6, 20.0), 0.03),
        (ptt.cook_torrance(0.1, 0.8, 0.3, 0.3), 0.03),
        (ptt.ward(0.1, 0.5, 0.3, 0.6), 0.06),
    ],
)
def test_against_the_path_tracer(ball: ptt.Scene, material: ptt.Material, bound: float) -> None:
    rough = material.shape is not None and not material.shape.isotropic
    relighter = ptt.EnvMapRelighter(ball, ptt.LightRotation.build(64, 32), views=32 if rough else 64, twists=16)
    got = relighter(SKY, {"ball": material}, ball.camera)
    at = facing(ball)
    assert ptt.relative_rmse(got[at], truth(ball, SKY, {"ball": material})[at]) < bound


@pytest.mark.parametrize("roughness", [0.2, 0.5])
def test_lamps_are_as_sharp_as_the_material(ball: ptt.Scene, roughness: float) -> None:
    """Under a sun of a degree, which the map's cells of six are too coarse for."""
    sky = ptt.Environment.sun_sky(radius=1.0)
    at = facing(ball)
    materials = {"ball": ptt.ggx(0.1, 1.0, 1.0, roughness)}
    wanted = truth(ball, sky, materials)[at]
    rotation = ptt.LightRotation.build(32, 32)
    fine, coarse = (
        ptt.relative_rmse(ptt.EnvMapRelighter(ball, rotation, lamps=lamps)(sky, materials, ball.camera)[at], wanted)
        for lamps in (True, False)
    )
    assert fine < 0.04 and coarse > 2 * fine


def test_a_mirror_shows_lamps_as_areas(ball: ptt.Scene, rotation: ptt.LightRotation) -> None:
    """A sharp shape sees the whole map through its slices, lamps kept apart or not."""
    sky = ptt.Environment.sun_sky(radius=1.0)
    material = {"ball": ptt.ggx(0.0, 1.0, 1.0, 0.05)}
    both = [
        ptt.EnvMapRelighter(ball, rotation, views=32, lamps=lamps)(sky, material, ball.camera)
        for lamps in (True, False)
    ]
    torch.testing.assert_close(*both)


def test_more_is_better(ball: ptt.Scene) -> None:
    """Finer maps, and more terms, come closer on a glossy ball."""
    materials = {"ball": ptt.blinn_phong(0.0, 1.0, 60.0)}
    at = facing(ball)
    exact = truth(ball, SKY, materials)[at]

    def error(n: int, terms: int) -> float:
        relighter = ptt.EnvMapRelighter(ball, ptt.LightRotation.build(n, 32), views=64, terms=terms)
        return ptt.relative_rmse(relighter(SKY, materials, ball.camera)[at], exact)

    assert error(64, 256) < error(32, 256) < error(16, 64)
    assert error(64, 256) < error(64, 64) < error(64, 16)


def test_factorised_slices_agree(ball: ptt.Scene, rotation: ptt.LightRotation) -> None:
    sparse = ptt.EnvMapRelighter(ball, rotation, views=32, terms=256)
    low = ptt.EnvMapRelighter(ball, rotation, views=32, rank=48)
    args = SKY, {"ball": ptt.blinn_phong(0.1, 0.5, 10.0)}, ball.camera
    assert ptt.relative_rmse(low(*args), sparse(*args)) < 0.01


@pytest.mark.parametrize("radius", [1.0, 15.0])
@pytest.mark.parametrize("material", [ptt.blinn_phong(0.1, 0.5, 30.0), ptt.ward(0.1, 0.5, 0.1, 0.4)])
def test_compiled_agrees_with_eager(ball: ptt.Scene, material: ptt.Material, radius: float) -> None:
    sky = ptt.Environment.sun_sky(radius=radius)  # a lamp, or none
    answers = []
    for compiled in (False, True):
        rotate = ptt.LightRotation.build(32, 8, compiled=compiled)
        relighter = ptt.EnvMapRelighter(ball, rotate, views=32, twists=8)
        answers.append(relighter(sky, {"ball": material}, ball.camera))
    torch.testing.assert_close(*answers, rtol=1e-4, atol=1e-4)


def test_constant_light_gives_the_albedo(relighter: ptt.EnvMapRelighter, ball: ptt.Scene) -> None:
    got = relighter(ptt.Environment.constant(2.0), {"ball": ptt.lambert((0.1, 0.5, 1.0))}, ball.camera)
    torch.testing.assert_close(got, torch.tensor([0.2, 1.0, 2.0]).expand_as(got), rtol=2e-3, atol=0)


def test_turning_everything_changes_nothing(rotation: ptt.LightRotation) -> None:
    """The light, the ball and the camera turned together by a quarter turn about z, which the map follows exactly."""
    vertices, faces = mesh.sphere_mesh(2)
    material = {"mesh": ptt.blinn_phong(0.2, 0.5, 20.0)}
    eye = torch.tensor([3.0, 1.0, 2.0])
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    still = ptt.EnvMapRelighter(ptt.Scene.from_mesh(vertices, faces), rotation, views=64)
    turned = ptt.EnvMapRelighter(ptt.Scene.from_mesh(vertices @ quarter.T, faces), rotation, views=64)
    a = still(SKY, material, eye)
    b = turned(SKY.rotated(z=90), material, quarter @ eye)
    assert ptt.relative_rmse(b, a) < 0.01


def test_linear_in_the_light(relighter: ptt.EnvMapRelighter, ball: ptt.Scene) -> None:
    one, many = (relighter(SKY.scaled(s), {}, ball.camera) for s in (1.0, 1e6))
    torch.testing.assert_close(many, one * 1e6, rtol=1e-4, atol=1e-3)
    assert not bool(relighter(ptt.Environment.constant(0.0), {}, ball.camera).any())


def test_one_bright_texel_is_finite(relighter: ptt.EnvMapRelighter, ball: ptt.Scene) -> None:
    sun = torch.ones(64, 128, 3)
    sun[20, 30] = 1e9
    assert bool(relighter(ptt.Environment(sun), {}, ball.camera).isfinite().all())


def test_occlusion_darkens(ball: ptt.Scene, rotation: ptt.LightRotation, relighter: ptt.EnvMapRelighter) -> None:
    shade = torch.linspace(0, 1, len(ball.vertices))
    dark = ptt.EnvMapRelighter(ball, rotation, views=32, occlusion=shade)
    torch.testing.assert_close(dark(SKY, {}, ball.camera), shade[:, None] * relighter(SKY, {}, ball.camera))


def test_caches_follow_every_input(
    relighter: ptt.EnvMapRelighter, ball: ptt.Scene, rotation: ptt.LightRotation
) -> None:
    """Whatever changes, the answer is that of a relighter that has seen nothing before."""
    red = ptt.blinn_phong((0.9, 0, 0), 0.2, 9.0)
    camera = ball.camera
    sky = ptt.Environment(SKY.map.clone())
    exponent = torch.tensor(15.0)
    calls = [
        (sky, {}, camera),
        (sky.rotated(y=40), {}, camera),
        (sky.rotated(y=40), {"ball": red}, camera),
        (sky, {"ball": ptt.blinn_phong(0.1, 0.3, exponent)}, camera.orbited(50)),
        (sky, {}, ptt.GBuffer.of(ball, camera)),
        (sky, {}, ptt.GBuffer.of(ball, camera.orbited(20))),
        (sky, {}, camera),
    ]
    for args in calls:
        fresh = ptt.EnvMapRelighter(ball, rotation, views=32)
        assert torch.equal(relighter(*args), fresh(*args))
    before = relighter(*calls[3])
    exponent.fill_(60.0)
    assert not torch.equal(relighter(*calls[3]), before)
    sky.map.mul_(2)
    torch.testing.assert_close(relighter(*calls[0]), 2 * fresh(*calls[0][:0], SKY, {}, camera), rtol=1e-5, atol=1e-6)


def test_gradients(relighter: ptt.EnvMapRelighter, ball: ptt.Scene) -> None:
    """Of a sum, which is linear in the map and in the weights: gradient times value is the value."""
    sky = torch.rand(16, 32, 3, requires_grad=True)
    diffuse = torch.tensor([0.2, 0.3, 0.4], requires_grad=True)
    specular = torch.tensor([0.5, 0.6, 0.7], requires_grad=True)
    material = ptt.Material(diffuse, specular, ptt.BlinnPhong(15.0))
    radiance = relighter(ptt.Environment(sky), {"ball": material}, ball.camera)
    radiance.sum().backward()
    total = float(radiance.detach().sum())
    assert sky.grad is not None and float((sky.grad * sky.detach()).sum()) == pytest.approx(total, rel=1e-4)
    assert diffuse.grad is not None and specular.grad is not None
    by_weights = (diffuse.grad * diffuse.detach()).sum() + (specular.grad * specular.detach()).sum()
    assert float(by_weights) == pytest.approx(total, rel=1e-4)
    with pytest.raises(ValueError, match="no gradients"):
        shape = ptt.BlinnPhong(torch.tensor(15.0, requires_grad=True))
        relighter(SKY, {"ball": ptt.Material(0.1, 0.5, shape)}, ball.camera)


def test_pixels_agree_with_vertices(ball: ptt.Scene, relighter: ptt.EnvMapRelighter) -> None:
    """On a fine mesh, shading per pixel and interpolating vertices are much the same where they show the surface."""
    camera = ptt.Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), width=40, height=30)
    pixels = ptt.GBuffer.of(ball, camera)
    per_pixel = pixels.image(relighter(SKY, {}, pixels)).pixels
    per_vertex = ptt.render(ball, camera, relighter(SKY, {}, camera), antialias=1).pixels
    assert ptt.relative_rmse(per_pixel, per_vertex) < 0.04  # edges of 8 degrees
    background = pixels.image(relighter(SKY, {}, pixels), SKY).pixels.flatten(0, 1)
    directions = camera.rays()[1].flatten(0, 1)
    torch.testing.assert_close(background[pixels.missed], SKY.radiance(directions[pixels.missed]))
    with pytest.raises(ValueError, match="radiance must be finite"):
        pixels.image(torch.full((len(pixels.pixel), 3), math.nan))


def test_a_camera_that_sees_nothing(ball: ptt.Scene, relighter: ptt.EnvMapRelighter) -> None:
    pixels = ptt.GBuffer.of(ball, ptt.Camera((0.0, 0.0, 9.0), (0.0, 0.0, 20.0), width=8, height=6))
    radiance = relighter(SKY, {}, pixels)
    assert radiance.shape == (0, 3) and bool(pixels.missed.all())


def test_several_regions(small_scene: ptt.Scene, rotation: ptt.LightRotation) -> None:
    relighter = ptt.EnvMapRelighter(small_scene, rotation, views=32)
    plain = relighter(SKY, {}, small_scene.camera)
    edited = relighter(SKY, {"ball": ptt.lambert(0.0)}, small_scene.camera)
    on_ball = small_scene.vertex_region == small_scene.region_index("ball")
    assert torch.equal(plain[~on_ball], edited[~on_ball]) and not bool(edited[on_ball].any())


def test_ambient_occlusion(small_scene: ptt.Scene, ball: ptt.Scene) -> None:
    """1 on a convex body; of the floor a ball of radius r at a distance d, height h hides r^2 h / d^3."""
    assert bool((ptt.ambient_occlusion(ball, 64) == 1).all())
    shade = ptt.ambient_occlusion(small_scene, 256)
    floor = small_scene.vertex_region == small_scene.region_index("floor")
    away = (small_scene.points - torch.tensor([0.0, 0.6, 0.0])).norm(dim=1)
    wanted = 1 - 0.5**2 * 0.6 / away**3
    assert float((shade - wanted)[floor].abs().max()) < 0.03  # the ball has 162 vertices and is a little smaller
    with pytest.raises(ValueError, match="rays"):
        ptt.ambient_occlusion(ball, 0)


def test_unshadowed_is_radiance_where_nothing_hides(ball: ptt.Scene) -> None:
    points = reference.vertex_points(ball)
    wo = ball.camera.toward(ball.points)
    args = SKY, ball.materials, points, wo
    a, b = (f(ball, *args, samples=64) for f in (reference.radiance, reference.unshadowed))
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-3, atol=1e-4)


def test_refuses(ball: ptt.Scene, rotation: ptt.LightRotation, relighter: ptt.EnvMapRelighter) -> None:
    for arguments, message in (
        ({"terms": 0}, r"terms must be in 1\.\.256"),
        ({"rank": 257}, r"rank must be in 1\.\.256"),
        ({"keep": 0}, r"keep must be in 1\.\.1024"),
        ({"views": 0}, "views must be"),
        ({"twists": 0}, "twists must be"),
        ({"occlusion": torch.ones(3)}, "occlusion must be"),
        ({"occlusion": torch.full((len(ball.vertices),), 1.5)}, "occlusion must be"),
    ):
        with pytest.raises(ValueError, match=message):
            ptt.EnvMapRelighter(ball, rotation, **arguments)
    with pytest.raises(ValueError, match="must be for normals"):
        ptt.EnvMapRelighter(ball, ptt.LightRotation.build(8, frames=torch.eye(3)[None]))
    with pytest.raises(ValueError, match="no region lid"):
        relighter(SKY, {"lid": ptt.lambert()}, ball.camera)
    with pytest.raises(ValueError, match="view must"):
        relighter(SKY, {}, torch.ones(2, 3))
