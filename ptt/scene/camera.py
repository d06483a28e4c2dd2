"""A pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ptt.ops.directions import toward

Vector = tuple[float, float, float]
PARALLEL = 1e-9  # sine of the least angle between up and the view


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks from an eye to a target.

    eye, target, up: positions, and a direction, in world space
    fov: vertical angle of view [degrees]
    width, height: size of the image [pixels]

    Raises:
        ValueError: eye and target coincide, up runs along the view, fov is outside (0, 180), or the image is empty.
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov: float = 40.0
    width: int = 640
    height: int = 480

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))
        if not 0 < self.fov < 180:
            raise ValueError(f"fov must lie between 0 and 180 degrees, got {self.fov}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width and height must be at least 1 pixel, got {self.width} x {self.height}")
        if not all(map(math.isfinite, self._axes()[0])):
            raise ValueError(f"eye, target and up must span a view, got {self.eye}, {self.target}, {self.up}")

    @classmethod
    def framing(cls, centre: Tensor, radius: float) -> Camera:
        """A three-quarter view from the front, right and above of the sphere (centre (3,), radius)."""
        away = torch.tensor([0.5, 0.45, 1.0], dtype=torch.float64)
        distance = radius / math.sin(math.radians(cls.fov / 2))
        eye = centre.double() + away / away.norm() * distance
        return cls(tuple(eye.tolist()), tuple(centre.tolist()))

    def orbited(self, degrees: float) -> Camera:
        """The camera turned about the vertical axis through its target; positive = right-handed."""
        c = math.cos(math.radians(degrees))
        s = math.sin(math.radians(degrees))
        x, y, z = (e - t for e, t in zip(self.eye, self.target, strict=True))
        around = (self.target[0] + c * x + s * z, self.target[1] + y, self.target[2] - s * x + c * z)
        return replace(self, eye=around)

    def moved(self, by: Tensor) -> Camera:
        """The camera moved by a vector (3,)."""
        x, y, z = by.tolist()
        eye, target = ((at[0] + x, at[1] + y, at[2] + z) for at in (self.eye, self.target))
        return replace(self, eye=eye, target=target)

    def axes(self) -> Tensor:
        """Unit vectors (3, 3) float64: to the right, up, and ahead in the image."""
        return torch.tensor(self._axes(), dtype=torch.float64)

    def _axes(self) -> tuple[Vector, Vector, Vector]:
        """`axes` as numbers; NaN where there is no view, or up runs along it."""
        ex, ey, ez = self.eye
        tx, ty, tz = self.target
        ahead = _unit((tx - ex, ty - ey, tz - ez))
        across = _cross(ahead, _unit(self.up))
        right = _unit(across) if math.hypot(*across) > PARALLEL else (math.nan, math.nan, math.nan)
        return right, _cross(right, ahead), ahead

    def rays(self) -> tuple[Tensor, Tensor]:
        """Origin (3,) and unit directions (height, width, 3) through the pixels' centres, row 0 on top."""
        half = math.tan(math.radians(self.fov / 2))
        y = -_centres(self.height) * half
        x = _centres(self.width) * half * self.width / self.height
        rows, columns = torch.meshgrid(y, x, indexing="ij")
        directions = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ self.axes()
        return torch.tensor(self.eye), (directions / directions.norm(dim=-1, keepdim=True)).float()

    def toward(self, points: Tensor) -> Tensor:
        """Unit directions (v, 3) from points (v, 3) to the eye."""
        eye = torch.tensor(self.eye, dtype=torch.float64, device=points.device)
        return toward(eye, points.double()).to(points.dtype)


def _centres(count: int) -> Tensor:
    """Middles (count,) of equal steps from -1 to 1."""
    return (torch.arange(count, dtype=torch.float64) + 0.5) * (2 / count) - 1


def _unit(x: Vector) -> Vector:
    """The vector scaled to length 1; NaN for zero."""
    size = math.hypot(*x) or math.nan
    return (x[0] / size, x[1] / size, x[2] / size)


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _vector(name: str, value: Sequence[float]) -> Vector:
    x = tuple(float(c) for c in value)
    if len(x) != 3 or not all(map(math.isfinite, x)):
        raise ValueError(f"{name} must be three finite numbers, got {value}")
    return x
