"""Maps made ready for lookups: a lobe's map is the light, weighted by the lobe about every axis."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt.light.prefiltered import light_maps
from ptt.ops import lobes
from ptt.ops.octahedral import Octahedral
from ptt.ops.view import light_about

LAMP = (0.3, 0.8, -0.5)
RADIUS = 6.0  # degrees


@pytest.mark.parametrize("angle", [7.0, 14.0, 21.0])
def test_a_small_lamp_is_seen_through_the_lobe(angle: float) -> None:
    """Mean light about an axis a: the integral of L G(d, a) over that of G(d, a), both by quadrature on a fine sphere.

    A blur of another width is wrong by its square at the peak. Tolerance: a tenth of the peak, since the map that is
    blurred has cells up to 0.8 of the lobe's standard deviation wide; a lamp narrower than a cell loses a fifth.
    """
    light = ptt.Environment.area_light(LAMP, RADIUS, 100.0)
    grid = Octahedral(512)
    directions = grid.directions().reshape(-1, 3)
    solid = grid.solid_angles().flatten()
    lamp = torch.nn.functional.normalize(torch.tensor(LAMP).double(), dim=0)
    tangent = torch.nn.functional.normalize(torch.linalg.cross(lamp, torch.tensor([0.0, 1.0, 0.0]).double()), dim=0)
    tilts = torch.tensor([0.0, angle / 6, angle / 3, angle / 2, 2 * angle]).double().deg2rad()
    axes = tilts.cos()[:, None] * lamp + tilts.sin()[:, None] * tangent
    wanted = []
    for axis in axes:
        weight = lobes.gaussian((directions @ axis).clamp(-1, 1).acos(), angle) * solid
        wanted.append(float((light.radiance(directions)[:, 0].double() * weight).sum() / weight.sum()))
    maps = light_maps(light.map, (angle,)).whole.blurred
    got = light_about(maps, axes[:, None].float())[:, 0, 0]
    torch.testing.assert_close(got.double(), torch.tensor(wanted).double(), rtol=0, atol=0.1 * wanted[0])
    assert wanted[0] > 1 > wanted[-1] and got[0] > 10 * got[-1]


def test_a_constant_light_stays_constant() -> None:
    maps = light_maps(ptt.Environment.constant((1.0, 2.0, 3.0)).map, (0.0, 7.0, 14.0, 21.0)).whole
    for map_of in (maps.fine, *maps.blurred):
        assert torch.allclose(map_of[:, :3], torch.tensor([1.0, 2.0, 3.0]), rtol=1e-5)
        assert not map_of[:, 3].any()


def test_the_integral_is_kept() -> None:
    """Of the fine map, by its solid angles: that of the lamp, 2 pi (1 - cos radius) times 100."""
    fine = light_maps(ptt.Environment.area_light(LAMP, RADIUS, 100.0).map, ()).whole.fine
    solid = Octahedral(math.isqrt(len(fine))).solid_angles().flatten()
    expected = 100 * 2 * math.pi * (1 - math.cos(math.radians(RADIUS)))
    assert float((fine[:, 0] * solid).sum()) == pytest.approx(expected, rel=0.02)
