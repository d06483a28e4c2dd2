"""Octahedral maps: the sphere, or the hemisphere around +z, unfolded to a square of n x n cells.

A chart projects directions to the octahedron |x| + |y| + |z| = 1, whose faces it lays flat in the square [-1, 1]^2
with coordinates (a, b), a along columns and b along rows. Straight lines in a face are great circles on the sphere.
The functions keep the type and device of their arguments, are differentiable, and branch on no value of a tensor.
Laws, beside those of every `Grid`:

- ``octahedral(grid.directions())`` are the centres of the cells of the square; so for `hemi_octahedral`.
- The weights of `corners` sum to 1, and at a cell's centre all weight is on that cell.
- A lookup by `corners` is continuous on the sphere, across the folds and across the edges of the square.

Example:
    >>> d = torch.tensor([0.3, -0.2, -0.9])
    >>> index, weights = corners(octahedral(d), 64, wrap=True)
    >>> height = Octahedral(64).directions()[..., 2].flatten()
    >>> round(float((height[index] * weights).sum()), 2), round(float(d[2] / d.norm()), 2)
    (-0.93, -0.93)
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from ptt.ops.constants import TILE
from ptt.ops.directions import checked_directions, triangle_solid_angles, unit
from ptt.ops.sphere import Squares, at_least_one, centres, crossed, step_index
from ptt.ops.transforms import active


def octahedral(d: Tensor) -> Tensor:
    """Coordinates (a, b) (..., 2) on the map of the sphere of directions d (..., 3), which need not be unit."""
    return _last(_folded(*_on_octahedron(d)))


def from_octahedral(ab: Tensor) -> Tensor:
    """Directions (..., 3) of |x| + |y| + |z| = 1 at coordinates (a, b) (..., 2) on the map of the sphere."""
    a, b = ab.unbind(-1)
    z = 1 - a.abs() - b.abs()
    return _last((*_folded(a, b, z), z))


def hemi_octahedral(d: Tensor) -> Tensor:
    """Coordinates (a, b) (..., 2) on the map of the hemisphere of directions d (..., 3), which need not be unit.

    A direction below the horizon has the coordinates of its mirror image above.
    """
    x, y, _ = _on_octahedron(d)
    return _last((x + y, x - y))


def from_hemi_octahedral(ab: Tensor) -> Tensor:
    """Directions (..., 3) of |x| + |y| + |z| = 1 at coordinates (a, b) (..., 2) on the map of the hemisphere."""
    a, b = ab.unbind(-1)
    x = (a + b) / 2
    y = (a - b) / 2
    return _last((x, y, 1 - x.abs() - y.abs()))


def corners(ab: Tensor, n: int, wrap: bool) -> tuple[Tensor, Tensor]:
    """Cells (..., 4) int64 and weights (..., 4) of a bilinear lookup at ab (..., 2) in a flat table (n * n, ...).

    wrap: beyond an edge of the square lie the edge's cells, mirrored about its middle, as an `Octahedral` map goes on;
        without, they are repeated, as fits a `HemiOctahedral` map
    """
    x, y = ((ab + 1) * (n / 2) - 0.5).unbind(-1)
    column, row = x.floor(), y.floor()
    a = x - column
    b = y - row
    weights = _last(((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b))
    if wrap:
        columns = _last((column, column + 1, column, column + 1)).long()
        rows = _last((row, row, row + 1, row + 1)).long()
        return _mirrored(rows, columns, n), weights
    left, right = (each.clamp(0, n - 1).long() for each in (column, column + 1))
    above, below = (n * each.clamp(0, n - 1).long() for each in (row, row + 1))
    return _last((above + left, above + right, below + left, below + right)), weights


def bordered(table: Tensor) -> Tensor:
    """The flat table (n * n, ...) of an `Octahedral` map with a border of the cells around it: ((n + 2) ** 2, ...).

    A lookup in it needs no `wrap`, and takes the four corners side by side: `corners(ab * n / (n + 2), n + 2, False)`.
    """
    n = round(len(table) ** 0.5)
    around = torch.arange(-1, n + 1, device=table.device)
    return table[_mirrored(around[:, None], around, n).flatten()]


def _mirrored(rows: Tensor, columns: Tensor, n: int) -> Tensor:
    """Numbers of the cells at rows and columns; beyond an edge lie its own cells, mirrored about its middle."""
    columns = torch.where((rows < 0) | (rows >= n), n - 1 - columns, columns)
    rows = torch.where((columns < 0) | (columns >= n), n - 1 - rows, rows)
    return rows.clamp(0, n - 1) * n + columns.clamp(0, n - 1)


@dataclass(frozen=True)
class _OctahedralGrid(Squares):
    """n x n cells on the square of a chart that is linear on each face; folds are edges or diagonals of cells."""

    n: int
    _scale: ClassVar[float]  # the area of a piece of a face in the plane of x and y over its area in the square

    @property
    def shape(self) -> tuple[int, int]:
        return self.n, self.n

    def refine(self, k: int) -> Self:
        return replace(self, n=self.n * at_least_one("k", k))

    @abstractmethod
    def _chart(self, d: Tensor) -> Tensor:
        """Coordinates (a, b) (..., 2) of directions (..., 3)."""

    @abstractmethod
    def _octahedron_points(self, b: Tensor, a: Tensor) -> Tensor:
        """Points (..., 3) of the octahedron at (a, b): the inverse of `_chart`."""

    def cell(self, directions: Tensor) -> Tensor:
        a, b = self._chart(checked_directions(directions)).unbind(-1)
        return step_index((b + 1) / 2, self.n) * self.n + step_index((a + 1) / 2, self.n)

    def _cell_directions(self, rows: Tensor, columns: Tensor) -> Tensor:
        return unit(self._octahedron_points(*crossed(2 * centres(rows) - 1, 2 * centres(columns) - 1)))

    def _cell_weights(self, rows: Tensor, columns: Tensor) -> Tensor:
        # of a point p of the octahedron, |p|^-3: its faces are at one distance, and a ray meets them at a slant of |p|
        points = self._octahedron_points(*crossed(2 * centres(rows) - 1, 2 * centres(columns) - 1))
        lengths: Tensor = torch.linalg.vector_norm(points.float(), dim=-1)
        return lengths**-3

    def _cell_solid_angles(self, rows: Tensor, columns: Tensor) -> Tensor:
        # both diagonals cut a cell in four triangles, none of which has a fold inside
        b = 2 * rows - 1
        a = 2 * columns - 1
        corner = self._octahedron_points(*crossed(b, a))
        centre = self._octahedron_points(*crossed(centres(b), centres(a)))
        around = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
        # p . (q x r) is twice a triangle's area in the plane of x and y, as |x| + |y| + |z| = 1: no cancellation
        volume = self._scale / 2 * b.diff()[:, None] * a.diff()
        sides = zip(around, (*around[1:], around[0]), strict=True)
        return torch.stack([triangle_solid_angles(centre, p, q, volume) for p, q in sides]).sum(0)


@dataclass(frozen=True)
class Octahedral(_OctahedralGrid):
    """The sphere, n even: +z at the centre of the square, -z at its corners, z = 0 on |a| + |b| = 1.

    The inner diamond holds the directions (a, b, 1 - |a| - |b|). The outer triangles are the lower faces, folded
    out: ((1 - |b|) sign a, (1 - |a|) sign b, 1 - |a| - |b|).
    """

    _scale = 1.0

    def __post_init__(self) -> None:
        if self.n < 2 or self.n % 2:
            raise ValueError(f"n must be even and at least 2, got {self.n}")

    def _chart(self, d: Tensor) -> Tensor:
        return octahedral(d)

    def _octahedron_points(self, b: Tensor, a: Tensor) -> Tensor:
        return from_octahedral(torch.stack((a, b), -1))


@dataclass(frozen=True)
class HemiOctahedral(_OctahedralGrid):
    """The hemisphere around +z: the horizon on the edges of the square, +x at (a, b) = (1, 1), +y at (1, -1).

    With x = (a + b) / 2 and y = (a - b) / 2, (a, b) holds the direction (x, y, 1 - |x| - |y|). `cell` takes a
    direction below the horizon to the cell of its mirror image above.
    """

    _scale = 0.5

    def __post_init__(self) -> None:
        at_least_one("n", self.n)

    def _chart(self, d: Tensor) -> Tensor:
        return hemi_octahedral(d)

    def _octahedron_points(self, b: Tensor, a: Tensor) -> Tensor:
        return from_hemi_octahedral(torch.stack((a, b), -1))


def _on_octahedron(d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates x, y, z (...) of directions (..., 3), projected to |x| + |y| + |z| = 1."""
    x, y, z = d.unbind(-1)
    scale = 1 / (x.abs() + y.abs() + z.abs())
    return x * scale, y * scale, z * scale


