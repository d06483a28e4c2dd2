"""Tucker decomposition: a dense tensor as a small core times one orthonormal factor per axis.

    A[a, b, c] ~ sum over i, j, k of core[i, j, k] U[a, i] V[b, j] W[c, k]          (Sun et al. 2007, equation 2)

Sequentially truncated HOSVD (Vannieuwenhoven 2012): each axis is projected on the leading eigenvectors of its
Gram matrix before the next one is looked at, shortest axis first. Gram matrices square the condition number, so
they are float64 whatever the input is.
"""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Tucker(NamedTuple):
    """core (r1, .., rk) and one factor (n, r) per axis with orthonormal columns."""

    core: Tensor
    factors: tuple[Tensor, ...]

    def to_dense(self) -> Tensor:
        """The tensor (n1, .., nk) that the decomposition stands for."""
        return multiply(self.core, self.factors)


def decompose(tensor: Tensor, *, ranks: Sequence[int] | None = None, error: float | None = None) -> Tucker:
    """Decompose a dense tensor by given ranks, or with the smallest ranks that meet a relative error.

    ranks: one per axis, 1..length
    error: bound on |A - approximation| / |A| in the Frobenius norm, in (0, 1); the rest of a zero tensor is zero

    Raises:
        ValueError: not exactly one of ranks and error is given, one is out of range, or the tensor is not finite.
    """
    ranks = _checked_ranks(tensor, ranks, error)
    core = tensor
    scale = float(tensor.abs().max()) or 1.0
    budget = ((error or 0.0) * float((tensor.double() / scale).norm())) ** 2 / tensor.ndim
    factors = [tensor.new_zeros(0)] * tensor.ndim
    for axis in sorted(range(tensor.ndim), key=lambda k: tensor.shape[k]):
        values, vectors = _spectrum(core / scale, axis)
        rank = ranks[axis] if ranks else _rank_within(values, budget)
        factors[axis] = vectors[:, :rank].to(tensor.dtype)
        core = _project(core, factors[axis], axis)
    return Tucker(core, tuple(factors))


def multiply(core: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """core (r1, .., rk) times a matrix (n, r) on every axis -> (n1, .., nk)."""
    small, large = string.ascii_lowercase[: core.ndim], string.ascii_uppercase[: core.ndim]
    pairs = ",".join(a + b for a, b in zip(large, small, strict=True))
    return torch.einsum(f"{small},{pairs}->{large}", core, *factors)


def _checked_ranks(tensor: Tensor, ranks: Sequence[int] | None, error: float | None) -> Sequence[int] | None:
    if (ranks is None) == (error is None):
        raise ValueError("give either ranks or error")
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError("tensor must be finite")
    if error is not None and not 0 < error < 1:
        raise ValueError(f"error must be in (0, 1), got {error}")
    if ranks is not None and (
        len(ranks) != tensor.ndim or not all(1 <= r <= n for r, n in zip(ranks, tensor.shape, strict=True))
    ):
        raise ValueError(f"ranks must be in 1..length for the axes {tuple(tensor.shape)}, got {tuple(ranks)}")
    return ranks


def _spectrum(tensor: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Eigenvalues, descending, and eigenvectors of the Gram matrix of one axis, float64."""
    length = tensor.shape[axis]
    gram = torch.zeros(length, length, dtype=torch.float64, device=tensor.device)
    for part in tensor.movedim(axis, 0).reshape(length, -1).split(1 << 16, dim=1):
        gram += part.double() @ part.double().T
    values, vectors = torch.linalg.eigh(gram)
    return values.flip(0).clamp(min=0), vectors.flip(1)


def _rank_within(values: Tensor, budget: float) -> int:
    """The fewest leading eigenvalues whose rest sums to at most the budget, at least one."""
    rest = values.flip(0).cumsum(0).flip(0)
    return max(1, int((rest > budget).sum()))


def _project(core: Tensor, factor: Tensor, axis: int) -> Tensor:
    projected: Tensor = torch.tensordot(core, factor, dims=([axis], [0]))
    return projected.movedim(-1, axis)
