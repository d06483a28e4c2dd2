"""Octahedral maps: exact measures, inverse, nesting, lookups without seams; oracles by counting directions."""

from __future__ import annotations

from math import pi

import pytest
import torch
from scipy.integrate import dblquad

from ptt.light.environment import Environment
from ptt.ops.octahedral import (
    HemiOctahedral,
    Octahedral,
    corners,
    hemi_octahedral,
    mix,
    octahedral,
    sampled,
    tiled_columns,
    tiled_rows,
    tiles,
)
from ptt.ops.sphere import Grid, LatLong

SPHERES = [Octahedral(2), Octahedral(4), Octahedral(16)]
HEMISPHERES = [HemiOctahedral(1), HemiOctahedral(2), HemiOctahedral(4), HemiOctahedral(5), HemiOctahedral(16)]
GRIDS: list[Grid] = [*SPHERES, *HEMISPHERES]
UPRIGHT = torch.tensor([1, 1, -1])


def random_directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    d = torch.randn(n, 3, dtype=torch.float64, generator=generator)
    return torch.nn.functional.normalize(d, dim=-1)


def great_circle(n: int, through: tuple[float, float, float], beside: tuple[float, float, float]) -> torch.Tensor:
    first, second = torch.linalg.qr(torch.tensor([through, beside], dtype=torch.float64).T).Q.T
    t = torch.arange(n, dtype=torch.float64)[:, None] * (2 * pi / n)
    circle: torch.Tensor = first * t.cos() + second * t.sin()
    return circle


def chart_of(grid: Grid, d: torch.Tensor) -> torch.Tensor:
    return octahedral(d) if isinstance(grid, Octahedral) else hemi_octahedral(d)


def smooth(d: torch.Tensor) -> torch.Tensor:
    """A function of unit directions whose gradient is at most 2.1."""
    x, y, z = d.unbind(-1)
    return x + torch.sin(2 * y + z) / 2 + x * z / 2


