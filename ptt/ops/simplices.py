"""Piecewise linear interpolation between points of a line or a plane."""

from __future__ import annotations

import math

import torch
from scipy.spatial import Delaunay
from torch import Tensor, nn

INSIDE = 1e-9  # a barycentric weight that is less below zero is inside


class Simplices:
    """Points (h, d) float64, d = 1 or 2, triangulated (Delaunay); a single point stands for everything.

    Points that are all pairs of some values of either axis form a grid, and interpolation between them is bilinear: a
    triangle would take what one axis does from one side of the other, now from this side and now from that.

    Raises:
        ValueError: points of another dimension, none, not finite, one twice, or all of a plane's on one line.
    """

    def __init__(self, points: Tensor) -> None:
        if points.ndim != 2 or points.shape[1] not in (1, 2) or not len(points) or not bool(points.isfinite().all()):
            raise ValueError(f"points must be finite (h, 1) or (h, 2), got {tuple(points.shape)}")
        count = len(points)
        if len(points.unique(dim=0)) < count:
            raise ValueError("points must differ, got one twice")
        self.points = points.double()
        self._scale = (points.amax(0) - points.amin(0)).double().clamp(min=1e-300)
        axes = [column.unique() for column in self.points.T.contiguous()]
        lengths = [len(axis) for axis in axes]
        self._axes = axes if math.prod(lengths) == count and (min(lengths) > 1 or count == 1) else []
        columns = self.points.T.contiguous()
        self._places = [torch.searchsorted(axis, x) for axis, x in zip(self._axes, columns, strict=False)]
        if not self._axes:
            self._triangulate()

    def _triangulate(self) -> None:
        if int(torch.linalg.matrix_rank((self.points - self.points[0]) / self._scale, rtol=1e-9)) < 2:
            raise ValueError("points of a plane must not lie on one line")
        triangles = Delaunay((self.points / self._scale).numpy())
        self._cells = torch.from_numpy(triangles.simplices).long()
        corners = nn.functional.pad(self.points[self._cells], (0, 1), value=1.0)  # shape: (t, 3, 3), a corner a row
        self._slopes, self._offsets = torch.linalg.inv(corners.mT).split((2, 1), dim=2)
        self._hull = torch.from_numpy(triangles.convex_hull).long()

    def weights(self, point: Tensor) -> Tensor:
        """Weights (h,) float64 whose mean of the points is a point (d,): >= 0, sum 1, at most 2^d of them not zero.

        A point outside of the hull has the weights of the hull's nearest point, where lengths along each axis count in
        parts of the points' range. Differentiable in the point.
        """
        point = point.double()
        if self._axes:
            return self._on_grid(point)
        weights = self._slopes @ point + self._offsets[..., 0]  # shape: (t, 3)
        least, cell = (extreme.item() for extreme in weights.detach().amin(1).max(0))
        if least < -INSIDE:
            return self._on_hull(point)
        weights = weights[cell].clamp(min=0)
        return self._scatter(self._cells[cell], weights / weights.sum())

    def _on_grid(self, point: Tensor) -> Tensor:
        """Bilinear weights (h,)."""
        weights = torch.ones(len(self.points), dtype=torch.float64)
        for axis, place, x in zip(self._axes, self._places, point, strict=True):
            weights = weights * _along(axis, x)[place]
        return weights

    def _on_hull(self, point: Tensor) -> Tensor:
        """Weights (h,) of the nearest point on the hull's edges."""
        a, b = (self.points / self._scale)[self._hull].unbind(1)
        point = point / self._scale
        t = (((point - a) * (b - a)).sum(1) / (b - a).square().sum(1)).clamp(0, 1)
        nearest = int((a + t[:, None] * (b - a) - point).norm(dim=1).argmin())
        return self._scatter(self._hull[nearest], torch.stack((1 - t[nearest], t[nearest])))

    def _scatter(self, corners: Tensor, weights: Tensor) -> Tensor:
        """Weights (h,) of all points from those of some."""
        return torch.zeros(len(self.points), dtype=torch.float64).index_put((corners,), weights)


def _along(axis: Tensor, x: Tensor) -> Tensor:
    """Linear weights (n,) of ascending values (n,) at x; beyond an end, all weight is on it."""
    if len(axis) == 1:
        return torch.ones_like(axis)
    k = torch.searchsorted(axis, x.detach()).clamp(1, len(axis) - 1)
    t = ((x - axis[k - 1]) / (axis[k] - axis[k - 1])).clamp(0, 1)
    return torch.zeros_like(axis).index_put((torch.stack((k - 1, k)),), torch.stack((1 - t, t)))
