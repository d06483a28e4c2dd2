"""Distant lighting: an HDR map as a function on the sphere.

    light = Environment.load("uffizi.hdr").rotated(y=30)
    light.radiance(directions)          # (..., 3)
    light.project(Cube(64))             # (6, 64, 64, 3), means of the cells

The function is the bilinear interpolant of a lat-long map, in the convention of `ptt.ops.sphere.LatLong`,
centres at half texels. It wraps around in u, and across the poles: beyond row 0 comes row 0, half a turn on.
All that is derived from a map (means of cells, the integral, the sampler) belongs to this one function. Its
integral is the texels' sum by solid angle, but for the first and the last row, whose texels weigh 8 % more.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, cos, pi, radians, sin
from os import PathLike
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from ptt.io import read_image
from ptt.ops.sphere import Grid, LatLong

Layout = Literal["auto", "latlong", "cross", "angular"]
"""How an image holds the sphere; "auto" decides by width : height.

latlong (2:1): as `LatLong`. cross (3:4): vertical, from the top +Y; -X -Z +X; -Y; +Z upside down.
angular (1:1): direction (sin(pi r) a / r, sin(pi r) b / r, -cos(pi r)), a right, b up, r = |(a, b)| <= 1.
"""
Colour = float | Sequence[float] | Tensor
"""Red, green and blue, or one number for grey; finite and >= 0."""

_SIZE = 256, 512  # height and width of maps that are made, not loaded
_LOOKUPS = 1 << 23  # `project` halves a map whose texels would ask for more


@dataclass(frozen=True, eq=False)
class Environment:
    """Radiance from every direction, the same at every point.

    map (height, width, 3): linear RGB, float32, lat-long, width even; may require grad [the map's units].
    rotation (3, 3): takes map directions to world directions, float64.

    Laws:
    - ``e.rotated(...).radiance(R d) = e.radiance(d)``.
    - The cells of ``e.project(g)`` times ``g.solid_angles()`` sum to ``e.integral()``.
    - `radiance`, `project` and `integral` are linear in `map`, and differentiable.

    Raises:
        ValueError: `map` has another shape or type or is not finite; `rotation` is no rotation.
    """

    map: Tensor
    rotation: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))

    def __post_init__(self) -> None:
        if self.map.ndim != 3 or self.map.shape[2] != 3 or self.map.shape[1] % 2 or self.map.numel() == 0:
            raise ValueError(f"map must have shape (height, even width, 3), got {tuple(self.map.shape)}")
        if self.map.dtype != torch.float32:
            raise ValueError(f"map must be float32, got {self.map.dtype}")
        _check_finite("map", self.map)
        _check_rotation(self.rotation)

    @classmethod
    def load(cls, path: str | PathLike[str], layout: Layout = "auto") -> Environment:
        """Reads .exr, .hdr or .png; crosses and angular maps are resampled at matching resolution.

        Negative values become 0, with one warning that counts them. Grey becomes RGB; alpha is dropped.

        Raises:
            ValueError: the file cannot be read, is not finite, or has another shape than `layout` asks for.
        """
        image = read_image(path)
        image = image[..., :3] if image.shape[2] > 2 else image[..., :1].expand(-1, -1, 3)
        _check_finite(str(path), image)
        negative = int((image < 0).sum())
        if negative:
            message = f"{path}: {negative} of {image.numel()} values were negative and became 0"
            warnings.warn(message, stacklevel=2)
        return cls(_to_latlong(image.clamp(min=0), layout, path))

    @classmethod
    def constant(cls, radiance: Colour = 1.0) -> Environment:
        """The same radiance from everywhere: its integral is 4 pi times `radiance`."""
        return cls(_colour("radiance", radiance).expand(*_SIZE, 3).contiguous())

    @classmethod
    def gradient_sky(
        cls,
        zenith: Colour = (0.2, 0.4, 0.8),
        horizon: Colour = (0.8, 0.9, 1.0),
        ground: Colour = (0.2, 0.18, 0.15),
    ) -> Environment:
        """A uniform ground, and a sky whose radiance is linear in y from `horizon` to `zenith`."""
        height, width = _SIZE
        top, edge, below = _colour("zenith", zenith), _colour("horizon", horizon), _colour("ground", ground)
        y = LatLong(height, 1).directions()[..., 1:2].float()
        rows = torch.where(y > 0, edge + (top - edge) * y, below)
        return cls(rows.expand(-1, width, -1).contiguous())

    @classmethod
    def area_light(
        cls, direction: Sequence[float] | Tensor, radius: float = 20.0, radiance: Colour = 1.0
    ) -> Environment:
        """A uniform round light around `direction`, black elsewhere; `radius` in degrees, 0 < radius <= 180.

        Texels on the rim are covered in part; the integral is exactly that of the cap, 2 pi (1 - cos radius).
        """
        return cls(_cap(direction, radius)[..., None] * _colour("radiance", radiance))

    @classmethod
    def sun_sky(
        cls,
        direction: Sequence[float] | Tensor = (0.4, 0.7, 0.6),
        irradiance: Colour = 3.0,
        radius: float = 0.2665,
        zenith: Colour = (0.2, 0.4, 0.8),
        horizon: Colour = (0.8, 0.9, 1.0),
        ground: Colour = (0.2, 0.18, 0.15),
    ) -> Environment:
        """`gradient_sky` with a sun: a disc of `radius` degrees, 0 < radius <= 90, around `direction`.

        `irradiance` is what the sun alone gives a surface that faces it [radiance units x sr]. A disc smaller
        than a texel (0.7 degrees) is spread over the texels that it touches.
        """
        if not 0 < radius <= 90:
            raise ValueError(f"radius must satisfy 0 < radius <= 90 degrees, got {radius}")
        sun = cls.area_light(direction, radius, _colour("irradiance", irradiance))
        sky = cls.gradient_sky(zenith, horizon, ground)
        return cls(sky.map + sun.map / (pi * sin(radians(radius)) ** 2))

    def rotated(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Environment:
        """The environment turned by degrees about the world axes, first x, then y, then z; right-handed."""
        return replace(self, rotation=_turn(2, z) @ _turn(1, y) @ _turn(0, x) @ self.rotation)

    def scaled(self, factor: Colour) -> Environment:
        """The environment with its radiance multiplied by `factor`."""
        return replace(self, map=self.map * _colour("factor", factor).to(self.map))

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance (..., 3) from world directions (..., 3), which need not be unit."""
        x, y, z = (directions.to(self.map) @ self.rotation.to(self.map)).unbind(-1)
        height, width = self.map.shape[:2]
        u = torch.atan2(x, -z) * (width / (2 * pi)) % width
        v = torch.atan2(torch.hypot(x, z), y) * (height / pi)
        return _bilinear(_surrounded(self.map), u + 1, v + 1)

    def project(self, grid: Grid) -> Tensor:
        """Mean radiance of each cell (*grid.shape, 3), by solid angle.

        The midpoint rule, about three samples to a texel along each axis. Where texels are narrower, near the
        poles, rows are first blurred along u to three samples, so that one bright texel keeps its energy to 1
        or 2 % wherever it is. Where many lookups would be needed, the map is first halved, as long as a cell
        spans more than eight texels; that keeps the integral.
        """
        spacing, light = float(grid.solid_angles().max().sqrt()), self
        while grid.cells * light._samples(spacing) ** 2 > _LOOKUPS and light._may_halve(spacing):
            light = light._halved()
        samples = light._samples(spacing)
        even = replace(light, map=_even_rows(light.map, 3 * spacing / samples))
        return grid.means(even.radiance, samples)

    def integral(self) -> Tensor:
        """Integral of the radiance over the sphere (3,) [map's units x sr], exact for the interpolant."""
        weights = _texel_weights(*self.map.shape[:2]).to(self.map)
        return torch.einsum("h,hwc->c", weights, self.map)

    def sampler(self) -> EnvironmentSampler:
        """Importance sampling by luminance; gradients stop here."""
        return EnvironmentSampler.build(self.map.detach(), self.rotation)

    def _texel(self) -> float:
        height, width = self.map.shape[:2]
        return min(pi / height, 2 * pi / width)

    def _samples(self, spacing: float) -> int:
        return ceil(3 * spacing / self._texel())

    def _may_halve(self, spacing: float) -> bool:
        height, width = self.map.shape[:2]
        return spacing > 8 * self._texel() and height % 2 == 0 and width % 4 == 0

    def _halved(self) -> Environment:
        columns = (self.map[:, ::2] + self.map[:, 1::2]) / 2
        rows = _halving(self.map.shape[0]).to(self.map)
        return replace(self, map=torch.einsum("rh,hwc->rwc", rows, columns))


@dataclass(frozen=True, eq=False)
class EnvironmentSampler:
    """Directions drawn with a density that is constant on each texel of the map.

    The density follows the mean over each texel of the interpolated luminance: it is positive wherever the
    radiance is. A black map is sampled uniformly. All tables are float64.

    density (height, width): [1/sr].
    rotation (3, 3): takes map directions to world directions.
    rows (height + 1): cumulative probability of the rows.
    columns (height * width + 1): cumulative probability within each row, plus the row's number.
    """

    density: Tensor
    rotation: Tensor
    rows: Tensor
    columns: Tensor

    @classmethod
    def build(cls, radiance: Tensor, rotation: Tensor) -> EnvironmentSampler:
        """Tables for a map (height, width, 3) and its rotation."""
        height, width = radiance.shape[:2]
        areas = LatLong(height, width).solid_angles().to(radiance.device)
        mean = _texel_means(radiance.double() @ radiance.new_tensor((0.2126, 0.7152, 0.0722)).double())
        mean = mean.clamp(min=0) if bool((mean > 0).any()) else torch.ones_like(mean)
        density = mean / (mean * areas).sum()
        mass = density * areas
        in_row = torch.where(mass.sum(1, keepdim=True) > 0, mass, 1.0)
        columns = _cumulative(in_row)[:, 1:] + torch.arange(height).to(mass)[:, None]
        columns = F.pad(columns.flatten(), (1, 0))
        return cls(density, rotation.to(radiance.device), _cumulative(mass.sum(1)), columns)

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """World directions (n, 3) and their densities (n,) [1/sr], float32, for numbers u (n, 2) in [0, 1).

        Raises:
            ValueError: u has another shape or leaves [0, 1).
        """
        if u.ndim != 2 or u.shape[1] != 2 or not bool(((u >= 0) & (u < 1)).all()):
            raise ValueError(f"u must be (n, 2) with values in [0, 1), got {tuple(u.shape)}")
        height, width = self.density.shape
        first, second = u.to(self.rows).clamp(max=1 - 2.0**-40).T.contiguous()
        row, along_row = _invert(self.rows, first)
        texel, along_column = _invert(self.columns, row + second)
        density = self.density.flatten()[texel]
        edges = torch.cos(torch.arange(height + 1).to(first) * (pi / height))
        y = edges[row] + along_row * (edges[row + 1] - edges[row])
        phi = (texel % width + along_column) * (2 * pi / width)
        sine = ((1 - y) * (1 + y)).clamp(min=0).sqrt()
        directions = torch.stack((sine * phi.sin(), y, -sine * phi.cos()), dim=-1) @ self.rotation.T
        return directions.float(), density.float()

    def pdf(self, directions: Tensor) -> Tensor:
        """Density (n,) [1/sr], float32, at world directions (n, 3), which need not be unit."""
        height, width = self.density.shape
        cell = LatLong(height, width).cell(directions.to(self.density) @ self.rotation)
        return self.density.flatten()[cell].float()


def _cumulative(mass: Tensor) -> Tensor:
    total = F.pad(mass.cumsum(-1), (1, 0))
    return total / total[..., -1:]


def _invert(cumulative: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The step of a cumulative table in which u falls, and how far along the step, in [0, 1]."""
    index = torch.searchsorted(cumulative, u, right=True) - 1
    below, above = cumulative[index], cumulative[index + 1]
    return index, ((u - below) / (above - below)).clamp(0, 1)


def _surrounded(texels: Tensor) -> Tensor:
    """Texels (h, w, ...) with one more all around: the next ones across the poles and around in u."""
    half = texels.shape[1] // 2
    texels = torch.cat((texels[:1].roll(half, 1), texels, texels[-1:].roll(half, 1)))
    return torch.cat((texels[:, -1:], texels, texels[:, :1]), dim=1)


def _texel_means(texels: Tensor) -> Tensor:
    """Mean over each texel (h, w) of the bilinear interpolant: weights 1/8, 3/4, 1/8 along each axis."""
    t = _surrounded(texels)
    t = (t[:-2] + 6 * t[1:-1] + t[2:]) / 8
    return (t[:, :-2] + 6 * t[:, 1:-1] + t[:, 2:]) / 8


def _texel_weights(height: int, width: int) -> Tensor:
    """Integral over the sphere of the interpolant of one texel of each row (height,) [sr], float64.

    With step d, the integral of (1 - |t - t0| / d) sin t dt is 4 sin(d/2)^2 sin(t0) / d. The first and the
    last row reach across a pole, where |sin t| adds 1 - 2 sin(d/2) / d: for small d, 1/24 d^2 to 1/2 d^2.
    """
    step = pi / height
    rows = 4 * sin(step / 2) ** 2 / step * torch.sin((torch.arange(height, dtype=torch.float64) + 0.5) * step)
    rows[0] += 1 - 2 * sin(step / 2) / step
    rows[-1] += 1 - 2 * sin(step / 2) / step
    return rows * (2 * pi / width)


def _halving(height: int) -> Tensor:
    """Averages of rows (height / 2, height) that preserve constants and the interpolant's integral.

    Rows as intervals of accumulated weight: each new row takes from the old ones that its interval overlaps.
    """
    new, old = (F.pad(_texel_weights(h, h).cumsum(0) * h, (1, 0)) for h in (height // 2, height))
    upper, lower = torch.minimum(new[1:, None], old[1:]), torch.maximum(new[:-1, None], old[:-1])
    return (upper - lower).clamp(min=0) / new.diff()[:, None]


def _even_rows(texels: Tensor, arc: float) -> Tensor:
    """Texels (h, w, 3), blurred along rows by a tent of about `arc` [radians] where texels are narrower."""
    height, width = texels.shape[:2]
    angles = (torch.arange(height).to(texels.device).double() + 0.5) * (pi / height)
    widths = arc / (torch.sin(angles) * (2 * pi / width))
    return _box(_box(texels, widths), widths - 1)  # the interpolation is a third box, of width 1


def _box(texels: Tensor, widths: Tensor) -> Tensor:
    """Means (h, w, 3) along rows over `widths` (h,) texels, at least 1 and at most the row."""
    width = texels.shape[1]
    reach = widths.clamp(1, width)[:, None] / 2
    middle = torch.arange(width).to(reach) + 0.5
    sums = F.pad(texels.double().cumsum(1), (0, 0, 1, 0))
    means = (_cumulated(sums, middle + reach) - _cumulated(sums, middle - reach)) / (2 * reach)[..., None]
    return means.to(texels)


def _cumulated(sums: Tensor, x: Tensor) -> Tensor:
    """Periodic running sums (h, w + 1, 3), linear in between, at columns x (h, w): (h, w, 3)."""
    width = sums.shape[1] - 1
    turns, column = torch.div(x, width, rounding_mode="floor"), (x % width).floor()
    index = column.long().clamp(max=width - 1)[..., None].expand(-1, -1, 3)
    below, above = sums.gather(1, index), sums.gather(1, index + 1)
    return below + (above - below) * (x % width - column)[..., None] + turns[..., None] * sums[:, -1:]


def _bilinear(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Image (h, w, 3) at x, y (...), counted in texels from its upper left corner: (..., 3)."""
    where = torch.stack((x * (2 / image.shape[1]) - 1, y * (2 / image.shape[0]) - 1), dim=-1)
    values = F.grid_sample(
        image.movedim(-1, 0)[None], where.reshape(1, -1, 1, 2), padding_mode="border", align_corners=False
    )
    return values[0, :, :, 0].T.reshape(*x.shape, 3)


def _same(image: Tensor) -> Tensor:
    return image


def _from_cross(image: Tensor) -> Tensor:
    n = image.shape[1] // 3
    axes = torch.tensor(_CROSS_AXES, dtype=torch.float32)  # shape: (face, axis, 3)
    corners = torch.tensor(_CROSS_CORNERS)

    def lookup(directions: Tensor) -> Tensor:
        face = (directions @ axes[:, 0].T).argmax(-1)
        ahead, right, down = (axes[face] @ directions[..., None])[..., 0].unbind(-1)
        column, row = corners[face].unbind(-1)
        x = ((right / ahead + 1) * (n / 2)).clamp(0.5, n - 0.5) + column * n
        y = ((down / ahead + 1) * (n / 2)).clamp(0.5, n - 0.5) + row * n
        return _bilinear(image, x.to(image), y.to(image))

    return LatLong(2 * n, 4 * n).means(lookup, 2)


_CROSS_AXES = (  # ahead, right, down
    ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
)
_CROSS_CORNERS = ((1, 0), (0, 1), (1, 1), (2, 1), (1, 2), (1, 3))  # column, row


def _from_angular(image: Tensor) -> Tensor:
    n = image.shape[0]
    rim = max(0.0, 1 - 8**0.5 / n)  # beyond, the interpolation would reach outside the disc

    def lookup(directions: Tensor) -> Tensor:
        x, y, z = directions.unbind(-1)
        sine = torch.hypot(x, y)
        r = (torch.atan2(sine, -z) / pi).clamp(max=rim) / sine.clamp(min=1e-12)
        return _bilinear(image, ((1 + r * x) * (n / 2)).to(image), ((1 - r * y) * (n / 2)).to(image))

    return LatLong((n + 1) // 2, 2 * ((n + 1) // 2)).means(lookup, 3)


_LAYOUTS: dict[str, tuple[int, int, Callable[[Tensor], Tensor]]] = {
    "latlong": (2, 1, _same),
    "cross": (3, 4, _from_cross),
    "angular": (1, 1, _from_angular),
}


def _to_latlong(image: Tensor, layout: str, path: str | PathLike[str]) -> Tensor:
    if layout not in ("auto", *_LAYOUTS):
        raise ValueError(f"layout must be one of auto, {', '.join(_LAYOUTS)}, got {layout!r}")
    height, width = image.shape[:2]
    allowed = _LAYOUTS if layout == "auto" else {layout: _LAYOUTS[layout]}
    for across, down, convert in allowed.values():
        if width * down == height * across:
            return convert(image).contiguous()
    shapes = ", ".join(f"{across}:{down} ({name})" for name, (across, down, _) in allowed.items())
    raise ValueError(f"{path}: width:height must be {shapes}, got {width} x {height}")


def _cap(direction: Sequence[float] | Tensor, radius: float) -> Tensor:
    """Coverage of texels (*_SIZE) by a cap of `radius` degrees, scaled so that its integral is the cap's.

    On a parallel of polar angle t, a cap at polar angle t0 covers the azimuths within
    acos((cos radius - cos t cos t0) / (sin t sin t0)) of its own: exact along rows, 32 midpoints across.
    """
    if not 0 < radius <= 180:
        raise ValueError(f"radius must satisfy 0 < radius <= 180 degrees, got {radius}")
    x, y, z = _direction(direction).unbind()
    rho, middle, azimuth = radians(radius), torch.atan2(torch.hypot(x, z), y), torch.atan2(x, -z)
    height, width = _SIZE
    edges = torch.linspace(0, pi, height + 1, dtype=torch.float64).clamp(middle - rho, middle + rho)
    steps = edges.diff()[:, None] / 32
    t = edges[:-1, None] + steps * (torch.arange(32, dtype=torch.float64) + 0.5)
    cosine = (cos(rho) - t.cos() * middle.cos()) / (t.sin() * middle.sin()).clamp(min=1e-15)
    arcs = _arc_overlap(cosine.clamp(-1, 1).acos(), azimuth, width)
    covered = (arcs * (steps * t.sin())[..., None]).sum(1) / LatLong(height, width).solid_angles()
    integral = _texel_weights(height, width) @ covered.sum(1)
    return (covered * (2 * pi * (1 - cos(rho)) / integral)).float()


def _arc_overlap(half: Tensor, azimuth: Tensor, width: int) -> Tensor:
    """How much of each of `width` columns (..., width) the arcs azimuth +- half (...) cover [radians]."""
    edges = torch.arange(width + 1, dtype=torch.float64) * (2 * pi / width) - azimuth
    turns = (edges / (2 * pi)).round()
    half = half[..., None]
    within = (edges - 2 * pi * turns).clamp(-half, half)
    return (within + 2 * turns * half).diff(dim=-1)


def _turn(axis: int, degrees: float) -> Tensor:
    matrix = torch.eye(3, dtype=torch.float64)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = cos(radians(degrees)), sin(radians(degrees))
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def _colour(name: str, value: Colour) -> Tensor:
    colour = torch.as_tensor(value, dtype=torch.float32)
    if colour.shape not in ((), (1,), (3,)) or not bool(((colour >= 0) & colour.isfinite()).all()):
        raise ValueError(f"{name} must be one or three finite numbers >= 0, got {value}")
    return colour.expand(3)


def _direction(value: Sequence[float] | Tensor) -> Tensor:
    direction = torch.as_tensor(value, dtype=torch.float64)
    if direction.shape != (3,) or not bool(direction.isfinite().all()) or not bool((direction != 0).any()):
        raise ValueError(f"direction must be three finite numbers, not all 0, got {value}")
    return direction


def _check_finite(name: str, values: Tensor) -> None:
    bad = int((~values.isfinite()).sum())
    if bad:
        raise ValueError(f"{name} must be finite: {bad} of {values.numel()} values are NaN or infinite")


def _check_rotation(r: Tensor) -> None:
    one = torch.eye(3, dtype=torch.float64)
    if r.shape != (3, 3) or r.dtype != torch.float64 or not torch.allclose(r @ r.T, one) or bool(r.det() < 0):
        raise ValueError(f"rotation must be a float64 rotation matrix (3, 3), got {r.tolist()}")
