"""An environment made ready once, so that turning it costs little: a fine map, and one blurred by each lobe.

They are octahedral maps in the environment's own frame: a turn of the light turns the directions that they are read in.

Sun et al. 2007, section 4.1.
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
from torch.nn.functional import pad

from ptt.light.environment import Environment
from ptt.ops import lobes
from ptt.ops.octahedral import Octahedral, bordered
from ptt.ops.sphere import Grid

FINE_SIDE = 256  # cells along an edge of the map from which lighting is read
BLURRED_SIDE = 128  # cells along an edge of the blurred maps
# Cells along an edge of the maps that are blurred, by the lobe [degrees]: the wider the lobe, the coarser
SOURCE_SIDE = {7.0: 128, 14.0: 64, 21.0: 32}


class LightMaps(NamedTuple):
    """The maps of one environment; the fourth channel is a zero that aligns them.

    fine (FINE_SIDE ** 2, 4): mean light of each cell
    blurred (k, (BLURRED_SIDE + 2) ** 2, 4): mean light under each lobe, on maps that are `bordered`
    """

    fine: Tensor
    blurred: Tensor


def light_maps(environment: Environment, angles: Sequence[float]) -> LightMaps:
    """The maps of an environment, for lobes of the given widths [degrees]; its turn does not matter."""
    still = replace(environment, rotation=torch.eye(3, dtype=torch.float64))
    fine = still.project(Octahedral(FINE_SIDE))
    light = fine * Octahedral(FINE_SIDE).solid_angles()[..., None].to(fine)
    blurred = fine.new_zeros(len(angles), BLURRED_SIDE**2, 3)
    for k, angle in enumerate(angles):
        n = SOURCE_SIDE.get(angle, BLURRED_SIDE)
        summed = Octahedral(n).coarsen(light, FINE_SIDE // n).reshape(-1, 3)
        if angle == 0:
            blurred[k] = summed / Octahedral(n).solid_angles().reshape(-1, 1).to(fine)
        else:
            blurred[k] = _blur(angle, n).to(fine) @ summed
    around = bordered(blurred.movedim(1, 0)).movedim(1, 0)
    return LightMaps(pad(fine.reshape(-1, 3), (0, 1)), pad(around, (0, 1)).contiguous())


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
    cells = Octahedral(n).directions().reshape(-1, 3)
    axes = Octahedral(BLURRED_SIDE).directions().reshape(-1, 3)
    chord = 2 * sin(radians(angle) / 2)
    near = cKDTree(axes.numpy()).sparse_distance_matrix(cKDTree(cells.numpy()), chord, output_type="coo_matrix")
    row = torch.from_numpy(near.row).long()
    column = torch.from_numpy(near.col).long()
    weight = lobes.gaussian(2 * torch.from_numpy(near.data).div(2).asin(), angle)
    solid_angles = Octahedral(n).solid_angles().flatten()
    total = torch.zeros(len(axes)).double().index_add_(0, row, weight * solid_angles[column])
    size = (len(axes), len(cells))
    values = (weight / total[row]).float()
    with torch.sparse.check_sparse_tensor_invariants(enable=False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_coo_tensor(torch.stack((row, column)), values, size).to_sparse_csr()
