"""Grids: exact measures, inverse, nesting; oracles by numerical integration."""

from __future__ import annotations

from itertools import pairwise
from math import asin, pi, sqrt

import pytest
import torch
from scipy.integrate import quad

from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.sphere import Cube, Disk, Grid, LatLong

GRIDS = [LatLong(1, 2), LatLong(5, 12), LatLong(64, 128), Cube(1), Cube(7), Cube(64)]
DISKS = [Disk(1), Disk(2), Disk(7), Disk(32), Disk(101)]


def random_directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    d = torch.randn(n, 3, dtype=torch.float64, generator=generator)
    return torch.nn.functional.normalize(d, dim=-1)


def numbers(grid: Grid) -> torch.Tensor:
    return torch.arange(grid.cells).view(grid.shape)


@pytest.mark.parametrize("grid", [*GRIDS, *DISKS], ids=str)
def test_solid_angles_sum_to_the_sphere_or_the_hemisphere(grid: Grid) -> None:
    whole = 2 * pi if isinstance(grid, Disk) else 4 * pi
    assert grid.solid_angles().dtype == torch.float64
    assert grid.solid_angles().shape == grid.shape
    assert abs(float(grid.solid_angles().sum()) / whole - 1) < 1e-12
    assert (grid.solid_angles() >= 0).all()


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_cell_inverts_directions(grid: Grid) -> None:
    d = grid.directions()
    assert d.shape == (*grid.shape, 3)
    assert torch.allclose(d.norm(dim=-1), torch.ones(grid.shape, dtype=torch.float64), atol=1e-14, rtol=0)
    assert torch.equal(grid.cell(d), numbers(grid))
    assert torch.equal(grid.cell(1e-20 * d), numbers(grid))
    assert torch.equal(grid.cell(d.float() * 1e10), numbers(grid))


@pytest.mark.parametrize("grid", DISKS, ids=str)
def test_disk_cells_with_a_weight_invert_and_the_others_lie_on_the_horizon(grid: Disk) -> None:
    weighs = grid.projected_solid_angles() > 0
    d = grid.directions()
    assert torch.equal(weighs, grid.solid_angles() > 0)
    assert torch.equal(grid.cell(d)[weighs], numbers(grid)[weighs])
    assert torch.equal(grid.cell(d * torch.tensor([1, 1, -1]))[weighs], numbers(grid)[weighs])
    assert (d[weighs][:, 2] > 0).all()
    assert d.isfinite().all()
    assert (d[~weighs][:, 2].abs() < 1e-7).all()
    assert torch.allclose(d.norm(dim=-1), torch.ones(grid.shape, dtype=torch.float64), atol=1e-14, rtol=0)


@pytest.mark.parametrize("grid", [LatLong(6, 10), Cube(5), Disk(9)], ids=str)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_refined_cells_nest(grid: Grid, k: int) -> None:
    fine = grid.refine(k)
    assert torch.allclose(grid.coarsen(fine.solid_angles(), k), grid.solid_angles(), rtol=1e-12, atol=1e-15)
    d = random_directions(20_000)
    mask = torch.zeros(fine.cells, dtype=torch.float64).view(fine.shape)
    for cell in grid.cell(d[:20]):  # the k x k parts of a cell, marked, are what `coarsen` adds up
        parts = torch.nn.functional.one_hot(cell, grid.cells).view(grid.shape)
        mask = parts.repeat_interleave(k, -1).repeat_interleave(k, -2)
        assert torch.equal(grid.coarsen(mask, k), parts * k * k)
        assert torch.equal(mask.flatten()[fine.cell(d)].bool(), grid.cell(d) == cell)


@pytest.mark.parametrize("grid", [LatLong(5, 12), Cube(3), Octahedral(6), HemiOctahedral(5), Geodesic(2)], ids=str)
@pytest.mark.parametrize("k", [1, 2, 4])
def test_samples_lie_in_their_cells(grid: Grid, k: int) -> None:
    owner = torch.arange(grid.cells).repeat_interleave(k * k)
    assert torch.equal(grid.cell(grid.samples(k)), owner)


