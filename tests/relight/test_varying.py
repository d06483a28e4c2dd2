"""Materials that vary over a surface, in every relighter and in light that bounces."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.materials.varying import KNOTS, SurfaceMaterial
from ptt.models.slots import OWN
from ptt.ops import mesh
from ptt.relight.triple_relighter import Highlights
from ptt.scene.parts import Part

SKY = ptt.Environment.sun_sky(radius=25.0)
ROUGH, SMOOTH = KNOTS[7], KNOTS[5]


def ball_over_floor(material: SurfaceMaterial, floor: SurfaceMaterial, editable: bool = True) -> ptt.Scene:
    """A ball over a floor with texture coordinates; the first has 162 vertices, then come those of the floor."""
    ball, faces = mesh.sphere_mesh(2, 0.5)
    plane, squares = mesh.plane_mesh(4.0, 13)
    uv = plane[:, [0, 2]] / 4 + 0.5
    colours = 0.3 + 0.6 * uv[:, :1].expand(-1, 3)
    parts = [
        Part("ball", ball + torch.tensor([0.0, 0.6, 0.0]), faces, material=material),
        Part("floor", plane, squares, uv=uv, colours=colours, material=floor, editable=editable),
    ]
    return ptt.Scene.from_parts(parts, camera=ptt.Camera((1.5, 2.0, 3.0), (0.0, 0.4, 0.0), width=48, height=36))


SCENE = ball_over_floor(ptt.ggx(0.2, 1.0, 0.04, 0.4), ptt.ggx(0.5, 1.0, 0.04, 0.4))


Any3 = ptt.TripleProductRelighter | ptt.EnvMapRelighter | ptt.TransferRelighter


@pytest.fixture(scope="module", params=["triple", "triple, lobes", "envmap", "points", "clusters"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def relighter(kind: str) -> Any3:
    if kind in ("triple", "triple, lobes"):
        highlights: Highlights = "triangles" if kind == "triple" else "lobes"
        return ptt.TripleProductRelighter(SCENE, 1, normals=8, twists=8, source=16, views=24, highlights=highlights)
    if kind == "envmap":
        return ptt.EnvMapRelighter(SCENE, ptt.LightRotation.build(16, normals=8), views=16)
    space = ptt.BRDFSpace.ggx((ROUGH, SMOOTH, 1.0))
    if kind == "points":
        brdf = ptt.TensorBRDF.fit(space, ranks=(6, 10, 10), separated=0)
        return ptt.TransferRelighter(ptt.compress(ptt.precompute(SCENE, resolution=16), 64, brdf, clusters=None))
    models = ptt.TensorBRDF.fit(space, ranks=(6, 8, 8), separated=3), ptt.BRDFBasis.fit(space, 3)
    raw = ptt.precompute(SCENE, 1, resolution=16, rays=64)
    return ptt.TransferRelighter(ptt.compress(raw, 64, *models, ptt.Clusters(60, 8, 16, 64, torch.float32)))


def test_a_map_of_two_roughnesses_is_either_at_each_point(kind: str, relighter: Any3) -> None:
    """Both are knots, and direct light is linear: where the map says smooth the ball is as one that is all smooth."""
    pixels = ptt.GBuffer.of(SCENE, SCENE.camera)
    halves = torch.rand(len(SCENE.vertices), generator=torch.Generator().manual_seed(0)) > 0.5
    views = {"vertices": SCENE.camera} | ({"pixels": pixels} if relighter.pixels else {})
    for what, view in views.items():
        material = ptt.MetalRough((0.9, 0.6, 0.3), 0.7, 1.0, roughness_map=torch.where(halves, SMOOTH, ROUGH))
        found = relighter(SKY, {"ball": material}, view)
        each = [relighter(SKY, {"ball": ptt.MetalRough(material.base, 0.7, r)}, view) for r in (SMOOTH, ROUGH)]
        region = SCENE.vertex_region if what == "vertices" else pixels.region
        smooth = halves.float() if what == "vertices" else pixels.interpolated(SCENE, halves.float())
        if kind == "clusters":  # the floor has some of the ball's reflected light, by its mean
            assert ptt.relative_rmse(found[region == 1], (each[0] + each[1])[region == 1] / 2) < 0.01
            found, each = found[region == 0], [x[region == 0] for x in each]
            smooth = smooth[region == 0]
        sure = (smooth == 0) | (smooth == 1)
        expected = torch.where(smooth[:, None] == 1, *each)
        torch.testing.assert_close(found[sure], expected[sure], rtol=2e-3, atol=2e-3)
        assert ptt.relative_rmse(*each) > 0.02


def test_it_is_as_the_uniform_material(kind: str, relighter: Any3) -> None:
    """`metal_rough` of the same values, on the white ball; on the floor its base colour tints the metal too.

    Narrow lobes are of all highlights of the one together, and of each layer of the other: alike but for their cells.
    """
    given = (0.9, 0.6, 0.3), 1.0, ROUGH
    found, plain = (
        relighter(SKY, {"ball": m}, SCENE.camera) for m in (ptt.MetalRough(*given), ptt.metal_rough(*given))
    )
    torch.testing.assert_close(found, plain, rtol=2e-3, atol=5e-3 if kind == "triple, lobes" else 2e-3)
    assert ptt.relative_rmse(found, plain) < 2e-3
    floor = relighter(SKY, {"floor": ptt.MetalRough(*given)}, SCENE.camera)
    vertex = int((SCENE.vertex_region == 1).nonzero()[90, 0])
    tinted = ptt.metal_rough((torch.tensor(given[0]) * SCENE.colours[vertex]).tolist(), *given[1:])
    alone = relighter(SKY, {"floor": tinted}, SCENE.camera)
    torch.testing.assert_close(floor[vertex], alone[vertex], rtol=5e-3, atol=2e-3)


def test_two_materials_are_mixed_by_texture(kind: str, relighter: Any3) -> None:
    """Linear in the share, by texture on the floor."""
    first, second = ptt.ggx(0.1, 0.3, 1.0, ROUGH), ptt.ggx(0.4, 0.2, 0.0, SMOOTH)
    share = torch.rand(6, 6, generator=torch.Generator().manual_seed(0))
    materials = first, second, ptt.Mixed(first, second, share)
    a, b, both = (relighter(SKY, {"floor": m}, SCENE.camera) for m in materials)
    floor = SCENE.vertex_region == 1
    assert SCENE.uv is not None
    amount = mesh.sample_texture(share[..., None], SCENE.uv)
    tolerance = 5e-3 if kind == "clusters" else 2e-3  # whose floor is lit by the ball, which the floor lights
    torch.testing.assert_close(both[floor], (a + (b - a) * amount)[floor], rtol=tolerance, atol=2e-3)


def relit(scene: ptt.Scene, materials: dict[str, SurfaceMaterial]) -> tuple[Tensor, ptt.TransferModel]:
    """The light of one bounce alone on the ball, as clusters have it."""
    space = ptt.BRDFSpace.ggx((ROUGH, SMOOTH, 1.0))
    brdf = ptt.TensorBRDF.fit(space, ranks=(6, 8, 8), separated=3)
    basis = ptt.BRDFBasis.fit(space, 6)
    light = ptt.Environment.constant(1.0)
    parts = []
    for bounces in (1, 0):
        raw = ptt.precompute(scene, bounces, resolution=16, rays=128)
        model = ptt.compress(raw, 384, brdf, basis, ptt.Clusters(200, 64, 64, 384, torch.float32))
        parts.append((ptt.TransferRelighter(model, compiled=False)(light, materials, scene.camera), model))
    (both, model), (direct, _) = parts
    return (both - direct)[scene.vertex_region == 0], model


def test_textures_show_in_light_that_bounces() -> None:
    """A matt floor mixed of two greys by a texture is one whose base colour is that mixture; fixed, or editable."""
    ball = ptt.lambert(0.5)
    share = torch.linspace(0, 1, 6).expand(6, 6).contiguous()
    mixed = ptt.Mixed(ptt.lambert(0.1), ptt.lambert((0.9, 0.5, 0.3)), share)
    textured = ball_over_floor(ball, mixed)
    assert textured.uv is not None
    amount = mesh.sample_texture(share[..., None], textured.uv[textured.vertex_region == 1])
    plain = ball_over_floor(ball, ptt.lambert(1.0))
    colours = plain.colours.clone()
    colours[plain.vertex_region == 1] *= torch.lerp(torch.full((1, 3), 0.1), torch.tensor([[0.9, 0.5, 0.3]]), amount)
    expected, _ = relit(replace(plain, colours=colours), {})
    for editable in (False, True):
        found, model = relit(ball_over_floor(ball, mixed, editable), {})
        assert [slot.channel for slot in model.slots if slot.function == OWN] == [0, 1, 2]
        assert ptt.relative_rmse(found, expected) < 0.03  # clusters; `tests/transfer/test_bounces.py` is exact
    edited, _ = relit(textured, {"floor": replace(mixed, share=1 - share)})
    assert ptt.relative_rmse(edited, expected) < 0.3  # by its mean: near, and not the same
    dark, _ = relit(textured, {"floor": ptt.lambert(0.0)})
    assert float(dark.abs().max()) < 0.02 * float(expected.max())


def test_a_metal_from_a_texture_bounces() -> None:
    """A floor whose map is the same everywhere reflects as the uniform metal, whole and by the basis' functions."""
    texture = ptt.Texture(torch.full((4, 4, 1), ROUGH))
    varying = ptt.MetalRough((0.9, 0.5, 0.3), 1.0, 1.0, roughness_map=texture)
    uniform = ptt.metal_rough((0.9, 0.5, 0.3), 1.0, ROUGH)
    white = torch.ones(196, 3)

    def scene(floor: SurfaceMaterial, editable: bool) -> ptt.Scene:
        made = ball_over_floor(ptt.lambert(0.5), floor, editable)
        return replace(made, colours=torch.cat((made.colours[:-196], white)))

    expected, _ = relit(scene(uniform, False), {})
    found, _ = relit(scene(varying, False), {})
    assert ptt.relative_rmse(found, expected) < 0.01
    edited, _ = relit(scene(ptt.MetalRough(1.0, 0.0, 1.0, roughness_map=texture), True), {"floor": varying})
    assert ptt.relative_rmse(edited, expected) < 0.03


