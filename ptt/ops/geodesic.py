"""The icosahedral grid, and its triangular Haar basis (Ma et al. 2006, section 3.1).

Twenty triangles, each cut in four, level by level, by the midpoints of its edges. The children of triangle i of level l
are 4 i (the one in the middle) to 4 i + 3 (at its first, second and third corner); a level has 20 x 4^l of them. With
an area of 1 for each of the twenty, those of level l have A_l = 4^-l: nominal areas, which the basis is made for. The
true solid angles differ by up to 80 %: `ratios` bakes them into one factor of a product, as the cosine is.

    f = sum over i < 20 of  a_i phi_i  +  sum over l, i < 20 x 4^l, t < 3 of  d_(l, i, t) psi_(l, i, t)

phi is 1 on a triangle, psi_t is 1 or -1 on its children by the signs of the paper; not normalised: |psi|^2 = A_l.
Coefficients (..., 20 x 4^L) lie in this order: the 20 a, then d of level 0, 1, ..., the three types of a triangle side
by side. So the first 20 x 4^l of them are all that is constant on the triangles of level l.

Example:
    >>> grid = Geodesic(3)
    >>> values = grid.directions()[:, 2].abs()
    >>> bool(torch.allclose(synthesise(analyse(values)), values))
    True
    >>> round(float((values * grid.solid_angles()).sum() / torch.pi), 2)      # the integral of |z|: 2 pi
    2.0

Departure from the paper: it numbers children 4 i + 1 to 4 i + 4 in one place and lets i run to 20 x 2^l in another.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from ptt.ops.constants import ROOTS
from ptt.ops.directions import checked_directions, triangle_solid_angles, unit
from ptt.ops.sphere import Grid, at_least_one

SIGNS = torch.tensor([[1, -1, -1, 1], [1, -1, 1, -1], [1, 1, -1, -1]])  # of psi_0, psi_1, psi_2 on the children
FINEST_LEVEL = 9  # 5 million triangles


@dataclass(frozen=True)
class Geodesic(Grid):
    """The sphere in 20 x 4^level triangles. `refine(k)` and `means` take powers of two for k, or the next one."""

    level: int

    def __post_init__(self) -> None:
        if not 0 <= self.level <= FINEST_LEVEL:
            raise ValueError(f"level must be in 0..{FINEST_LEVEL}, got {self.level}")

    @property
    def shape(self) -> tuple[int]:
        return (ROOTS << 2 * self.level,)

    def corners(self) -> Tensor:
        """Corners (t, 3, 3) of the triangles, counter-clockwise seen from outside, unit, float64."""
        corners = _icosahedron()
        for _ in range(self.level):
            corners = _children(corners).flatten(0, 1)
        return corners

    def directions(self) -> Tensor:
        """Directions of the middles (t, 3) of the triangles, unit, float64."""
        return unit(self.corners().sum(1))

    def solid_angles(self) -> Tensor:
        """Exact solid angles (t,) [sr], float64."""
        return triangle_solid_angles(*self.corners().unbind(1))

    def ratios(self) -> Tensor:
        """Solid angles (t,) over their mean, float64: 0.6 to 1.1 at level 4."""
        return self.solid_angles() * (self.cells / (4 * math.pi))

    def cell(self, directions: Tensor) -> Tensor:
        d = checked_directions(directions)
        batch = d.shape[:-1]
        d = unit(d.reshape(-1, 3))
        corners = _icosahedron().to(d.device)
        index = (d @ _edges(corners).reshape(-1, 3).T).reshape(-1, ROOTS, 3).amin(2).argmax(1)
        corners = corners[index]
        for _ in range(self.level):
            parts = _children(corners)  # shape: (n, 4, 3, 3)
            inside = torch.einsum("nkax,nx->nka", _edges(parts), d).amin(2)
            child = inside.argmax(1)
            index = 4 * index + child
            corners = parts[torch.arange(len(d), device=d.device), child]
        return index.reshape(batch)

    def refine(self, k: int) -> Geodesic:
        return Geodesic(self.level + (at_least_one("k", k) - 1).bit_length())

    def coarsen(self, values: Tensor, k: int) -> Tensor:
        fine = self.refine(k)
        if values.shape[0] != fine.cells:
            raise ValueError(f"values must have refine({k}).shape = {fine.shape}, got {tuple(values.shape)}")
        return values.reshape(self.cells, -1, *values.shape[1:]).sum(1)

    def samples(self, k: int) -> Tensor:
        if k < 1 or k & (k - 1):
            raise ValueError(f"k must be a power of two for triangles, got {k}")
        return self.refine(k).directions()

    def means(self, function: Callable[[Tensor], Tensor], k: int, chunk: int = 1 << 20) -> Tensor:
        parts = []
        cuts = self.refine(k).level - self.level
        for corners in self.corners().split(max(1, chunk >> 2 * cuts)):
            fine = corners
            for _ in range(cuts):
                fine = _children(fine).flatten(0, 1)
            values = function(unit(fine.sum(1)).float())
            weights = triangle_solid_angles(*fine.unbind(1)).to(values)[:, None]
            summed = (values * weights).reshape(len(corners), -1, values.shape[1]).sum(1)
            parts.append(summed / weights.reshape(len(corners), -1, 1).sum(1))
        return torch.cat(parts)


def analyse(values: Tensor) -> Tensor:
    """Coefficients (..., n) of values (..., n) on the triangles of a level, in O(n).

    Raises:
        ValueError: n is not 20 x 4^level.
    """
    signs = SIGNS.to(values)
    parts = []
    for _ in range(levels(values.shape[-1])):
        children = values.unflatten(-1, (-1, 4))
        parts.append((children @ (signs.T / 4)).flatten(-2))
        values = children.mean(-1)
    return torch.cat([values, *reversed(parts)], dim=-1)


def synthesise(coefficients: Tensor) -> Tensor:
    """Values (..., n) of coefficients (..., n): the inverse of `analyse`."""
    signs = SIGNS.to(coefficients)
    values = coefficients[..., :ROOTS]
    for level in range(levels(coefficients.shape[-1])):
        first = ROOTS << 2 * level
        details = coefficients[..., first : 4 * first].unflatten(-1, (-1, 3))
        values = (values[..., None] + details @ signs).flatten(-2)
    return values


@cache
def areas(level: int) -> Tensor:
    """Nominal areas A_l (n,) of the basis functions' domains, which are their squared norms, float64."""
    parts = [torch.full((ROOTS * 3 << 2 * k,), 4.0**-k, dtype=torch.float64) for k in range(level)]
    return torch.cat([torch.ones(ROOTS, dtype=torch.float64), *parts])


