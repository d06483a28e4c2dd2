"""Error measures against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from ptt.imaging.metrics import relative_rmse


def test_by_hand() -> None:
    """Errors 3 and 4 in two of six elements, all six of the reference 5: sqrt(25 / 6) / 5 = 1 / sqrt(6)."""
    b = torch.full((2, 3), 5.0)
    a = b.clone()
    a[0, 0] += 3
    a[1, 2] -= 4
    assert relative_rmse(a, b) == pytest.approx(1 / math.sqrt(6), rel=1e-12)


def test_relative_to_the_second_argument() -> None:
    a = torch.tensor([[3.0]])
    b = torch.tensor([[2.0]])
    assert relative_rmse(a, b) == pytest.approx(0.5)
    assert relative_rmse(b, a) == pytest.approx(1 / 3)
    assert relative_rmse(a * 1e-3, b * 1e-3) == pytest.approx(0.5, rel=1e-6)


def test_float64_where_float32_would_lose_the_difference() -> None:
    """2^24 + 1 rounds to 2^24 in float32; squares of 1e30 overflow it."""
    b = torch.tensor([[2.0**24]], dtype=torch.float64)
    assert relative_rmse(b + 1, b) == pytest.approx(2.0**-24, rel=1e-9)
    big = torch.tensor([[1e30]])
    assert relative_rmse(2 * big, big) == pytest.approx(1)


def test_black_reference() -> None:
    black = torch.zeros(4, 3)
    assert relative_rmse(black, black) == 0
    assert relative_rmse(black + 1e-20, black) == math.inf


def test_nan_is_not_hidden() -> None:
    bad = torch.tensor([[math.nan, 0.0, 0.0]])
    assert math.isnan(relative_rmse(bad, torch.ones(1, 3)))
    assert math.isnan(relative_rmse(bad, torch.zeros(1, 3)))


@pytest.mark.parametrize(("a", "b"), [((2, 3), (3, 3)), ((2, 3), (3,)), ((0, 3), (0, 3))])
def test_shapes_must_agree(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"same shape.*got \("):
        relative_rmse(torch.ones(a), torch.ones(b))
