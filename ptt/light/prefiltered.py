"""A map made ready once, so that turning it costs little: fine, and blurred by each lobe (Sun 2007, section 4.1).

All in the map's own frame, on octahedral maps: a turn of the light turns the directions in which they are read.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import radians, sin
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ptt.light.environment import Environment
from ptt.ops import lobes
from ptt.ops.octahedral import Octahedral, bordered
from ptt.ops.sphere import Grid

FINE = 256  # cells along an edge of the map that lighting is read from
SIDE = 128  # of the blurred ones
SOURCE = {7.0: 128, 14.0: 64, 21.0: 32}  # of what is blurred


class LightMaps(NamedTuple):
    """fine (FINE * FINE, 4): means of its cells; blurred (k, (SIDE + 2) ** 2, 4): mean light under each lobe, on maps
    that are `bordered`. The fourth channel is a zero that aligns them."""

    fine: Tensor
    blurred: Tensor


def light_maps(environment: Environment, angles: Sequence[float]) -> LightMaps:
    """Both, for the lobes of so many degrees; the turn of the environment does not matter."""
    still = replace(environment, rotation=torch.eye(3, dtype=torch.float64))
    fine = still.project(Octahedral(FINE))
    light = fine * Octahedral(FINE).solid_angles()[..., None].to(fine)
    blurred = fine.new_zeros(len(angles), SIDE * SIDE, 3)
    for k, angle in enumerate(angles):
        n = SOURCE.get(angle, SIDE)
        summed = Octahedral(n).coarsen(light, FINE // n).reshape(-1, 3)
        if angle == 0:
            blurred[k] = summed / Octahedral(n).solid_angles().reshape(-1, 1).to(fine)
        else:
            blurred[k] = _blur(angle, n).to(fine) @ summed
    around = bordered(blurred.movedim(1, 0)).movedim(1, 0)
    fine, around = (torch.nn.functional.pad(maps, (0, 1)) for maps in (fine.reshape(-1, 3), around))
    return LightMaps(fine, around.contiguous())


def samples(grid: Grid) -> tuple[Tensor, Tensor]:
    """For `relight.lighting`: directions (4, 3, cells) and shares (4, cells) of the quarters of each cell."""
    *_, rows, columns = grid.shape
    fine = grid.refine(2)
    directions = fine.directions().reshape(-1, rows, 2, columns, 2, 3).permute(2, 4, 5, 0, 1, 3).reshape(4, 3, -1)
    solid = fine.solid_angles().reshape(-1, rows, 2, columns, 2).permute(2, 4, 0, 1, 3).reshape(4, -1)
    return directions.float().contiguous(), (solid / solid.sum(0)).float()


@cache
def _blur(angle: float, n: int) -> Tensor:
    """From light times solid angle in the cells of an octahedral map to its means (SIDE * SIDE, n n), sparse CSR."""
    cells, axes = (Octahedral(side).directions().reshape(-1, 3) for side in (n, SIDE))
    chord = 2 * sin(radians(angle) / 2)
    near = cKDTree(axes.numpy()).sparse_distance_matrix(cKDTree(cells.numpy()), chord, output_type="coo_matrix")
    row = torch.from_numpy(near.row).long()
    column = torch.from_numpy(near.col).long()
    weight = lobes.gaussian(2 * torch.from_numpy(near.data).div(2).asin(), angle)
    total = torch.zeros(len(axes)).double().index_add_(0, row, weight * Octahedral(n).solid_angles().flatten()[column])
    size = (len(axes), len(cells))
    values = (weight / total[row]).float()
    with torch.sparse.check_sparse_tensor_invariants(enable=False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_coo_tensor(torch.stack((row, column)), values, size).to_sparse_csr()
