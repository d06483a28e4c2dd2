"""Lamps of a light: found where they are, with the power they have; nothing of the light is lost."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.light.lamps import LEAST, apart
from ptt.ops.octahedral import Octahedral

GRID = Octahedral(256)
DIRECTIONS = GRID.directions().reshape(-1, 3).float()
SOLID_ANGLES = GRID.solid_angles().reshape(-1, 1).float()


def disk(axis: Tensor, degrees: float, power: float) -> Tensor:
    """A bright disk (n, 3) of so much power."""
    inside = (DIRECTIONS @ axis > torch.tensor(degrees).deg2rad().cos()).float()[:, None]
    return (power / float((inside * SOLID_ANGLES).sum())) * inside.expand(-1, 3)


def unit(*xyz: float) -> Tensor:
    return torch.nn.functional.normalize(torch.tensor(xyz), dim=0)


def test_suns_of_a_sky_are_found() -> None:
    """Two disks on a gradient: direction to a quarter of a degree, power to 2 %; the rest is the gradient to 2 %."""
    sky = 1 + 0.5 * DIRECTIONS[:, 1:2].expand(-1, 3)
    axes = [unit(0.4, 0.8, -0.3), unit(-0.7, 0.1, 0.5)]
    light = sky + disk(axes[0], 1.0, 6.0) + disk(axes[1], 0.7, 1.0)
    lamps, rest = apart(light, DIRECTIONS, SOLID_ANGLES)
    assert len(lamps.directions) == 2
    for axis, power in zip(axes, (6.0, 1.0), strict=True):
        nearest = int((lamps.directions @ axis).argmax())
        assert float(torch.rad2deg(torch.acos((lamps.directions[nearest] @ axis).clamp(max=1)))) < 0.25
        assert torch.allclose(lamps.powers[nearest], torch.full((3,), power), rtol=0.02)
        assert torch.allclose(lamps.shares[nearest].sum(), torch.ones(()))
        mean = torch.nn.functional.normalize(lamps.shares[nearest] @ lamps.areas[nearest], dim=0)
        assert float(mean @ lamps.directions[nearest]) > 1 - 1e-6
        inside = lamps.areas[nearest][lamps.shares[nearest] > 1e-2] @ lamps.directions[nearest]
        assert float(torch.rad2deg(torch.acos(inside.min()))) < 1.5
    assert torch.allclose(rest, sky, rtol=0.02)


def test_power_is_kept() -> None:
    light = torch.rand(len(DIRECTIONS), 3, generator=torch.Generator().manual_seed(0)) + disk(
        unit(1.0, 1.0, 1.0), 0.6, 20.0
    )
    lamps, rest = apart(light, DIRECTIONS, SOLID_ANGLES)
    assert len(lamps.powers) and bool((rest >= 0).all()) and bool((lamps.powers >= 0).all())
    whole, left = ((x * SOLID_ANGLES).sum(0) for x in (light, rest))
    assert torch.allclose(left + lamps.powers.sum(0), whole, rtol=1e-4)


def test_what_is_even_weak_or_black_has_no_lamps() -> None:
    even = torch.ones(len(DIRECTIONS), 3)
    weak = even + disk(unit(1.0, 1.0, 1.0), 0.7, 0.5 * LEAST * float((even * SOLID_ANGLES).sum()) / 3)
    for light in (even, weak, 0 * even):
        lamps, rest = apart(light, DIRECTIONS, SOLID_ANGLES)
        assert not len(lamps.directions) and torch.equal(rest, light)


def test_derivatives_add_up() -> None:
    """What a cell sends more is in a lamp or in the rest: in all, its solid angle."""
    light = (torch.ones(len(DIRECTIONS), 3) + disk(unit(0.0, 1.0, 0.2), 0.8, 9.0)).requires_grad_()
    lamps, rest = apart(light, DIRECTIONS, SOLID_ANGLES)
    (lamps.powers.sum() + (rest * SOLID_ANGLES).sum()).backward()
    assert light.grad is not None
    assert torch.allclose(light.grad, SOLID_ANGLES.expand(-1, 3), rtol=1e-3, atol=1e-9)
