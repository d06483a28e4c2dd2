"""A map made ready once, so that turns, factors and sums of lights cost little: a fine one, and one a lobe, blurred.

They are octahedral maps in the map's own frame: a turn of the light turns the directions that they are read in.

Sun et al. 2007, section 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping, Sequence
from functools import cache
from math import radians, sin
from typing import Any, NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.weak import WeakTensorKeyDictionary

from ptt.light.lamps import Lamps, apart
from ptt.ops import latlong, lobes
from ptt.ops.marks import mark
from ptt.ops.octahedral import Octahedral, bordered
from ptt.ops.sparse import csr, product
from ptt.ops.sphere import Grid
from ptt.ops.transforms import outside, stands_in
from ptt.ops.view import light_about

FINE_SIDE = 256  # cells along an edge of the map from which lighting is read
BLURRED_SIDE = 128  # cells along an edge of the blurred maps
# Cells along an edge of the maps that are blurred, for lobes of at least so many degrees: the wider, the coarser
SOURCE_SIDES = {21.0: 32, 14.0: 64}


class LightMaps(NamedTuple):
    """What is made of one map; the fourth channel is a zero that aligns them.

    fine (FINE_SIDE ** 2, 4): mean light of each cell
    blurred (k, (BLURRED_SIDE + 2) ** 2, 4): mean light under each lobe, on maps that are `bordered`
    """

    fine: Tensor
    blurred: Tensor


class SplitMaps(NamedTuple):
    """The maps of a whole light; its lamps, none unless they are kept apart; and the maps of the rest, which are those
    of the whole where there are no lamps."""

    whole: LightMaps
    lamps: Lamps
    rest: LightMaps


Means = Callable[[Tensor, int, int, float], Tensor]
_READY: MutableMapping[Tensor, dict[tuple[Any, ...], SplitMaps]] = WeakTensorKeyDictionary()
"""What was made of a map's texels, for as long as they are there."""


def light_maps(
    texels: Tensor,
    angles: Sequence[float],
    octahedral_means: Means = latlong.octahedral_means,
    lamps: bool = False,
) -> SplitMaps:
    """The maps of a light's texels (h, w, 3), for lobes of the given widths [degrees]; made once, until texels change.

    octahedral_means: `ptt.ops.latlong.octahedral_means`, or its kernel
    lamps: says whether lamps are kept apart
    """
    if texels.is_inference() or (torch.is_grad_enabled() and texels.requires_grad) or stands_in(texels):
        return _made(texels, angles, octahedral_means, lamps)
    made = _READY.setdefault(texels, {})
    now = mark(texels)
    key = (now, tuple(angles), octahedral_means, lamps)
    if key not in made:
        with torch.inference_mode(False), torch.no_grad():
            ready = outside(_made, texels, angles, octahedral_means, lamps)
        stale = [other for other in made if other[0] != now]
        for other in stale:
            del made[other]
        made[key] = ready
    return made[key]


def _made(texels: Tensor, angles: Sequence[float], octahedral_means: Means, lamps: bool) -> SplitMaps:
    texels, samples, arc = latlong.sampled(texels, Octahedral(FINE_SIDE))
    fine = octahedral_means(texels, FINE_SIDE, samples, arc)
    solid_angles = outside(_solid_angles, FINE_SIDE).to(fine)
    whole = _maps(fine, solid_angles, angles)
    if not lamps:
        return SplitMaps(whole, Lamps.none(fine), whole)
    found, rest = apart(fine, outside(_axes, FINE_SIDE).to(fine), solid_angles)
    return SplitMaps(whole, found, _maps(rest, solid_angles, angles) if len(found.directions) else whole)


def _maps(fine: Tensor, solid_angles: Tensor, angles: Sequence[float]) -> LightMaps:
    return LightMaps(pad(fine, (0, 1)), _all_blurred(fine * solid_angles, angles))


def _all_blurred(light: Tensor, angles: Sequence[float]) -> Tensor:
    """Maps (k, cells, 4) of light times solid angle (n, 3) under each lobe."""
    light = light.reshape(FINE_SIDE, FINE_SIDE, 3)
    around = [bordered(_blurred(light, angle)) for angle in angles] or [light.new_zeros(0, 3)]
    return pad(torch.stack(around), (0, 1))[: len(angles)]


def _blurred(light: Tensor, angle: float) -> Tensor:
    """The mean (BLURRED_SIDE ** 2, 3) under a lobe of light times solid angle (FINE_SIDE, FINE_SIDE, 3)."""
    n = next((side for least, side in SOURCE_SIDES.items() if angle >= least), BLURRED_SIDE)
    summed = Octahedral(n).coarsen(light, FINE_SIDE // n).reshape(-1, 3)
    if angle == 0:
        return summed / outside(_solid_angles, n).to(light)
    return product(outside(_blur, angle, n), summed)


def turned(maps: Tensor, turn: Tensor) -> Tensor:
    """Blurred maps (k, cells, 4) of a light that is turned: in its frame, directions are turn @ those of the maps."""
    axes = outside(_axes, BLURRED_SIDE).to(maps) @ turn.to(maps)
    light = light_about(maps, axes[:, None].expand(-1, len(maps), -1))  # shape: (cells, k, 3)
    return pad(bordered(light).transpose(0, 1), (0, 1)).contiguous()


@cache
def _solid_angles(n: int) -> Tensor:
    """Of an octahedral map's cells (n * n, 1)."""
    return Octahedral(n).solid_angles().reshape(-1, 1)


@cache
def _axes(n: int) -> Tensor:
    """Of an octahedral map's cells (n * n, 3)."""
    return Octahedral(n).directions().reshape(-1, 3)


def samples(grid: Grid) -> tuple[Tensor, Tensor]:
    """Directions (4, 3, cells) and shares (4, cells) of the quarters of a grid's cells, for `ops.relight.lighting`."""
    *_, rows, columns = grid.shape
    fine = grid.refine(2)
    directions = fine.directions().reshape(-1, rows, 2, columns, 2, 3).permute(2, 4, 5, 0, 1, 3).reshape(4, 3, -1)
    solid = fine.solid_angles().reshape(-1, rows, 2, columns, 2).permute(2, 4, 0, 1, 3).reshape(4, -1)
    return directions.float().contiguous(), (solid / solid.sum(0)).float()


@cache
def _blur(angle: float, n: int) -> Tensor:
    """The matrix (BLURRED_SIDE ** 2, n * n), sparse CSR, from light times solid angle to mean light under a lobe."""
    cells = _axes(n)
    axes = _axes(BLURRED_SIDE)
    chord = 2 * sin(radians(angle) / 2)
    near = cKDTree(axes.numpy()).sparse_distance_matrix(cKDTree(cells.numpy()), chord, output_type="coo_matrix").tocsr()
    near.sort_indices()
    starts, column = (torch.from_numpy(part).long() for part in (near.indptr, near.indices))
    row = torch.arange(len(axes)).repeat_interleave(starts.diff())
    weight = lobes.gaussian(2 * torch.from_numpy(near.data).div(2).asin(), angle)
    solid_angles = _solid_angles(n)[:, 0]
    total = torch.zeros(len(axes)).double().index_add_(0, row, weight * solid_angles[column])
    return csr(starts, column, (weight / total[row]).float(), len(cells))
