"""What points see of their hemispheres: bits for narrow lobes, and shares of wide ones, at a point or between several.

    V_p(a, s) = sum over j of  b_j h_j V_j(a, s)  /  sum over j of  b_j h_j

V_j is what is seen from place j, a vertex or a texel, b_j the weight of that at point p, and h_j says how far axis a
stands above the horizon of j, below which nothing is known of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.constants import TINY, WIDE_SIDE, WIDEST_SIDE
from ptt.ops.octahedral import corners, hemi_octahedral
from ptt.ops.view import BYTE

SHARES = {10.0: WIDE_SIDE, 20.0: WIDEST_SIDE}
"""Degrees that the lobes cover of which `seen` has visible shares, and cells along the edges of the maps of their axes.

Bilinear lookups in maps so coarse make them 14 and 28: in a trial on 160 points (GGX of roughness 0.3 to 0.7, 16
lobes) under two maps without lamps, shares of 14 and 28 degrees left 4.9 and 4.7 % of error, of 10 and 20 4.5 and 4.6,
and maps of 24 x 24 cells for 7, 14 and 28 degrees, of three times the size, 4.3 and 4.1.
"""

BYTES = sum(side * side for side in SHARES.values())
"""Of the maps of shares, which come after the bits."""

RISEN = 0.1
"""The sine of the height from which a place counts in full: places that are smooth together know what lies above."""


class Between(NamedTuple):
    """Where p points lie between places of which what is seen is known: rows (p, k) int32 and weights (p, k), and the
    frames (places, 3, 3) of these."""

    rows: Tensor
    weights: Tensor
    frames: Tensor

    def risen(self, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Axes (p, k, n, 3) in the frames of the places of every point, of world axes (p, n, 3), and how much what the
        places know of each counts (p, k, n): 1 in all, or 0 where none knows."""
        local = axes[:, None] @ self.frames[self.rows].transpose(2, 3)
        counts = self.weights[..., None] * (local[..., 2] / RISEN).clamp(0, 1)
        return local, counts / counts.sum(1, keepdim=True).clamp(min=TINY)


def visible(seen: Tensor, axes: Tensor, level: Tensor) -> Tensor:
    """The share (n, k) that points see of lobes about local axes (n, k, 3), between those of the widths next to theirs:
    bits at level 1, and the maps of `SHARES`.

    seen (n, words) int32: bits, a cell each of a `HemiOctahedral` map, then bytes
    """
    first = side_of(seen) ** 2 // 8  # byte
    shares = [bits_at(seen, axes)]
    for side in SHARES.values():
        shares.append(_bytes_at(seen.view(torch.uint8)[:, first : first + side * side], axes))
        first += side * side
    at = (level - 1) / 4
    through = torch.lerp(shares[0], shares[1], at.clamp(0, 1))
    through = torch.lerp(through, shares[2], (2 * at - 2).clamp(0, 1))
    return through


def visible_between(seen: Tensor, between: Between, axes: Tensor, level: Tensor) -> Tensor:
    """The share (p, n) that points see of lobes about world axes (p, n, 3), from what places see (places, words)."""
    local, counts = between.risen(axes)
    shares = [visible(seen[rows], own, level) for rows, own in zip(between.rows.T, local.unbind(1), strict=True)]
    return (counts * torch.stack(shares, 1)).sum(1)


def lamps_seen(seen: Tensor, frames: Tensor, areas: Tensor, shares: Tensor) -> Tensor:
    """How much (m, places) of each of m lamps places see, by bits alone.

    seen (places, words), frames (places, 3, 3)
    areas (m, k, 3), shares (m, k): directions within each lamp, and how much of its power comes from there
    """
    found = seen.new_empty(len(areas), len(seen), dtype=shares.dtype)
    for lamp, (directions, share) in enumerate(zip(areas, shares, strict=True)):
        lit = share > 0  # lamps have areas of several sizes
        local = directions[lit] @ frames.transpose(1, 2)  # shape: (places, k, 3)
        found[lamp] = (bits_at(seen, local) * (local[..., 2] > 0)) @ share[lit]
    return found


def lamps_between(through: Tensor, between: Between, lamps: Tensor) -> Tensor:
    """How much (m, p) points see of lamps (m, 3), from what places see of them (m, places)."""
    counts = between.risen(lamps.expand(len(between.rows), -1, -1))[1]
    return torch.einsum("pkm,mpk->mp", counts, through[:, between.rows])


def words_of(side: int) -> int:
    """Words of what is seen, with so many cells along an edge of the map of bits."""
    return (side * side // 8 + BYTES) // 4


def side_of(seen: Tensor) -> int:
    """Cells along an edge of the map of bits in what is seen (n, words)."""
    return math.isqrt(8 * max(0, 4 * seen.shape[1] - BYTES))


def bits_at(seen: Tensor, axes: Tensor) -> Tensor:
    """The bilinear mean (n, k) of bits about local directions (n, k, 3)."""
    index, weights = corners(hemi_octahedral(axes), side_of(seen), wrap=False)
    words = seen.gather(1, (index >> 5).flatten(1)).view_as(index)
    mean: Tensor = ((words >> (index & 31)) & 1).to(weights).mul(weights).sum(-1)
    return mean


def _bytes_at(shares: Tensor, axes: Tensor) -> Tensor:
    """The bilinear mean (n, k) of shares (n, cells) uint8 about local directions (n, k, 3)."""
    index, weights = corners(hemi_octahedral(axes), math.isqrt(shares.shape[1]), wrap=False)
    mean: Tensor = shares.gather(1, index.flatten(1)).view_as(index).to(weights).mul(weights).sum(-1) / BYTE
    return mean
