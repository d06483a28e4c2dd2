"""Triple products: every coefficient of the theorem by enumeration, integrals against the dense quadrature."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from ptt.ops import geodesic, haar, native, triple


def functions(count: int, level: int, seed: int = 0) -> Tensor:
    """Values (count, 20 x 4^level)."""
    g = torch.Generator().manual_seed(seed)
    return torch.randn(count, 20 << 2 * level, generator=g, dtype=torch.float64)


def subtree(level: int) -> list[int]:
    """Positions of all basis functions on the first root and a neighbour's scaling function, to a level."""
    found = [0, 1]
    for own in range(level):
        first = 20 << 2 * own
        found += list(range(first, first + 3 * 4**own))
    return found


@pytest.mark.parametrize("level", range(4))
def test_every_case_and_every_zero(level: int) -> None:
    """C_ijk of all triples on one root by the theorem, against the integral of the three functions on the triangles."""
    positions = subtree(level)
    basis = geodesic.synthesise(torch.eye(20 << 2 * level, dtype=torch.float64)[positions])
    exact = torch.einsum("it,jt,kt->ijk", basis, basis, basis) / 4**level
    triples = itertools.combinations_with_replacement(range(len(positions)), 3)
    seen = set()
    for i, j, k in triples:
        got = triple.coefficient(positions[i], positions[j], positions[k])
        assert got == pytest.approx(float(exact[i, j, k]), abs=1e-13)
        seen.add(got)
    assert seen == {0.0, 1.0} | {s * 4.0**-own for own in range(level) for s in (1, -1) if own or s > 0}


def test_coefficients_do_not_depend_on_the_order() -> None:
    for i, j, k in ((0, 20, 20), (20, 21, 22), (20, 80, 80), (21, 85, 85), (1, 23, 23), (5, 5, 5)):
        values = {triple.coefficient(*order) for order in itertools.permutations((i, j, k))}
        assert len(values) == 1 and values != {0.0}


@pytest.mark.parametrize("level", range(6))
def test_dense_integral_is_the_quadrature(level: int) -> None:
    f, g, h = functions(3, level)
    got = triple.integral(geodesic.analyse(f), geodesic.analyse(g), geodesic.analyse(h))
    assert float(got) == pytest.approx(float(triple.quadrature(f, g, h)), abs=1e-12 * 20)
    assert float(got) == pytest.approx(float((f * g * h).sum() / 4**level), abs=1e-11)


def test_integral_is_the_sum_over_the_theorem() -> None:
    """Level 1, by all triples whose coefficient may not be zero."""
    f, g, h = (geodesic.analyse(x) for x in functions(3, 1, seed=3))
    total = 0.0
    for i, j, k in _likely(len(f)):
        total += triple.coefficient(i, j, k) * float(f[i] * g[j] * h[k])
    assert total == pytest.approx(float(triple.integral(f, g, h)), rel=1e-10)


def _likely(n: int) -> list[tuple[int, int, int]]:
    """Triples (i, j, k) of which two at least belong to one triangle: all others are zero by the theorem."""
    groups = [(x,) for x in range(20)] + [(x, x + 1, x + 2) for x in range(20, n, 3)]
    found = set()
    for group in groups:
        for a, b in itertools.product(group, repeat=2):
            for c in range(n):
                found |= {(a, b, c), (a, c, b), (c, a, b)}
    return sorted(found)


