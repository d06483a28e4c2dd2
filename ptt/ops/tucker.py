"""Tucker decomposition: a dense tensor as a small core times one orthonormal factor per axis.

    A[a, b, c] ~ sum over i, j, k of core[i, j, k] U[a, i] V[b, j] W[c, k]          (Sun et al. 2007, equation 2)

A factor holds the leading eigenvectors of the Gram matrix of its axis. Gram matrices square the condition number, so
they are float64 whatever the input is; an axis longer than all others together is first reduced by QR, in float64 too.
Each axis may lose |A|^2 error^2 / ndim, and the losses add up to at most |A|^2 error^2.
"""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

Method = Literal["hosvd", "st-hosvd", "hooi"]
"""hosvd: every factor from the tensor itself (De Lathauwer et al. 2000, SIAM J. Matrix Anal. Appl. 21, page 1253).
st-hosvd: shortest axis first, each on what the axes before it left (Vannieuwenhoven et al. 2012); the fastest.
hooi: then each axis on the projection on all others, until the core stops growing (De Lathauwer, same volume, 1324)."""

Slices = Sequence[Tensor] | Tensor  # A[k] (n2, .., nk): a list, a memory-mapped tensor, an object that computes them
_MAX_SWEEPS = 50
_MIN_GAIN = 1e-8  # of hooi; the gain of the core's norm, relative
_CHUNK = 1 << 22  # elements that are float64 at a time: 32 MiB


class Tucker(NamedTuple):
    """core (r1, .., rk) and one factor (n, r) per axis; the decompositions below have orthonormal columns."""

    core: Tensor
    factors: tuple[Tensor, ...]

    def to_dense(self) -> Tensor:
        """The tensor (n1, .., nk) that the decomposition stands for."""
        return multiply(self.core, self.factors)

    def to_tensorly(self) -> Any:
        """tensorly's TuckerTensor, two axes or more, of the same torch tensors: evaluate it under backend "pytorch"."""
        from tensorly.tucker_tensor import TuckerTensor  # slow to import

        return TuckerTensor((self.core, list(self.factors)))

    @classmethod
    def from_tensorly(cls, tucker_tensor: Any) -> Tucker:
        """From a TuckerTensor of numpy arrays or torch tensors, whose memory it shares; factors stay as they are."""
        core, factors = tucker_tensor
        return cls(torch.as_tensor(core), tuple(torch.as_tensor(factor) for factor in factors))

    @classmethod
    def checked(cls, tucker_tensor: Any, shape: Sequence[int | None], like: Tensor, name: str) -> Tucker:
        """From a TuckerTensor of that shape, at any ranks from 1, in the type and on the device of `like`.

        shape: the length of every axis, None for any

        Raises:
            ValueError: it is none, has another shape, core and factors do not fit, or a value is not finite; the
                message starts with the name.
        """
        try:
            core, factors = tucker_tensor
            parts = [torch.as_tensor(part).to(like) for part in (core, *factors)]
        except (TypeError, ValueError) as error:
            kind = type(tucker_tensor).__name__
            raise ValueError(f"{name} must be a TuckerTensor, a pair (core, factors), got {kind}") from error
        fit = cls(parts[0], tuple(parts[1:]))
        shapes = [tuple(factor.shape) for factor in fit.factors]
        ranks = tuple(fit.core.shape)
        fits = len(shape) == len(shapes) == len(ranks) and 0 not in ranks
        lengths = [len(factor) if n is None else n for n, factor in zip(shape, fit.factors, strict=False)]
        if not fits or shapes != list(zip(lengths, ranks, strict=True)):
            raise ValueError(
                f"{name} must be a TuckerTensor of shape {tuple(shape)}, with a factor (n, r) per axis of its core, "
                f"got factors {shapes} and a core {ranks}"
            )
        if not all(bool(part.isfinite().all()) for part in parts):
            raise ValueError(f"{name} must be finite")
        return fit

    def orthonormal(self, axes: Iterable[int]) -> Tucker:
        """The same tensor with orthonormal factors (n, min(n, r)) of some axes; those that are so stay, to rounding."""
        core = self.core
        factors = list(self.factors)
        for axis in axes:
            basis, rest = torch.linalg.qr(factors[axis].double())
            sign = torch.where(rest.diagonal() < 0, -1.0, 1.0)
            factors[axis] = (basis * sign).to(core.dtype)
            core = torch.tensordot((sign[:, None] * rest).to(core.dtype), core, ([1], [axis])).movedim(0, axis)
        return Tucker(core, tuple(factors))


