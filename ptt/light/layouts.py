"""Layouts of the sphere in an image: lat-long, cross, angular map, equal-area octahedron; all become lat-long."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from math import pi
from os import PathLike
from typing import Literal

import torch
from torch import Tensor

from ptt.ops import latlong
from ptt.ops.sphere import LatLong

Layout = Literal["auto", "latlong", "cross", "angular", "octahedral"]
"""The layout of the sphere in an image.

auto: lat-long where width : height is 2:1, a cross where it is 3:4; a square says nothing, and is taken for an angular
    map with a warning that asks
latlong: that of `LatLong`
cross: vertical, from the top +Y; -X -Z +X; -Y; +Z upside down
angular: direction (sin(pi r) a / r, sin(pi r) b / r, -cos(pi r)), a to the right, b up, r = |(a, b)| <= 1
octahedral: Clarberg's equal-area map as in pbrt-v4, its z axis up and its y axis to -Z
"""


def _from_latlong(image: Tensor) -> Tensor:
    """The same, where the width is odd at twice the width: the same interpolant, but for its kinks."""
    if image.shape[1] % 2 == 0:
        return image
    left = torch.lerp(image, image.roll(1, 1), 0.25)
    right = torch.lerp(image, image.roll(-1, 1), 0.25)
    return torch.stack((left, right), 2).flatten(1, 2)


def _from_cross(image: Tensor) -> Tensor:
    """The lat-long map of a vertical cross, three faces wide and four high."""
    height = image.shape[0] / 4
    width = image.shape[1] / 3
    axes = torch.tensor(_CROSS_AXES, dtype=torch.float32)  # shape: (face, axis, 3)
    corners = torch.tensor(_CROSS_CORNERS)

    def lookup(directions: Tensor) -> Tensor:
        face = (directions @ axes[:, 0].T).argmax(-1)
        ahead, right, down = (axes[face] @ directions[..., None])[..., 0].unbind(-1)
        column, row = corners[face].unbind(-1)
        x = ((right / ahead + 1) * (width / 2)).clamp(0.5, width - 0.5) + column * width
        y = ((down / ahead + 1) * (height / 2)).clamp(0.5, height - 0.5) + row * height
        return latlong.bilinear(image, x.to(image), y.to(image))

    n = max(1, round(height))
    return LatLong(2 * n, 4 * n).means(lookup, 2)


_CROSS_AXES = (  # ahead, right and down in each face
    ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
)
_CROSS_CORNERS = ((1, 0), (0, 1), (1, 1), (2, 1), (1, 2), (1, 3))  # column and row of each face


def _from_angular(image: Tensor) -> Tensor:
    """The lat-long map of an angular map, with as many rows as the radius has texels."""
    height, width = image.shape[:2]
    rim = max(0.0, 1 - 8**0.5 / min(height, width))  # beyond, the interpolation would reach outside the disc

    def lookup(directions: Tensor) -> Tensor:
        x, y, z = directions.unbind(-1)
        sine = torch.hypot(x, y)
        r = (torch.atan2(sine, -z) / pi).clamp(max=rim) / sine.clamp(min=1e-12)
        return latlong.bilinear(image, ((1 + r * x) * (width / 2)).to(image), ((1 - r * y) * (height / 2)).to(image))

    rows = (height + 1) // 2
    return LatLong(rows, 2 * rows).means(lookup, 3)


def _from_octahedral(image: Tensor) -> Tensor:
    """The lat-long map of an equal-area octahedron, with as many rows as make its texels about as large."""
    height, width = image.shape[:2]

    def lookup(directions: Tensor) -> Tensor:
        """Clarberg 2008, Fast equal-area mapping of the (hemi)sphere using SIMD, in pbrt-v4's axes."""
        x, up, y = directions.unbind(-1)
        y = -y
        r = (1 - up.abs()).clamp(min=0).sqrt()
        turn = torch.atan2(y.abs(), x.abs()) * (2 / pi)
        v = turn * r
        u = r - v
        below = up < 0
        u, v = torch.where(below, 1 - v, u), torch.where(below, 1 - u, v)
        across = (1 + u.copysign(x)) * (width / 2)
        down = (1 + v.copysign(y)) * (height / 2)
        return latlong.bilinear(image, across.to(image), down.to(image))

    rows = max(1, round(height / 2**0.5))
    return LatLong(rows, 2 * rows).means(lookup, 2)


_LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "latlong": _from_latlong,
    "cross": _from_cross,
    "angular": _from_angular,
    "octahedral": _from_octahedral,
}
_RATIOS = {"latlong": (2, 1), "cross": (3, 4)}  # width : height that only one of them has


def to_latlong(image: Tensor, layout: str, path: str | PathLike[str]) -> Tensor:
    """An image (h, w, 3) in a layout as a lat-long map; the path is for messages.

    Raises:
        ValueError: the layout is unknown, or "auto" where width : height does not tell it.
    """
    if layout not in ("auto", *_LAYOUTS):
        raise ValueError(f"layout must be one of auto, {', '.join(_LAYOUTS)}, got {layout!r}")
    if layout == "auto":
        layout = _by_ratio(image.shape[0], image.shape[1], path)
    return _LAYOUTS[layout](image).contiguous()


def _by_ratio(height: int, width: int, path: str | PathLike[str]) -> str:
    """The layout that width : height tell."""
    for name, (across, down) in _RATIOS.items():
        if width * down == height * across:
            return name
    ask = f"say which it is: layout= one of {', '.join(map(repr, _LAYOUTS))}"
    if width == height:
        warnings.warn(f"{path}: a square may be any layout, and was taken for angular; {ask}", stacklevel=4)
        return "angular"
    shapes = ", ".join(f"{across}:{down} ({name})" for name, (across, down) in _RATIOS.items())
    raise ValueError(f"{path}: {width} x {height} is neither of {shapes}, the ratios that tell a layout; {ask}")
