"""TripleProductRelighter: against the path tracer with shadows, caches, gradients, pixels, refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.ops import mesh, rotation, table
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import Octahedral
from ptt.relight.triple_relighter import Highlights, RotatedLight
from ptt.relight.triple_tables import turned
from ptt.scene.parts import Part

SKY = ptt.Environment.sun_sky(radius=25.0)


BULB = ptt.Environment(SKY.map.index_put((torch.tensor([30]), torch.tensor([50])), torch.tensor([2e4, 1.6e4, 1e4])))


@pytest.fixture(scope="module", params=["lobes", "triangles"])
def highlights(request: pytest.FixtureRequest) -> Highlights:
    found: Highlights = request.param
    return found


@pytest.fixture(scope="module")
def relighter(small_scene: ptt.Scene, highlights: Highlights) -> ptt.TripleProductRelighter:
    return small(small_scene, highlights)


def small(scene: ptt.Scene, highlights: Highlights, **others: Any) -> ptt.TripleProductRelighter:
    return ptt.TripleProductRelighter(
        scene, 1, normals=8, twists=8, source=16, views=24, highlights=highlights, **others
    )


def facing(scene: ptt.Scene) -> Tensor:
    assert scene.camera is not None
    return ((scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.1).nonzero()[:, 0]


@pytest.mark.parametrize(
    "material",
    [ptt.lambert((0.3, 0.5, 0.7)), ptt.blinn_phong(0.2, 0.5, 12.0), ptt.ward(0.2, 0.4, 0.5, 0.2)],
    ids=["dull", "glossy", "brushed"],
)
def test_against_the_path_tracer(small_scene: ptt.Scene, material: ptt.Material, highlights: Highlights) -> None:
    """With shadows, at the vertices that face the camera."""
    relighter = ptt.TripleProductRelighter(
        small_scene, 3, normals=16, twists=16, source=32, views=64, highlights=highlights
    )
    given = {region.name: material for region in small_scene.regions}
    at = facing(small_scene)
    assert error(relighter, SKY, given, at) < 0.05


def error(
    relighter: ptt.TripleProductRelighter, light: ptt.Environment, given: dict[str, ptt.Material], at: Tensor
) -> float:
    """Against the path tracer at vertices."""
    scene = relighter.scene
    points = reference.vertex_points(scene).take(at)
    wo = scene.camera.toward(points.position)
    truth = reference.radiance(scene, light, given, points, wo, samples=1024).mean
    return ptt.relative_rmse(relighter(light, given, scene.camera)[at], truth)


@pytest.mark.parametrize("material", [ptt.ggx(0.0, 1.0, 0.9, 0.25), ptt.lambert(0.5)], ids=["metal", "matt"])
def test_lobes_see_metals_and_lamps_as_they_are(small_scene: ptt.Scene, material: ptt.Material) -> None:
    """Under a small bright lamp, on 80 triangles, which err by more than twice as much."""
    given = {region.name: material for region in small_scene.regions}
    at = facing(small_scene)
    by_lobes, by_triangles = (error(small(small_scene, kind), BULB, given, at) for kind in get_args(Highlights))
    assert by_lobes < 0.06 and by_triangles > 2 * by_lobes


def test_pixels_show_shadows_of_lamps() -> None:
    """Of a ball on a floor of small triangles, per pixel against rays: neither too bright nor too dark."""
    ball, faces = mesh.sphere_mesh(2, 0.5)
    parts = [Part("floor", *mesh.plane_mesh(3.0, 40)), Part("ball", ball + torch.tensor([0.0, 0.6, 0.0]), faces)]
    scene = ptt.Scene.from_parts(parts, camera=ptt.Camera((1.5, 2.0, 3.0), (0.0, 0.4, 0.0), width=60, height=45))
    pixels = ptt.GBuffer.of(scene, scene.camera)
    given = {region.name: ptt.lambert(0.5) for region in scene.regions}
    by_lobes, by_triangles = (
        pixels.image(ptt.TripleProductRelighter(scene, highlights=kind)(BULB, given, pixels)).pixels
        for kind in get_args(Highlights)
    )
    truth = reference.image(scene, BULB, given, scene.camera, samples=128).mean.float()
    on_mesh = ~pixels.missed.reshape(truth.shape[:2])
    assert abs(float(by_lobes[on_mesh].mean() / truth[on_mesh].mean()) - 1) < 0.01
    assert ptt.relative_rmse(by_lobes[on_mesh], truth[on_mesh]) < 0.08
    assert ptt.relative_rmse(by_triangles[on_mesh], truth[on_mesh]) > 0.15


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
    eager = small(small_scene, "lobes" if relighter.narrow else "triangles", compiled=False)
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    for view in (small_scene.camera, pixels):
        torch.testing.assert_close(relighter(SKY, {}, view), eager(SKY, {}, view), rtol=2e-3, atol=1e-4)


def test_pixels_have_shadows_of_their_own(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """Per pixel and per vertex agree where the surface is smooth; each pixel mixes its vertices' visibility."""
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    per_pixel = pixels.image(relighter(SKY, {}, pixels)).pixels
    per_vertex = ptt.render(small_scene, small_scene.camera, relighter(SKY, {}, small_scene.camera), antialias=1).pixels
    assert ptt.relative_rmse(per_pixel, per_vertex) < 0.1


