"""Glossy reflection by narrow lobes, each with a light and a visibility of its own, and lamps apart.

    B[v, c] = sum over n of  w_n[c](wo) (V_v(a_n, s_n) E[c](a_n, s_n) + (1 - V_v(a_n, s_n)) B[y_n, c])
            + sum over m of  f[c](d_m, wo) cos(d_m) V_vm P_m[c]

w_n, a_n and s_n are the weights, axes and widths of a material's lobes (`ops.cells`). E is the light blurred to a width
(`levels`), V_v the share of it that point v sees. What is small and bright in the light, lamps of power P_m, is
reflected by f itself; V_vm is how much of it is seen, the same from wherever one looks.

y_n is the point that v sees along a_n, and what it sends to v is that of `ptt.ops.around`. E is looked up about the
mean direction of what v sees of the lobe, and y_n about that of what it does not (`ops.hemispheres`).

Sun et al. 2007, section 4.1, has up to four lobes about common axes, of at most 21 degrees, and a tensor for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.around import Around, alone, close, from_points
from ptt.ops.cells import Gloss, frames, octaves
from ptt.ops.constants import SECTORS, SHARPEST, TILTS, TINY
from ptt.ops.directions import faces_eye
from ptt.ops.hemispheres import Between, SplitLobes, split, split_between
from ptt.ops.octahedral import mix
from ptt.ops.transforms import chosen
from ptt.ops.view import SurfaceBlocks, blurred, local_directions

AT_ONCE = 4096  # points that are worked out together, so that they stay in the cache

Sky = Callable[[Tensor, Tensor], SplitLobes]
"""What points see of lobes about local axes (n, k, 3) at levels (n, k), all in local directions."""


class GlossLight(NamedTuple):
    """A light for lobes.

    maps (LEVELS, cells, 4): blurred to each width, on `bordered` octahedral maps; turn (3, 3): world = turn @ map
    lamps (m, 3), powers (m, c): of lamps, which the maps are without, in the world
    through (m, n): how much of each lamp n points see (`lamp_visibility`)
    """

    maps: Tensor
    turn: Tensor
    lamps: Tensor
    powers: Tensor
    through: Tensor


def rows_of(wo: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Rows (n, j) int64 of tables over `outgoing`, and their weights (n, j), at wo (n, 3)."""
    at = (wo[:, 2].abs() * (TILTS - 0.5) - 0.5).clamp(0, TILTS - 1)
    i = at.floor().clamp(max=TILTS - 2).long()
    a = at - i
    index = torch.stack((i, i + 1), -1)
    weights = torch.stack((1 - a, a), -1)
    if turns == 1:
        return index, weights
    turn = torch.atan2(wo[:, 1], wo[:, 0]) * (turns / (2 * math.pi)) % turns
    j = turn.floor()
    b = (turn - j)[:, None]
    row = TILTS * (j.long() % turns)[:, None]
    after = TILTS * ((j.long() + 1) % turns)[:, None]
    return torch.cat((row + index, after + index), -1), torch.cat((weights * (1 - b), weights * b), -1)


def shine(
    points: SurfaceBlocks,
    eye: Tensor,
    seen: Tensor,
    gloss: Gloss,
    light: GlossLight,
    around: Around | None = None,
    share: Tensor | None = None,
    between: Between | None = None,
) -> Tensor:
    """What points reflect glossily to the eye (v, c), for an eye (3,) or unit directions (3, n) to it.

    seen (n, words) int32: what is seen of the hemisphere, a bit for each cell of a `HemiOctahedral` map, and then a
        byte for each cell of those of `hemispheres.SHARES`: the visible share of a lobe about it
    around: what sends light where the sky is hidden; None for direct light alone
    share (c, n): how much of the material there is at each point; None for all
    between: where points lie between places, which `seen` is of then; None where it is their own
    """
    wo = local_directions(points.position, points.frame, eye).T
    seen_at_all = faces_eye(points.dip, wo[:, 2], eye)
    frame = points.frame.movedim(2, 0)  # shape: (n, 3, 3)
    rows = chosen(seen_at_all, AT_ONCE)
    parts = []
    for some in rows:
        near = None if around is None else around._replace(mean=around.mean[:, some], meets=around.meets[some])
        lit = light._replace(through=light.through[:, some])
        sky = _sky(seen, frame, some, between)
        parts.append(_shine(gloss, lit, frame[some], sky, wo[some], near))
    at = torch.cat(rows)
    shining = torch.cat(parts) * seen_at_all[at, None]
    out = shining.new_zeros(len(wo), shining.shape[1]).index_copy(0, at, shining)
    return (out if share is None else out * share.T).index_select(0, points.place)


