"""Tucker decomposition: exact where the rank allows it, near-best elsewhere, stable in scale; tensorly as a peer."""

from __future__ import annotations

import gc
import math
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import pytest
import tensorly
import torch
from tensorly.decomposition import partial_tucker
from torch import Tensor

from ptt.imaging.metrics import relative_rmse
from ptt.ops import tucker


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def decaying() -> Tensor:
    """A 12 x 20 x 30 tensor whose singular values fall by about two a step along each axis."""
    factors = [torch.linalg.qr(random(n, n, seed=n))[0] * 2.0 ** -torch.arange(n) for n in (12, 20, 30)]
    return tucker.multiply(random(12, 20, 30), factors)


METHODS: dict[str, Callable[..., tucker.Tucker]] = {
    method: lambda a, method=method, **how: tucker.decompose(a, method=method, **how)
    for method in get_args(tucker.Method)
} | {"slices": tucker.decompose_slices}
every_method = pytest.mark.parametrize("method", METHODS)
ROUNDING = {torch.float64: 1e-12, torch.float32: 1e-5}


def assert_orthonormal(fit: tucker.Tucker) -> None:
    for factor in fit.factors:
        eye = torch.eye(factor.shape[1], dtype=factor.dtype)
        assert torch.allclose(factor.T @ factor, eye, atol=ROUNDING[factor.dtype])


@every_method
@pytest.mark.parametrize("dtype", ROUNDING)
def test_low_rank_is_recovered_exactly_and_factors_are_orthonormal(method: str, dtype: torch.dtype) -> None:
    factors = [random(9, 2), random(11, 3, seed=1), random(13, 4, seed=2)]
    a = tucker.multiply(random(2, 3, 4), factors).to(dtype)
    fit = METHODS[method](a, ranks=(2, 3, 4))
    assert relative_rmse(fit.to_dense(), a) < ROUNDING[dtype]
    assert_orthonormal(fit)
    assert fit.core.shape == (2, 3, 4)
    assert {part.dtype for part in (fit.core, *fit.factors)} == {dtype}


@every_method
@pytest.mark.parametrize("shape, ranks", [((9, 11, 13), (5, 6, 7)), ((40, 5, 6), (40, 2, 2)), ((4, 3, 30), (1, 1, 30))])
def test_ranks_above_the_true_rank(method: str, shape: tuple[int, ...], ranks: tuple[int, ...]) -> None:
    """A rank one tensor at higher ranks, even above the product of the others: padded with zeros, not with NaN."""
    a = tucker.multiply(random(1, 1, 1), [random(n, 1, seed=n) for n in shape])
    fit = METHODS[method](a, ranks=ranks)
    assert fit.core.shape == ranks
    assert_orthonormal(fit)
    assert relative_rmse(fit.to_dense(), a) < 1e-13


@every_method
@pytest.mark.parametrize("shape", [(6, 9), (1, 8, 9), (4, 5, 6, 7)])
def test_full_rank_is_exact_for_any_number_of_axes(method: str, shape: tuple[int, ...]) -> None:
    a = random(*shape)
    fit = METHODS[method](a, ranks=shape)
    assert relative_rmse(fit.to_dense(), a) < 1e-13
    assert_orthonormal(fit)
    assert tucker.relative_error(fit, a) < 1e-13


