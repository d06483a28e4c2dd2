"""Interpolation between scattered points: exact for linear functions, nearest outside of the hull."""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from torch import Tensor

from ptt.ops.simplices import Simplices


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def grid(n: int) -> Tensor:
    """Cells that grow: long triangles, and many points on one line."""
    x = 0.03 * 30 ** torch.linspace(0, 1, n, dtype=torch.float64)
    return torch.cartesian_prod(x, x)


CLOUDS = {
    "line": random(9, 1) * 200,
    "unordered-line": torch.tensor([[3.0], [-1.0], [7.0], [0.5]]),
    "plane": random(30, 2, seed=1) * torch.tensor([1.0, 1e-3]),
    "grid": grid(8),
    "triangle": torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 5.0]]),
}


@pytest.mark.parametrize("points", CLOUDS.values(), ids=CLOUDS)
def test_linear_functions_are_reproduced_inside(points: Tensor) -> None:
    """Convex combinations of the points lie inside: sum of w p = p is what makes a + b . x exact for every a and b."""
    simplices = Simplices(points)
    mixed = random(100, len(points), seed=2) ** 8
    for point in (mixed / mixed.sum(1, keepdim=True)) @ points.double():
        weights = simplices.weights(point)
        assert weights.dtype == torch.float64 and weights.shape == (len(points),)
        assert bool((weights >= 0).all()) and int((weights > 0).sum()) <= 2 ** points.shape[1]
        assert float(weights.sum()) == pytest.approx(1, abs=1e-12)
        reached = weights @ points.double()
        assert bool(((reached - point).abs() <= 1e-9 * points.double().abs().amax(0)).all())


@pytest.mark.parametrize("points", CLOUDS.values(), ids=CLOUDS)
def test_a_point_weighs_itself(points: Tensor) -> None:
    simplices = Simplices(points)
    for h, point in enumerate(points):
        assert float(simplices.weights(point)[h]) == pytest.approx(1, abs=1e-6)


def test_a_grid_is_bilinear() -> None:
    """In whatever order the pairs come: the product of the weights along both axes, beyond the border its nearest."""
    shuffle = torch.tensor([4, 0, 5, 2, 1, 3])
    x = torch.tensor([1.0, 2.0, 5.0])
    y = torch.tensor([0.0, 10.0])
    points = torch.cartesian_prod(x, y)[shuffle]
    along = {1.25: [0.75, 0.25, 0], 4.0: [0, 1 / 3, 2 / 3], 9.0: [0, 0, 1], 0.0: [1, 0, 0]}
    up = {3.0: [0.7, 0.3], -2.0: [1, 0], 11.0: [0, 1]}
    for (a, wa), (b, wb) in product(along.items(), up.items()):
        expected = torch.outer(torch.tensor(wa), torch.tensor(wb)).flatten()[shuffle].double()
        assert torch.allclose(Simplices(points).weights(torch.tensor([a, b])), expected, atol=1e-7)


def test_beyond_a_line_its_end() -> None:
    line = Simplices(torch.tensor([[3.0], [-1.0], [7.0]]))
    assert line.weights(torch.tensor([-50.0])).tolist() == [0, 1, 0]
    assert line.weights(torch.tensor([7.1])).tolist() == [0, 0, 1]


def test_beyond_a_plane_the_nearest_in_parts_of_the_range() -> None:
    """The triangle (0, 0), (1, 0), (0, 5). In parts of the range, (1, 5) is (1, 1), and the middle of the long side is
    the nearest; (0.3, -2) falls on the lower side at 0.3; beyond a corner, the corner."""
    triangle = Simplices(CLOUDS["triangle"])
    assert triangle.weights(torch.tensor([1.0, 5.0])).tolist() == pytest.approx([0, 0.5, 0.5])
    assert triangle.weights(torch.tensor([0.3, -2.0])).tolist() == pytest.approx([0.7, 0.3, 0])
    assert triangle.weights(torch.tensor([-1.0, -1.0])).tolist() == pytest.approx([1, 0, 0])


def test_beyond_a_plane_nothing_in_the_hull_is_nearer() -> None:
    points = CLOUDS["plane"]
    simplices = Simplices(points)
    scale = points.amax(0) - points.amin(0)
    mixed = random(4000, len(points), seed=3) ** 30
    inside = (mixed / mixed.sum(1, keepdim=True)) @ points / scale
    for turn in range(12):
        outside = points.mean(0) + scale * torch.tensor([math.cos(turn / 2), math.sin(turn / 2)])
        reached = simplices.weights(outside) @ points
        distance = (reached / scale - outside / scale).norm()
        assert float(distance) <= float((inside - outside / scale).norm(dim=1).min()) + 1e-9
        assert torch.allclose(simplices.weights(reached) @ points, reached, rtol=1e-6)


@pytest.mark.parametrize("point", [[0.0], [1e9], [-2.0]])
def test_a_single_point_stands_for_everything(point: list[float]) -> None:
    assert Simplices(torch.tensor([[2.0]])).weights(torch.tensor(point)).tolist() == [1]
    assert Simplices(torch.tensor([[2.0, 3.0]])).weights(torch.tensor(point * 2)).tolist() == [1]


@pytest.mark.parametrize(("points", "at"), [(CLOUDS["line"], [70.0]), (grid(4), [0.2, 0.5]), (grid(4), [0.2, 3.0])])
def test_gradients(points: Tensor, at: list[float]) -> None:
    point = torch.tensor(at, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(Simplices(points).weights, (point,), eps=1e-7)


@pytest.mark.parametrize(("points", "message"), [
    (torch.tensor([[0.0, 0.0], [1.0, 1e-4], [3.0, 3e-4]], dtype=torch.float64), "must not lie on one line"),
    (torch.tensor([[0.0, 1.0], [0.5, 1.0], [3.0, 1.0]]), "must not lie on one line"),
    (torch.tensor([[0.0], [math.nan]]), r"points must be finite \(h, 1\) or \(h, 2\)"),
    (torch.tensor([[0.0, 1.0], [1.0, math.inf], [0.0, 0.0]]), "points must be finite"),
    (torch.zeros(4, 3), r"got \(4, 3\)"),
    (torch.zeros(0, 2), r"got \(0, 2\)"),
    (torch.zeros(3), r"got \(3,\)"),
    (torch.tensor([[1.0], [2.0], [1.0]]), "points must differ"),
])  # fmt: skip
def test_refusals(points: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Simplices(points)
