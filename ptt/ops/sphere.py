"""Grids: partitions of the sphere, or of the hemisphere around +z, in cells.

Most are a rectangle (or six) of rows and columns with a chart to directions (`Squares`). Tables are float64.
Laws, for every grid g:

- ``g.solid_angles()`` is exact and sums to 4 pi (2 pi on the hemisphere).
- ``g.cell(g.directions())`` is 0, 1, 2, ... (on the disk: wherever a cell has a weight).
- ``g.refine(k)`` nests: ``g.coarsen(g.refine(k).solid_angles(), k)`` is ``g.solid_angles()``.

Example:
    >>> grid = Cube(8)
    >>> grid.shape, round(float(grid.solid_angles().sum() / torch.pi), 6)
    ((6, 8, 8), 4.0)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import pi, prod

import torch
from torch import Tensor

from ptt.ops.directions import checked_directions, unit

_Function = Callable[[Tensor], Tensor]


class Grid(ABC):
    """A partition of the sphere, or of a part of it, in cells."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Cells along each axis, e.g. (6, n, n)."""

    @property
    def cells(self) -> int:
        """Number of cells."""
        return prod(self.shape)

    @abstractmethod
    def directions(self) -> Tensor:
        """Centres of the cells (*shape, 3), unit, float64."""

    @abstractmethod
    def solid_angles(self) -> Tensor:
        """Exact solid angles (*shape) [sr], float64."""

    @abstractmethod
    def cell(self, directions: Tensor) -> Tensor:
        """Flat index (...) int64 of the cell that holds each direction (..., 3); lengths do not matter.

        Raises:
            ValueError: a direction is zero or not finite.
        """

    @abstractmethod
    def refine(self, k: int) -> Grid:
        """The grid with each cell cut in k x k cells."""

    @abstractmethod
    def coarsen(self, values: Tensor, k: int) -> Tensor:
        """Sums (*shape, ...), over the k x k parts of each cell, of values (*refine(k).shape, ...).

        Raises:
            ValueError: the leading axes of `values` are not those of `refine(k)`.
        """

    @abstractmethod
    def samples(self, k: int) -> Tensor:
        """Centres (cells * k * k, 3) of the k x k parts of each cell, cell by cell, unit, float64."""

    @abstractmethod
    def means(self, function: _Function, k: int, chunk: int = 1 << 20) -> Tensor:
        """Mean over each cell (*shape, channels) of function(directions (..., 3) float32) -> (..., channels).

        The midpoint rule on `refine(k)`, weighted by solid angles, about `chunk` directions at a time.
        A cell without a weight (outside the disk) takes the plain mean.
        """