@pytest.mark.parametrize("how", ["triple", "points", "clusters"])
def test_against_the_path_tracer(how: str) -> None:
    """Roughness and metallic from maps, with shadows, at the vertices of the ball that face the camera."""
    random = torch.Generator().manual_seed(0)
    height = SCENE.vertices[:, 1].clamp(0, 1)
    material = ptt.MetalRough(
        (0.9, 0.7, 0.4), metallic_map=torch.rand(len(height), generator=random), roughness_map=0.6 + 0.4 * height
    )
    space = ptt.BRDFSpace.holding([material])
    if how == "triple":
        relighter: object = ptt.TripleProductRelighter(SCENE, 3, normals=16, twists=16, source=32, views=64)
    else:
        brdf = ptt.TensorBRDF.fit(space, ptt.usual_ranks(space), separated=0 if how == "points" else 3)
        raw = ptt.precompute(SCENE, resolution=32)
        clusters = None if how == "points" else ptt.Clusters(60, 16, 32, 256, torch.float32)
        relighter = ptt.TransferRelighter(ptt.compress(raw, 256, brdf, clusters=clusters))
    given = SCENE.materials | {"ball": material}
    toward = (SCENE.camera.toward(SCENE.points) * SCENE.normals).sum(1)
    at = ((toward > 0.2) & (SCENE.vertex_region == 0)).nonzero()[:, 0]
    found = relighter(SKY, given, SCENE.camera)[at]  # type: ignore[operator]
    points = reference.vertex_points(SCENE).take(at)
    truth = reference.radiance(SCENE, SKY, given, points, SCENE.camera.toward(points.position), samples=1024).mean
    assert ptt.relative_rmse(found, truth) < 0.06