def lamp_visibility(visible: Tensor, cells: Tensor, shares: Tensor) -> Tensor:
    """How much (m, n) of each of m lamps n points see.

    visible (words, n) int32: bits of the cells of a cube map that points see, packed as by `transfer.visibility`
    cells (m, k) int64, shares (m, k): where each lamp is on that map, and how much of its power comes from there

    In a trial on a statue under a map with five lamps of one degree (GGX of roughness 0.5 and 0.7, a metallic paint, a
    plastic), bits of 64 x 64 cells of a point's hemisphere about the middle of a lamp left 11.3, 10.7, 11.4 and 8.2 %
    of error, these cells 6.7, 5.7, 6.6 and 4.3, rays all over the lamps 4.9, 2.9, 4.4 and 2.4.
    """
    seen = shares.new_empty(len(cells), visible.shape[1])
    for lamp, (cell, share) in enumerate(zip(cells, shares, strict=True)):
        bits = visible[cell >> 5] >> ((cell & 31) ^ 7)[:, None] & 1  # a byte begins with its highest bit
        seen[lamp] = share @ bits.to(share)
    return seen


def _sky(seen: Tensor, frame: Tensor, some: Tensor, between: Between | None) -> Sky:
    """What some points see of the sky, with frames (n, 3, 3)."""
    if between is None:
        return partial(split, seen[some])
    own = between._replace(rows=between.rows[some], weights=between.weights[some])
    here = frame[some]

    def sky(axes: Tensor, level: Tensor) -> SplitLobes:
        share, *parts = split_between(seen, own, axes @ here, level)
        return SplitLobes(share, *(part @ here.transpose(1, 2) for part in parts))

    return sky


def _shine(gloss: Gloss, light: GlossLight, frame: Tensor, sky: Sky, wo: Tensor, around: Around | None) -> Tensor:
    """What points (n, ...) send out (n, c)."""
    table, turns = gloss.lobes
    index, weights = rows_of(wo, turns)
    row = mix(table.flatten(1), index, weights).unflatten(1, table.shape[1:])  # shape: (n, lobes, 4 + c)
    level = row[..., 3]
    axes = row[..., :3] @ frames(wo)
    through, seen, hidden = sky(axes, level)
    about = blurred(light.maps, seen @ frame @ light.turn, level)
    about = about * through[..., None]
    if around is not None:
        spread = (level - alone(row.shape[1])).clamp(0, 1)[..., None]
        much = (row[..., 4:].mean(2) * (1 - through)).detach() / close(row.shape[1])
        closely = (much - 1).clamp(0, 1) * (alone(row.shape[1]) - level).detach().clamp(0, 1)
        surfaces = from_points(around, frame, hidden, light.turn, closely)
        surfaces = torch.lerp(surfaces, around.mean.T[:, None], spread)
        about = about + surfaces * (1 - through)[..., None]
    out: Tensor = (row[..., 4:] * about).sum(1)
    if not len(light.lamps):
        return out
    return out + _lamps(frame, wo, gloss.values, index, weights, light.lamps, light.powers, light.through)