@every_method
@pytest.mark.parametrize("error", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize("dtype", ROUNDING)
def test_error_is_met_and_not_by_far_too_much(method: str, error: float, dtype: torch.dtype) -> None:
    a = decaying().to(dtype)
    fit = METHODS[method](a, error=error)
    reached = relative_rmse(fit.to_dense(), a)
    assert error / 10 < reached <= error


def test_the_share_of_an_axis_in_the_error() -> None:
    """Three axes share the squared error: a diagonal tensor (10, 2, 1) loses 1 of 105 on the first axis it is cut on.

    error^2 |A|^2 / 3 >= 1 keeps two, which takes error >= sqrt(3 / 105) = 0.169.
    """
    a = torch.zeros(3, 3, 3, dtype=torch.float64)
    a[range(3), range(3), range(3)] = torch.tensor([10.0, 2.0, 1.0], dtype=torch.float64)
    for method in METHODS.values():
        assert method(a, error=0.168).core.shape == (3, 3, 3)
        assert method(a, error=0.170).core.shape == (2, 2, 2)


@pytest.mark.parametrize("a", [decaying(), random(12, 20, 30)], ids=["decaying", "noise"])
def test_order_of_the_errors(a: Tensor) -> None:
    """HOOI only improves on ST-HOSVD; each HOSVD is at most sqrt(3) worse than the best, which HOOI is not below."""
    errors = {m: relative_rmse(fit(a, ranks=(3, 4, 5)).to_dense(), a) for m, fit in METHODS.items()}
    (core, factors), _ = partial_tucker(a.numpy(), rank=[3, 4, 5], modes=[0, 1, 2], tol=1e-10, n_iter_max=200)
    peer = relative_rmse(torch.from_numpy(tensorly.tucker_to_tensor((core, factors))), a)
    assert errors["hooi"] == pytest.approx(peer, rel=1e-2)  # two local optima, from different starts
    assert errors["hooi"] < errors["st-hosvd"]
    for method in ("hosvd", "st-hosvd", "slices"):
        assert errors[method] <= math.sqrt(3) * errors["hooi"]


@every_method
@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e20, 1e30])
@pytest.mark.parametrize("dtype", ROUNDING)
def test_scale_does_not_matter(method: str, scale: float, dtype: torch.dtype) -> None:
    a = decaying().to(dtype)
    plain, scaled = (METHODS[method](x, ranks=(3, 4, 5)) for x in (a, a * scale))
    assert torch.allclose(scaled.to_dense() / scale, plain.to_dense(), atol=ROUNDING[dtype])
    assert tucker.relative_error(scaled, a * scale) == pytest.approx(tucker.relative_error(plain, a), rel=1e-5)
    assert METHODS[method](a * scale, error=0.01).core.shape == METHODS[method](a, error=0.01).core.shape


@pytest.mark.parametrize("scale", [1e-200, 1e200])
@every_method
def test_squares_may_leave_float64(method: str, scale: float) -> None:
    a = decaying()
    plain, scaled = (METHODS[method](x, ranks=(3, 4, 5)) for x in (a, a * scale))
    assert torch.allclose(scaled.to_dense() / scale, plain.to_dense(), atol=1e-12)


@pytest.mark.parametrize("powers", [(-30, 0, 30), (30, 0, -30), (0, 0, 0)], ids=str)
def test_slices_of_very_different_size(powers: tuple[int, ...]) -> None:
    """The Gram matrices are kept by the largest slice so far, whether it comes first or last; zeros do not matter."""
    a = torch.stack([random(8, 9, seed=k) * 10.0**power for k, power in enumerate(powers)] + [torch.zeros(8, 9)])
    fits = [tucker.decompose_slices(a, ranks=(2, 3, 4)), tucker.decompose_slices(a.flip(0), ranks=(2, 3, 4))]
    size = a.abs().max()
    assert torch.allclose(fits[0].to_dense() / size, fits[1].to_dense().flip(0) / size, atol=1e-12)


def test_slices_are_the_hosvd_of_the_trailing_axes() -> None:
    a = decaying()
    fit, whole = (METHODS[method](a, ranks=(3, 4, 5)) for method in ("slices", "hosvd"))
    for ours, theirs in zip(fit.factors[1:], whole.factors[1:], strict=True):
        assert torch.allclose(ours @ ours.T, theirs @ theirs.T, atol=1e-10)
    assert tucker.relative_error(fit, a) <= tucker.relative_error(whole, a)  # the first axis sees what they left
    assert relative_rmse(fit.to_dense(), whole.to_dense()) < 2 * tucker.relative_error(whole, a)


