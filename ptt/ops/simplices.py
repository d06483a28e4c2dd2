"""Piecewise linear interpolation between scattered points of a line or a plane."""

from __future__ import annotations

import torch
from scipy.spatial import Delaunay
from torch import Tensor


class Simplices:
    """Points (h, d) float64, d = 1 or 2, triangulated (Delaunay); a single point stands for everything.

    Raises:
        ValueError: points of another dimension, not finite, or all of a plane's on one line.
    """

    def __init__(self, points: Tensor) -> None:
        count, dimension = points.shape
        if dimension not in (1, 2) or not bool(torch.isfinite(points).all()):
            raise ValueError(f"points must be finite (h, 1) or (h, 2), got {tuple(points.shape)}")
        self.points = points.double()
        self._scale = (points.amax(0) - points.amin(0)).double().clamp(min=1e-300)
        if count == 1:
            self._cells = self._hull = torch.zeros(0, 2, dtype=torch.int64)
        elif dimension == 1:
            order = points[:, 0].argsort()
            self._cells = self._hull = torch.stack((order[:-1], order[1:]), 1)
        else:
            if int(torch.linalg.matrix_rank((self.points - self.points[0]) / self._scale, rtol=1e-9)) < 2:
                raise ValueError("points of a plane must not lie on one line")
            self._triangles = Delaunay((self.points / self._scale).numpy())
            self._cells = torch.from_numpy(self._triangles.simplices).long()
            self._hull = torch.from_numpy(self._triangles.convex_hull).long()

    def weights(self, point: Tensor) -> Tensor:
        """Weights (h,) float64, >= 0, sum 1, at most d + 1 of them not zero, that place the points at a point (d,).

        Outside of the hull, those of its nearest point; along each axis, lengths count in parts of the range.
        Differentiable in the point.
        """
        point = point.double()
        if len(self.points) == 1:
            return point.new_ones(1)
        inside = -1
        if self.points.shape[1] == 2:
            scaled = (point / self._scale).detach().numpy()
            inside = int(self._triangles.find_simplex(scaled, tol=1e-9))
        return self._on_hull(point) if inside < 0 else self._within(self._cells[inside], point)

    def _within(self, corners: Tensor, point: Tensor) -> Tensor:
        a, b, c = self.points[corners]
        u, v = torch.linalg.solve(torch.stack((b - a, c - a), 1), point - a)
        weights = torch.stack((1 - u - v, u, v)).clamp(min=0)
        return self._scatter(corners, weights / weights.sum())

    def _on_hull(self, point: Tensor) -> Tensor:
        """The nearest point on the hull's edges, or on the intervals of a line."""
        a, b = (self.points / self._scale)[self._hull].unbind(1)
        point = point / self._scale
        t = (((point - a) * (b - a)).sum(1) / (b - a).square().sum(1)).clamp(0, 1)
        nearest = int((a + t[:, None] * (b - a) - point).norm(dim=1).argmin())
        return self._scatter(self._hull[nearest], torch.stack((1 - t[nearest], t[nearest])))

    def _scatter(self, corners: Tensor, weights: Tensor) -> Tensor:
        return torch.zeros(len(self.points), dtype=torch.float64).index_put((corners,), weights)
