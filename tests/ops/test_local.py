"""Functions in local frames on triangles: against closed forms, and a product of three against the path tracer."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt import reference
from ptt.materials.shapes import is_mirror_symmetric
from ptt.ops import geodesic, local, mesh, rotation, triple
from ptt.ops.albedo import nodes
from ptt.ops.constants import ROOTS
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.raycast import Surface


def test_lambert_reflects_all() -> None:
    """Under light 1, with nothing hidden, what a white surface sends is 1."""
    for level in (0, 1, 3):
        grid = Geodesic(level)
        white = local.cosine(grid).double()
        assert float(triple.quadrature(white)) == pytest.approx(1.0, abs=0.01)
        below = grid.corners()[..., 2].amax(1) < 0
        assert not bool(white[below].any()) and bool((white[~below] >= 0).all())


def test_brdf_against_its_albedo() -> None:
    """The sum over triangles is the albedo, at every direction of view and every level."""
    from ptt.ops.albedo import albedo

    shape = ptt.BlinnPhong(30.0)
    wo = torch.nn.functional.normalize(torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [0.5, 0.5, 0.4]]).double(), dim=1)
    wanted = albedo(shape.evaluate, wo)
    for level, samples in ((1, 8), (2, 8), (4, 2)):
        table = local.brdf(shape.evaluate, Geodesic(level), wo, samples).double()
        torch.testing.assert_close(triple.quadrature(table), wanted, rtol=0.02, atol=0)


def test_an_open_sky_is_all_visible() -> None:
    """From the middle of a lone triangle all that lies above the horizon is seen, and nothing below."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2]])
    grid = Geodesic(2)
    seen = local.visibility(Surface(vertices, faces), torch.full((1, 3), 0.2), torch.eye(3)[None], grid, 4)[0]
    z = grid.corners()[..., 2]
    assert bool((seen[z.amin(1) > 0] == 255).all()) and not bool(seen[z.amax(1) < 0].any())
    lit = triple.quadrature(seen.double() / 255, local.cosine(grid).double())
    assert float(lit) == pytest.approx(1.0, abs=0.01)