def test_coarsen_keeps_trailing_axes_and_refuses_other_shapes() -> None:
    values = torch.rand(6, 6, 6, 4)
    assert torch.allclose(Cube(2).coarsen(values, 3)[4, 1, 0, 2], values[4, 3:, :3, 2].sum())
    with pytest.raises(ValueError, match=r"refine\(2\)\.shape = \(6, 4, 4\)"):
        Cube(2).coarsen(values, 2)


@pytest.mark.parametrize("grid", [LatLong(4, 8), Cube(3), Disk(6)], ids=str)
def test_share_of_random_directions_is_the_share_of_solid_angle(grid: Grid) -> None:
    """Standard error of a share p of n samples: sqrt(p (1 - p) / n); five of them allow for all cells."""
    n = 400_000
    d = random_directions(400_000)
    if isinstance(grid, Disk):
        d[:, 2] = d[:, 2].abs()
    share = torch.bincount(grid.cell(d), minlength=grid.cells).view(grid.shape) / n
    expected = grid.solid_angles() / grid.solid_angles().sum()
    assert ((share - expected).abs() <= 5 * (expected * (1 - expected) / n).sqrt()).all()


def test_random_directions_lie_between_the_bounds_of_their_cell() -> None:
    d = random_directions(10_000)
    row = LatLong(16, 32).cell(d) // 32
    column = LatLong(16, 32).cell(d) % 32
    v = torch.acos(d[:, 1]) / pi * 16
    u = torch.atan2(d[:, 0], -d[:, 2]) / (2 * pi) % 1 * 32
    assert ((row <= v) & (v <= row + 1) & (column <= u) & (u <= column + 1)).all()
    row = Disk(10).cell(d) // 10
    column = Disk(10).cell(d) % 10
    y = (d[:, 1] + 1) * 5
    x = (d[:, 0] + 1) * 5
    assert ((row <= y) & (y <= row + 1) & (column <= x) & (x <= column + 1)).all()


def test_conventions() -> None:
    """Lat-long columns run from -Z over +X, +Z, -X; cube faces are +X -X +Y -Y +Z -Z."""
    axes = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    assert (Cube(3).cell(axes) == torch.arange(6) * 9 + 4).all()
    beside = torch.tensor([[0.1, 0.1, -1], [1, 0.1, 0.1], [-0.1, 0.1, 1], [-1, 0.1, -0.1]])
    assert LatLong(4, 8).cell(beside).tolist() == [8 + 0, 8 + 2, 8 + 4, 8 + 6]
    assert LatLong(4, 8).cell(axes[2:4]).tolist()[0] < 8
    assert LatLong(4, 8).cell(axes[2:4]).tolist()[1] >= 24
    right_down = torch.tensor([[1, -0.9, -0.9], [-1, -0.9, 0.9], [0.9, 1, 0.9],
                               [0.9, -1, -0.9], [0.9, -0.9, 1], [-0.9, -0.9, -1]])  # fmt: skip
    assert (Cube(3).cell(right_down) == torch.arange(6) * 9 + 8).all()
    assert Disk(4).cell(torch.tensor([0.6, -0.1, 0.5])) == 1 * 4 + 3


@pytest.mark.parametrize("grid", [LatLong(4, 8), Cube(4), Disk(4)], ids=str)
def test_edges_corners_poles_and_signed_zeros_fall_in_a_cell_that_touches_them(grid: Grid) -> None:
    values = torch.tensor([-1.0, -0.5, -0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
    d = torch.cartesian_prod(values, values, values)
    d = d[(d != 0).any(-1)]
    cell = grid.cell(d)
    assert ((cell >= 0) & (cell < grid.cells)).all()
    unit = d / d.norm(dim=-1, keepdim=True)
    if isinstance(grid, Disk):
        unit[:, 2] = unit[:, 2].abs()
    inside = grid.refine(16).directions().reshape(-1, 3)  # points of each cell, one of which must be close
    parent = grid.cell(inside)
    for direction, index in zip(unit, cell, strict=True):
        assert (inside[parent == index] @ direction).max() > (0.95 if isinstance(grid, Disk) else 0.998)


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [float("nan"), 0, 1], [1, float("inf"), 0]])
def test_directions_without_a_direction_are_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="1 of 2 are not"):
        Cube(2).cell(torch.tensor([[1.0, 0, 0], bad]))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        Cube(2).cell(torch.ones(4, 2))


