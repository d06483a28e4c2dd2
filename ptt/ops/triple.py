"""Integrals of products of three functions, in the triangular or the square Haar basis (Ma et al. 2006, section 3.1).

    integral of F G H = sum over i, j, k of  C_ijk F_i G_j H_k        C_ijk = integral of Psi_i Psi_j Psi_k

The theorem: C is zero but in three cases.

1. The same scaling function thrice: 1.
2. The three types of wavelet of one triangle: A_l.
3. A wavelet twice, and a scaling function or a wavelet of a coarser level around it: A_l times the value, 1 or -1, that
   the coarser function has on the wavelet's triangle.

The sum goes triangle by triangle. With f, g, h the means of F, G, H over triangle (l, i), which are the values of all
coarser functions together there:

    integral = sum over roots of  f g h  +  sum over l, i of  A_l (D + E)
    D = sum over t of  F_t G_t h + F_t H_t g + G_t H_t f         E = sum over the six orders a, b, c of  F_a G_b H_c

Functions are coefficients (..., n) in the order of `ops.geodesic`; `from_square` brings those of `ops.haar` there.
Areas are nominal: 1 for each of the roots.

- The integral does not depend on the order of the three functions, and is linear in each.
- It equals `quadrature`, the sum over the finest triangles.
- Truncated after a level, it equals the quadrature on the triangles of that level.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ptt.ops import geodesic
from ptt.ops.constants import ROOTS
from ptt.ops.haar import Truncated

PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two of three functions, then the third
PERMUTED = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))  # the six orders of three types


def coefficient(i: int, j: int, k: int, roots: int = ROOTS) -> float:
    """C_ijk by the theorem, for basis functions at positions i, j, k of the coefficients."""
    (level, at, kind), second, third = sorted((_function(x, roots) for x in (i, j, k)), reverse=True)
    if level < 0:
        return float((level, at, kind) == second == third)
    if second[:2] != (level, at):
        return 0.0
    if third[:2] == (level, at):
        return 4.0**-level if {kind, second[2], third[2]} == {0, 1, 2} else 0.0
    return 4.0**-level * _value(third, level, at) if second[2] == kind else 0.0


def integral(f: Tensor, g: Tensor, h: Tensor, roots: int = ROOTS) -> Tensor:
    """The integrals (...) of products of three functions with coefficients (..., n), in O(n)."""
    means = [x[..., :roots] for x in (f, g, h)]
    total = (means[0] * means[1] * means[2]).sum(-1)
    signs = geodesic.SIGNS.to(f)
    area = 1.0
    first = roots
    while first < f.shape[-1]:
        d = [x[..., first : 4 * first].unflatten(-1, (-1, 3)) for x in (f, g, h)]
        twice = sum((d[a] * d[b]).sum(-1) * means[c] for a, b, c in PAIRS)
        thrice = sum(d[0][..., a] * d[1][..., b] * d[2][..., c] for a, b, c in PERMUTED)
        total = total + area * (twice + thrice).sum(-1)
        means = [(m[..., None] + x @ signs).flatten(-2) for m, x in zip(means, d, strict=True)]
        first = 4 * first
        area = area / 4
    return total


def quadrature(*values: Tensor, roots: int = ROOTS) -> Tensor:
    """The integrals (...) of products of any number of functions with values (..., t) on the triangles of a level."""
    product = values[0]
    for other in values[1:]:
        product = product * other
    return product.sum(-1) * (roots / product.shape[-1])


def adaptive(f: Truncated, g: Truncated, h: Truncated, n: int) -> Tensor:
    """The integrals (...) of products of three functions of which few coefficients (..., k) of n are kept."""
    return integral(f.to_dense(n), g.to_dense(n), h.to_dense(n))


def top_only(coefficients: Tensor, keep: int) -> Tensor:
    """Values (..., keep) on the triangles of the level that the first `keep` = 20 x 4^l coefficients (..., n) reach.

    The triple product of such values is `quadrature`, a weighted dot product of three.
    """
    return geodesic.synthesise(coefficients[..., :keep])


def from_square(coefficients: Tensor) -> Tensor:
    """Coefficients (..., n * n) in this module's order and scale, with one root, from those of `ops.haar` (..., n, n).

    The children of a square are its quarters, row by row; horizontal, vertical, diagonal details are types 1, 2, 0.
    """
    n = coefficients.shape[-1]
    parts = [coefficients[..., :1, 0] / n]
    h = 1
    while h < n:
        horizontal = coefficients[..., :h, h : 2 * h]
        vertical = coefficients[..., h : 2 * h, :h]
        diagonal = coefficients[..., h : 2 * h, h : 2 * h]
        three = torch.stack((diagonal, horizontal, vertical), -1).flatten(-3, -2)  # shape: (..., h * h, 3)
        parts.append((three[..., _quarters(h), :] * (h / n)).flatten(-2))
        h *= 2
    return torch.cat(parts, -1)


def _quarters(h: int) -> Tensor:
    """The squares (h * h,) of a grid, in the order of a tree of quarters."""
    order = torch.zeros(1, dtype=torch.int64)
    for k in range(h.bit_length() - 1):
        row = 2 * (order >> k)[:, None] + torch.tensor([0, 0, 1, 1])
        column = 2 * (order & (1 << k) - 1)[:, None] + torch.tensor([0, 1, 0, 1])
        order = (row * (2 << k) + column).flatten()
    return order


def _function(position: int, roots: int) -> tuple[int, int, int]:
    """Level (-1 for a scaling function), triangle and type of the basis function at a position."""
    if position < roots:
        return -1, position, 0
    level = int(math.log2(position // roots)) // 2
    at = position - (roots << 2 * level)
    return level, at // 3, at % 3


def _value(function: tuple[int, int, int], level: int, at: int) -> int:
    """The value of a basis function (`_function`) on a triangle of a finer level; 0 where the level is not finer."""
    own, triangle, kind = function
    if own < 0:
        return int(at >> 2 * level == triangle)
    if own >= level:
        return 0
    child = at >> 2 * (level - own - 1)
    return int(geodesic.SIGNS[kind, child % 4]) if child // 4 == triangle else 0