class Squares(Grid):
    """A grid whose cells lie row by row; the last two axes of `shape` are rows and columns."""

    def directions(self) -> Tensor:
        return self._cell_directions(*self._edges())

    def solid_angles(self) -> Tensor:
        return self._cell_solid_angles(*self._edges())

    def coarsen(self, values: Tensor, k: int) -> Tensor:
        expected = self.refine(k).shape
        if tuple(values.shape[: len(expected)]) != expected:
            raise ValueError(f"values must have refine({k}).shape = {expected}, got {tuple(values.shape)}")
        return self._block_sums(values, k)

    def samples(self, k: int) -> Tensor:
        rows, columns = self.shape[-2:]
        fine = self.refine(k).directions().reshape(-1, rows, k, columns, k, 3)
        return fine.transpose(2, 3).reshape(-1, 3)

    def means(self, function: _Function, k: int, chunk: int = 1 << 20) -> Tensor:
        return torch.cat(list(self._strips_of_means(function, k, chunk)), dim=len(self.shape) - 2)

    def _strips_of_means(self, function: _Function, k: int, chunk: int) -> Iterator[Tensor]:
        """The means of the cells, some rows after the other, for `means`."""
        fine = self.refine(k)
        assert isinstance(fine, Squares)
        rows, columns = fine._edges()
        step = max(1, chunk * self.shape[-2] // (self.cells * k * k))
        for first in range(0, self.shape[-2], step):
            strip = rows[first * k : (first + step) * k + 1]
            values = function(self._cell_directions(strip.float(), columns.float()))
            weights = self._cell_weights(strip, columns).to(values).clamp(min=1e-30)[..., None]
            yield self._block_sums(values * weights, k) / self._block_sums(weights, k)

    def _cell_weights(self, rows: Tensor, columns: Tensor) -> Tensor:
        """What `means` weights cells by, in proportion to their solid angles, exactly or where cells are small."""
        return self._cell_solid_angles(rows, columns)

    def _block_sums(self, values: Tensor, k: int) -> Tensor:
        """Sums of values (faces, rows k, columns k, ...) over the k x k parts of each cell; faces may be missing."""
        lead = len(self.shape) - 2
        rest = values.shape[len(self.shape) :]
        rows = values.shape[lead] // k
        columns = values.shape[lead + 1] // k
        return values.reshape(*values.shape[:lead], rows, k, columns, k, *rest).sum(dim=(lead + 1, lead + 3))

    def _edges(self) -> tuple[Tensor, Tensor]:
        """Row and column coordinates in [0, 1] of the borders between cells."""
        rows, columns = self.shape[-2:]
        return _fractions(rows), _fractions(columns)

    @abstractmethod
    def _cell_directions(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Centres (..., len(rows) - 1, len(columns) - 1, 3) of the cells between the given edges, unit."""

    @abstractmethod
    def _cell_solid_angles(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Solid angles (..., len(rows) - 1, len(columns) - 1) [sr] of the cells between the given edges."""


@dataclass(frozen=True)
class LatLong(Squares):
    """Latitude-longitude grid: u = atan2(x, -z) / 2 pi (mod 1) along columns, v = acos(y) / pi along rows."""

    height: int
    width: int

    def __post_init__(self) -> None:
        at_least_one("height", self.height)
        at_least_one("width", self.width)

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    def refine(self, k: int) -> LatLong:
        return LatLong(self.height * at_least_one("k", k), self.width * k)

    def cell(self, directions: Tensor) -> Tensor:
        x, y, z = checked_directions(directions).unbind(-1)
        u = torch.atan2(x, -z) / (2 * pi)
        v = torch.atan2(torch.hypot(x, z), y) / pi
        column = (u % 1.0 * self.width).long() % self.width
        return step_index(v, self.height) * self.width + column

    def _cell_directions(self, rows: Tensor, columns: Tensor) -> Tensor:
        theta, phi = crossed(pi * centres(rows), 2 * pi * centres(columns))
        return torch.stack((theta.sin() * phi.sin(), theta.cos(), -theta.sin() * phi.cos()), dim=-1)

    def _cell_solid_angles(self, rows: Tensor, columns: Tensor) -> Tensor:
        # cos a - cos b = 2 sin((a + b) / 2) sin((b - a) / 2): no cancellation at the poles
        heights = 2 * torch.sin(pi * centres(rows)) * torch.sin(pi / 2 * rows.diff())
        return heights[:, None] * (2 * pi * columns.diff())


@dataclass(frozen=True)
class Cube(Squares):
    """Six faces of n x n cells, +X -X +Y -Y +Z -Z, uniform in the plane of each face (OpenGL's orientation).

    With s along columns and t along rows, both in [-1, 1], the faces hold the directions
    (1, -t, -s), (-1, -t, s), (s, 1, t), (s, -1, -t), (s, -t, 1), (-s, -t, -1).
    """

    n: int

    def __post_init__(self) -> None:
        at_least_one("n", self.n)

    @property
    def shape(self) -> tuple[int, int, int]:
        return 6, self.n, self.n

    def refine(self, k: int) -> Cube:
        return Cube(self.n * at_least_one("k", k))

    def cell(self, directions: Tensor) -> Tensor:
        d = checked_directions(directions)
        axis = d.abs().argmax(dim=-1, keepdim=True)
        major = d.gather(-1, axis)
        x, y, z = (d / major.abs()).unbind(-1)
        axis = axis[..., 0]
        positive = major[..., 0] > 0
        sign = torch.where(positive, 1.0, -1.0)
        s = torch.where(axis == 0, -sign * z, torch.where(axis == 1, x, sign * x))
        t = torch.where(axis == 1, sign * z, -y)
        face = 2 * axis + (~positive).long()
        return (face * self.n + step_index((t + 1) / 2, self.n)) * self.n + step_index((s + 1) / 2, self.n)

    def _cell_directions(self, rows: Tensor, columns: Tensor) -> Tensor:
        t, s = crossed(2 * centres(rows) - 1, 2 * centres(columns) - 1)
        one = torch.ones_like(s)
        faces = (one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)
        return unit(torch.stack([torch.stack(face, dim=-1) for face in faces]))

    def _cell_solid_angles(self, rows: Tensor, columns: Tensor) -> Tensor:
        b, a = crossed(2 * rows - 1, 2 * columns - 1)
        corner = torch.atan2(a * b, (1 + a * a + b * b).sqrt())
        return _mixed_difference(corner).expand(6, -1, -1)


@dataclass(frozen=True)
class Disk(Squares):
    """Hemisphere around +z, seen along z: n x n cells on the square around the unit disk.

    x runs along columns, y along rows. Inside the unit circle all cells have the same projected solid angle:
    the cosine is in the measure. A cell that the circle cuts weighs what lies inside; its direction is its
    centre if that lies inside, else a point of its inner part. A cell outside weighs zero; its direction is
    the point of the horizon (z = 0) next to it.
    """

    n: int

    def __post_init__(self) -> None:
        at_least_one("n", self.n)

    @property
    def shape(self) -> tuple[int, int]:
        return self.n, self.n

    def refine(self, k: int) -> Disk:
        return Disk(self.n * at_least_one("k", k))

    def cell(self, directions: Tensor) -> Tensor:
        """The cell (...) of each direction (..., 3), flat; below the horizon, that of the mirror image above."""
        x, y, _ = unit(checked_directions(directions)).unbind(-1)
        return step_index((y + 1) / 2, self.n) * self.n + step_index((x + 1) / 2, self.n)

    def coordinates(self, directions: Tensor) -> Tensor:
        """Continuous (row, column) (..., 2) of unit directions (..., 3), for bilinear lookups.

        Cell (i, j) has its centre at (i, j), so coordinates reach from -0.5 to n - 0.5. z is ignored.
        """
        return (directions[..., [1, 0]] + 1) * (self.n / 2) - 0.5

    def projected_solid_angles(self) -> Tensor:
        """Integral of the cosine over each cell (n, n), float64: its area in the unit circle; sums to pi."""
        edges = 2 * _fractions(self.n) - 1
        return _within_circle(_mixed_difference(_disk_area(*crossed(edges, edges))), edges, edges)

    def nearest_inside(self) -> Tensor:
        """For every cell, the flat index (n * n,) of the nearest cell that lies at least half inside of the circle.

        For a cell that does, that is its own index. Tables that are filled by it read well up to the horizon.
        """
        area = self.projected_solid_angles().flatten()
        inside = torch.nonzero(area >= 0.5 * area.max())[:, 0]
        centre = centres(_fractions(self.n))
        cells = torch.cartesian_prod(centre, centre)
        return inside[torch.cdist(cells, cells[inside]).argmin(1)]

    def _cell_directions(self, rows: Tensor, columns: Tensor) -> Tensor:
        near_y, near_x = crossed(_nearest_zero(2 * rows - 1), _nearest_zero(2 * columns - 1))
        y, x = crossed(2 * centres(rows) - 1, 2 * centres(columns) - 1)
        step = _step_within_circle(near_x, near_y, x - near_x, y - near_y)
        x = near_x + step * (x - near_x)
        y = near_y + step * (y - near_y)
        z = (1 - x * x - y * y).clamp(min=0).sqrt()
        return unit(torch.stack((x, y, z), dim=-1))

    def _cell_solid_angles(self, rows: Tensor, columns: Tensor) -> Tensor:
        b, a = crossed(2 * rows - 1, 2 * columns - 1)
        r = (1 - a * a - b * b).clamp(min=0).sqrt()
        # area of the sphere above the rectangle from (0, 0) to (a, b): integral of asin(b / sqrt(1 - x^2)) dx
        corner = a * torch.atan2(b, r) + b * torch.atan2(a, r) - torch.atan2(a * b, r)
        return _within_circle(_mixed_difference(corner), 2 * rows - 1, 2 * columns - 1)


def _disk_area(b: Tensor, a: Tensor) -> Tensor:
    """Signed area of the part of the rectangle from (0, 0) to (a, b) that lies in the unit disk."""

    def segment(x: Tensor) -> Tensor:
        height = (1 - x * x).clamp(min=0).sqrt()
        return x * height + torch.atan2(x, height)

    cut = (segment(a.abs()) + segment(b.abs()) - pi / 2) / 2
    area = torch.where(a * a + b * b <= 1, (a * b).abs(), cut)
    return area * a.sign() * b.sign()


def _step_within_circle(x: Tensor, y: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """The share of the way to go from (x, y), the point of a cell next to the axes, to its centre (x + dx, y + dy).

    It is 1 where the centre is inside the circle, and leads halfway to the circle where the centre is not.
    """
    a = dx * dx + dy * dy
    b = x * dx + y * dy
    c = x * x + y * y - 1
    crossing = (-b + (b * b - a * c).clamp(min=0).sqrt()) / a
    return torch.where(a + 2 * b + c < 0, 1.0, crossing.clamp(min=0) / 2)


def _within_circle(weights: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Weights of the cells between the given edges, with exact zeros outside the unit circle."""
    outside = torch.hypot(*crossed(_nearest_zero(y), _nearest_zero(x))) >= 1
    return weights.clamp(min=0).masked_fill(outside, 0.0)


def _nearest_zero(edges: Tensor) -> Tensor:
    """The point of each interval between edges that is nearest to 0."""
    return torch.zeros_like(edges[1:]).clamp(edges[:-1], edges[1:])


def _mixed_difference(corner: Tensor) -> Tensor:
    """Integrals over cells (..., m - 1, n - 1) from those over rectangles from (0, 0) to corners (..., m, n)."""
    return corner.diff(dim=-1).diff(dim=-2)


def _fractions(n: int) -> Tensor:
    """The borders (n + 1,) of n equal steps from 0 to 1."""
    return torch.arange(n + 1, dtype=torch.float64) / n


def centres(edges: Tensor) -> Tensor:
    """Middles (n,) of the steps between edges (n + 1,)."""
    return (edges[1:] + edges[:-1]) / 2


def crossed(rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """The row's and the column's coordinate (m, n), each, at every crossing of rows (m,) and columns (n,)."""
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return y, x


def step_index(fraction: Tensor, n: int) -> Tensor:
    """The number (...) int64 of the one of n equal steps in 0..1 that holds each fraction (...)."""
    return (fraction * n).floor().long().clamp(0, n - 1)


def at_least_one(name: str, value: int) -> int:
    """The value; raises ValueError where it is below 1."""
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}")
    return value
