"""Distant lighting: an HDR map as a function on the sphere.

    light = Environment.load("uffizi.hdr").rotated(y=30)
    light.radiance(directions)          # (..., 3)
    light.project(Cube(64))             # (6, 64, 64, 3), means of the cells

The function is the bilinear interpolant of a lat-long map, in the convention of `ptt.ops.sphere.LatLong`, texel
centres at half texels. It wraps around in u, and across the poles: beyond row 0 comes row 0, half a turn on.
All that is derived from a map (means of cells, the integral, the sampler) belongs to this one function. The function's
integral is the texels' sum by solid angle, but for the first and the last row, whose texels weigh 8 % more.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from math import ceil, pi, radians, sin
from os import PathLike

import torch
import torch.nn.functional as F
from torch import Tensor

from ptt.io.images import read_image
from ptt.light.layouts import Layout, to_latlong
from ptt.ops import latlong
from ptt.ops.sphere import Grid, LatLong, turn

Colour = float | Sequence[float] | Tensor
"""Red, green and blue, or one number for grey; finite and >= 0."""

LARGEST_RADIANCE = 1e30  # of a map, in its own units: products with it must stay within float32, which ends at 3e38
_SIZE = 256, 512  # height and width of maps that are made, not loaded
_LOOKUPS = 1 << 23  # `project` halves a map whose texels would ask for more; bounds its time
_LUMINANCE = 0.2126, 0.7152, 0.0722  # of linear sRGB (IEC 61966-2-1)


@dataclass(frozen=True, eq=False)
class Environment:
    """Radiance from every direction, the same at every point.

    map (height, width, 3): linear RGB, float32, lat-long, width even [the map's own units]; may require grad
    rotation (3, 3): takes map directions to world directions, float64

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
        """Read .exr, .hdr or .png; crosses and angular maps are resampled at matching resolution.

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
        return cls(to_latlong(image.clamp(min=0), layout, path))

    @classmethod
    def constant(cls, radiance: Colour = 1.0) -> Environment:
        """A light with the same radiance from everywhere: its integral is 4 pi times `radiance`."""
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
        top = _colour("zenith", zenith)
        edge = _colour("horizon", horizon)
        below = _colour("ground", ground)
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
        return cls(latlong.cap(_direction(direction), radius, *_SIZE)[..., None] * _colour("radiance", radiance))

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

    def __add__(self, other: Environment) -> Environment:
        """The sum of two lights, such as area lights.

        Raises:
            ValueError: their maps differ in size, or one is turned against the other.
        """
        if self.map.shape != other.map.shape or not torch.equal(self.rotation, other.rotation):
            raise ValueError("lights must have maps of one size that are turned alike: add first, then turn the sum")
        return replace(self, map=self.map + other.map)

    def rotated(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Environment:
        """The environment turned by degrees about the world axes, first x, then y, then z; right-handed."""
        rotation = turn(2, z) @ turn(1, y) @ turn(0, x) @ self.rotation
        _check_rotation(rotation)
        turned = copy(self)  # without checking the map again
        object.__setattr__(turned, "rotation", rotation)
        return turned

    def scaled(self, factor: Colour) -> Environment:
        """The environment with its radiance multiplied by `factor`."""
        return replace(self, map=self.map * _colour("factor", factor).to(self.map))

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance (..., 3) from world directions (..., 3), which need not be unit."""
        x, y, z = (directions.to(self.map) @ self.rotation.to(self.map)).unbind(-1)
        height, width = self.map.shape[:2]
        u = torch.atan2(x, -z) * (width / (2 * pi)) % width
        v = torch.atan2(torch.hypot(x, z), y) * (height / pi)
        return latlong.bilinear(latlong.surrounded(self.map), u + 1, v + 1)

    def project(self, grid: Grid) -> Tensor:
        """Mean radiance of each cell (*grid.shape, 3), by solid angle.

        The means follow from the midpoint rule, with about three samples to a texel along each axis. Where texels are
        narrower, near the poles, rows are first blurred along u to three samples, so that one bright texel keeps its
        energy to 1 or 2 % wherever it is. Where many lookups would be needed, the map is first halved, as long as a
        cell spans more than eight texels; that keeps the integral.
        """
        spacing = float(grid.solid_angles().max().sqrt())
        light = self
        while grid.cells * light._samples_per_cell(spacing) ** 2 > _LOOKUPS and light._may_halve(spacing):
            light = light._halved()
        samples = light._samples_per_cell(spacing)
        even = replace(light, map=latlong.even_rows(light.map, 3 * spacing / samples))
        return grid.means(even.radiance, samples)

    def integral(self) -> Tensor:
        """The integral (3,) of the radiance over the sphere [map's units x sr], exact for the interpolant."""
        weights = latlong.texel_weights(*self.map.shape[:2]).to(self.map)
        return weights @ self.map.sum(1)  # row by row: half a million texels in one float32 sum lose 1e-3

    def sampler(self) -> EnvironmentSampler:
        """A sampler of directions by luminance; gradients stop here."""
        return EnvironmentSampler.build(self.map.detach(), self.rotation)

    def _texel_angle(self) -> float:
        """The smaller side [rad] of a texel on the equator."""
        height, width = self.map.shape[:2]
        return min(pi / height, 2 * pi / width)

    def _samples_per_cell(self, spacing: float) -> int:
        """Samples along the edge of a cell that is `spacing` [rad] wide, three to a texel."""
        return ceil(3 * spacing / self._texel_angle())

    def _may_halve(self, spacing: float) -> bool:
        """Tell whether the map can be halved, and a cell that is `spacing` [rad] wide spans more than eight texels."""
        height, width = self.map.shape[:2]
        return spacing > 8 * self._texel_angle() and height % 2 == 0 and width % 4 == 0

    def _halved(self) -> Environment:
        """The environment with half as many rows and columns, and the same integral."""
        columns = (self.map[:, ::2] + self.map[:, 1::2]) / 2
        rows = latlong.halving(self.map.shape[0]).to(self.map)
        return replace(self, map=torch.einsum("rh,hwc->rwc", rows, columns))


@dataclass(frozen=True, eq=False)
class EnvironmentSampler:
    """Directions drawn with a density that is constant on each texel of the map.

    The density follows the mean over each texel of the interpolated luminance: it is positive wherever the
    radiance is. A black map is sampled uniformly. All tables are float64.

    density (height, width): density of directions [1/sr]
    rotation (3, 3): takes map directions to world directions
    rows (height + 1): cumulative probability of the rows
    columns (height * width + 1): cumulative probability within each row, plus the row's number
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
        mean = latlong.texel_means(radiance.double() @ radiance.new_tensor(_LUMINANCE).double())
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
    """Cumulative probabilities (..., n + 1), from 0 to 1, of masses (..., n)."""
    total = F.pad(mass.cumsum(-1), (1, 0))
    return total / total[..., -1:]


def _invert(cumulative: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The step of a cumulative table in which u falls, and how far along the step, in [0, 1]."""
    index = torch.searchsorted(cumulative, u, right=True) - 1
    below = cumulative[index]
    above = cumulative[index + 1]
    return index, ((u - below) / (above - below)).clamp(0, 1)


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
    bad = int((~(values.abs() <= LARGEST_RADIANCE)).sum())
    if bad:
        raise ValueError(
            f"{name} must be finite: {bad} of {values.numel()} values are NaN or beyond {LARGEST_RADIANCE:g}"
        )


def _check_rotation(r: Tensor) -> None:
    one = torch.eye(3, dtype=torch.float64)
    if r.shape != (3, 3) or r.dtype != torch.float64 or not torch.allclose(r @ r.T, one) or bool(r.det() < 0):
        raise ValueError(f"rotation must be a float64 rotation matrix (3, 3), got {r.tolist()}")