def _folded(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """x and y (...), reflected about the diamond's side |x| + |y| = 1 where z < 0; the function is its own inverse."""
    turned_x = (1 - y.abs()).copysign(x)
    turned_y = (1 - x.abs()).copysign(y)
    return torch.where(z < 0, turned_x, x), torch.where(z < 0, turned_y, y)


def _last(parts: Sequence[Tensor]) -> Tensor:
    """Parts (...) as (..., parts), which lie one after the other in memory."""
    return torch.stack(tuple(parts)).movedim(0, -1)


def mix(table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Weighted sums (n, x) of rows of a table (cells, x), by index and weights (n, j)."""
    if active():  # the function below has no tangents, and takes batches one by one
        parts = [table[row] * weight[:, None] for row, weight in zip(index.unbind(1), weights.unbind(1), strict=True)]
        return torch.stack(parts).sum(0)
    return torch.nn.functional.embedding_bag(index, table, per_sample_weights=weights, mode="sum")


def sampled(tables: Tensor, ab: Tensor) -> Tensor:
    """Bilinear values (b, x, k) of tables (b, x, rows, columns) at ab (b, 2, k): -1..1 from edge to edge.

    As `corners` without `wrap` and `mix`, but points are innermost, and no cells and weights are ever in memory.
    """
    if active():  # the function below has no tangents
        return _gathered(tables, ab)
    grid = ab[:, :, None].movedim(1, 3)  # shape: (b, 1, k, 2)
    values = torch.nn.functional.grid_sample(tables, grid, padding_mode="border", align_corners=False)
    return values[:, :, 0]


def _gathered(tables: Tensor, ab: Tensor) -> Tensor:
    """Values of `sampled`, corner by corner."""
    rows, columns = tables.shape[2:]
    x, y = (((ab[:, k] + 1) * (n / 2) - 0.5).clamp(0, n - 1) for k, n in enumerate((columns, rows)))
    column, row = x.floor(), y.floor()
    flat = tables.flatten(2)

    def at(down: int, right: int) -> Tensor:
        index = (row + down).clamp(max=rows - 1).long() * columns + (column + right).clamp(max=columns - 1).long()
        return flat.gather(2, index[:, None].expand(-1, flat.shape[1], -1))

    above, below = (torch.lerp(at(down, 0), at(down, 1), (x - column)[:, None]) for down in (0, 1))
    return torch.lerp(above, below, (y - row)[:, None])


def tiles(n: int) -> Tensor:
    """The places (n * n,) of a grid's cells in tiles of TILE x TILE: the corners of a lookup then often share a tile.

    Raises:
        ValueError: n is no multiple of TILE.
    """
    if n % TILE:
        raise ValueError(f"n must be a multiple of {TILE}, got {n}")
    order = torch.arange(n * n).reshape(n // TILE, n // TILE, TILE, TILE).transpose(1, 2)
    return order.flatten()


def tiled_rows(row: Tensor, n: int) -> Tensor:
    """What rows (...) of a grid of n x n cells add to the places of their cells in `tiles`; columns add the rest."""
    return row * TILE + (row / TILE).floor() * (TILE * (n - TILE))


def tiled_columns(column: Tensor) -> Tensor:
    """What columns (...) add to the places of their cells in `tiles`."""
    return column + (column / TILE).floor() * (TILE * (TILE - 1))
