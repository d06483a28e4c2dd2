"""Points that shine by narrow lobes, between places of which what is seen is known: vertices, or texels of an atlas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops.cells import Gloss
from ptt.ops.constants import GROUP
from ptt.ops.hemispheres import Between
from ptt.ops.shade import ShadedPoints
from ptt.ops.view import SurfaceBlocks, points_at
from ptt.relight.glosses import light_for
from ptt.relight.light_step import SplitLight
from ptt.relight.surface_points import SurfacePoints


class ShiningPoints(NamedTuple):
    """The points that have one group of layers: which they are, (n,), beyond their count the last one again, until n is
    a multiple of `GROUP`; as the kernel takes them; between which places; how much of each layer (i, 3, n)."""

    group: int
    rows: Tensor
    surface: SurfaceBlocks
    between: Between
    shares: Tensor


class LampLight(NamedTuple):
    """A light, how much points see of each of its lamps (m, p), and what Lambert's BRDF reflects of these (p, 3)."""

    split: SplitLight
    through: Tensor
    matt: Tensor


def by_groups(at: ShadedPoints, surface: SurfacePoints, places: Tensor) -> list[ShiningPoints]:
    """The points of every group of layers.

    places: frames (r, 3, 3) of those that `at.seen` names
    """
    positions, frames, dips, *_ = surface
    found = []
    for group in at.region.unique().tolist():
        own = (at.region == group).nonzero()[:, 0]
        rows = torch.cat((own, own[-1:].expand(-len(own) % GROUP)))
        none = positions.new_empty(0, dtype=torch.int32)
        place = torch.arange(len(own), device=rows.device)
        point = points_at(place, len(rows))
        lines = positions[rows].T.contiguous(), frames[rows].movedim(0, 2).contiguous(), dips[rows]
        between = Between(at.seen.rows[rows], at.seen.weights[rows], places)
        shares = at.shares[:, rows].transpose(1, 2).contiguous()
        found.append(ShiningPoints(group, rows, SurfaceBlocks(*lines, None, none, place, point), between, shares))
    return found


def shining(
    points: Sequence[ShiningPoints],
    glosses: Sequence[Sequence[Gloss | None]],
    light: LampLight,
    seen: Tensor,
    eye: Tensor,
    radiance: Tensor,
    operations: Any,
) -> Tensor:
    """Radiance (p, 3) with what points reflect by lobes of their groups, i of each at most.

    seen (places, words) int32: what places see; eye (3,), or unit directions (p, 3) to it
    """
    for part in points:
        toward = eye if eye.ndim == 1 else eye[part.rows].T.contiguous()
        own = part.rows[: len(part.surface.place)]
        for gloss, share in zip(glosses[part.group], part.shares, strict=False):
            if gloss is None:
                continue
            lit = light_for(gloss, light.split, light.through[:, part.rows])
            found = operations.shine(part.surface, toward, seen, gloss, lit, None, share, part.between)
            radiance = radiance.index_add(0, own, found)
    return radiance