def test_symmetric_and_linear() -> None:
    f, g, h = (geodesic.analyse(x) for x in functions(3, 3))
    whole = triple.integral(f, g, h)
    for a, b, c in itertools.permutations((f, g, h)):
        torch.testing.assert_close(triple.integral(a, b, c), whole, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(triple.integral(2 * f + g, g, h), 2 * whole + triple.integral(g, g, h))


@pytest.mark.parametrize("level", range(4))
def test_top_only_is_the_quadrature_of_its_level(level: int) -> None:
    f, g, h = (geodesic.analyse(x) for x in functions(3, 4))
    keep = 20 << 2 * level
    a, b, c = (torch.cat((x[:keep], torch.zeros(len(x) - keep, dtype=x.dtype))) for x in (f, g, h))
    by_values = triple.quadrature(*(triple.top_only(x, keep) for x in (f, g, h)))
    torch.testing.assert_close(triple.integral(a, b, c), by_values, rtol=1e-12, atol=1e-12)


def test_adaptive_is_the_integral_of_what_is_kept() -> None:
    """The largest by magnitude times the root of the area: the best approximation for its number."""
    weights = geodesic.areas(3).sqrt()
    coefficients = geodesic.analyse(functions(3, 3))
    f, g, h = (haar.truncate(x, 100, weights) for x in coefficients)
    got = triple.adaptive(f, g, h, 1280)
    dense = f.to_dense(1280), g.to_dense(1280), h.to_dense(1280)
    torch.testing.assert_close(got, triple.integral(*dense), rtol=0, atol=0)
    values = triple.quadrature(*(geodesic.synthesise(x) for x in dense))
    torch.testing.assert_close(got, values, rtol=1e-12, atol=1e-12)
    lost = ((coefficients[0] - dense[0]) * weights).norm()
    top = ((coefficients[0][100:]) * weights[100:]).norm()
    assert float(lost) < float(top)


def test_constants_give_the_integral_of_the_third() -> None:
    """A constant light over the visible part: with `ratios` as one factor, its solid angle exactly."""
    grid = geodesic.Geodesic(4)
    visible = (grid.directions()[:, 2] > 0.3).double()
    light, seen, ratios = (geodesic.analyse(x) for x in (torch.ones(grid.cells).double(), visible, grid.ratios()))
    solid = float(triple.integral(light, seen, ratios)) * 4 * math.pi / 20
    assert solid == pytest.approx(float((visible * grid.solid_angles()).sum()), rel=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4, 16])
def test_square_haar_is_the_same_tree(n: int) -> None:
    """Three maps on a square grid: the mean of their product over cells is the integral, with one root of area 1."""
    g = torch.Generator().manual_seed(n)
    maps = torch.randn(3, 2, n, n, generator=g, dtype=torch.float64)
    a, b, c = (triple.from_square(haar.analyse(x)) for x in maps)
    wanted = (maps[0] * maps[1] * maps[2]).sum((-1, -2)) / n**2
    torch.testing.assert_close(triple.integral(a, b, c, roots=1), wanted, rtol=1e-12, atol=1e-12)
    assert triple.coefficient(1, 2, 3, roots=1) == 1.0 and triple.coefficient(0, 0, 0, roots=1) == 1.0


def test_products_of_more_functions() -> None:
    values = functions(5, 2)
    torch.testing.assert_close(triple.quadrature(*values), values.prod(0).sum() / 16, rtol=1e-12, atol=1e-13)


def test_batches_and_gradients() -> None:
    f, g, h = (geodesic.analyse(x) for x in functions(6, 1).reshape(3, 2, 80))
    batched = triple.integral(f, g, h)
    assert batched.shape == (2,)
    torch.testing.assert_close(batched[1], triple.integral(f[1], g[1], h[1]))
    torch.autograd.gradcheck(triple.integral, tuple(x.requires_grad_() for x in (f, g, h)))


@pytest.mark.parametrize("level", [0, 1, 3])
@pytest.mark.parametrize("keep", [1, 17, 80])
def test_adaptive_kernel(level: int, keep: int, built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    n = 20 << 2 * level
    g = torch.Generator().manual_seed(keep)
    three = [torch.randn(130, n, generator=g) for _ in range(3)]
    a, b, c = (haar.truncate(x, min(n, keep + k)) for k, x in enumerate(three))
    wanted = triple.adaptive(a, b, c, n)
    monkeypatch.setattr(triple, "adaptive", None)  # so that it cannot have been the plain one
    torch.testing.assert_close(native.adaptive(a, b, c, n), wanted, rtol=1e-4, atol=1e-3)


def test_what_the_adaptive_kernel_does_not_take_is_computed_plainly(built: None) -> None:
    a, b, c = (haar.truncate(torch.randn(4, 80).double(), 9) for _ in range(3))
    assert torch.equal(native.adaptive(a, b, c, 80), triple.adaptive(a, b, c, 80))


def test_coefficients_beyond_the_last_are_not_written_anywhere(built: None) -> None:
    kept = haar.truncate(torch.ones(2, 320), 320)
    with pytest.raises(RuntimeError, match="out of bounds"):
        native.adaptive(kept, kept, kept, 80)
