"""Lat-long maps as functions on the sphere: the bilinear interpolant of texels at half-texel centres.

It wraps around in u, and across the poles: beyond row 0 comes row 0, half a turn on. `ptt.ops.sphere.LatLong` has
the texels' directions and solid angles; here is what the interpolant adds.
"""

from __future__ import annotations

from math import ceil, cos, pi, radians, sin

import torch
import torch.nn.functional as F
from torch import Tensor

from ptt.ops.octahedral import Octahedral
from ptt.ops.octahedral import sampled as sampled_at
from ptt.ops.sphere import Grid, LatLong

_LOOKUPS = 1 << 23  # `means` halves a map whose texels would ask for more; bounds its time
_MIDPOINTS = 32  # of the coverage by a cap across each row of texels


def surrounded(texels: Tensor) -> Tensor:
    """Texels (h + 2, w + 2, ...) of a map (h, w, ...) and of those next to it, across the poles and around in u."""
    half = texels.shape[1] // 2
    texels = torch.cat((texels[:1].roll(half, 1), texels, texels[-1:].roll(half, 1)))
    return torch.cat((texels[:, -1:], texels, texels[:, :1]), dim=1)


def texel_means(texels: Tensor) -> Tensor:
    """Mean over each texel (h, w) of the bilinear interpolant: its weights are 1/8, 3/4, 1/8 along each axis."""
    t = surrounded(texels)
    t = (t[:-2] + 6 * t[1:-1] + t[2:]) / 8
    return (t[:, :-2] + 6 * t[:, 1:-1] + t[:, 2:]) / 8


def texel_weights(height: int, width: int) -> Tensor:
    """Integral over the sphere of the interpolant of one texel of each row (height,) [sr], float64.

    With step d, the integral of (1 - |t - t0| / d) sin t dt is 4 sin(d/2)^2 sin(t0) / d. The first and the
    last row reach across a pole, where |sin t| adds 1 - 2 sin(d/2) / d: for small d, 1/24 d^2 to 1/2 d^2.
    """
    step = pi / height
    rows = 4 * sin(step / 2) ** 2 / step * torch.sin((torch.arange(height, dtype=torch.float64) + 0.5) * step)
    rows[0] += 1 - 2 * sin(step / 2) / step
    rows[-1] += 1 - 2 * sin(step / 2) / step
    return rows * (2 * pi / width)