class CountedSlices(Sequence[Tensor]):
    """Slices computed on demand, which remembers the most that were alive at a time and how many were asked for."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor
        self.alive = 0
        self.most = 0
        self.asked = 0

    def __len__(self) -> int:
        return len(self.tensor)

    def __getitem__(self, k: int) -> Tensor:  # type: ignore[override]
        self.alive = self.alive + 1
        self.asked = self.asked + 1
        self.most = max(self.most, self.alive)
        part = self.tensor[k].clone()
        weakref.finalize(part, self.release)
        return part

    def release(self) -> None:
        self.alive -= 1


def test_one_slice_is_held_at_a_time() -> None:
    slices = CountedSlices(decaying())
    gc.disable()  # reference counts alone release them
    try:
        fit = tucker.decompose_slices(slices, error=0.01)
        assert (slices.most, slices.alive, slices.asked) == (1, 0, 2 * 12 + 1)
        assert tucker.relative_error(fit, slices) <= 0.01
        assert (slices.most, slices.alive, slices.asked) == (1, 0, 3 * 12 + 2)
    finally:
        gc.enable()


def test_relative_error_of_dense_and_sliced_tensors() -> None:
    a = decaying()
    fit = tucker.decompose(a, ranks=(3, 4, 5))
    expected = relative_rmse(fit.to_dense(), a)
    forms: list[tucker.Slices] = [a, list(a), CountedSlices(a)]
    for tensor in forms:
        assert tucker.relative_error(fit, tensor) == pytest.approx(expected, rel=1e-12)
    zero = torch.zeros_like(a)
    assert tucker.relative_error(fit, zero) == math.inf
    assert tucker.relative_error(tucker.decompose(zero, ranks=(1, 1, 1)), zero) == 0
    assert math.isnan(tucker.relative_error(fit, a * math.nan))
    for other in (a[1:], a[:, :1], a[0]):
        with pytest.raises(ValueError, match=r"tensor must have the shape \(12, 20, 30\) of the fit"):
            tucker.relative_error(fit, other)


def test_memory_mapped_tensor(tmp_path: Path) -> None:
    a = decaying().float()
    path = tmp_path / "tensor.bin"
    a.numpy().tofile(path)
    mapped = torch.from_file(str(path), size=a.numel(), dtype=torch.float32).reshape(a.shape)
    assert tucker.relative_error(tucker.decompose_slices(mapped, error=0.01), mapped) <= 0.01


@pytest.mark.parametrize("backend", ["numpy", "pytorch"])
def test_tensorly_round_trip(backend: str) -> None:
    """Tensorly evaluates our fit under pytorch; we take its fits from either backend."""
    a = decaying()
    fit = tucker.decompose(a, ranks=(3, 4, 5))
    back = tucker.Tucker.from_tensorly(fit.to_tensorly())
    assert all(x is y for x, y in zip((back.core, *back.factors), (fit.core, *fit.factors), strict=True))
    with tensorly.backend_context("pytorch"):
        assert torch.allclose(tensorly.tucker_to_tensor(fit.to_tensorly()), fit.to_dense(), atol=1e-12)
    with tensorly.backend_context(backend):
        theirs, _ = partial_tucker(tensorly.tensor(a.numpy()), rank=[3, 4, 5], modes=[0, 1, 2])
        dense = torch.as_tensor(tensorly.tucker_to_tensor(theirs))
    ours = tucker.Tucker.from_tensorly(theirs)
    assert ours.core.dtype == torch.float64
    assert torch.allclose(ours.to_dense(), dense, atol=1e-12)


def test_what_comes_from_tensorly_is_checked() -> None:
    """Numpy arrays of another type too; any length where None is asked for."""
    fit = tucker.decompose(decaying(), ranks=(3, 4, 5))
    arrays = fit.core.numpy(), [factor.numpy() for factor in fit.factors]
    like = torch.zeros(1)
    known: list[tuple[int | None, ...]] = [(12, 20, 30), (12, None, 30)]
    for shape in known:
        got = tucker.Tucker.checked(arrays, shape, like, "it")
        assert got.core.dtype == torch.float32
        assert relative_rmse(got.to_dense(), decaying()) == pytest.approx(tucker.relative_error(fit, decaying()), 1e-4)
    others: list[tuple[int | None, ...]] = [(12, 20), (12, 20, 31), (None, 20, 30, 1)]
    for shape in others:
        with pytest.raises(ValueError, match="it must be a TuckerTensor of shape"):
            tucker.Tucker.checked(arrays, shape, like, "it")
    empty = fit.core[:0], [fit.factors[0][:, :0], *fit.factors[1:]]
    with pytest.raises(ValueError, match=r"got factors .* and a core \(0, 4, 5\)"):
        tucker.Tucker.checked(empty, (12, 20, 30), like, "it")
    with pytest.raises(ValueError, match="it must be finite"):
        tucker.Tucker.checked((fit.core * math.inf, fit.factors), (12, 20, 30), like, "it")
    for other in (None, 3, "abc", decaying()):
        with pytest.raises(ValueError, match=r"it must be a TuckerTensor, a pair \(core, factors\), got"):
            tucker.Tucker.checked(other, (12, 20, 30), like, "it")


def test_factors_made_orthonormal() -> None:
    """Any factors of the same tensor, even more columns than rows; those that are so already stay, signs too."""
    wide = tucker.Tucker(random(3, 4, 40), (random(12, 3), random(20, 4, seed=1), random(30, 40, seed=2)))
    done = wide.orthonormal((0, 2))
    assert done.core.shape == (3, 4, 30)
    assert torch.allclose(done.to_dense(), wide.to_dense(), atol=1e-10)
    for axis in (0, 2):
        factor = done.factors[axis]
        assert torch.allclose(factor.T @ factor, torch.eye(factor.shape[1], dtype=torch.float64), atol=1e-12)
    again = done.orthonormal((0, 2))
    assert torch.equal(again.factors[1], wide.factors[1])
    for part, other in zip((done.core, *done.factors), (again.core, *again.factors), strict=True):
        assert torch.allclose(part, other, atol=1e-12)


def test_tensorly_is_imported_on_demand() -> None:
    code = "import sys, ptt.ops.tucker; sys.exit('tensorly' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_float32_keeps_its_accuracy() -> None:
    a = decaying()
    errors = [relative_rmse(tucker.decompose(x, ranks=(8, 8, 8)).to_dense(), x) for x in (a, a.float())]
    assert abs(errors[0] - errors[1]) < 1e-6


@every_method
def test_zero_and_constant_tensors(method: str) -> None:
    for value in (0.0, 2.0):
        a = torch.full((3, 4, 5), value)
        for how, shape in (({"error": 0.01}, (1, 1, 1)), ({"ranks": (2, 3, 4)}, (2, 3, 4))):
            fit = METHODS[method](a, **how)
            assert fit.core.shape == shape
            assert torch.allclose(fit.to_dense(), a, atol=1e-6)
            assert_orthonormal(fit)
            assert tucker.relative_error(fit, a) < 1e-6


@every_method
def test_refusals(method: str) -> None:
    a = random(3, 4)
    fit = METHODS[method]
    for ranks in [(4, 4), (3, 5), (0, 1), (1,), ()]:
        with pytest.raises(ValueError, match=r"ranks must be in 1..length for the axes \(3, 4\)"):
            fit(a, ranks=ranks)
    for arguments in [{}, {"ranks": (1, 1), "error": 0.1}]:
        with pytest.raises(ValueError, match="give either ranks or error"):
            fit(a, **arguments)
    with pytest.raises(ValueError, match=r"error must be in \(0, 1\), got 1.5"):
        fit(a, error=1.5)
    with pytest.raises(ValueError, match="finite"):
        fit(a / 0, ranks=(1, 1))
    with pytest.raises(ValueError, match="floating point"):
        fit(torch.ones(3, 4, dtype=torch.int64), ranks=(1, 1))
    with pytest.raises(ValueError, match=r"not (be )?empty"):
        fit(torch.ones(0, 4), error=0.1)


@pytest.mark.parametrize("method", get_args(tucker.Method))
def test_a_vector_is_a_length_times_a_direction(method: str) -> None:
    fit = METHODS[method](torch.tensor([3.0, -4.0]), ranks=(1,))
    assert fit.core.abs().item() == pytest.approx(5)
    assert torch.allclose(fit.to_dense(), torch.tensor([3.0, -4.0]))


def test_refusals_of_one_method_and_of_unlike_slices() -> None:
    with pytest.raises(ValueError, match="with axes"):
        tucker.decompose_slices(random(3), ranks=(1,))
    with pytest.raises(ValueError, match="method must be one of hosvd, st-hosvd, hooi, got 'svd'"):
        tucker.decompose(random(3, 4), ranks=(1, 1), method="svd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"slices must have the same shape \(4,\), got \(5,\)"):
        tucker.decompose_slices([random(4), random(5)], ranks=(1, 1))
