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
from functools import lru_cache

import torch
from torch import Tensor

from ptt.ops.albedo import is_missed, lobe_nodes
from ptt.ops.brdf import half_vector
from ptt.ops.constants import BYTE, ROOTS
from ptt.ops.geodesic import FINEST_LEVEL, Geodesic
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.raycast import Surface

EDGE = math.atan(2)  # [rad] of a root, an icosahedron's triangle
DIRECTIONS_AT_ONCE = 64  # of view, whose nodes take 7 MB
ZERO_WITHIN = 1e-9  # a coordinate this little below 0 counts as 0, so that the planes between mirror images are kept
_RAYS_AT_ONCE = 1 << 20  # 24 MB of origins and directions in float32
_VALUES_AT_ONCE = 1 << 18  # of the BRDF: 1 MB, which stays in the cache


def visibility(surface: Surface, points: Tensor, frames: Tensor, grid: Geodesic, samples: int = 2) -> Tensor:
    """The share of each triangle that every point sees (v, n) uint8, in 255ths.

    points (v, 3), frames (v, 3, 3): positions and rows tangent, bitangent, normal of the points that look
    samples: rays along the edge of a triangle, a power of two

    What lies at or below the horizon counts as hidden.
    """
    local = grid.samples(samples).float()
    above = (local[:, 2] > 0).nonzero()[:, 0]
    owner = above // samples**2
    origins = surface.offset(points, frames[:, 2])
    step = max(1, _RAYS_AT_ONCE // len(above))
    parts = []
    for start, frame in zip(origins.split(step), frames.float().split(step), strict=True):
        directions = (local[above] @ frame).flatten(0, 1)
        hidden = surface.occluded(start.repeat_interleave(len(above), 0), directions).reshape(len(start), -1)
        seen = torch.zeros(len(start), grid.cells, dtype=torch.float32).index_add_(1, owner, 1 - hidden.float())
        parts.append(seen.mul_(BYTE / samples**2).round_().to(torch.uint8))
    return torch.cat(parts)


def brdf(f: Callable[[Tensor, Tensor], Tensor], grid: Geodesic, wo: Tensor, samples: int = 4) -> Tensor:
    """F (o, n), float32, of a BRDF f(wi, wo) for directions of view (o, 3).

    samples: points of the midpoint rule along the edge of a triangle, a power of two

    Raises:
        ValueError: the BRDF returns a value that is not finite.
    """
    fine = grid.refine(samples)
    wi = fine.directions()
    above = wi[:, 2] > 0
    cosine = fine.solid_angles() * wi[:, 2].clamp(min=0) * (grid.cells / ROOTS)
    wi = wi[above].float()
    weight = cosine[above].float()
    owner = above.nonzero()[:, 0] // samples**2
    parts = []
    for some in wo.float().split(max(1, _VALUES_AT_ONCE // len(wi))):
        values = f(wi, some[:, None]) * weight
        if not bool(values.isfinite().all()):
            raise ValueError("the BRDF must be finite")
        parts.append(torch.zeros(len(some), grid.cells, dtype=torch.float32).index_add_(1, owner, values))
    return torch.cat(parts)


def brdf_table(
    f: Callable[[Tensor, Tensor], Tensor],
    grid: Geodesic,
    views: int,
    mirrored: bool,
    narrow: bool = False,
    samples: int = 4,
) -> Tensor:
    """F (views^2, n) of a BRDF for all directions of `HemiOctahedral(views)`.

    mirrored: says that f is its own mirror image in x and in y, as the grid is; then only a quarter of it is sampled
    narrow: says that its lobe falls between the samples of a triangle (`is_narrow`): it has nodes of its own then
    """
    wo = HemiOctahedral(views).directions().reshape(-1, 3)
    quarter = ((wo[:, 0] > -ZERO_WITHIN) & (wo[:, 1] > -ZERO_WITHIN)).nonzero()[:, 0]
    rows = quarter if mirrored else torch.arange(len(wo))
    found = narrow_brdf(f, grid, views, mirrored, rows, samples) if narrow else brdf(f, grid, wo[rows], samples)
    if not mirrored:
        return found
    table = torch.empty(len(wo), grid.cells, dtype=torch.float32)
    for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        flip = torch.tensor([x, y, 1], dtype=torch.float64)
        rows = HemiOctahedral(views).cell(wo[quarter] * flip)
        table[rows] = found[:, grid.cell(grid.directions() * flip)]
    return table


def narrow_brdf(
    f: Callable[[Tensor, Tensor], Tensor], grid: Geodesic, views: int, mirrored: bool, rows: Tensor, samples: int
) -> Tensor:
    """F (o, n) of a BRDF with a lobe narrower than triangles, for some directions of `HemiOctahedral(views)` (o,).

    Half vectors near the normal, up to the width of a triangle, are those of a quadrature that resolves lobes there
    (`ops.albedo.lobe_nodes`), each in the triangle of its direction; what is left is sampled as by `brdf`. At level 2
    the samples of GGX of roughness 0.2 reflect 17 % too much or too little, RMS over views; this 0.3 %.
    """
    wo = HemiOctahedral(views).directions().reshape(-1, 3)[rows]
    near = _nearness(grid.level)
    table = brdf(lambda wi, wo: f(wi, wo) * (1 - near(wi, wo)), grid, wo, samples)
    cells = _cells_of_lobes(grid.level, views, mirrored)
    scale = grid.cells / ROOTS
    for first in range(0, len(wo), DIRECTIONS_AT_ONCE):
        some = slice(first, first + DIRECTIONS_AT_ONCE)
        wi, weights = lobe_nodes(wo[some])
        out = wo[some, None].expand_as(wi)
        values = f(wi, out) * near(wi, out) * weights * scale
        table[some] += (
            torch.zeros(len(values), grid.cells, dtype=torch.float64)
            .scatter_add_(1, cells[some].long(), torch.where(weights > 0, values, 0.0))
            .float()
        )
    return table


def is_narrow(f: Callable[[Tensor, Tensor], Tensor], grid: Geodesic, samples: int = 4) -> bool:
    """Tell whether samples on triangles miss more than RESOLVED of what a BRDF reflects, seen from some directions."""
    return is_missed(f, lambda wo: brdf(f, grid, wo, samples).sum(1) * (ROOTS / grid.cells))


def _nearness(level: int) -> Callable[[Tensor, Tensor], Tensor]:
    """near(wi, wo): 1 where the half vector is as near to the normal as half a triangle's edge, 0 from a whole one."""
    edge = EDGE / 2**level

    def near(wi: Tensor, wo: Tensor) -> Tensor:
        h = half_vector(wi, wo)
        angle = torch.atan2(h[..., :2].norm(dim=-1), h[..., 2])
        t: Tensor = (2 - 2 * angle / edge).clamp(0, 1)
        return t * t * (3 - 2 * t)

    return near


@lru_cache(maxsize=2)
def _cells_of_lobes(level: int, views: int, mirrored: bool) -> Tensor:
    """The triangles (o, m) int32 of the nodes of every direction of view, or of a quarter of them."""
    grid = Geodesic(level)
    wo = HemiOctahedral(views).directions().reshape(-1, 3)
    if mirrored:
        wo = wo[(wo[:, 0] > -ZERO_WITHIN) & (wo[:, 1] > -ZERO_WITHIN)]
    parts = []
    for some in wo.split(DIRECTIONS_AT_ONCE):
        wi = lobe_nodes(some)[0]
        wi = torch.where(wi[..., 2:] > 0, wi, wi.new_tensor([0.0, 0.0, 1.0]))
        parts.append(grid.cell(wi).int())
    return torch.cat(parts)


def cosine(grid: Geodesic) -> Tensor:
    """F (n,) of Lambert's BRDF, 1 / pi: the cosine and the solid angle alone."""
    samples = 1 << min(3, FINEST_LEVEL - grid.level)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float32)
    return brdf(lambda wi, wo: torch.full_like(wi[..., 0] * wo[..., 0], 1 / math.pi), grid, up, samples)[0]