def test_unshadowed_against_the_path_tracer() -> None:
    random = torch.Generator().manual_seed(0)
    values = torch.rand(2, len(SCENE.vertices), generator=random)
    material = ptt.MetalRough((0.9, 0.7, 0.4), metallic_map=values[0], roughness_map=0.4 + 0.6 * values[1])
    relighter = ptt.EnvMapRelighter(SCENE, ptt.LightRotation.build(32, normals=32))
    given = SCENE.materials | {"ball": material}
    toward = (SCENE.camera.toward(SCENE.points) * SCENE.normals).sum(1)
    at = ((toward > 0.2) & (SCENE.vertex_region == 0)).nonzero()[:, 0]
    points = reference.vertex_points(SCENE).take(at)
    wo = SCENE.camera.toward(points.position)
    truth = reference.unshadowed(SCENE, SKY, given, points, wo, samples=1024).mean
    assert ptt.relative_rmse(relighter(SKY, given, SCENE.camera)[at], truth) < 0.06


def test_a_saved_model_keeps_what_varies(tmp_path: object) -> None:
    """Maps at the points, texture coordinates, and what glows."""
    share = torch.rand(6, 6, generator=torch.Generator().manual_seed(0))
    mixed = ptt.Mixed(ptt.ggx(0.1, roughness=ROUGH), ptt.ggx(0.9, roughness=SMOOTH), share)
    rough = ptt.MetalRough(roughness_map=torch.rand(162 + 196, generator=torch.Generator().manual_seed(1)) * 0.5 + 0.4)
    scene = ball_over_floor(rough, mixed)
    glowing = replace(scene.regions[0], glow=ptt.Texture(torch.full((1, 1, 3), 2.0)))
    scene = replace(scene, regions=(glowing, scene.regions[1]))
    model = ptt.compress(ptt.precompute(scene, 1, resolution=16, rays=64))
    path = f"{tmp_path}/model.safetensors"
    model.save(path)
    views: list[dict[str, SurfaceMaterial]] = [
        scene.materials,
        {},
        {"floor": ptt.Mixed(ptt.lambert(0.2), ptt.lambert(0.4), 1 - share)},
    ]
    for given in views:
        one, two = (ptt.TransferRelighter(m)(SKY, given, scene.camera) for m in (model, ptt.TransferModel.load(path)))
        assert torch.equal(one, two)
    black = ptt.TransferRelighter(model)(ptt.Environment.constant(0.0), {}, scene.camera)
    assert black[scene.vertex_region == 0].unique().tolist() == [2.0] and not black[scene.vertex_region == 1].any()


def test_a_fixed_region_has_its_own_material_alone() -> None:
    share = torch.rand(6, 6, generator=torch.Generator().manual_seed(0))
    mixed = ptt.Mixed(ptt.lambert(0.1), ptt.lambert(0.9), share)
    scene = ball_over_floor(ptt.lambert(0.5), mixed, editable=False)
    relighter = ptt.TransferRelighter(ptt.compress(ptt.precompute(scene, 1, resolution=16, rays=64)))
    relighter(SKY, scene.materials, scene.camera)
    with pytest.raises(ValueError, match="region floor is fixed"):
        relighter(SKY, {"floor": ptt.Mixed(ptt.lambert(0.1), ptt.lambert(0.9), 1 - share)}, scene.camera)
    with pytest.raises(ValueError, match="region floor is fixed"):
        relighter(SKY, {"floor": ptt.lambert(0.1)}, scene.camera)
