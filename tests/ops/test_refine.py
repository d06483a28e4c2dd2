"""Triangles with short edges: no edge is too long, nothing is lost, no cracks, and few pieces."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ptt.ops import mesh, refine


def fan(count: int = 100) -> tuple[Tensor, Tensor]:
    """Slivers of length 1 around a point."""
    turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    rim = torch.stack((turns.cos(), torch.zeros_like(turns), -turns.sin()), 1)
    k = torch.arange(count)
    return torch.cat((torch.zeros(1, 3).double(), rim)), torch.stack(
        (torch.zeros_like(k), 1 + k, 1 + (k + 1) % count), 1
    )


MESHES = {
    "slivers": fan(),
    "plane": mesh.plane_mesh(1.0, 1),
    "ball": mesh.sphere_mesh(2, 1.0),
    "plates": mesh.box_mesh((4.0, 0.05, 1.0)),
}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("edge", [0.07, 0.3, 10.0])
def test_edges_are_short_and_nothing_is_lost(name: str, edge: float) -> None:
    """Areas and fronts stay; every edge inside has a face on either side, so that there is no vertex amid an edge."""
    vertices, faces = MESHES[name]
    finer, pairs = refine.refined(vertices, faces, edge, 10**6)
    placed = refine.interpolated(vertices.double(), pairs)
    corners = placed[finer]
    assert float((corners - corners.roll(-1, 1)).norm(dim=2).max()) <= max(edge, 3.0 if edge > 4 else 0) + 1e-9
    whole = mesh.face_crosses(vertices, faces)
    pieces = mesh.face_crosses(placed, finer)
    torch.testing.assert_close(pieces.norm(dim=1).sum(), whole.norm(dim=1).sum(), rtol=1e-6, atol=0)
    torch.testing.assert_close(pieces.sum(0), whole.sum(0), rtol=1e-5, atol=1e-6)
    assert bool((pieces.norm(dim=1) > 0).all()) and len(placed) == len(finer.unique())

    def border(of: Tensor, at: Tensor) -> float:
        """The length of the edges that have a face on one side."""
        ends = torch.stack((of, of.roll(-1, 1)), 2).reshape(-1, 2).sort(1).values
        edges, counts = torch.unique(ends, dim=0, return_counts=True)
        a, b = at.double()[edges[counts == 1]].unbind(1)
        return float((a - b).norm(dim=1).sum())

    assert border(finer, placed) == pytest.approx(border(faces, vertices), rel=1e-6)


def test_slivers_become_strips() -> None:
    """Of length 1 at edges of 0.1: 16 steps on either side, 31 triangles each; cut in four they were 81."""
    finer, _ = refine.refined(*fan(), 0.1, 10**6)
    assert len(finer) <= 100 * 33


def test_squares_become_about_as_many_as_their_area_needs() -> None:
    """Right triangles with a hypotenuse of 0.1 have an area of 0.0025: 400 fill the unit square, and halving 512."""
    finer, _ = refine.refined(*mesh.plane_mesh(1.0, 1), 0.1, 10**6)
    assert len(finer) <= 512


def test_both_sides_of_a_seam_are_cut_alike() -> None:
    """Two triangles that share the places of an edge, not its vertices."""
    v = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0], [0, -3, 0]], dtype=torch.float64)
    finer, pairs = refine.refined(v, torch.tensor([[0, 1, 2], [3, 4, 5]]), 0.11, 10**6)
    placed = refine.interpolated(v, pairs)
    on = torch.nonzero(placed[:, 1] == 0)[:, 0]
    places, counts = placed[on[torch.isin(on, finer)]].unique(dim=0, return_counts=True)
    assert len(places) == 17 and counts.tolist() == [2] * 17


def test_too_many_are_refused() -> None:
    with pytest.raises(ValueError, match=r"edge = 0\.001 makes more than 1000 triangles"):
        refine.refined(*mesh.plane_mesh(1.0, 1), 0.001, 1000)
