"""Directions and angles: unit vectors, turns, and the solid angles of triangles."""

from __future__ import annotations

from math import cos, radians, sin

import torch
from torch import Tensor

from ptt.ops.constants import TINY


def unit(directions: Tensor) -> Tensor:
    """Directions (..., 3) scaled to length 1."""
    lengths: Tensor = torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    return directions / lengths


def checked_directions(directions: Tensor) -> Tensor:
    """Directions (..., 3) in float64.

    Raises:
        ValueError: another shape, or a direction that is zero or not finite.
    """
    d = directions.to(torch.float64)
    if d.ndim < 1 or d.shape[-1] != 3:
        raise ValueError(f"directions must have shape (..., 3), got {tuple(directions.shape)}")
    bad = ~(d.isfinite().all(-1) & (d != 0).any(-1))
    if bad.any():
        raise ValueError(f"directions must be finite and non-zero: {int(bad.sum())} of {bad.numel()} are not")
    return d


def toward(eye: Tensor, positions: Tensor, axis: int = -1) -> Tensor:
    """Unit directions from positions, whose coordinates lie along an axis, to an eye (3,).

    An eye of the shape of the positions holds the directions themselves. A position in the eye has the direction 0.
    """
    if eye.ndim == 1:
        shape = [1] * positions.ndim
        shape[axis] = 3
        eye = eye.reshape(shape) - positions
    return eye / eye.square().sum(axis, keepdim=True).clamp(min=TINY).sqrt()


def turn(axis: int, degrees: float) -> Tensor:
    """Right-handed rotation (3, 3) about axis 0, 1 or 2 by degrees, float64."""
    c = cos(radians(degrees))
    s = sin(radians(degrees))
    about_x = ((1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c))
    rows = [[about_x[(i - axis) % 3][(j - axis) % 3] for j in range(3)] for i in range(3)]
    return torch.tensor(rows, dtype=torch.float64)


def triangle_solid_angles(p: Tensor, q: Tensor, r: Tensor, volume: Tensor | None = None) -> Tensor:
    """Solid angles (...) [sr] of triangles with corners (..., 3), by Van Oosterom and Strackee.

    volume (...): |p . (q x r)|, where it is known without cancellation
    """
    if volume is None:
        volume = (p * torch.linalg.cross(q, r)).sum(-1).abs()
    lp, lq, lr = (corner.norm(dim=-1) for corner in (p, q, r))
    pq, qr, rp = ((a * b).sum(-1) for a, b in ((p, q), (q, r), (r, p)))
    return 2 * torch.atan2(volume, lp * lq * lr + pq * lr + qr * lp + rp * lq)


def faces_eye(dip: Tensor, height: Tensor, eye: Tensor) -> Tensor:
    """Whether an eye (3,) sees the front of a triangle of points (n,), by `mesh.dips` and its heights above their
    horizons (n,), the cosines to the normals; points of which directions (3, n) to a viewer are given are all seen.

    Surfaces are one-sided: a picture shows nothing of the other points, a third to a half of a mesh.
    """
    return height > -dip if eye.ndim == 1 else torch.ones_like(height, dtype=torch.bool)
