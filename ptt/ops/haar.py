"""Two-dimensional Haar wavelets on square grids (cube faces, octahedral maps) and their non-linear truncation.

Orthonormal, so that `(analyse(a) * analyse(b)).sum() == (a * b).sum()`: a lighting's coefficients times a
transfer's coefficients integrate the product of the two. Non-standard decomposition: rows and columns are halved
together. The coefficients lie in Mallat's order: [0, 0] is the mean (times n), and the 2^j x 2^j blocks
right of, below and diagonally below it hold the horizontal, vertical and diagonal details of level j.

Example:
    >>> x = torch.randn(6, 64, 64)
    >>> bool(torch.allclose(synthesise(analyse(x)), x, atol=1e-5))
    True
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

RUN = 32  # numbers in a row that are asked for their largest first: a trial of 16, 32 and 64 on T0


def analyse(values: Tensor) -> Tensor:
    """Coefficients (..., n, n) of values (..., n, n); n is a power of two.

    Raises:
        ValueError: the last two axes are not equal powers of two.
    """
    out = torch.empty_like(values)
    n = _side(values)
    while n > 1:
        top = values[..., 0::2, :]
        bottom = values[..., 1::2, :]
        s = top + bottom
        d = top - bottom
        h = n // 2
        out[..., :h, h:n] = (s[..., 0::2] - s[..., 1::2]) / 2
        out[..., h:n, :h] = (d[..., 0::2] + d[..., 1::2]) / 2
        out[..., h:n, h:n] = (d[..., 0::2] - d[..., 1::2]) / 2
        values = (s[..., 0::2] + s[..., 1::2]) / 2
        n = h
    out[..., :1, :1] = values
    return out


def analyse_coarsely(values: Tensor, side: int) -> Tensor:
    """The coarsest coefficients (..., side, side) of values (..., n, n), `analyse(values)[..., :side, :side]`, from the
    sums of blocks alone."""
    k = _side(values) // side
    blocks = avg_pool2d(values.flatten(0, -3)[:, None], k, divisor_override=k)
    return analyse(blocks.reshape(*values.shape[:-2], side, side))


def synthesise(coefficients: Tensor) -> Tensor:
    """Values (..., n, n) of coefficients (..., n, n): the inverse, and the transpose, of `analyse`."""
    n = _side(coefficients)
    values = coefficients[..., :1, :1]
    h = 1
    while h < n:
        a = values
        b = coefficients[..., :h, h : 2 * h]
        c = coefficients[..., h : 2 * h, :h]
        d = coefficients[..., h : 2 * h, h : 2 * h]
        top = torch.stack((a + b + c + d, a - b + c - d), -1).flatten(-2)
        bottom = torch.stack((a + b - c - d, a - b - c + d), -1).flatten(-2)
        values = torch.stack((top, bottom), -2).flatten(-3, -2) / 2
        h *= 2
    return values


class Truncated(NamedTuple):
    """The k largest of l coefficients.

    indices (..., k) int32: positions in 0..l-1, ascending
    values (..., k): the coefficients there
    """

    indices: Tensor
    values: Tensor

    def to_dense(self, length: int) -> Tensor:
        """The coefficients (..., length), with zeros where none was kept."""
        dense = self.values.new_zeros(*self.values.shape[:-1], length)
        return dense.scatter(-1, self.indices.long(), self.values)


def truncate(coefficients: Tensor, keep: int, weights: Tensor | None = None) -> Truncated:
    """Non-linear approximation of coefficients (..., l): the `keep` largest magnitudes, the best in the L2 norm.

    weights (l,): factors >= 0 on the magnitudes; default 1. Where they are the standard deviations that the other
        factor of a product is expected to have in each coefficient, the choice is the best for the product

    Raises:
        ValueError: keep is not in 1..l.
    """
    length = coefficients.shape[-1]
    if not 1 <= keep <= length:
        raise ValueError(f"keep must be in 1..{length}, got {keep}")
    if keep == length:
        return Truncated(torch.arange(length, dtype=torch.int32).expand(coefficients.shape), coefficients)
    magnitude = coefficients.abs() if weights is None else coefficients.abs().mul_(weights)
    indices = _largest(magnitude, keep).sort(dim=-1).values
    return Truncated(indices.int(), coefficients.gather(-1, indices))


def _largest(values: Tensor, keep: int) -> Tensor:
    """Positions (..., keep) of the largest of values (..., l): all are in the `keep` runs with the largest ones."""
    if values.shape[-1] % RUN or keep * RUN >= values.shape[-1]:
        return values.topk(keep, dim=-1, sorted=False).indices
    runs = values.unflatten(-1, (-1, RUN)).amax(-1).topk(keep, dim=-1, sorted=False).indices
    near = (RUN * runs[..., None] + torch.arange(RUN, device=values.device)).flatten(-2)
    best = values.gather(-1, near).topk(keep, dim=-1, sorted=False).indices
    found: Tensor = near.gather(-1, best)
    return found


def support(n: int) -> Tensor:
    """Side of the square (n, n) on which each basis function differs from zero, as a share of the grid's, float64."""
    side = torch.ones(n, dtype=torch.float64)
    for level in range(n.bit_length() - 1):
        first = 1 << level
        side[first : 2 * first] = 1 / first
    return torch.minimum(side, side[:, None])


def _side(values: Tensor) -> int:
    """The side n of values (..., n, n), checked."""
    rows, columns = values.shape[-2:]
    if rows != columns or rows & (rows - 1) or rows == 0:
        raise ValueError(f"the last two axes must be equal powers of two, got {rows} x {columns}")
    return rows
