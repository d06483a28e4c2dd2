"""Tucker decomposition: exact where the rank allows it, near-best elsewhere, stable in scale; tensorly as a peer."""

from __future__ import annotations

import pytest
import tensorly
import torch
from tensorly.decomposition import partial_tucker
from torch import Tensor

from ptt.metrics import relative_rmse
from ptt.ops import tucker


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def decaying() -> Tensor:
    """A 12 x 20 x 30 tensor whose singular values fall by about two a step along each axis."""
    factors = [torch.linalg.qr(random(n, n, seed=n))[0] * 2.0 ** -torch.arange(n) for n in (12, 20, 30)]
    return tucker.multiply(random(12, 20, 30), factors)


def test_low_rank_is_recovered_exactly_and_factors_are_orthonormal() -> None:
    a = tucker.multiply(random(2, 3, 4), [random(9, 2), random(11, 3, seed=1), random(13, 4, seed=2)])
    fit = tucker.decompose(a, ranks=(2, 3, 4))
    assert relative_rmse(fit.to_dense(), a) < 1e-13
    for factor in fit.factors:
        assert torch.allclose(factor.T @ factor, torch.eye(factor.shape[1], dtype=torch.float64), atol=1e-12)
    assert fit.core.shape == (2, 3, 4)


@pytest.mark.parametrize("error", [0.3, 1e-2, 1e-5])
def test_error_is_met_and_not_by_far_too_much(error: float) -> None:
    a = decaying()
    fit = tucker.decompose(a, error=error)
    reached = relative_rmse(fit.to_dense(), a)
    assert error / 10 < reached <= error


def test_near_the_best_of_tensorly() -> None:
    """HOOI iterates to a local optimum; ST-HOSVD is at most sqrt(3) worse, and in practice within a few percent."""
    a = decaying()
    ours = relative_rmse(tucker.decompose(a, ranks=(3, 4, 5)).to_dense(), a)
    (core, factors), _ = partial_tucker(a.numpy(), rank=[3, 4, 5], modes=[0, 1, 2])
    best = relative_rmse(torch.from_numpy(tensorly.tucker_to_tensor((core, factors))), a)
    assert best <= ours * (1 + 1e-9) <= 1.1 * best


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_does_not_matter(scale: float) -> None:
    a = decaying()
    plain, scaled = (tucker.decompose(x, ranks=(3, 4, 5)) for x in (a, a * scale))
    assert torch.allclose(scaled.to_dense() / scale, plain.to_dense(), atol=1e-12)


def test_float32_keeps_its_accuracy() -> None:
    a = decaying()
    errors = [relative_rmse(tucker.decompose(x, ranks=(8, 8, 8)).to_dense(), x) for x in (a, a.float())]
    assert abs(errors[0] - errors[1]) < 1e-6


def test_zero_and_constant_tensors() -> None:
    for value in (0.0, 2.0):
        a = torch.full((3, 4, 5), value)
        fit = tucker.decompose(a, error=0.01)
        assert fit.core.shape == (1, 1, 1)
        assert torch.allclose(fit.to_dense(), a, atol=1e-6)


def test_refusals() -> None:
    a = random(3, 4)
    for ranks in [(4, 4), (0, 1), (1,)]:
        with pytest.raises(ValueError, match=r"ranks must be in 1..length for the axes \(3, 4\)"):
            tucker.decompose(a, ranks=ranks)
    for arguments in [{}, {"ranks": (1, 1), "error": 0.1}]:
        with pytest.raises(ValueError, match="give either ranks or error"):
            tucker.decompose(a, **arguments)
    with pytest.raises(ValueError, match=r"error must be in \(0, 1\), got 1.5"):
        tucker.decompose(a, error=1.5)
    with pytest.raises(ValueError, match="finite"):
        tucker.decompose(a / 0, ranks=(1, 1))
