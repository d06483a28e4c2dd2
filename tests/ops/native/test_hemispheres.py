"""The kernels of hemispheres against the plain functions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops import hemispheres as plain
from ptt.ops import native
from ptt.ops.hemispheres import Between


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def rotations(n: int) -> Tensor:
    rotation: Tensor = torch.linalg.qr(random(n, 3, 3, seed=n))[0]
    return rotation.contiguous()


@pytest.mark.parametrize("side", [32, 64, 128])
@pytest.mark.parametrize(("places", "lamps", "each"), [(1, 1, 1), (17, 3, 5), (100, 0, 0), (64, 9, 30)])
def test_lamps_seen_agree(built: None, places: int, lamps: int, each: int, side: int) -> None:
    """To the weight of single bits at the borders of cells, where rounding chooses others."""
    words = plain.words_of(side)
    seen = torch.randint(-(2**31), 2**31, (places, words), generator=torch.Generator().manual_seed(1)).int()
    areas = normalize(random(lamps, each, 3), dim=2)
    shares = random(lamps, each, seed=2).abs()
    if each > 1:
        shares[:, -1] = 0  # lamps have areas of several sizes, filled up with zeros
        areas[:, -1] = 0
    with native.refusals() as found:
        got = native.lamps_seen(seen, rotations(places), areas, shares)
    assert not found
    expected = plain.lamps_seen(seen, rotations(places).double(), areas.double(), shares.double())
    assert got.shape == expected.shape == (lamps, places)
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("corners", [1, 3, 4])
@pytest.mark.parametrize(("points", "lamps"), [(1, 1), (50, 3), (64, 0)])
def test_lamps_between_agree(built: None, points: int, lamps: int, corners: int) -> None:
    places = 11
    rows = torch.randint(places, (points, corners), generator=torch.Generator().manual_seed(3)).int()
    between = Between(rows, random(points, corners).abs(), rotations(places))
    through = random(lamps, places).abs()
    directions = normalize(random(lamps, 3, seed=4), dim=1)
    with native.refusals() as found:
        got = native.lamps_between(through, between, directions)
    assert not found
    double = Between(rows, between.weights.double(), between.frames.double())
    expected = plain.lamps_between(through.double(), double, directions.double())
    torch.testing.assert_close(got.double(), expected, rtol=1e-4, atol=1e-5)
