"""Colour: the sRGB curve, and linear values from other primaries in those of Rec. 709, which all of ptt works in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""x and y of red, green, blue and white."""
BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))
"""From XYZ to the responses of the eye's cones that adapt to a white."""


def to_srgb(linear: Tensor) -> Tensor:
    """sRGB-encoded values (IEC 61966-2-1) of linear ones, which are clipped to [0, 1]."""
    x = linear.clamp(0, 1)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Tensor) -> Tensor:
    """Linear values of sRGB-encoded ones in [0, 1]: the inverse of `to_srgb`."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def to_xyz(primaries: Sequence[float]) -> NDArray[np.float64]:
    """The matrix (3, 3) from RGB of some primaries, x and y of red, green, blue and white, to XYZ; white has Y = 1.

    Raises:
        ValueError: they are no primaries: not eight numbers, or red, green and blue on one line.
    """
    if len(primaries) != 8 or not np.isfinite(primaries).all() or min(primaries[1::2]) == 0:
        raise ValueError(f"primaries must be x and y of red, green, blue and white, got {tuple(primaries)}")
    x, y = np.array(primaries, dtype=np.float64).reshape(4, 2).T
    columns = np.stack((x / y, np.ones(4), (1 - x - y) / y))
    if abs(np.linalg.det(columns[:, :3])) < 1e-9:
        raise ValueError(f"red, green and blue must not lie on one line, got {tuple(primaries)}")
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def to_rec_709(primaries: Sequence[float]) -> NDArray[np.float64]:
    """The matrix (3, 3) from linear RGB of some primaries to that of Rec. 709; white stays white (Bradford)."""
    ours = to_xyz(REC_709)
    theirs = to_xyz(primaries)
    cones = np.array(BRADFORD)
    gain = cones @ ours.sum(1) / (cones @ theirs.sum(1))
    adapted = np.linalg.solve(cones, gain[:, None] * cones) @ theirs
    return np.linalg.solve(ours, adapted).astype(np.float64)
