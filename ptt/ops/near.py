"""Where the functions of points lie in their tables: between frames of light, directions of view, texels of an atlas.

Each is a bilinear lookup of four rows, or of four pairs. Weights are not negative and sum to 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import slices
from ptt.ops.directions import toward
from ptt.ops.octahedral import corners, hemi_octahedral
from ptt.ops.table import Table


class Near(NamedTuple):
    """What is interpolated at p points: rows (p, k) int32 of a table, and weights (p, k)."""

    rows: Tensor
    weights: Tensor

    def mix(self, table: Table) -> Tensor:
        """(p, ..., n) of functions (f, ..., n), one row after the other: never are all of a point's in memory."""
        values, scale = table
        weights = (self.weights * scale[self.rows]).to(torch.promote_types(values.dtype, scale.dtype))
        each = weights.T.reshape(weights.shape[1], -1, *(1,) * (values.ndim - 1))
        total = each[0] * values.index_select(0, self.rows[:, 0])
        for rows, weight in zip(self.rows.T[1:], each[1:], strict=True):
            total = torch.addcmul(total, weight, values.index_select(0, rows).to(weight))
        return total

    def one(self) -> Near:
        """The row of the largest weight alone."""
        largest = self.weights.argmax(1, keepdim=True)
        return Near(self.rows.gather(1, largest), torch.ones_like(self.weights[:, :1]))


def of_frames(frames: Tensor, sampled: Tensor, twists: int, between: bool = False) -> Near:
    """The lookup of frames (p, 3, 3) among sampled ones (n * n, 3, 3), each with so many turns of its tangent.

    sampled: of the normals `Octahedral(n).directions()`; row = twists * normal + turn
    between: of each the two turns on either side (p, 8), for brushed materials; else the nearest (p, 4)
    """
    at = slices.located(frames[:, 2], frames, sampled)
    turn = at.twist.T * (twists / (2 * math.pi))
    normal = at.near.T * twists
    if not between:
        return Near(normal + turn.round().int() % twists, at.weights.T.contiguous())
    first = turn.floor()
    share = turn - first
    rows = torch.stack([normal + (first.int() + k) % twists for k in range(2)], 2)
    weights = torch.stack((1 - share, share), 2) * at.weights.T[..., None]
    return Near(rows.flatten(1), weights.flatten(1))


def of_views(frames: Tensor, positions: Tensor, eye: Tensor, views: int) -> Near:
    """The lookup of directions from positions (p, 3) to an eye (3,), in frames (p, 3, 3), on `HemiOctahedral(views)`.

    eye (p, 3): the directions themselves, in place of an eye, of any length; one that is zero stands for up
    Those below the horizon have what their mirror images above have.
    """
    local = torch.einsum("pax,px->pa", frames, toward(eye, positions))
    local = torch.where((local == 0).all(1, keepdim=True), local.new_tensor([0.0, 0.0, 1.0]), local)
    cells, weights = corners(hemi_octahedral(local), views, wrap=False)
    return Near(cells.int(), weights)


def of_texels(corner_uv: Tensor, triangle: Tensor, barycentric: Tensor, rows: Tensor) -> Near:
    """The lookup of points in triangles (p,), at barycentric (p, 3), among texels, whose rows (size * size,) are given.

    corner_uv (f, 3, 2): of the triangles' corners, in 0..1
    """
    size = math.isqrt(len(rows))
    uv = (corner_uv[triangle] * barycentric[..., None].to(corner_uv)).sum(1)
    cells, weights = corners(2 * uv - 1, size, wrap=False)
    return Near(rows[cells], weights)