def halving(height: int) -> Tensor:
    """Averages of rows (height / 2, height) that preserve constants and the interpolant's integral.

    Rows are intervals of accumulated weight: each new row averages the old ones that its interval overlaps.
    """

    def ends(h: int) -> Tensor:
        return F.pad(texel_weights(h, h).cumsum(0) * h, (1, 0))

    new = ends(height // 2)
    old = ends(height)
    upper = torch.minimum(new[1:, None], old[1:])
    lower = torch.maximum(new[:-1, None], old[:-1])
    return (upper - lower).clamp(min=0) / new.diff()[:, None]


def radiance(texels: Tensor, directions: Tensor) -> Tensor:
    """The interpolant (..., 3) of texels (h, w, 3) in directions (..., 3) of the map, which need not be unit."""
    x, y, z = directions.unbind(-1)
    height, width = texels.shape[:2]
    u = torch.atan2(x, -z) * (width / (2 * pi)) % width
    v = torch.atan2(torch.hypot(x, z), y) * (height / pi)
    return bilinear(surrounded(texels), u + 1, v + 1)


def means(texels: Tensor, grid: Grid, rotation: Tensor) -> Tensor:
    """Means (*grid.shape, 3) of the interpolant of texels (h, w, 3), by solid angle; world = rotation @ map.

    They follow from the midpoint rule, with about three samples to a texel along each axis. Where texels are narrower,
    near the poles, rows are first blurred along u to three samples, so that one bright texel keeps its energy to 1 or
    2 % wherever it is. Where many lookups would be needed, the map is first halved, as long as a cell spans more than
    eight texels; that keeps the integral.
    """
    texels, samples, arc = sampled(texels, grid)
    return _means(texels, grid, rotation, samples, arc)


def _means(texels: Tensor, grid: Grid, rotation: Tensor, samples: int, arc: float) -> Tensor:
    even = even_rows(texels, arc)
    return grid.means(lambda directions: radiance(even, directions.to(even) @ rotation.to(even)), samples)


def octahedral_means(texels: Tensor, n: int, samples: int, arc: float) -> Tensor:
    """Means (n * n, 3) over the cells of an octahedral map in the frame of the texels, of what `sampled` gives."""
    return _means(texels, Octahedral(n), torch.eye(3, dtype=torch.float32), samples, arc).flatten(0, 1)


def sampled(texels: Tensor, grid: Grid) -> tuple[Tensor, int, float]:
    """The texels (h, w, 3) that `means` reads, maybe halved; samples along a cell's edge, and their arc [radians]."""
    spacing = float(grid.solid_angles().max().sqrt())
    while grid.cells * _samples(texels, spacing) ** 2 > _LOOKUPS and _may_halve(texels, spacing):
        texels = halved(texels)
    samples = _samples(texels, spacing)
    return texels, samples, 3 * spacing / samples


def halved(texels: Tensor) -> Tensor:
    """Texels (h / 2, w / 2, 3) with the integral of those (h, w, 3)."""
    columns = (texels[:, ::2] + texels[:, 1::2]) / 2
    return torch.einsum("rh,hwc->rwc", halving(len(texels)).to(texels), columns)


def _samples(texels: Tensor, spacing: float) -> int:
    """Samples along the edge of a cell that is `spacing` [rad] wide, three to a texel."""
    return ceil(3 * spacing / _texel_angle(texels))


def _may_halve(texels: Tensor, spacing: float) -> bool:
    """Tell whether texels can be halved, and a cell that is `spacing` [rad] wide spans more than eight of them."""
    height, width = texels.shape[:2]
    return spacing > 8 * _texel_angle(texels) and height % 2 == 0 and width % 4 == 0


def _texel_angle(texels: Tensor) -> float:
    """The smaller side [rad] of a texel on the equator."""
    height, width = texels.shape[:2]
    return min(pi / height, 2 * pi / width)


def even_rows(texels: Tensor, arc: float) -> Tensor:
    """Texels (h, w, 3), blurred along rows by a tent of about `arc` [radians] where texels are narrower."""
    height, width = texels.shape[:2]
    angles = (torch.arange(height).to(texels.device).double() + 0.5) * (pi / height)
    widths = arc / (torch.sin(angles) * (2 * pi / width))
    return _box(_box(texels, widths), widths - 1)  # the interpolation is a third box, of width 1


def _box(texels: Tensor, widths: Tensor) -> Tensor:
    """Means (h, w, 3) of texels over `widths` (h,) of them along the row, at least 1 and at most all."""
    width = texels.shape[1]
    reach = widths.clamp(1, width)[:, None] / 2
    middle = torch.arange(width).to(reach) + 0.5
    sums = F.pad(texels.double().cumsum(1), (0, 0, 1, 0))
    means = (_cumulated(sums, middle + reach) - _cumulated(sums, middle - reach)) / (2 * reach)[..., None]
    return means.to(texels)


def _cumulated(sums: Tensor, x: Tensor) -> Tensor:
    """Periodic running sums (h, w + 1, 3), linear in between, at columns x (h, w): (h, w, 3)."""
    width = sums.shape[1] - 1
    turns = torch.div(x, width, rounding_mode="floor")
    column = (x % width).floor()
    index = column.long().clamp(max=width - 1)[..., None].expand(-1, -1, 3)
    below = sums.gather(1, index)
    above = sums.gather(1, index + 1)
    return below + (above - below) * (x % width - column)[..., None] + turns[..., None] * sums[:, -1:]


def bilinear(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Values (..., 3) of an image (h, w, 3) at x, y (...), which count texels from its upper left corner."""
    at = torch.stack((x.flatten() * (2 / image.shape[1]) - 1, y.flatten() * (2 / image.shape[0]) - 1))
    return sampled_at(image.movedim(-1, 0)[None], at[None])[0].T.reshape(*x.shape, 3)


def cap(direction: Tensor, radius: float, height: int, width: int) -> Tensor:
    """Coverage of texels (height, width) by a cap of `radius` degrees, scaled so that its integral is the cap's.

    On a parallel of polar angle t, a cap at polar angle t0 covers the azimuths within
    acos((cos radius - cos t cos t0) / (sin t sin t0)) of its own. The coverage is exact along rows, and by the midpoint
    rule across them.
    """
    if not 0 < radius <= 180:
        raise ValueError(f"radius must satisfy 0 < radius <= 180 degrees, got {radius}")
    x, y, z = direction.unbind()
    rho = radians(radius)
    middle = torch.atan2(torch.hypot(x, z), y)
    azimuth = torch.atan2(x, -z)
    edges = torch.linspace(0, pi, height + 1, dtype=torch.float64).clamp(middle - rho, middle + rho)
    steps = edges.diff()[:, None] / _MIDPOINTS
    t = edges[:-1, None] + steps * (torch.arange(_MIDPOINTS, dtype=torch.float64) + 0.5)
    cosine = (cos(rho) - t.cos() * middle.cos()) / (t.sin() * middle.sin()).clamp(min=1e-15)
    arcs = _arc_overlap(cosine.clamp(-1, 1).acos(), azimuth, width)
    covered = (arcs * (steps * t.sin())[..., None]).sum(1) / LatLong(height, width).solid_angles()
    integral = texel_weights(height, width) @ covered.sum(1)
    return (covered * (2 * pi * (1 - cos(rho)) / integral)).float()


def _arc_overlap(half: Tensor, azimuth: Tensor, width: int) -> Tensor:
    """The part [radians] of each of `width` columns (..., width) that arcs azimuth +- half (...) cover."""
    edges = torch.arange(width + 1, dtype=torch.float64) * (2 * pi / width) - azimuth
    turns = (edges / (2 * pi)).round()
    half = half[..., None]
    within = (edges - 2 * pi * turns).clamp(-half, half)
    return (within + 2 * turns * half).diff(dim=-1)
