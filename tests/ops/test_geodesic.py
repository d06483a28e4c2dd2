"""The icosahedral grid and its Haar basis: laws of grids, of the transform, of the norms."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt.ops import geodesic
from ptt.ops.geodesic import Geodesic

LEVELS = range(6)


def directions(count: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1)


@pytest.mark.parametrize("level", LEVELS)
def test_solid_angles_sum_to_the_sphere(level: int) -> None:
    solid = Geodesic(level).solid_angles()
    assert len(solid) == 20 * 4**level and float(solid.min()) > 0
    assert float(solid.sum()) == pytest.approx(4 * math.pi, rel=1e-12)
    assert float(Geodesic(level).ratios().mean()) == pytest.approx(1, rel=1e-12)


def test_the_icosahedron() -> None:
    """Twelve vertices, twenty equal faces, thirty edges of one length, counter-clockwise."""
    corners = Geodesic(0).corners()
    vertices = (corners.reshape(-1, 3) * 1e6).round().unique(dim=0)
    assert len(vertices) == 12
    a, b, c = corners.unbind(1)
    edges = torch.cat([(a - b).norm(dim=1), (b - c).norm(dim=1), (c - a).norm(dim=1)])
    torch.testing.assert_close(edges, edges[:1].expand(60))
    assert bool(((torch.linalg.cross(b - a, c - a) * a).sum(1) > 0).all())


@pytest.mark.parametrize("level", range(4))
def test_children_nest_and_the_first_is_in_the_middle(level: int) -> None:
    grid = Geodesic(level)
    fine = Geodesic(level + 1)
    torch.testing.assert_close(grid.coarsen(fine.solid_angles(), 2), grid.solid_angles(), rtol=1e-12, atol=0)
    parts = fine.corners().unflatten(0, (-1, 4))
    torch.testing.assert_close(parts[:, 1:].diagonal(dim1=1, dim2=2).movedim(-1, 1), grid.corners())
    middles = parts.sum(2)
    middles = middles / middles.norm(dim=-1, keepdim=True)
    nearest = (middles * grid.directions()[:, None]).sum(-1).argmax(1)
    assert not bool(nearest.any())


@pytest.mark.parametrize("level", LEVELS)
def test_cells_of_the_middles(level: int) -> None:
    grid = Geodesic(level)
    assert grid.cell(grid.directions() * 3.0).tolist() == list(range(grid.cells))


@pytest.mark.parametrize("level", [0, 2, 4])
def test_cells_hold_their_directions(level: int) -> None:
    """A direction lies on the inner side of its triangle's three edges; one on an edge may belong to either."""
    grid = Geodesic(level)
    d = torch.cat((directions(500), grid.corners()[:40, 0], torch.eye(3).double(), -torch.eye(3).double()))
    corners = grid.corners()[grid.cell(d)]
    inside = torch.einsum("nkx,nx->nk", torch.linalg.cross(corners, corners.roll(-1, 1)), d)
    assert float(inside.min()) > -1e-12
    assert grid.cell(d.reshape(-1, 2, 3)).shape == (len(d) // 2, 2)


def test_refuses_directions() -> None:
    with pytest.raises(ValueError, match="finite and non-zero"):
        Geodesic(1).cell(torch.zeros(2, 3))
    for level in (-1, 10):
        with pytest.raises(ValueError, match=r"level must be in 0\.\.9"):
            Geodesic(level)


@pytest.mark.parametrize("level", LEVELS)
def test_transform_and_back(level: int) -> None:
    values = torch.randn(2, 20 * 4**level, dtype=torch.float64)
    coefficients = geodesic.analyse(values)
    torch.testing.assert_close(geodesic.synthesise(coefficients), values, rtol=1e-12, atol=1e-12)
    energy = (coefficients.square() * geodesic.areas(level)).sum(1)
    torch.testing.assert_close(energy, values.square().sum(1) / 4**level, rtol=1e-12, atol=0)  # |f|^2, areas nominal


def test_basis_functions_are_those_of_the_paper() -> None:
    """Level 1: a scaling function is 1 on four triangles, the wavelets have the signs + - - +, + - + -, + + - -."""
    basis = geodesic.synthesise(torch.eye(80, dtype=torch.float64))
    assert basis[3].nonzero()[:, 0].tolist() == [12, 13, 14, 15]
    assert basis[20 + 3 * 3 : 20 + 3 * 4, 12:16].tolist() == [[1, -1, -1, 1], [1, -1, 1, -1], [1, 1, -1, -1]]
    gram = basis @ basis.T / 4
    torch.testing.assert_close(gram, torch.diag(geodesic.areas(1)), rtol=0, atol=1e-14)


def test_truncation_keeps_the_means() -> None:
    """The first 20 x 4^l coefficients are the means over the triangles of level l."""
    values = torch.randn(20 * 4**4, dtype=torch.float64)
    few = geodesic.synthesise(geodesic.analyse(values)[: 20 * 4**2])
    torch.testing.assert_close(few, values.reshape(320, 16).mean(1), rtol=1e-12, atol=1e-12)


def test_wrong_lengths_are_refused() -> None:
    for n in (0, 19, 40, 79, 20 * 64 - 1):
        with pytest.raises(ValueError, match="20, 80, 320"):
            geodesic.analyse(torch.zeros(n))


def test_projects_an_environment() -> None:
    """A constant exactly; a sky to its integral."""
    grid = Geodesic(3)
    flat = ptt.Environment.constant((1.0, 2.0, 3.0)).project(grid)
    torch.testing.assert_close(flat, torch.tensor([1.0, 2.0, 3.0]).expand(grid.cells, 3), rtol=1e-5, atol=0)
    sky = ptt.Environment.sun_sky(radius=10.0)
    total = (sky.project(grid) * grid.solid_angles()[:, None]).sum(0)
    torch.testing.assert_close(total.float(), sky.integral(), rtol=0.01, atol=0)