def test_half_of_the_sky_behind_a_wall() -> None:
    """A tall wall at x = 0, looked at from close by, hides the half space behind it: half of the cosine is left."""
    wall = torch.tensor([[0.0, -1e3, -1e3], [0, 1e3, -1e3], [0, 1e3, 1e3], [0, -1e3, 1e3]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    grid = Geodesic(3)
    seen = local.visibility(Surface(wall, faces), torch.tensor([[0.5, 0.0, 0.0]]), torch.eye(3)[None], grid, 4)[0]
    lit = triple.quadrature(seen.double() / 255, local.cosine(grid).double())
    assert float(lit) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("level", "bound"), [(2, 0.06), (3, 0.03), (4, 0.02)])
def test_triple_product_against_the_path_tracer(small_scene: ptt.Scene, level: int, bound: float) -> None:
    """Shadows, a glossy and a dull material, a soft light: light rotated into each vertex's frame, times V, times F."""
    sky = ptt.Environment.sun_sky(radius=25.0)
    grid = Geodesic(level)
    index = torch.arange(0, len(small_scene.vertices), 5)
    frames = small_scene.frames[index]
    wo = small_scene.camera.toward(small_scene.points[index])
    seen = local.visibility(small_scene.surface, small_scene.points[index], frames, grid, 4).double() / 255
    values = sky.project(Octahedral(64)).reshape(-1, 3).double()
    s = rotation.resampling(Octahedral(64), grid, frames, 4)
    light = rotation.resample(values, s).reshape(len(index), grid.cells, 3)
    shape = ptt.BlinnPhong(12.0)
    material = ptt.Material((0.3, 0.4, 0.5), 0.4, shape)
    out = torch.einsum("vax,vx->va", frames, wo)
    glossy = torch.cat([local.brdf(shape.evaluate, grid, o[None]) for o in out]).double()
    dull = local.cosine(grid).double()
    kept = out[:, 2] > 0.05
    factors = material.diffuse.double() * dull[:, None] + material.specular.double() * glossy[..., None]
    got = triple.quadrature((light * factors).movedim(-1, 1), seen[:, None])
    points = reference.vertex_points(small_scene).take(index)
    given = {region.name: material for region in small_scene.regions}
    truth = reference.radiance(small_scene, sky, given, points, wo, samples=1024).mean
    assert ptt.relative_rmse(got[kept], truth[kept]) < bound
    shaded, shadow, one = (geodesic.analyse(x) for x in ((light * factors)[..., 0], seen, torch.ones_like(seen)))
    by_wavelets = triple.integral(shaded, shadow, one)
    torch.testing.assert_close(by_wavelets, got[:, 0], rtol=1e-9, atol=1e-12)


def test_refuses() -> None:
    with pytest.raises(ValueError, match="finite"):
        local.brdf(lambda wi, wo: wi[..., 0] * wo[..., 0] * math.nan, Geodesic(0), torch.tensor([[0.0, 0, 1]]))
    with pytest.raises(ValueError, match="power of two"):
        vertices, faces = mesh.sphere_mesh(0)
        local.visibility(Surface(vertices, faces), vertices, torch.eye(3).expand(12, 3, 3), Geodesic(0), 3)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("views", [5, 8])
@pytest.mark.parametrize("shape", [ptt.BlinnPhong(12.0), ptt.Ward(1.0, 0.7)], ids=["isotropic", "brushed"])
def test_table_of_a_brdf_is_mirrored(level: int, views: int, shape: ptt.BlinnPhong | ptt.Ward) -> None:
    """A quarter of it is sampled; the rest is what sampling gives, as the grid is its own mirror image."""
    grid = Geodesic(level)
    assert is_mirror_symmetric(shape)
    whole, quarter = (local.brdf_table(shape.evaluate, grid, views, some) for some in (False, True))
    torch.testing.assert_close(quarter, whole, rtol=1e-4, atol=1e-5)
    for axis in range(2):
        flip = torch.ones(3).double()
        flip[axis] = -1
        image = grid.cell(grid.directions() * flip)
        assert torch.equal(image.sort().values, torch.arange(grid.cells))
        torch.testing.assert_close(grid.directions()[image], grid.directions() * flip, rtol=0, atol=1e-12)


def test_a_narrow_table_is_mirrored() -> None:
    """To what nodes by the edges of triangles leave: they are not their own mirror image."""
    shape = ptt.Ward(0.03, 0.2)
    whole, quarter = (local.brdf_table(shape.evaluate, Geodesic(2), 8, some, narrow=True) for some in (False, True))
    assert float((quarter - whole).norm() / whole.norm()) < 0.02


@pytest.mark.parametrize("roughness", [0.03, 0.1, 0.2])
def test_a_lobe_narrower_than_triangles_reflects_all_that_it_does(roughness: float) -> None:
    """Under light of 1 from everywhere, by the albedo's own quadrature; samples alone are 5 % off and more."""
    grid = Geodesic(2)
    shape = ptt.GGX(1.0, roughness)
    wo = HemiOctahedral(12).directions().reshape(-1, 3)
    assert local.is_narrow(shape.evaluate, grid) and not local.is_narrow(ptt.GGX(1.0, 0.5).evaluate, grid)
    found = local.brdf_table(shape.evaluate, grid, 12, mirrored=True, narrow=True).sum(1) * (ROOTS / grid.cells)
    wi, weights = nodes(wo, 1e-5, 96, 64)
    exact = (shape.evaluate(wi, wo[:, None].expand_as(wi)) * weights).sum(1)
    steep = wo[:, 2] > 0.2
    torch.testing.assert_close(found[steep].double(), exact[steep], rtol=5e-3, atol=0)
    sampled = local.brdf(shape.evaluate, grid, wo).sum(1) * (ROOTS / grid.cells)
    assert float((sampled[steep] / exact[steep] - 1).square().mean().sqrt()) > 0.04


def test_a_narrow_lobe_lies_where_samples_have_it() -> None:
    """Between both ways of integration, where fine samples find the lobe too: triangle by triangle."""
    grid = Geodesic(2)
    shape = ptt.GGX(0.5, 0.3)
    wo = HemiOctahedral(12).directions().reshape(-1, 3)
    narrow = local.narrow_brdf(shape.evaluate, grid, 12, False, torch.arange(144), 4)
    sampled = local.brdf(shape.evaluate, grid, wo, 32)
    steep = wo[:, 2] > 0.3
    assert float((narrow - sampled)[steep].norm() / sampled[steep].norm()) < 0.05