def decompose(
    tensor: Tensor, *, ranks: Sequence[int] | None = None, error: float | None = None, method: Method = "st-hosvd"
) -> Tucker:
    """Decompose a dense tensor by given ranks, or by a relative error with the smallest ranks within its shares.

    ranks: one per axis, 1..length; above the true rank the rest of the core is zero
    error: bound on |A - approximation| / |A| in the Frobenius norm, in (0, 1); the rest of a zero tensor is zero

    - error of hooi <= error of st-hosvd <= sqrt(ndim) times the best possible, and so is that of hosvd
    - scaling the tensor scales the core and leaves the factors
    - the bound holds to the rounding of the dtype, for errors above 1e-7, the root of the Gram matrices' rounding

    Raises:
        ValueError: not one of ranks and error, one out of range, an unknown method, or a tensor that is not finite.
    """
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {method!r}")
    wanted = _checked_ranks(tuple(tensor.shape), ranks, error)
    scale = _magnitude(tensor) or 1.0
    unit = tensor / scale
    square = float(torch.linalg.vector_norm(unit, dtype=torch.float64)) ** 2 if error else 0.0
    fit = _hosvd(unit, wanted, (error or 0.0) ** 2 * square / tensor.ndim, sequential=method != "hosvd")
    fit = _alternate(unit, fit) if method == "hooi" else fit
    return Tucker(fit.core * scale, fit.factors)


def decompose_slices(slices: Slices, *, ranks: Sequence[int] | None = None, error: float | None = None) -> Tucker:
    """Decompose a tensor larger than memory: hosvd of the trailing axes, then the first axis on what they left.

    Slices are asked for twice, the first one three times, and held one at a time, beside a scaled copy, the Gram
    matrices (n, n) of the trailing axes and the cores (n1, r2, .., rk). Arguments, bounds and errors of `decompose`.
    """
    if not len(slices):
        raise ValueError("slices must not be empty")
    first = slices[0]
    dtype = first.dtype
    shape = (len(slices), *first.shape)
    grams = [first.new_zeros(n, n, dtype=torch.float64) for n in first.shape]
    del first  # before the next one is asked for
    head, *wanted = _checked_ranks(shape, ranks, error)
    scale = 0.0
    for k in range(len(slices)):
        scale = _add_slice(grams, slices[k], scale)
    budget = (error or 0.0) ** 2 * float(grams[0].trace()) / len(shape)
    factors = [_principal(gram, rank, budget).to(dtype) for gram, rank in zip(grams, wanted, strict=True)]
    cores = torch.stack([_project(slices[k], factors, range(len(factors))) for k in range(len(slices))])
    factor = _leading(cores / (scale or 1.0), 0, head, budget)
    return Tucker(_project(cores, [factor], [0]), (factor, *factors))


def relative_error(fit: Tucker, tensor: Slices) -> float:
    """|A - fit| / |A| of a tensor (n1, .., nk), dense or by slices, from the residual itself in float64.

    A zero tensor gives 0 for a zero fit, else inf; ValueError if the tensor does not have the shape of the fit.
    """
    core, (head, *factors) = fit.core.double(), [factor.double() for factor in fit.factors]
    shape = (len(tensor), *tensor[0].shape)
    expected = tuple(len(factor) for factor in fit.factors)
    if shape != expected:
        raise ValueError(f"tensor must have the shape {expected} of the fit, got {shape}")
    rows = (multiply(torch.tensordot(row, core, dims=1), factors) for row in head)
    norms = torch.stack([_norms(tensor[k], row) for k, row in enumerate(rows)])
    residual, size = norms.norm(dim=0).tolist()
    return residual / size if size else math.inf if residual > 0 else residual