def test_empty_grids_are_refused() -> None:
    for make in (lambda: Cube(0), lambda: Disk(0), lambda: LatLong(0, 2), lambda: Cube(1).refine(0)):
        with pytest.raises(ValueError, match="at least 1"):
            make()


def test_projected_solid_angles_sum_to_pi_and_are_even_inside() -> None:
    for grid in DISKS:
        weights = grid.projected_solid_angles()
        assert abs(float(weights.sum()) / pi - 1) < 1e-12
    corner = (torch.arange(102).double() * 2 / 101 - 1).abs()
    far = torch.hypot(torch.maximum(corner[1:], corner[:-1])[:, None], torch.maximum(corner[1:], corner[:-1]))
    assert torch.allclose(weights[far < 1], torch.tensor((2 / 101) ** 2, dtype=torch.float64), rtol=1e-11)


def test_disk_measures_against_quadrature() -> None:
    """Area of a cut cell: integral of the chord over x. Solid angle: integral of asin(y / sqrt(1 - x^2))."""
    grid = Disk(5)
    n = 5
    edge = [2 * i / n - 1 for i in range(n + 1)]

    def strip(i: int, j: int, measure: str) -> float:
        def across(x: float) -> float:
            rim = sqrt(1 - x * x)
            low, high = (min(max(y, -rim), rim) for y in (edge[i], edge[i + 1]))
            if measure == "area":
                return high - low
            return asin(high / rim) - asin(low / rim)

        kinks = [s * sqrt(1 - y * y) for y in edge[i : i + 2] for s in (-1, 1) if abs(y) < 1]
        inside = sorted({edge[j], edge[j + 1], *(x for x in kinks if edge[j] < x < edge[j + 1])})
        area: float = sum(quad(across, a, b, epsabs=1e-12)[0] for a, b in pairwise(inside))
        return area

    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (2, 2), (1, 0), (4, 3)):
        assert float(grid.projected_solid_angles()[i, j]) == pytest.approx(strip(i, j, "area"), abs=1e-9)
        assert float(grid.solid_angles()[i, j]) == pytest.approx(strip(i, j, "solid angle"), abs=1e-9)


def test_disk_coordinates_are_cell_numbers_at_the_centres() -> None:
    grid = Disk(8)
    inside = torch.zeros(8, 8, dtype=torch.bool)
    inside[2:6, 2:6] = True
    expected = torch.stack(torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij"), -1).double()
    assert torch.allclose(grid.coordinates(grid.directions())[inside], expected[inside], atol=1e-12)


@pytest.mark.parametrize("grid", [LatLong(6, 10), Cube(4), Disk(5)], ids=str)
def test_means_are_exact_on_constants_and_do_not_depend_on_the_chunks(grid: Grid) -> None:
    def wave(d: torch.Tensor) -> torch.Tensor:
        return torch.stack((d[..., 0] + 2 * d[..., 1] * d[..., 2], torch.ones_like(d[..., 0])), -1)

    whole = grid.means(wave, 8)
    strips = grid.means(wave, 8, chunk=100)
    assert whole.shape == (*grid.shape, 2)
    assert torch.allclose(whole, strips, atol=1e-6)
    assert torch.allclose(whole[..., 1], torch.ones(grid.shape), atol=1e-6)


def test_means_of_a_coordinate_against_its_closed_form() -> None:
    """On a cap cut in a lat-long row, the mean of y = cos t over [a, b] is (cos a + cos b) / 2."""
    edges = torch.cos(torch.linspace(0, pi, 7))
    means = LatLong(6, 4).means(lambda d: d[..., 1:2], 16)
    assert torch.allclose(means[..., 0], ((edges[1:] + edges[:-1]) / 2)[:, None].expand(-1, 4), atol=1e-3)
