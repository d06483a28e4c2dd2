"""Embree occlusion and first hits, on all cores.

embreex fixes the near end of every ray at 0, so origins must be moved off the surface by the caller
(`Surface.offset`); the mesh is recentred and rescaled to the unit sphere first, because float32 keeps about
1e-7 of the largest coordinate, not of the object's size.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

RAYS_PER_TASK = 1 << 17  # 3 MB of origins and directions
OFFSET = 1e-5  # of the scene's radius, by which origins leave the surface; on a unit sphere 1e-6 ended all self-hits


class Hits(NamedTuple):
    """First hits of n rays.

    triangle (n,): index of the face hit, -1 for a miss
    barycentric (n, 3): weights of the face's three vertices, 0 for a miss
    distance (n,): in units of the ray direction's length, inf for a miss
    front (n,): True where the ray meets the side on which the vertices turn counter-clockwise
    """

    triangle: Tensor
    barycentric: Tensor
    distance: Tensor
    front: Tensor


class Surface:
    """A triangle mesh that rays can be shot at.

    vertices (v, 3): positions in world space
    faces (f, 3): vertex indices

    Raises:
        ImportError: embreex is not installed.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        points = vertices.detach().cpu().double()
        low = points.amin(0)
        high = points.amax(0)
        self.centre = (low + high) / 2
        self.radius = max(float((points - self.centre).norm(dim=1).max()), 1e-30)
        self.threads = os.cpu_count() or 1
        unit = ((points - self.centre) / self.radius).float().contiguous().numpy()
        self._embree = _build(unit, faces.detach().cpu().int().contiguous().numpy())

    def offset(self, points: Tensor, normals: Tensor) -> Tensor:
        """Ray origins (n, 3), float64: points moved off the surface along their normals, by 1e-5 of the scene."""
        return points.double() + normals.double() * (OFFSET * self.radius)

    def occluded(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Tell whether anything lies along each ray: (n, 3), (n, 3) -> (n,) bool. Origins are used as they are."""

        def query(o: np.ndarray, d: np.ndarray) -> Any:
            return self._embree.run(o, d, query="OCCLUDED") == 0

        parts = self._chunks(query, origins, directions)
        return torch.from_numpy(np.concatenate(parts)) if parts else torch.zeros(0, dtype=torch.bool)

    def first_hit(self, origins: Tensor, directions: Tensor) -> Hits:
        """The nearest hit of each ray: (n, 3), (n, 3) -> Hits. Origins are used as they are."""

        def query(o: np.ndarray, d: np.ndarray) -> Any:
            return self._embree.run(o, d, output=True)

        parts = self._chunks(query, origins, directions) or [query(*np.zeros((2, 0, 3), np.float32))]

        def joined(field: str) -> Tensor:
            return torch.from_numpy(np.concatenate([part[field] for part in parts]))

        triangle = joined("primID").long()
        miss = triangle < 0
        u = joined("u")
        v = joined("v")
        barycentric = torch.stack([1 - u - v, u, v], -1).masked_fill(miss[:, None], 0.0)
        distance = (joined("tfar").double() * self.radius).float().masked_fill(miss, torch.inf)
        # embreex gives Ng = (v1 - v0) x (v2 - v0): against the ray where it meets the counter-clockwise side.
        front = ((joined("Ng") * directions.cpu().float()).sum(-1) < 0) & ~miss
        return Hits(triangle, barycentric, distance, front)

    def _chunks(self, query: Callable[..., Any], origins: Tensor, directions: Tensor) -> list[Any]:
        """The results of a query for the rays of each task, on all cores."""

        def run(start: int) -> Any:
            o = (origins[start : start + RAYS_PER_TASK].double() - self.centre) / self.radius
            d = directions[start : start + RAYS_PER_TASK].float()
            return query(o.float().contiguous().numpy(), d.contiguous().numpy())

        starts = range(0, len(origins), RAYS_PER_TASK)
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(run, starts))


def _build(vertices: np.ndarray, faces: np.ndarray) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise ImportError("ptt traces rays with embree: pip install embreex") from error
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")  # builds the tree once
    return scene
