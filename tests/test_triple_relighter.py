"""TripleProductRelighter: against the path tracer with shadows, caches, gradients, pixels, refusals."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.models.triple_relighter import turned
from ptt.ops import rotation
from ptt.ops.octahedral import Octahedral

SKY = ptt.Environment.sun_sky(radius=25.0)


@pytest.fixture(scope="module")
def relighter(small_scene: ptt.Scene) -> ptt.TripleProductRelighter:
    return ptt.TripleProductRelighter(small_scene, 1, normals=8, twists=8, source=16, views=24)


def facing(scene: ptt.Scene) -> Tensor:
    assert scene.camera is not None
    return ((scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.1).nonzero()[:, 0]


@pytest.mark.parametrize(
    "material",
    [ptt.lambert((0.3, 0.5, 0.7)), ptt.blinn_phong(0.2, 0.5, 12.0), ptt.ward(0.2, 0.4, 0.5, 0.2)],
    ids=["dull", "glossy", "brushed"],
)
def test_against_the_path_tracer(small_scene: ptt.Scene, material: ptt.Material) -> None:
    """With shadows, at the vertices that face the camera."""
    relighter = ptt.TripleProductRelighter(small_scene, 3, normals=16, twists=16, source=32, views=64)
    given, at = {region.name: material for region in small_scene.regions}, facing(small_scene)
    got = relighter(SKY, given, small_scene.camera)[at]
    points = reference.Points(*(x[at] for x in reference.vertex_points(small_scene)))
    wo = small_scene.camera.toward(points.position)
    truth = reference.radiance(small_scene, SKY, given, points, wo, samples=1024).mean
    assert ptt.relative_rmse(got, truth) < 0.05


def test_turned_frames() -> None:
    """Rotations; the first is the frame itself, the normal stays, a quarter turn takes tangent to bitangent."""
    frames = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3))
    four = turned(frames, 4).unflatten(0, (-1, 4))
    assert torch.equal(four[:, 0], frames)
    torch.testing.assert_close(four[:, :, 2], frames[:, None, 2].expand(-1, 4, -1), rtol=0, atol=1e-15)
    torch.testing.assert_close(four[:, 1, 0], frames[:, 1], rtol=0, atol=1e-15)
    torch.testing.assert_close(four.det(), torch.ones(16, 4).double())


def test_constant_light_gives_the_visible_part(small_scene: ptt.Scene) -> None:
    """Of a white floor under light 1: what the ambient occlusion leaves."""
    relighter = ptt.TripleProductRelighter(small_scene, 2, normals=8, twists=4, source=8, views=8, rays=4)
    given = {region.name: ptt.lambert(1.0) for region in small_scene.regions}
    got = relighter(ptt.Environment.constant(1.0), given, small_scene.camera)[:, 0]
    assert float((got - ptt.ambient_occlusion(small_scene, 1024)).abs().max()) < 0.02


def test_compiled_agrees_with_eager(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    eager = ptt.TripleProductRelighter(small_scene, 1, normals=8, twists=8, source=16, views=24, compiled=False)
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    for view in (small_scene.camera, pixels):
        torch.testing.assert_close(relighter(SKY, {}, view), eager(SKY, {}, view), rtol=2e-3, atol=1e-4)


def test_pixels_have_shadows_of_their_own(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """Per pixel and per vertex agree where the surface is smooth; each pixel mixes its vertices' visibility."""
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    per_pixel = pixels.image(relighter(SKY, {}, pixels)).pixels
    per_vertex = ptt.render(small_scene, small_scene.camera, relighter(SKY, {}, small_scene.camera), antialias=1).pixels
    assert ptt.relative_rmse(per_pixel, per_vertex) < 0.1


def test_caches_follow_every_input(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    sky, camera, exponent = ptt.Environment(SKY.map.clone()), small_scene.camera, torch.tensor(9.0)
    calls = [
        (sky, {}, camera),
        (sky.rotated(y=40), {}, camera),
        (sky.rotated(y=40), {"ball": ptt.blinn_phong(0.9, 0.2, exponent)}, camera),
        (sky, {}, camera.orbited(50)),
        (sky, {}, ptt.GBuffer.of(small_scene, camera)),
        (sky, {}, camera),
    ]
    for args in calls:
        fresh = ptt.TripleProductRelighter(small_scene, 1, normals=8, twists=8, source=16, views=24)
        assert torch.equal(relighter(*args), fresh(*args))
    before = relighter(*calls[2])
    exponent.fill_(60.0)
    assert not torch.equal(relighter(*calls[2]), before)
    sky.map.mul_(2)
    torch.testing.assert_close(relighter(*calls[0]), 2 * relighter(SKY, {}, camera), rtol=1e-3, atol=1e-4)


def test_linear_and_finite(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    one, many = (relighter(SKY.scaled(s), {}, small_scene.camera) for s in (1.0, 1e6))
    torch.testing.assert_close(many, one * 1e6, rtol=1e-4, atol=1e2)
    assert not bool(relighter(ptt.Environment.constant(0.0), {}, small_scene.camera).any())
    sun = torch.ones(64, 128, 3)
    sun[20, 30] = 1e9
    assert bool(relighter(ptt.Environment(sun), {}, small_scene.camera).isfinite().all())


def test_gradients(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """Of a sum, which is linear in the map and in the weights: gradient times value is the value."""
    sky = torch.rand(16, 32, 3, requires_grad=True)
    diffuse, specular = torch.full((3,), 0.3, requires_grad=True), torch.full((3,), 0.4, requires_grad=True)
    material = ptt.Material(diffuse, specular, ptt.BlinnPhong(15.0))
    given = {region.name: material for region in small_scene.regions}
    radiance = relighter(ptt.Environment(sky), given, small_scene.camera)
    radiance.sum().backward()
    total = float(radiance.detach().sum())
    assert sky.grad is not None and float((sky.grad * sky.detach()).sum()) == pytest.approx(total, rel=1e-3)
    assert diffuse.grad is not None and specular.grad is not None
    by_weights = (diffuse.grad * diffuse.detach()).sum() + (specular.grad * specular.detach()).sum()
    assert float(by_weights) == pytest.approx(total, rel=1e-3)
    with pytest.raises(ValueError, match="no gradients"):
        shape = ptt.BlinnPhong(torch.tensor(15.0, requires_grad=True))
        relighter(SKY, {"ball": ptt.Material(0.1, 0.5, shape)}, small_scene.camera)


def test_refuses(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    for arguments, message in (
        ({"level": 8}, r"level must be in 0\.\.7"),
        ({"level": 6}, "81920 triangles take 8.9 GB|81920 triangles take"),
        ({"storage": "4-bit"}, "storage must be one of float, 16-bit, 8-bit"),
        ({"twists": 0}, r"twists must be in 1\.\.256"),
        ({"views": 0}, r"views must be in 1\.\.512"),
        ({"normals": 3}, "n must be even"),
        ({"rays": 3}, "power of two"),
    ):
        with pytest.raises(ValueError, match=message):
            ptt.TripleProductRelighter(small_scene, **arguments)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no region lid"):
        relighter(SKY, {"lid": ptt.lambert()}, small_scene.camera)
    with pytest.raises(ValueError, match="view must"):
        relighter(SKY, {}, torch.ones(2, 3))
