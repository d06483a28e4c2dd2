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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite, pi, radians, sin
from os import PathLike
from typing import NamedTuple, SupportsFloat

import torch
import torch.nn.functional as F
from torch import Tensor

from ptt.io.images import read_image
from ptt.light.layouts import Layout, to_latlong
from ptt.ops import latlong
from ptt.ops.compiling import in_python
from ptt.ops.directions import turn
from ptt.ops.sphere import Grid, LatLong
from ptt.ops.transforms import beneath, stands_in

Colour = float | Sequence[float] | Tensor
"""Red, green and blue, or one number for grey; finite and >= 0."""

LARGEST_RADIANCE = 1e30  # of a map, in its own units: products with it must stay within float32, which ends at 3e38
_SIZE = 256, 512  # height and width of maps that are made, not loaded
_LUMINANCE = 0.2126, 0.7152, 0.0722  # of linear sRGB (IEC 61966-2-1)
_ONE = torch.ones(3)
_UNTURNED = torch.eye(3, dtype=torch.float64)


@in_python
class Layer(NamedTuple):
    """A map that a light is the sum of.

    texels (height, width, 3): linear RGB, lat-long
    gain (3,): what they are multiplied by; may require grad
    rotation (3, 3): takes map directions to world directions, float64
    largest: absolute value of the texels
    """

    texels: Tensor
    gain: Tensor
    rotation: Tensor
    largest: float

    @property
    def changed(self) -> bool:
        """Whether the gain is not 1."""
        return self.gain.requires_grad or stands_in(self.gain) or self.gain.tolist() != [1.0, 1.0, 1.0]

    def scaled(self, values: Tensor) -> Tensor:
        """Values (..., 3) of the texels times the gain."""
        return values * self.gain.to(values) if self.changed else values


