"""Lighting as the lobes see it: the map, blurred by each Gaussian, on octahedral maps (Sun et al. 2007, section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from ptt.environment import Environment
from ptt.ops import lobes
from ptt.ops.octahedral import Octahedral
from ptt.ops.sphere import Cube

SIDE = 128  # cells along an edge of the maps
SOURCE = {0.0: 0, 7.0: 64, 14.0: 32, 21.0: 16}  # cells along an edge of the cube map that is blurred; 0: the map itself


def prefiltered(environment: Environment, angles: Sequence[float]) -> Tensor:
    """Mean light (SIDE * SIDE, k, 3) about each direction of the map's own frame, by each lobe's Gaussian."""
    still = replace(environment, rotation=torch.eye(3, dtype=torch.float64))
    grid = Octahedral(SIDE)
    found = []
    for angle in angles:
        n = SOURCE[angle]
        if n == 0:
            found.append(still.project(grid).reshape(-1, 3))
        else:
            found.append(_filter(angle, n).to(still.map.device) @ still.project(Cube(n)).reshape(-1, 3))
    return torch.stack(found, 1)


@cache
def _filter(angle: float, n: int) -> Tensor:
    """Weights (SIDE * SIDE, 6 n n) as a sparse CSR matrix; rows sum to 1."""
    texels, solid = Cube(n).directions().reshape(-1, 3).float(), Cube(n).solid_angles().flatten().float()
    rows = []
    for axes in Octahedral(SIDE).directions().reshape(-1, 3).float().split(512):
        apart = (axes[:, None] - texels).norm(dim=2).div(2).clamp(max=1).asin() * 2
        weight = lobes.gaussian(apart, angle) * solid
        rows.append((weight / weight.sum(1, keepdim=True)).to_sparse_coo())
    return torch.cat(rows).to_sparse_csr()