def reflected_lamps(
    position: Tensor,
    frame: Tensor,
    dip: Tensor,
    eye: Tensor,
    values: Tensor,
    lamps: Tensor,
    powers: Tensor,
    through: Tensor | None = None,
) -> Tensor:
    """What points reflect of lamps to the eye (n, c), for an eye (3,) or unit directions (3, n) to it.

    position (3, n), frame (3, 3, n): rows tangent, bitangent, normal; dip (n,): `mesh.dips`
    values (turns * tilts, rings, sectors, c): the root of f (`ops.cells.Gloss`)
    lamps (m, 3), powers (m, c): in the world
    through (m, n): how much of each lamp the points see; None for all of it
    """
    wo = local_directions(position, frame, eye).T
    seen = position.new_ones(len(lamps), position.shape[1]) if through is None else through
    frames_of = frame.movedim(2, 0).split(AT_ONCE)
    turns = len(values) // TILTS
    parts = [
        _lamps(some, towards, values, *rows_of(towards, turns), lamps, powers, own)
        for some, towards, own in zip(frames_of, wo.split(AT_ONCE), seen.split(AT_ONCE, 1), strict=True)
    ]
    return torch.cat(parts) * faces_eye(dip, wo[:, 2], eye)[:, None]


def _lamps(
    frame: Tensor,
    wo: Tensor,
    values: Tensor,
    rows: Tensor,
    shares: Tensor,
    lamps: Tensor,
    powers: Tensor,
    through: Tensor,
) -> Tensor:
    """What points with frames (n, 3, 3) reflect of lamps to local wo (n, 3), as `reflected_lamps`, by rows (n, j) of
    values and their shares (n, j)."""
    t, r, s, c = values.shape
    wi = lamps.to(frame) @ frame.transpose(1, 2)  # shape: (n, m, 3)
    lit = wi[..., 2].clamp(min=0) * through.T
    index, weights = _on_nodes(wi, wo, r, s)
    every = (rows[:, None, :, None] * (r * s) + index[:, :, None]).flatten(2).flatten(0, 1)
    mixed = (shares[:, None, :, None] * weights[:, :, None]).flatten(2).flatten(0, 1)
    root = mix(values.reshape(t * r * s, c), every, mixed).unflatten(0, wi.shape[:2])
    sent: Tensor = (root * root * lit[..., None] * powers.to(root)).sum(1)
    return sent


def _on_nodes(wi: Tensor, wo: Tensor, r: int, s: int) -> tuple[Tensor, Tensor]:
    """Cells (n, m, 4) of r rings and s sectors, and their weights, at local wi (n, m, 3) and wo (n, 3)."""
    upper = torch.cat((wo[:, :2], wo[:, 2:].abs()), 1)[:, None]
    h = (wi + upper) @ _towards(wo).transpose(1, 2)
    square = (h[..., :2].square().sum(-1) / h[..., 2].square().clamp(min=TINY)).clamp(min=TINY)
    ring = ((octaves(square) - SHARPEST) * 4 - 0.5).clamp(0, r - 1)
    sector = torch.atan2(h[..., 1], h[..., 0]) * (SECTORS / math.pi) - 0.5
    i, j = ring.detach().floor().clamp(max=r - 2), sector.detach().floor()
    a, b = ring - i, sector - j
    row = s * i.long()
    left, right = (_sector(j.long() + on, s) for on in (0, 1))
    weights = torch.stack(((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b), -1)
    return torch.stack((row + left, row + right, row + s + left, row + s + right), -1), weights


def _sector(number: Tensor, stored: int) -> Tensor:
    """Where the sector of a number is stored; those of the second half turn follow the first, or are its mirror."""
    number = number % (2 * SECTORS)
    return torch.where(number < SECTORS, number, SECTORS + stored - 1 - number)


def _towards(wo: Tensor) -> Tensor:
    """Rows (n, 3, 3) that turn about the normal, so that wo (n, 3) lies over x."""
    across = frames(wo)[:, 1]
    flat = torch.stack((across[:, 1], -across[:, 0], across[:, 2]), 1)
    up = torch.zeros_like(flat)
    up[:, 2] = 1
    return torch.stack((flat, across, up), 1)