def multiply(core: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """core (r1, .., rk) times a matrix (n, r) on every axis -> (n1, .., nk)."""
    small = string.ascii_lowercase[: core.ndim]
    large = string.ascii_uppercase[: core.ndim]
    pairs = (a + b for a, b in zip(large, small, strict=True))
    return torch.einsum(f"{','.join((small, *pairs))}->{large}", core, *factors)


def _hosvd(tensor: Tensor, ranks: Sequence[int | None], budget: float, sequential: bool) -> Tucker:
    core = tensor
    factors = [tensor] * tensor.ndim
    for axis in sorted(range(tensor.ndim), key=lambda k: tensor.shape[k]):
        factors[axis] = _leading(core if sequential else tensor, axis, ranks[axis], budget)
        core = _project(core, factors, [axis])
    return Tucker(core, tuple(factors))


def _alternate(tensor: Tensor, fit: Tucker) -> Tucker:
    core, (*factors,) = fit
    for _ in range(_MAX_SWEEPS):
        before = float(core.double().norm())
        for axis, rank in enumerate(core.shape):
            rest = _project(tensor, factors, (k for k in reversed(range(tensor.ndim)) if k != axis))
            factors[axis] = _leading(rest, axis, rank, 0.0)
            core = _project(rest, factors, [axis])
        if float(core.double().norm()) - before <= _MIN_GAIN * before:
            break
    return Tucker(core, tuple(factors))


def _checked_ranks(shape: tuple[int, ...], ranks: Sequence[int] | None, error: float | None) -> Sequence[int | None]:
    """The rank of every axis, None where the error decides."""
    if (ranks is None) == (error is None):
        raise ValueError("give either ranks or error")
    if error is not None and not 0 < error < 1:
        raise ValueError(f"error must be in (0, 1), got {error}")
    if ranks is None:
        return [None] * len(shape)
    if len(ranks) != len(shape) or not all(1 <= r <= n for r, n in zip(ranks, shape, strict=True)):
        raise ValueError(f"ranks must be in 1..length for the axes {shape}, got {tuple(ranks)}")
    return ranks


def _magnitude(tensor: Tensor) -> float:
    """The power of two at or below the largest magnitude, by which dividing is exact; 0 for a zero tensor."""
    if not (tensor.is_floating_point() and tensor.numel() and tensor.ndim):
        raise ValueError(f"tensor must be floating point, with axes, not empty, got {tensor.dtype} {[*tensor.shape]}")
    largest = max(abs(float(end)) for end in torch.aminmax(tensor))
    if not math.isfinite(largest):
        raise ValueError("tensor must be finite")
    return math.ldexp(1.0, math.frexp(largest)[1] - 1) if largest else 0.0


def _add_slice(grams: list[Tensor], part: Tensor, scale: float) -> float:
    """Add the Gram matrices of a slice to those of A / scale; the new scale, the largest magnitude so far."""
    if part.shape != (lengths := tuple(len(gram) for gram in grams)):
        raise ValueError(f"slices must have the same shape {lengths}, got {tuple(part.shape)}")
    largest = max(scale, _magnitude(part))
    unit = part / (largest or 1.0)
    for axis, gram in enumerate(grams):
        gram.mul_((scale / (largest or 1.0)) ** 2).add_(_gram(unit, axis))
    return largest


def _norms(part: Tensor, fit: Tensor) -> Tensor:
    """|slice - fit| and |slice|."""
    part = part.double()
    return torch.stack([(part - fit).norm(), part.norm()])


def _leading(core: Tensor, axis: int, rank: int | None, budget: float) -> Tensor:
    """The factor (n, r) of one axis, by its rank or else by the budget of its squared loss."""
    rows = core.movedim(axis, 0)
    if (others := rows[0].numel()) >= len(rows):
        return _principal(_gram(core, axis), rank, budget).to(core.dtype)
    padded = torch.nn.functional.pad(rows.reshape(-1, others).double(), (0, max(0, (rank or 1) - others)))
    basis, small = torch.linalg.qr(padded)
    return torch.matmul(basis, _principal(small @ small.T, rank, budget)).to(core.dtype)


def _gram(tensor: Tensor, axis: int) -> Tensor:
    """The Gram matrix (n, n) of one axis, float64."""
    length = tensor.shape[axis]
    blocks = tensor.reshape(math.prod(tensor.shape[:axis]), length, -1)
    split = 0 if blocks.shape[0] > 1 else 2
    gram = tensor.new_zeros(length, length, dtype=torch.float64)
    for part in blocks.split(max(1, _CHUNK * blocks.shape[split] // blocks.numel()), dim=split):
        rows = part.double().movedim(1, 0).reshape(length, -1)
        gram += rows @ rows.T
    return gram


def _principal(gram: Tensor, rank: int | None, budget: float) -> Tensor:
    """The leading eigenvectors: by the rank, else the fewest whose rest is within the budget, at least one."""
    values, vectors = torch.linalg.eigh(gram)
    rank = rank or max(1, int((values.clamp(min=0).cumsum(0) > budget).sum()))
    return torch.flip(vectors[:, -rank:], [1]).contiguous()


def _project(core: Tensor, factors: Sequence[Tensor], axes: Iterable[int]) -> Tensor:
    """The coefficients of the axes, one after the other, by products that spare copies of a large core."""
    place = -min(2, core.ndim)
    for axis in axes:
        core = (factors[axis].T @ core.movedim(axis, place)).movedim(place, axis)
    return core
