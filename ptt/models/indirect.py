"""The form of indirect light: lit by a coarse cube map, arriving in harmonics of the hemisphere (Sun 2007, 3.1).

Light that bounces twice is lit by the axes of that map which matter most to light that bounces once, as many as the
paper's 2 x 2 x 6 coarsest coefficients. Under a sky that is a narrow strip those lost a quarter of it, in a trial.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import harmonics, lobes
from ptt.ops.sphere import Disk

ORDER = 4  # of the harmonics, as in the paper
COARSE = 8  # cells along an edge of the cube map that lights the first bounce, as in the paper
TWICE = 24  # axes of that light which light the second bounce, for the paper's 2 x 2 x 6 coarsest cells


def blurs(angles: Sequence[float]) -> Tensor:
    """Factors (k, s), float64, by which each lobe scales each harmonic; angles (k): widths of the lobes [degrees]."""
    table = [lobes.zonal(a, ORDER)[harmonics.degrees(ORDER)] for a in angles]
    return torch.stack(table) if table else torch.zeros(0, ORDER**2, dtype=torch.float64)


def responses(brdf: TensorBRDF) -> Tensor:
    """C (s, 1 + i): integrals of Z_s times each incident factor and cosine, the constant first (section 3.3)."""
    grid = Disk(brdf.u_i.shape[-1])
    z = harmonics.evaluate(grid.directions().reshape(-1, 3), ORDER) @ harmonics.hemispherical(ORDER).T
    weights = grid.projected_solid_angles().flatten()
    specular = (z * weights[:, None]).T @ brdf.u_i.flatten(1).double().cpu().T
    constant = torch.zeros(ORDER**2, 1, dtype=torch.float64)
    constant[0] = math.sqrt(math.pi)
    return torch.cat((constant, specular), 1).float()
