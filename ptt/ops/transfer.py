"""Transfer tensors: how the light from each direction arrives at a point, before any lighting is known.

T0[v, i, t] = visibility[v, t] * factor_i(local direction) * cosine * solid angle      (Sun et al. 2007, section 3.3)

so that sum over t of L[t] T0[v, i, t] is the integral of lighting, visibility, cosine and the i-th incident factor.
Factor 0 is the constant 1, for diffuse reflection.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ptt.ops.raycast import Surface


def visibility(surface: Surface, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """Which directions (t, 3) each point (v, 3) sees, one ray each: packed bits (v, ceil(t / 8)) uint8.

    A direction at or below the horizon of the point's normal (v, 3) counts as hidden.
    """
    above = normals.double() @ directions.double().T > 0  # shape: (v, t)
    point, texel = above.nonzero(as_tuple=True)
    origins = surface.offset(points, normals)
    above[point, texel] = ~surface.occluded(origins[point], directions[texel])
    return torch.from_numpy(np.packbits(above.numpy(), axis=1))


def unpack(bits: Tensor, length: int) -> Tensor:
    """Packed bits (v, ceil(t / 8)) uint8 -> (v, t) bool."""
    return torch.from_numpy(np.unpackbits(bits.numpy(), axis=1, count=length)).bool()


def lookup(table: Tensor, local: Tensor) -> Tensor:
    """Bilinear values (b, i, k) of a table on the disk grid (i, n, n) at local directions (b, 3, k); z is unused."""
    grid = local[:, None, :2].movedim(2, 3)  # shape: (b, 1, k, 2)
    tables = table.expand(len(local), -1, -1, -1)
    values = torch.nn.functional.grid_sample(tables, grid, padding_mode="border", align_corners=False)
    return values[:, :, 0]


def direct_transfer(
    visible: Tensor, frames: Tensor, directions: Tensor, solid_angles: Tensor, factors: Tensor
) -> Tensor:
    """T0 (v, 1 + i, t) in the texel basis.

    visible (v, t) bool: the texels that each point sees
    frames (v, 3, 3): rows tangent, bitangent, normal
    directions (t, 3), solid_angles (t,) [sr]: the lighting's texels
    factors (i, n, n): incident factors of the BRDF tensor on the disk grid

    The cosine weights of each point are scaled so that all of its hemisphere sums to pi exactly: unoccluded,
    a constant map gives exactly its value, and with occlusion never more.
    """
    local = frames @ directions.T  # shape: (v, 3, t)
    weight = local[:, 2].clamp(min=0) * solid_angles
    weight *= math.pi / weight.sum(1, keepdim=True)
    weight *= visible
    out = weight.new_empty(len(visible), 1 + len(factors), len(directions))
    out[:, 0] = weight
    torch.mul(lookup(factors, local), weight[:, None], out=out[:, 1:])
    return out
