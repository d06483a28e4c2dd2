"""Light, visibility and BRDF in local frames, on triangles of a geodesic grid (Ma et al. 2006, sections 3.2 and 4.1).

    B[v] = integral of  L_v(wi) V_v(wi) f(wi, wo) max(wi . n, 0) dwi  =  20 / n sum over t of  L[t] V[t] F[t]

for n triangles: L and V are means over a triangle, F carries the cosine and the triangle's true solid angle against its
nominal one, so that a constant light gives exactly the visible part of what the BRDF reflects. All three are given in
the frame of the point (rows tangent, bitangent, normal), so that points of one material share F. The sum is
`ops.triple.quadrature`; in the basis of `ops.geodesic` it is `ops.triple.integral`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ptt.ops.geodesic import FINEST, ROOTS, Geodesic
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.raycast import Surface

BYTE = 255
MIDDLE = 1e-9  # of the sphere: nearer, a direction is its own mirror image
_RAYS = 1 << 20  # a block
_VALUES = 1 << 18  # BRDF values at once: what fits the cache


def visibility(surface: Surface, points: Tensor, frames: Tensor, grid: Geodesic, samples: int = 2) -> Tensor:
    """How much of each triangle every point sees (v, n) uint8, of 255.

    points (v, 3), frames (v, 3, 3): of the points that look
    samples: along the edge of a triangle, a power of two; a ray each. What is at or below the horizon counts as hidden
    """
    local = grid.samples(samples).float()
    above = (local[:, 2] > 0).nonzero()[:, 0]
    owner = above // samples**2
    origins = surface.offset(points, frames[:, 2])
    parts = []
    for start, frame in zip(*(x.split(max(1, _RAYS // len(above))) for x in (origins, frames.float())), strict=True):
        directions = (local[above] @ frame).flatten(0, 1)
        hidden = surface.occluded(start.repeat_interleave(len(above), 0), directions).reshape(len(start), -1)
        seen = torch.zeros(len(start), grid.cells).index_add_(1, owner, 1 - hidden.float())
        parts.append(seen.mul_(BYTE / samples**2).round_().to(torch.uint8))
    return torch.cat(parts)


def brdf(f: Callable[[Tensor, Tensor], Tensor], grid: Geodesic, wo: Tensor, samples: int = 4) -> Tensor:
    """F (o, n), float32, of a BRDF f(wi, wo) for directions of view (o, 3).

    samples: along the edge of a triangle, a power of two, of the midpoint rule

    Raises:
        ValueError: the BRDF returns what is not finite.
    """
    fine = grid.refine(samples)
    wi = fine.directions()
    above = wi[:, 2] > 0
    cosine = fine.solid_angles() * wi[:, 2].clamp(min=0) * (grid.cells / ROOTS)
    wi = wi[above].float()
    weight = cosine[above].float()
    owner = above.nonzero()[:, 0] // samples**2
    parts = []
    for some in wo.float().split(max(1, _VALUES // len(wi))):
        values = f(wi, some[:, None]) * weight
        if not bool(values.isfinite().all()):
            raise ValueError("the BRDF must be finite")
        parts.append(torch.zeros(len(some), grid.cells).index_add_(1, owner, values))
    return torch.cat(parts)


def brdf_table(
    f: Callable[[Tensor, Tensor], Tensor], grid: Geodesic, views: int, mirrored: bool, samples: int = 4
) -> Tensor:
    """F (views^2, n) of a BRDF for all directions of `HemiOctahedral(views)`.

    mirrored: f is its own mirror image in x and in y, as the grid's triangles are: only a quarter of it is sampled
    """
    wo = HemiOctahedral(views).directions().reshape(-1, 3)
    if not mirrored:
        return brdf(f, grid, wo, samples)
    quarter = ((wo[:, 0] > -MIDDLE) & (wo[:, 1] > -MIDDLE)).nonzero()[:, 0]
    found = brdf(f, grid, wo[quarter], samples)
    table = torch.empty(len(wo), grid.cells)
    for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        flip = torch.tensor([x, y, 1], dtype=torch.float64)
        table[HemiOctahedral(views).cell(wo[quarter] * flip)] = found[:, grid.cell(grid.directions() * flip)]
    return table


def cosine(grid: Geodesic) -> Tensor:
    """F (n,) of Lambert's BRDF, 1 / pi."""
    samples = 1 << min(3, FINEST - grid.level)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    return brdf(lambda wi, wo: torch.full_like(wi[..., 0] * wo[..., 0], 1 / math.pi), grid, up, samples)[0]