def lookup(grid: Grid, d: torch.Tensor) -> torch.Tensor:
    ab = chart_of(grid, d)
    index, weights = corners(ab, grid.shape[0], wrap=isinstance(grid, Octahedral))
    return (smooth(grid.directions()).flatten().to(d)[index] * weights).sum(-1)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_solid_angles_sum_to_the_sphere_or_the_hemisphere(grid: Grid) -> None:
    whole = 4 * pi if isinstance(grid, Octahedral) else 2 * pi
    assert grid.solid_angles().dtype == torch.float64
    assert grid.solid_angles().shape == grid.shape
    assert abs(float(grid.solid_angles().sum()) / whole - 1) < 1e-12
    assert (grid.solid_angles() > 0).all()


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_cell_inverts_directions(grid: Grid) -> None:
    d = grid.directions()
    numbers = torch.arange(grid.cells).view(grid.shape)
    assert d.shape == (*grid.shape, 3)
    assert torch.allclose(d.norm(dim=-1), torch.ones(grid.shape, dtype=torch.float64), atol=1e-14, rtol=0)
    assert torch.equal(grid.cell(d), numbers)
    assert torch.equal(grid.cell(1e-20 * d), numbers)
    assert torch.equal(grid.cell(d.float() * 1e10), numbers)
    if isinstance(grid, HemiOctahedral):
        assert (d[..., 2] > 0).all()
        assert torch.equal(grid.cell(d * UPRIGHT), numbers)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_refined_cells_nest(grid: Grid, k: int) -> None:
    fine = grid.refine(k)
    n = grid.shape[0]
    assert torch.allclose(grid.coarsen(fine.solid_angles(), k), grid.solid_angles(), rtol=1e-12, atol=0)
    d = random_directions(20_000)
    row = fine.cell(d) // (n * k)
    column = fine.cell(d) % (n * k)
    assert torch.equal(row // k * n + column // k, grid.cell(d))


@pytest.mark.parametrize("grid", [Octahedral(2), Octahedral(6), HemiOctahedral(3), HemiOctahedral(4)], ids=str)
def test_solid_angles_against_counts_of_lat_long_cells(grid: Grid) -> None:
    fine = LatLong(600, 1200)
    weights = fine.solid_angles().flatten() / (1 if isinstance(grid, Octahedral) else 2)
    counted = torch.bincount(grid.cell(fine.directions()).flatten(), weights, minlength=grid.cells)
    assert torch.allclose(counted.view(grid.shape), grid.solid_angles(), rtol=0, atol=1e-3)


def test_solid_angles_against_quadrature() -> None:
    """A cell with a fold inside, by the density 1 / |p|^3 of the sphere over the plane of x and y."""

    def upper(x: float, y: float) -> float:
        return float((x * x + y * y + (1 - abs(x) - abs(y)) ** 2) ** -1.5)

    half = dblquad(upper, 0.5, 1, lambda y: 0, lambda y: 1 - y, epsabs=1e-12)[0]  # z > 0; below, its mirror image
    assert float(Octahedral(4).solid_angles()[3, 2]) == pytest.approx(2 * half, abs=1e-10)
    sides = ((-1 / 3, 0), (0, 1 / 3))  # the cell in the middle, |x| + |y| < 1 / 3, has four faces
    middle = sum(
        dblquad(upper, *side, lambda y: abs(y) - 1 / 3, lambda y: 0, epsabs=1e-12)[0]
        + dblquad(upper, *side, lambda y: 0, lambda y: 1 / 3 - abs(y), epsabs=1e-12)[0]
        for side in sides
    )
    assert float(HemiOctahedral(3).solid_angles()[1, 1]) == pytest.approx(middle, abs=1e-10)


def test_charts_are_round_trips() -> None:
    a, b = (2 * torch.rand(2, 10_000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1).unbind(0)
    z = 1 - a.abs() - b.abs()
    inner = torch.stack((a, b, z), -1)
    outer = torch.stack(((1 - b.abs()) * a.sign(), (1 - a.abs()) * b.sign(), z), -1)
    ab = torch.stack((a, b), -1)
    d = torch.where(z[:, None] >= 0, inner, outer)
    assert torch.allclose(octahedral(d), ab, atol=1e-14, rtol=0)
    assert torch.allclose(octahedral(1e-5 * d), ab, atol=1e-14, rtol=0)
    x = (a + b) / 2
    y = (a - b) / 2
    d = torch.stack((x, y, 1 - x.abs() - y.abs()), -1)
    assert torch.allclose(hemi_octahedral(7 * d), ab, atol=1e-14, rtol=0)
    assert torch.equal(hemi_octahedral(d * UPRIGHT), hemi_octahedral(d))


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_charts_of_directions_are_the_centres_of_cells(grid: Grid) -> None:
    n = grid.shape[0]
    centre = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 / n) - 1
    b, a = torch.meshgrid(centre, centre, indexing="ij")
    assert torch.allclose(chart_of(grid, grid.directions()), torch.stack((a, b), -1), atol=1e-14, rtol=0)


def test_conventions() -> None:
    axes = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    assert octahedral(axes).tolist() == [[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]]
    assert hemi_octahedral(axes).tolist() == [[1, 1], [-1, -1], [1, -1], [-1, 1], [0, 0]]
    below = torch.tensor([[1.0, 1, -8], [-1, 1, -8], [1, -1, -8], [-1, -1, -8]])
    assert torch.equal(octahedral(below).sign(), below[:, :2])
    assert Octahedral(4).cell(below).tolist() == [15, 12, 3, 0]
    assert octahedral(torch.tensor([0.0, 0, -2])).abs().tolist() == [1, 1]
    assert Octahedral(4).cell(torch.tensor([0.9, 0.05, 0.05])) == 2 * 4 + 3  # a along columns, b along rows


@pytest.mark.parametrize("grid", [Octahedral(6), HemiOctahedral(3), HemiOctahedral(4)], ids=str)
def test_edges_corners_poles_and_signed_zeros_fall_in_a_cell_that_touches_them(grid: Grid) -> None:
    values = torch.tensor([-1.0, -0.5, -0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
    d = torch.cartesian_prod(values, values, values)
    d = d[(d != 0).any(-1)]
    cell = grid.cell(d)
    assert ((cell >= 0) & (cell < grid.cells)).all()
    unit = d / d.norm(dim=-1, keepdim=True)
    if isinstance(grid, HemiOctahedral):
        unit[:, 2] = unit[:, 2].abs()
    inside = grid.refine(16).directions().reshape(-1, 3)
    parent = grid.cell(inside)
    for direction, index in zip(unit, cell, strict=True):
        assert (inside[parent == index] @ direction).max() > 0.998


@pytest.mark.parametrize("grid", [Octahedral(4), HemiOctahedral(5)], ids=str)
def test_means_integrate_a_smooth_function_and_do_not_depend_on_the_chunks(grid: Grid) -> None:
    """z^2 integrates to a third of the whole; z to pi on the hemisphere, to 0 on the sphere."""

    def heights(d: torch.Tensor) -> torch.Tensor:
        return torch.stack((d[..., 2], d[..., 2] ** 2, torch.ones_like(d[..., 2])), -1)

    means = grid.means(heights, 16)
    whole = float(grid.solid_angles().sum())
    assert means.shape == (*grid.shape, 3)
    assert torch.allclose(means, grid.means(heights, 16, chunk=100), atol=1e-6)
    assert torch.allclose(means[..., 2], torch.ones(grid.shape), atol=1e-6)
    integral = torch.einsum("rcf,rc->f", means.double(), grid.solid_angles())
    expected = [0.0 if isinstance(grid, Octahedral) else pi, whole / 3, whole]
    assert torch.allclose(integral, torch.tensor(expected, dtype=torch.float64), atol=5e-3)


@pytest.mark.parametrize("grid", [Octahedral(8), HemiOctahedral(7)], ids=str)
def test_environments_are_projected(grid: Grid) -> None:
    constant = Environment.constant((1.0, 2.0, 3.0)).project(grid)
    assert torch.allclose(constant, torch.tensor([1.0, 2.0, 3.0]).expand(*grid.shape, 3), rtol=1e-5)
    light = Environment.area_light((0.5, -0.3, 0.8), radius=10.0)
    integral = torch.einsum("rcx,rc->x", light.project(grid).double(), grid.solid_angles())
    assert torch.allclose(integral, light.integral().double(), rtol=5e-3)


@pytest.mark.parametrize("wrap", [True, False])
def test_corners_are_cells_with_weights_that_sum_to_one(wrap: bool) -> None:
    edge = torch.linspace(-1, 1, 41, dtype=torch.float64)
    ab = torch.cartesian_prod(edge, edge)
    index, weights = corners(ab, 6, wrap)
    assert index.shape == weights.shape == (41 * 41, 4) and index.dtype == torch.int64
    assert ((index >= 0) & (index < 36)).all() and (weights >= 0).all()
    assert torch.allclose(weights.sum(-1), torch.ones(41 * 41, dtype=torch.float64), atol=1e-14, rtol=0)


def test_corners_beyond_an_edge_are_mirrored_or_repeated() -> None:
    top_left = torch.tensor([-1.0, -1.0])
    left = torch.tensor([-1.0, -0.75])  # of 4 x 4 cells
    assert sorted(corners(top_left, 4, wrap=True)[0].tolist()) == [0, 3, 12, 15]
    assert corners(left, 4, wrap=True)[0].tolist()[:2] == [12, 0]
    assert corners(left.flip(0), 4, wrap=True)[0].tolist()[::2] == [3, 0]
    assert corners(-left, 4, wrap=True)[0].tolist()[:2] == [15, 3]
    assert corners(top_left, 4, wrap=False)[0].tolist() == [0, 0, 0, 0]
    assert corners(left, 4, wrap=False)[0].tolist()[:2] == [0, 0]


def test_samples_are_corners_mixed() -> None:
    """Of two tables, to their edges and beyond."""
    generator = torch.Generator().manual_seed(0)
    tables = torch.rand(2, 3, 6, 6, dtype=torch.float64, generator=generator)
    ab = 2.2 * torch.rand(2, 2, 50, dtype=torch.float64, generator=generator) - 1.1
    for table, at, found in zip(tables, ab, sampled(tables, ab), strict=True):
        wanted = mix(table.flatten(1).T, *corners(at.T, 6, wrap=False))
        assert torch.allclose(found.T, wanted, atol=1e-14, rtol=0)


@pytest.mark.parametrize("n", [4, 12])
def test_places_in_tiles_are_those_of_rows_and_columns(n: int) -> None:
    at = torch.arange(n, dtype=torch.float32)
    places = tiled_rows(at, n)[:, None] + tiled_columns(at)
    assert torch.equal(places.flatten().long(), tiles(n))


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_lookups_at_the_centres_of_cells_are_exact(grid: Grid) -> None:
    assert torch.allclose(lookup(grid, grid.directions()), smooth(grid.directions()), atol=1e-13, rtol=0)


@pytest.mark.parametrize("n", [8, 32, 128])
@pytest.mark.parametrize("sphere", [True, False])
def test_lookups_along_great_circles_follow_the_function_without_a_jump(sphere: bool, n: int) -> None:
    """Along the edges of the square through -z, across them, along the horizon's fold, and over all faces."""
    steps = 20_000
    grid = Octahedral(n) if sphere else HemiOctahedral(n)
    for axes in (((0, 0, 1), (1, 0, 0)), ((0, 0, 1), (0.3, 0.7, 0)), ((1, 0, 0), (0, 1, 0)), ((1, 2, 3), (-2, 1, 0.5))):
        d = great_circle(steps, *axes)
        upper = d if sphere else torch.cat((d[:, :2], d[:, 2:].abs()), -1)
        found = lookup(grid, d)
        assert (found - smooth(upper)).abs().max() < 2 / n
        assert (found - found.roll(1)).abs().max() < 3 * (2 * pi / steps)


def test_functions_keep_the_type_and_the_device_and_have_no_control_flow() -> None:
    d = random_directions(1000)
    for chart, wrap in ((octahedral, True), (hemi_octahedral, False)):
        index, weights = corners(chart(d.float()), 16, wrap)
        assert chart(d.float()).dtype == weights.dtype == torch.float32
        assert torch.allclose(chart(d.float()).double(), chart(d), atol=1e-6)
        table = torch.rand(256, dtype=torch.float64)
        exact_index, exact_weights = corners(chart(d), 16, wrap)
        found = (table[index] * weights.double()).sum(-1)
        assert torch.allclose(found, (table[exact_index] * exact_weights).sum(-1), atol=1e-5)
        index, weights = corners(chart(torch.empty(5, 7, 3, device="meta")), 16, wrap)  # has no values to look at
        assert index.shape == weights.shape == (5, 7, 4) and weights.device.type == "meta"
        assert torch.autograd.gradcheck(chart, d[:20].clone().requires_grad_())


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [float("nan"), 0, 1], [1, float("inf"), 0]])
@pytest.mark.parametrize("grid", [Octahedral(2), HemiOctahedral(2)], ids=str)
def test_directions_without_a_direction_are_refused(grid: Grid, bad: list[float]) -> None:
    with pytest.raises(ValueError, match="1 of 2 are not"):
        grid.cell(torch.tensor([[1.0, 0, 0], bad]))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        grid.cell(torch.ones(4, 2))


def test_empty_and_odd_maps_are_refused() -> None:
    for n in (-2, 0, 1, 3):
        with pytest.raises(ValueError, match="even and at least 2"):
            Octahedral(n)
    for make in (lambda: HemiOctahedral(0), lambda: HemiOctahedral(1).refine(0), lambda: Octahedral(2).refine(0)):
        with pytest.raises(ValueError, match="at least 1"):
            make()


def test_samples_have_tangents() -> None:
    """Forward derivatives, which torch's own lookup lacks, are what reverse ones are; values are the same."""
    g = torch.Generator().manual_seed(5)
    tables = torch.rand(2, 3, 5, 4, generator=g, dtype=torch.float64)
    ab = torch.rand(2, 2, 40, generator=g, dtype=torch.float64) * 2.4 - 1.2
    tangent = torch.rand(2, 2, 40, generator=g, dtype=torch.float64)
    values, forward = torch.func.jvp(lambda at: sampled(tables, at), (ab,), (tangent,))[:2]
    assert torch.allclose(values, sampled(tables, ab))
    at = ab.clone().requires_grad_()
    lit = sampled(tables, at)
    direction = torch.rand(lit.shape, generator=g, dtype=torch.float64)
    (reverse,) = torch.autograd.grad((lit * direction).sum(), at)
    assert torch.allclose((forward * direction).sum(), (reverse * tangent).sum())
