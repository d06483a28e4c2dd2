"""Polygons in space, cut into triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
BENT = -1e-9  # a corner is concave whose turn is below this share of the polygon's area


def triangulate(corners: Floats, counts: Ints) -> tuple[Ints, Ints]:
    """Triangles (t, 3) of polygons, as numbers of their corners, and the polygon (t,) that each comes from.

    corners (c, 3): of all polygons, one after the other; counts (p,): how many each has

    Convex polygons become fans, others lose their ears (Meisters 1975) in the plane of their mean normal; polygons of
    fewer than three corners become nothing.
    """
    starts = counts.cumsum() - counts
    faces = [np.zeros((0, 3), np.int64)]
    owners = [np.zeros(0, np.int64)]
    for size in np.unique(counts[counts > 2]):
        own = np.nonzero(counts == size)[0]
        rows = starts[own, None] + np.arange(size)
        convex = _convex(corners[rows]) if size > 3 else np.ones(len(own), bool)
        for k in range(1, size - 1):
            faces.append(rows[convex][:, [0, k, k + 1]])
            owners.append(own[convex])
        for polygon, around in zip(own[~convex], rows[~convex], strict=True):
            ears = around[_ears(_flat(corners[around]))]
            faces.append(ears)
            owners.append(np.full(len(ears), polygon))
    owner = np.concatenate(owners)
    order = owner.argsort(kind="stable")
    return np.concatenate(faces)[order], owner[order]


def _normals(corners: Floats) -> Floats:
    """Newell's normals (p, 3) of polygons (p, n, 3), twice their areas long."""
    from_first = corners - corners[:, :1]
    normals: Floats = np.cross(from_first, np.roll(from_first, -1, 1)).sum(1)
    return normals


def _convex(corners: Floats) -> NDArray[np.bool_]:
    """Tell which polygons (p, n, 3) turn to one side at every corner."""
    normals = _normals(corners)
    along = np.roll(corners, -1, 1) - corners
    turns = np.einsum("pna,pa->pn", np.cross(along, np.roll(along, -1, 1)), normals)
    convex: NDArray[np.bool_] = (turns >= BENT * np.einsum("pa,pa->p", normals, normals)[:, None]).all(1)
    return convex


def _flat(corners: Floats) -> Floats:
    """A polygon (n, 3) in the plane (n, 2) across its normal, counter-clockwise."""
    normal = _normals(corners[None])[0]
    normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    across = np.eye(3)[np.abs(normal).argmin()]
    x = np.cross(across, normal)
    flat: Floats = (corners - corners[0]) @ np.stack((x, np.cross(normal, x)), 1)
    return flat


def _ears(points: Floats) -> Ints:
    """Triangles (n - 2, 3) of a polygon (n, 2), ear by ear; what has none, since it crosses itself, ends as a fan."""
    left = list(range(len(points)))
    found = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(points, left, k)), None)
        if ear is None:
            break
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    found += [(left[0], left[k], left[k + 1]) for k in range(1, len(left) - 1)]
    return np.array(found, dtype=np.int64)


def _is_ear(points: Floats, left: list[int], k: int) -> bool:
    """Tell whether corner k and its neighbours make a triangle that faces the right way and holds no other corner."""
    ear = left[k - 1], left[k], left[(k + 1) % len(left)]
    a, b, c = points[list(ear)]
    if _side(a, b, c) <= 0:
        return False
    others = points[[i for i in left if i not in ear]]
    others = others[~((others[:, None] == (a, b, c)).all(2).any(1))]  # of a hole's bridge, corners lie twice
    inside = (_side(a, b, others) >= 0) & (_side(b, c, others) >= 0) & (_side(c, a, others) >= 0)
    return not bool(inside.any())


def _side(a: Floats, b: Floats, p: Floats) -> Floats:
    """Twice the area of a, b and each p (..., 2); positive where they turn counter-clockwise."""
    area: Floats = (b[0] - a[0]) * (p[..., 1] - a[1]) - (b[1] - a[1]) * (p[..., 0] - a[0])
    return area
