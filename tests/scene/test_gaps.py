"""Vertices are added where surfaces almost touch, so that light that bounces there is right, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import ptt
from ptt.ops import mesh
from ptt.scene.parts import Part

GAP = 0.01
CELL = 0.25  # edges of the triangles, 25 times as long


def plates() -> ptt.Scene:
    """A slab that hovers over a floor, a 25th of an edge above it; the floor in two colours, with a map over it."""
    ground, squares = mesh.plane_mesh(2.0, int(2.0 / CELL))
    slab, sides = mesh.box_mesh((1.1, 0.3, 1.1), int(1.1 / CELL))
    slab = slab + torch.tensor([0.03, 0.15 + GAP, 0.02])
    colours = torch.where(ground[:, :1] > 0, torch.tensor([0.8, 0.4, 0.2]), torch.tensor([0.1, 0.2, 0.3]))
    floor = Part("floor", ground, squares, uv=ground[:, [0, 2]] / 2 + 0.5, colours=colours)
    scene = ptt.Scene.from_parts([floor, Part("slab", slab, sides, material=ptt.lambert(0.5))])
    share = (scene.vertices[:, 0] / 2 + 0.5).clamp(0, 1)
    return replace(scene, materials={**scene.materials, "floor": ptt.Mixed(ptt.lambert(0.2), ptt.ggx(1.0), share)})


def received(scene: ptt.Scene, rows: Tensor, exact: bool) -> Tensor:
    """What surfaces show vertices (r,) of a white sky over x > 0, (r,): where they are met, or by their corners."""
    generator = torch.Generator().manual_seed(5)
    local = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1).float()
    local = torch.nn.functional.normalize(local + torch.tensor([0.0, 0.0, 1.0]), dim=1)  # density of the cosine
    origins = scene.surface.offset(scene.points[rows], scene.normals[rows]).repeat_interleave(len(local), 0)
    hits = scene.surface.first_hit(origins, (local @ scene.frames[rows]).flatten(0, 1))
    met = torch.nonzero(hits.front)[:, 0]
    triangle, barycentric = hits.triangle[met], hits.barycentric[met]
    sent = torch.zeros(len(origins))
    if exact:
        positions = scene.interpolated(scene.vertices, triangle, barycentric)
        sent[met] = half_sky(scene, positions, scene.frames_at(triangle, barycentric)[:, 2])
    else:
        sent[met] = scene.interpolated(half_sky(scene, scene.points, scene.normals), triangle, barycentric)
    return sent.reshape(len(rows), -1).mean(1)


def half_sky(scene: ptt.Scene, positions: Tensor, normals: Tensor) -> Tensor:
    """The share (n,) of the light of a white sky over x > 0 that points receive."""
    generator = torch.Generator().manual_seed(6)
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=1).float()
    cosine = (normals @ directions.T).clamp(min=0)
    origins = scene.surface.offset(positions, normals).repeat_interleave(len(directions), 0)
    hidden = scene.surface.occluded(origins, directions.repeat(len(positions), 1)).reshape(cosine.shape)
    seen = cosine * ~hidden * (directions[:, 0] > 0)
    share: Tensor = seen.sum(1) / cosine.sum(1)
    return share


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return plates()


@pytest.fixture(scope="module")
def finer(scene: ptt.Scene) -> ptt.Scene:
    return ptt.finer_in_gaps(scene)


def test_what_points_see_in_gaps_is_right(scene: ptt.Scene, finer: ptt.Scene) -> None:
    def errors(of: ptt.Scene) -> Tensor:
        rows = torch.arange(len(of.vertices))
        return (received(of, rows, exact=False) - received(of, rows, exact=True)).abs()

    before, after = errors(scene), errors(finer)
    assert before.max() > 0.1
    assert after.max() < 0.05 and after.square().mean().sqrt() < 0.3 * before.square().mean().sqrt()
    assert len(finer.vertices) < 2.5 * len(scene.vertices)


def test_a_smaller_error_takes_more_vertices(scene: ptt.Scene, finer: ptt.Scene) -> None:
    assert len(scene.vertices) < len(ptt.finer_in_gaps(scene, 0.2).vertices) < len(finer.vertices)


def test_the_surface_stays_and_old_vertices_come_first(scene: ptt.Scene, finer: ptt.Scene) -> None:
    assert finer.regions == scene.regions and finer.camera == scene.camera
    assert bool((finer.vertex_region.diff() >= 0).all())
    names = ("vertices", "normals", "tangents", "colours", "uv")
    for region in range(len(scene.regions)):
        old, new = scene.vertex_region == region, finer.vertex_region == region
        for name in names:
            assert torch.equal(getattr(finer, name)[new][: int(old.sum())], getattr(scene, name)[old])

    def area(of: ptt.Scene, region: int) -> Tensor:
        a, b, c = of.vertices[of.faces[of.face_region == region]].double().unbind(1)
        areas: Tensor = torch.linalg.cross(b - a, c - a).norm(dim=1)
        assert bool((areas > 0).all())
        return areas.sum()

    for region in range(len(scene.regions)):
        torch.testing.assert_close(area(finer, region), area(scene, region), rtol=1e-6, atol=0)


def test_new_vertices_have_what_their_surface_has(scene: ptt.Scene, finer: ptt.Scene) -> None:
    """Positions on the floor say what uv and map there must be; a camera above sees the colours of the old scene."""
    floor = finer.vertex_region == 0
    at = finer.vertices[floor]
    assert finer.uv is not None
    torch.testing.assert_close(finer.uv[floor], at[:, [0, 2]] / 2 + 0.5, rtol=0, atol=1e-5)
    torch.testing.assert_close(finer.materials["floor"].maps[0][floor], at[:, 0] / 2 + 0.5, rtol=0, atol=1e-5)
    torch.testing.assert_close(finer.frames @ finer.frames.mT, torch.eye(3).expand(len(finer.vertices), 3, 3))
    down = torch.tensor([0.0, -1.0, 0.0]).expand(len(at), 3)
    above = (at * 0.99 + torch.tensor([0.0, 0.5 * GAP, 0.0])).double()
    hits = [of.surface.first_hit(above, down) for of in (scene, finer)]
    old, new = (of.albedo(h.triangle, h.barycentric) for of, h in zip((scene, finer), hits, strict=True))
    torch.testing.assert_close(new, old, rtol=0, atol=1e-4)


def test_nothing_is_added_where_there_are_no_gaps() -> None:
    scene = ptt.Scene.from_mesh(*mesh.sphere_mesh(2))
    assert torch.equal(ptt.finer_in_gaps(scene).faces, scene.faces)


def test_a_scene_file_asks_for_it(tmp_path: Path) -> None:
    file = tmp_path / "plates.toml"
    regions = """
        [[region]]
        name = "floor"
        plane = { size = 2.0, cells = 8 }
        [[region]]
        name = "slab"
        box = { size = [1.1, 0.3, 1.1], cells = 4 }
        translate = [0.03, 0.16, 0.02]
    """
    file.write_text(regions)
    without = ptt.load_scene(file)
    file.write_text("gaps = 0.1\n" + regions)
    assert len(ptt.load_scene(file).vertices) == len(ptt.finer_in_gaps(without, 0.1).vertices) > len(without.vertices)


@pytest.mark.parametrize("error", [0.0, -1.0, float("nan")])
def test_an_error_that_is_not_positive_is_refused(scene: ptt.Scene, error: float) -> None:
    with pytest.raises(ValueError, match="error must be > 0"):
        ptt.finer_in_gaps(scene, error)