def levels(n: int) -> int:
    """The level that has n triangles.

    Raises:
        ValueError: there is none.
    """
    level = (max(n // ROOTS, 1).bit_length() - 1) // 2
    if n != ROOTS << 2 * level:
        raise ValueError(f"the last axis must have 20 x 4^level elements, 20, 80, 320, ..., got {n}")
    return level


@cache
def _icosahedron() -> Tensor:
    """Corners (20, 3, 3) of the triangles, counter-clockwise, from the top down.

    The icosahedron is its own mirror image in x, y and z.
    """
    golden = (1 + math.sqrt(5)) / 2
    signs = torch.cartesian_prod(*[torch.tensor([1.0, -1.0], dtype=torch.float64)] * 2)
    flat = torch.cat((torch.zeros(4, 1).double(), signs * torch.tensor([1, golden]).double()), 1)
    corners = unit(torch.cat([flat.roll(k, 1) for k in range(3)]))
    triples = torch.combinations(torch.arange(12), 3)
    apart = torch.stack([(corners[triples[:, i]] - corners[triples[:, i - 1]]).norm(dim=1) for i in range(3)])
    faces = corners[triples[(apart < 1.1).all(0)]]  # edges are 1.05 long, diagonals 1.7
    outward = torch.linalg.det(faces) > 0
    faces = torch.where(outward[:, None, None], faces, faces.flip(1))
    return faces[faces.sum(1)[:, 2].argsort(descending=True, stable=True)]


def _children(corners: Tensor) -> Tensor:
    """Corners (..., 4, 3, 3) of the four children of triangles (..., 3, 3)."""
    a, b, c = corners.unbind(-2)
    ab = unit(a + b)
    bc = unit(b + c)
    ca = unit(c + a)
    parts = ((bc, ca, ab), (a, ab, ca), (ab, b, bc), (ca, bc, c))
    return torch.stack([torch.stack(part, -2) for part in parts], -3)


def _edges(corners: Tensor) -> Tensor:
    """Normals (..., 3, 3), inwards, of the planes through the origin and the edges of triangles (..., 3, 3)."""
    normals: Tensor = torch.linalg.cross(corners, corners.roll(-1, -2))
    return normals