def test_an_eye_that_moves_alone_leaves_the_pixels(
    small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter
) -> None:
    """Where their functions are found is looked up once."""
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    views = [replace(pixels, camera=small_scene.camera.orbited(angle)) for angle in (0, 20)]
    first, second = (relighter.prepared(SKY, {}, view)[2] for view in views)
    assert second.light.rows is first.light.rows and second.shares is first.shares


def test_caches_follow_every_input(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    sky = ptt.Environment(SKY.map.clone())
    camera = small_scene.camera
    exponent = torch.tensor(9.0)
    pixels = ptt.GBuffer.of(small_scene, camera)
    calls = [
        (sky, {}, camera),
        (sky.rotated(y=40), {}, camera),
        (sky.rotated(y=40), {"ball": ptt.blinn_phong(0.9, 0.2, exponent)}, camera),
        (sky, {}, camera.orbited(50)),
        (sky, {}, pixels),
        (sky, {}, replace(pixels, camera=camera.orbited(20))),
        (sky, {}, camera),
    ]
    for args in calls:
        fresh = small(small_scene, "lobes" if relighter.narrow else "triangles")
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
    diffuse = torch.full((3,), 0.3, requires_grad=True)
    specular = torch.full((3,), 0.4, requires_grad=True)
    material = ptt.Material(diffuse, specular, ptt.BlinnPhong(15.0))
    given = {region.name: material for region in small_scene.regions}
    radiance = relighter(ptt.Environment(sky), given, small_scene.camera)
    radiance.sum().backward()
    total = float(radiance.detach().sum())
    assert sky.grad is not None and float((sky.grad * sky.detach()).sum()) == pytest.approx(total, rel=1e-3)
    assert diffuse.grad is not None and specular.grad is not None
    by_weights = (diffuse.grad * diffuse.detach()).sum() + (specular.grad * specular.detach()).sum()
    assert float(by_weights) == pytest.approx(total, rel=1e-3)


def test_gradients_of_shapes(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """Lobes have them, two-sided, over a step so wide that cells which jump between nodes cancel; triangles refuse."""

    def relit(exponent: Tensor) -> Tensor:
        shape = ptt.BlinnPhong(exponent)
        radiance: Tensor = relighter(SKY, {"ball": ptt.Material(0.1, 0.5, shape)}, small_scene.camera)
        return radiance.sum()

    exponent = torch.tensor(15.0, requires_grad=True)
    if not relighter.narrow:
        with pytest.raises(ValueError, match="no gradients"):
            relit(exponent)
        return
    relit(exponent).backward()
    step = 2.0
    difference = (relit(torch.tensor(15.0 + step)) - relit(torch.tensor(15.0 - step))) / (2 * step)
    assert exponent.grad is not None and float(exponent.grad) == pytest.approx(float(difference), rel=0.05)


def test_refuses(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    for arguments, message in (
        ({"level": 8}, r"level must be in 0\.\.7"),
        ({"level": 6}, "81920 triangles take 8.9 GB|81920 triangles take"),
        ({"storage": "4-bit"}, "storage must be one of float, 16-bit, 8-bit"),
        ({"highlights": "tensor"}, "highlights must be one of lobes, triangles"),
        ({"lobes": 65}, r"lobes must be in 1\.\.64"),
        ({"twists": 0}, r"twists must be in 1\.\.256"),
        ({"views": 0}, r"views must be in 1\.\.512"),
        ({"normals": 3}, "n must be even"),
        ({"rays": 3}, "power of two"),
    ):
        with pytest.raises(ValueError, match=message):
            ptt.TripleProductRelighter(small_scene, **arguments)
    with pytest.raises(ValueError, match="no region lid"):
        relighter(SKY, {"lid": ptt.lambert()}, small_scene.camera)
    with pytest.raises(ValueError, match="view must"):
        relighter(SKY, {}, torch.ones(2, 3))
    other = ptt.Scene.from_mesh(*mesh.sphere_mesh(5))
    with pytest.raises(ValueError, match="of this relighter's scene"):
        relighter(SKY, {}, ptt.GBuffer.of(other, other.camera))


def test_two_materials_on_a_region_are_mixed(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """Linear in the share, which is interpolated; a share of 0 or 1 is one material alone."""
    first = ptt.blinn_phong((0.1, 0.5, 0.2), 0.3, 30.0)
    second = ptt.ggx(0.4, 0.2, 0.3, 0.4)
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    share = torch.rand(len(small_scene.vertices), generator=torch.Generator().manual_seed(0))
    share[:50] = torch.arange(50) % 2
    for view, amount in ((small_scene.camera, share), (pixels, pixels.interpolated(small_scene, share))):
        a, b, both = (relighter(SKY, {"ball": m}, view) for m in (first, second, ptt.Mixed(first, second, share)))
        region = small_scene.vertex_region if view is small_scene.camera else pixels.region
        amount = torch.where(region == small_scene.region_index("ball"), amount, torch.zeros(()))[:, None]
        torch.testing.assert_close(both, a + (b - a) * amount, rtol=5e-3, atol=1e-3)


def test_a_mixed_region_refuses(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    a = ptt.lambert(0.2)
    b = ptt.lambert(0.4)
    for share, message in ((torch.rand(4, 4), "needs a scene with uv"), (torch.rand(7), "must have .* values")):
        with pytest.raises(ValueError, match=message):
            relighter(SKY, {"ball": ptt.Mixed(a, b, share)}, small_scene.camera)
    for share, message in ((torch.rand(2, 2, 2), "texture"), (torch.tensor([1.5]), "share must")):
        with pytest.raises(ValueError, match=message):
            ptt.Mixed(a, b, share)
    with pytest.raises(ValueError, match="needs a scene with uv"):
        ptt.EnvMapRelighter(small_scene, ptt.LightRotation.build(8, normals=4))(
            SKY,
            {"ball": ptt.Mixed(a, b, torch.rand(4, 4))},
            small_scene.camera,
        )


@pytest.mark.parametrize(("storage", "error"), [("16-bit", 1e-3), ("8-bit", 0.01)])
def test_storage(small_scene: ptt.Scene, storage: str, error: float) -> None:
    def relit(storage: str) -> Tensor:
        relighter = ptt.TripleProductRelighter(
            small_scene,
            1,
            normals=8,
            twists=8,
            source=16,
            views=24,
            storage=storage,  # type: ignore[arg-type]
            highlights="triangles",
        )
        radiance: Tensor = relighter(SKY, {"ball": ptt.blinn_phong(0.2, 0.5, 20.0)}, small_scene.camera)
        return radiance

    exact = relit("float")
    rough = relit(storage)
    assert 0 < ptt.relative_rmse(rough, exact) < error


def test_light_rotated_before(small_scene: ptt.Scene, relighter: ptt.TripleProductRelighter) -> None:
    """From four times as many cells, and sixteen times the samples: nearly the same for a smooth sky."""
    sky = ptt.Environment.gradient_sky()
    tables = relighter.prerotated(sky)
    on_the_fly = relighter.incident(sky)
    assert tables.frames.values.shape == on_the_fly.frames.values.shape
    assert ptt.relative_rmse(on_the_fly.frames.to_dense(), tables.frames.to_dense()) < 0.03
    got, wanted = (relighter(light, {}, small_scene.camera) for light in (tables, sky))
    assert ptt.relative_rmse(got, wanted) < 0.02
    with pytest.raises(ValueError, match="rotated by this relighter"):
        fewer = tables.frames._replace(values=tables.frames.values[:5])
        relighter(tables._replace(frames=fewer), {}, small_scene.camera)
    other = small(small_scene, "triangles" if relighter.narrow else "lobes")
    with pytest.raises(ValueError, match="rotated by this relighter"):
        relighter(other.prerotated(sky), {}, small_scene.camera)


@pytest.mark.parametrize("level", [0, 7])
def test_coarsest_and_finest_level(level: int) -> None:
    """A white ball alone under light 1 reflects 1, on twenty triangles and on 327,680."""
    vertices, faces = mesh.sphere_mesh(0)
    scene = ptt.Scene.from_mesh(vertices, faces, material=ptt.lambert(1.0))
    relighter = ptt.TripleProductRelighter(scene, level, normals=2, twists=1, source=8, views=2, rays=1)
    radiance = relighter(ptt.Environment.constant(1.0), {}, scene.camera)
    torch.testing.assert_close(radiance, torch.ones_like(radiance), rtol=0, atol=0.15 if level == 0 else 0.01)


@pytest.mark.parametrize("hidden", [False, True])
def test_all_visible_and_all_hidden(hidden: bool) -> None:
    """A floor alone, and under a lid that is far larger."""
    parts = [Part("floor", *mesh.plane_mesh(1.0, 2), material=ptt.lambert(1.0))]
    if hidden:
        over, faces = mesh.plane_mesh(100.0, 1)
        parts.append(Part("lid", over + torch.tensor([0.0, 0.01, 0.0]), faces))
    scene = ptt.Scene.from_parts(parts, camera=ptt.Camera((0.0, 0.005, 0.4), (0.0, 0.0, 0.0)))
    relighter = ptt.TripleProductRelighter(scene, 2, normals=4, twists=4, source=16, views=4)
    radiance = relighter(ptt.Environment.constant(1.0), {}, scene.camera)[:9]
    assert bool(((radiance - float(not hidden)).abs() < 0.01).all())


def test_light_in_one_triangle() -> None:
    """Of a level-1 grid: what a matt floor reflects of it is its solid angle times its cosine over pi."""
    grid = Geodesic(1)
    scene = ptt.Scene.from_mesh(*mesh.plane_mesh(1.0, 1), material=ptt.lambert(1.0))
    relighter = ptt.TripleProductRelighter(scene, 1, normals=4, twists=1, source=8, views=4, highlights="triangles")
    cell = int(grid.directions()[:, 2].argmax())
    values = torch.zeros(len(relighter.frames), 3, grid.cells)
    values[:, :, cell] = torch.tensor([1.0, 2.0, 0.0])
    light = RotatedLight(table.stored(values, torch.float16), None, None)
    radiance = relighter(light, {}, scene.camera)
    wanted = float(relighter.dull[cell]) * 20 / 80
    assert wanted == pytest.approx(float(grid.solid_angles()[cell] * grid.directions()[cell, 2]) / math.pi, rel=0.05)
    torch.testing.assert_close(radiance, torch.tensor([[1.0, 2.0, 0.0]]).expand(4, 3) * wanted, rtol=2e-3, atol=0)