@dataclass(frozen=True, eq=False, init=False)
class Environment:
    """Radiance from every direction, the same at every point: a map, or the sum of several.

    map (height, width, 3): linear RGB, float32, lat-long, width even [the map's own units]; may require grad
    rotation (3, 3): takes map directions to world directions, float64

    `rotated`, `scaled` and `+` keep the maps as they are: what a relighter made ready of each serves them all, and is
    made anew when a map changes. Writes through numpy or `.data`, which torch does not count, are seen where they
    change one of 4096 values that are looked at, and always after `torch.autograd.graph.increment_version(map)`.

    Laws:

    - ``e.rotated(...).radiance(R d) = e.radiance(d)``.
    - The cells of ``e.project(g)`` times ``g.solid_angles()`` sum to ``e.integral()``.
    - `radiance`, `project` and `integral` are linear in `map`, and differentiable.
    - ``(2 * a + b).radiance(d) = 2 * a.radiance(d) + b.radiance(d)``, with `scaled` for the product.

    Raises:
        ValueError: `map` has another shape or type or is not finite; `rotation` is no rotation.
    """

    layers: tuple[Layer, ...]

    def __repr__(self) -> str:
        return f"Environment({' + '.join(map(_described, self.layers))})"

    def __init__(self, map: Tensor, rotation: Tensor | None = None) -> None:
        if map.ndim != 3 or map.shape[2] != 3 or map.shape[1] % 2 or map.numel() == 0:
            raise ValueError(f"map must have shape (height, even width, 3), got {tuple(map.shape)}")
        if map.dtype != torch.float32:
            raise ValueError(f"map must be float32, got {map.dtype}")
        rotation = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
        _check_rotation(rotation)
        layer = Layer(map, _ONE, rotation, _checked_largest("map", map))
        object.__setattr__(self, "layers", (layer,))

    @classmethod
    def _of(cls, layers: Iterable[Layer]) -> Environment:
        """The sum of layers."""
        environment = object.__new__(cls)
        object.__setattr__(environment, "layers", tuple(layers))
        largest = sum(layer.largest * float(beneath(layer.gain).detach().max()) for layer in environment.layers)
        if not largest <= LARGEST_RADIANCE:
            raise ValueError(f"radiance must stay within {LARGEST_RADIANCE:g}, got up to {largest:g}")
        return environment

    @property
    def map(self) -> Tensor:
        """The light as one map, turned by `rotation`; of maps that differ in size or turn, resampled to the largest."""
        if self._one_frame:
            return self._summed(lambda texels, _: texels)
        height = max(len(layer.texels) for layer in self.layers)
        width = max(layer.texels.shape[1] for layer in self.layers)
        turn = self.rotation.float().T
        return LatLong(height, width).means(lambda directions: self.radiance(directions @ turn), 3)

    @property
    def rotation(self) -> Tensor:
        """What takes directions of `map` to world directions: that of the first layer."""
        return self.layers[0].rotation

    def factored(self) -> tuple[Environment, Tensor | None]:
        """A light and the factor (3,) that it must be multiplied by; None for 1, and for a sum of maps."""
        first, *others = self.layers
        if others or not first.changed:
            return self, None
        return Environment._of([first._replace(gain=_ONE)]), first.gain

    @property
    def _one_frame(self) -> bool:
        """Whether all layers have texels in the same directions."""
        first = self.layers[0]
        return all(
            layer.texels.shape == first.texels.shape and torch.equal(layer.rotation, first.rotation)
            for layer in self.layers
        )

    @classmethod
    def load(cls, path: str | PathLike[str], layout: Layout = "auto", layer: str | None = None) -> Environment:
        """Read .exr, .hdr or .png; what is not lat-long is resampled at matching resolution.

        layout: of the sphere in the image (`ptt.light.layouts.Layout`), at any width and height
        layer: of an .exr with several parts or layers, the one to read

        Negative values become 0, with one warning that counts them. Grey becomes RGB; alpha is dropped.

        Raises:
            ValueError: the file cannot be read, is not finite, or its width and height do not tell the layout.
        """
        image = read_image(path, layer)
        image = image[..., :3] if image.shape[2] > 2 else image[..., :1].expand(-1, -1, 3)
        _checked_largest(str(path), image)
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
        """The sum of two lights, of any sizes and turns."""
        return Environment._of(self.layers + other.layers)

    def rotated(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Environment:
        """The environment turned by degrees about the world axes, first x, then y, then z; right-handed."""
        for angle in (x, y, z):
            if not isinstance(angle, SupportsFloat) or getattr(angle, "ndim", 0) > 0 or not isfinite(angle):
                raise ValueError(f"angles must be finite numbers of degrees, got {angle!r}")
        rotation = _UNTURNED
        for axis, angle in enumerate((x, y, z)):
            rotation = turn(axis, angle) @ rotation if angle else rotation
        return Environment._of(layer._replace(rotation=rotation @ layer.rotation) for layer in self.layers)

    def scaled(self, factor: Colour) -> Environment:
        """The environment with its radiance multiplied by `factor`, which may require grad."""
        colour = _colour("factor", factor)
        return Environment._of(layer._replace(gain=layer.gain * colour) for layer in self.layers)

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance (..., 3) from world directions (..., 3), which need not be unit."""
        return self._summed(
            lambda texels, rotation: latlong.radiance(texels, directions.to(texels) @ rotation.to(texels))
        )

    def project(self, grid: Grid) -> Tensor:
        """Mean radiance of each cell (*grid.shape, 3), by solid angle (`ptt.ops.latlong.means`)."""
        return self._summed(lambda texels, rotation: latlong.means(texels, grid, rotation))

    def integral(self) -> Tensor:
        """The integral (3,) of the radiance over the sphere [map's units x sr], exact for the interpolant."""

        def integral(texels: Tensor, _: Tensor) -> Tensor:
            weights = latlong.texel_weights(*texels.shape[:2]).to(texels)
            return weights @ texels.sum(1)  # row by row: half a million texels in one float32 sum lose 1e-3

        return self._summed(integral)

    def sampler(self) -> EnvironmentSampler:
        """A sampler of directions by luminance; gradients stop here."""
        return EnvironmentSampler.build(self.map.detach(), self.rotation)

    def _summed(self, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """The sum of function(texels, rotation) (..., 3), linear in the texels, over the layers."""
        first, *others = [layer.scaled(function(layer.texels, layer.rotation)) for layer in self.layers]
        return sum(others, first)


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
    values = beneath(colour)
    if colour.shape not in ((), (1,), (3,)) or not bool(((values >= 0) & values.isfinite()).all()):
        raise ValueError(f"{name} must be one or three finite numbers >= 0, got {values.tolist()}")
    return colour.expand(3)


def _direction(value: Sequence[float] | Tensor) -> Tensor:
    direction = torch.as_tensor(value, dtype=torch.float64)
    if direction.shape != (3,) or not bool(direction.isfinite().all()) or not bool((direction != 0).any()):
        raise ValueError(f"direction must be three finite numbers, not all 0, got {value}")
    return direction


def _checked_largest(name: str, values: Tensor) -> float:
    """The largest absolute value; of a batch, that of all its samples.

    Raises:
        ValueError: one is NaN, or beyond LARGEST_RADIANCE.
    """
    values = beneath(values).detach()
    largest = float(values.abs().max())
    if largest <= LARGEST_RADIANCE:
        return largest
    bad = int((~(values.abs() <= LARGEST_RADIANCE)).sum())
    raise ValueError(f"{name} must be finite: {bad} of {values.numel()} values are NaN or beyond {LARGEST_RADIANCE:g}")


def _described(layer: Layer) -> str:
    """A layer in a few words."""
    height, width, _ = layer.texels.shape
    turned = "" if torch.equal(layer.rotation, torch.eye(3, dtype=torch.float64)) else ", turned"
    gain = f", times {[round(x, 4) for x in layer.gain.tolist()]}" if layer.changed else ""
    return f"map of {width} x {height}, at most {layer.largest:.3g}{gain}{turned}"


def _check_rotation(r: Tensor) -> None:
    one = torch.eye(3, dtype=torch.float64)
    if r.shape != (3, 3) or r.dtype != torch.float64 or not torch.allclose(r @ r.T, one) or bool(r.det() < 0):
        raise ValueError(f"rotation must be a float64 rotation matrix (3, 3), got {r.tolist()}")
