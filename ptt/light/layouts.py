"""Layouts of the sphere in an image: lat-long, vertical cross, angular map; all become lat-long."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from os import PathLike
from typing import Literal

import torch
from torch import Tensor

from ptt.ops import latlong
from ptt.ops.grids import LatLong

Layout = Literal["auto", "latlong", "cross", "angular"]
"""The layout of the sphere in an image; "auto" decides by width : height.

latlong (2:1): that of `LatLong`. cross (3:4): vertical, from the top +Y; -X -Z +X; -Y; +Z upside down.
angular (1:1): direction (sin(pi r) a / r, sin(pi r) b / r, -cos(pi r)), a to the right, b up, r = |(a, b)| <= 1.
"""


def _unchanged(image: Tensor) -> Tensor:
    return image


def _from_cross(image: Tensor) -> Tensor:
    """The lat-long map (2 n, 4 n, 3) of a vertical cross (4 n, 3 n, 3)."""
    n = image.shape[1] // 3
    axes = torch.tensor(_CROSS_AXES, dtype=torch.float32)  # shape: (face, axis, 3)
    corners = torch.tensor(_CROSS_CORNERS)

    def lookup(directions: Tensor) -> Tensor:
        face = (directions @ axes[:, 0].T).argmax(-1)
        ahead, right, down = (axes[face] @ directions[..., None])[..., 0].unbind(-1)
        column, row = corners[face].unbind(-1)
        x = ((right / ahead + 1) * (n / 2)).clamp(0.5, n - 0.5) + column * n
        y = ((down / ahead + 1) * (n / 2)).clamp(0.5, n - 0.5) + row * n
        return latlong.bilinear(image, x.to(image), y.to(image))

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
    """The lat-long map of an angular map (n, n, 3), with as many rows as the radius has texels."""
    n = image.shape[0]
    rim = max(0.0, 1 - 8**0.5 / n)  # beyond, the interpolation would reach outside the disc

    def lookup(directions: Tensor) -> Tensor:
        x, y, z = directions.unbind(-1)
        sine = torch.hypot(x, y)
        r = (torch.atan2(sine, -z) / pi).clamp(max=rim) / sine.clamp(min=1e-12)
        return latlong.bilinear(image, ((1 + r * x) * (n / 2)).to(image), ((1 - r * y) * (n / 2)).to(image))

    return LatLong((n + 1) // 2, 2 * ((n + 1) // 2)).means(lookup, 3)


_LAYOUTS: dict[str, tuple[int, int, Callable[[Tensor], Tensor]]] = {
    "latlong": (2, 1, _unchanged),
    "cross": (3, 4, _from_cross),
    "angular": (1, 1, _from_angular),
}


def to_latlong(image: Tensor, layout: str, path: str | PathLike[str]) -> Tensor:
    """An image (h, w, 3) in a layout as a lat-long map; the path is for messages.

    Raises:
        ValueError: the layout is unknown, or width : height is not that of the layout.
    """
    if layout not in ("auto", *_LAYOUTS):
        raise ValueError(f"layout must be one of auto, {', '.join(_LAYOUTS)}, got {layout!r}")
    height, width = image.shape[:2]
    allowed = _LAYOUTS if layout == "auto" else {layout: _LAYOUTS[layout]}
    for across, down, convert in allowed.values():
        if width * down == height * across:
            return convert(image).contiguous()
    shapes = ", ".join(f"{across}:{down} ({name})" for name, (across, down, _) in allowed.items())
    raise ValueError(f"{path}: width:height must be {shapes}, got {width} x {height}")
