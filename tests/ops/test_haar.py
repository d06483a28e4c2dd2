"""Haar wavelets: orthonormality, order of the coefficients, and the best k of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ptt.ops import haar


def random(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("n", [1, 2, 8, 64])
def test_round_trip_and_parseval(n: int) -> None:
    a = random(3, n, n)
    b = random(3, n, n).flip(0)
    assert torch.allclose(haar.synthesise(haar.analyse(a)), a, atol=1e-12)
    assert torch.allclose(haar.analyse(haar.synthesise(a)), a, atol=1e-12)
    product = (haar.analyse(a) * haar.analyse(b)).sum()
    assert abs(float(product - (a * b).sum())) < 1e-11 * float(a.norm() * b.norm())


def test_analysis_is_the_matrix_of_the_basis_functions() -> None:
    """Row l of the matrix is the l-th function, by synthesis of a unit coefficient; it must be orthonormal."""
    basis = haar.synthesise(torch.eye(64, dtype=torch.float64).reshape(64, 8, 8)).reshape(64, 64)
    assert torch.allclose(basis @ basis.T, torch.eye(64, dtype=torch.float64), atol=1e-13)
    x = random(8, 8)
    assert torch.allclose(haar.analyse(x).flatten(), basis @ x.flatten(), atol=1e-13)


@pytest.mark.parametrize("side", [1, 4, 16])
def test_the_coarsest_coefficients_alone(side: int) -> None:
    x = random(2, 3, 16, 16)
    assert torch.allclose(haar.analyse_coarsely(x, side), haar.analyse(x)[..., :side, :side], atol=1e-13)
    assert haar.analyse_coarsely(x[:, :0], side).shape == (2, 0, side, side)


def test_coefficients_stand_where_the_docstring_says() -> None:
    """A constant 3 on 4 x 4 has the coefficient 3 * 4; left - right = 2 on 4 x 4 is a horizontal detail of 4."""
    constant = haar.analyse(torch.full((4, 4), 3.0))
    assert constant[0, 0] == 12.0 and constant.count_nonzero() == 1
    step = torch.tensor([1.0, 1.0, -1.0, -1.0]).expand(4, 4)
    assert haar.analyse(step)[0, 1] == 4.0 and haar.analyse(step).count_nonzero() == 1
    assert haar.analyse(step.T.contiguous())[1, 0] == 4.0


def test_truncation_keeps_the_largest_and_its_error_is_what_was_left_out() -> None:
    x = random(5, 256)
    kept = haar.truncate(x, 20)
    dense = kept.to_dense(256)
    assert (kept.indices.diff(dim=-1) > 0).all()
    left = torch.where(dense == 0, x, 0.0)
    assert (left.abs().amax(-1) <= kept.values.abs().amin(-1)).all()
    assert torch.allclose((x - dense).norm(dim=-1), left.norm(dim=-1))
    assert torch.equal(haar.truncate(x, 256).to_dense(256), x)


@pytest.mark.parametrize("keep", [0, 257])
def test_truncation_refuses_counts_out_of_range(keep: int) -> None:
    with pytest.raises(ValueError, match=f"keep must be in 1..256, got {keep}"):
        haar.truncate(random(2, 256), keep)


@pytest.mark.parametrize("shape", [(4, 8), (6, 6), (0, 0)])
def test_other_sizes_are_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="equal powers of two"):
        haar.analyse(torch.zeros(shape))


def test_weights_choose_and_do_not_change_what_is_kept() -> None:
    x = torch.tensor([1.0, 2.0, 3.0, 4.0])
    kept = haar.truncate(x, 2, torch.tensor([9.0, 1.0, 1.0, 1.0]))
    assert kept.indices.tolist() == [0, 3] and kept.values.tolist() == [1.0, 4.0]


def test_support_is_where_a_basis_function_is_not_zero() -> None:
    basis = haar.synthesise(torch.eye(64, dtype=torch.float64).reshape(64, 8, 8))
    sides = (basis != 0).flatten(1).sum(1).double().sqrt() / 8
    assert torch.equal(sides, haar.support(8).flatten())


@pytest.mark.parametrize("keep", [1, 40, 127, 128, 500])
def test_the_largest_of_many_are_found_wherever_they_lie(keep: int) -> None:
    """All of them in one run of neighbours, one in each run, and by chance; 128 runs of 32."""
    scattered = torch.randn(3, 4096, generator=torch.Generator().manual_seed(3))
    scattered[1, 640:672] *= 100
    scattered[2, ::32] *= 100
    kept = haar.truncate(scattered, keep)
    assert torch.equal(
        kept.values.abs().sort(descending=True).values, scattered.abs().sort(descending=True).values[:, :keep]
    )
    assert torch.equal(kept.values, scattered.gather(1, kept.indices.long()))
