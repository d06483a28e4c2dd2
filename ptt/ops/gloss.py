"""Glossy reflection by narrow lobes, each with a light and a visibility of its own, and lamps apart.

    B[v, c] = sum over n of  w_n[c](wo) (V_v(a_n, s_n) E[c](a_n, s_n) + (1 - V_v(a_n, s_n)) B[y_n, c])
            + sum over m of  f[c](d_m, wo) cos(d_m) V_vm P_m[c]

w_n, a_n and s_n are the weights, axes and widths of a material's lobes (`ops.cells`). E is the light blurred to a width
(`levels`), V_v the share of it that point v sees. What is small and bright in the light, lamps of power P_m, is
reflected by f itself; V_vm is how much of it is seen, the same from wherever one looks.

y_n is the point that v sees along a_n (`Around`), which sends to v what is diffuse, D, and what its material reflects
as one lobe w, a, s, of the light, of the mean S of the surfaces that it sees itself, and of lamps, with g a lobe on the
sphere of von Mises and Fisher:

    B[y, c] = D[y, c] + w[c] (V_y(a, s) E[c](a, s) + (1 - V_y(a, s)) S[y, c] + sum over m of  g(a, s, d_m) V_ym P_m[c])

Where v reflects much of what comes of y_n, by a lobe narrow enough to see one point alone (`close`, `alone`), y
reflects by `PARTS` lobes instead, and S is what the point that y sees along each of these sends to it, itself as one
lobe without surfaces. In an ablation on 500 points of a statue under uffizi, gold of roughness 0.2, what v reflects
erred by 13.2 % in total with one lobe and S, by 10.2 with one lobe and that point, 7.9 with four and S, 5.8 with four
and that point, and 4.5 with the exact radiance of every y. Visibility of y itself is not what errs: rays from where y
is hit, in place of the bits of the vertex, took 10.9 to 10.6.

The wider all lobes of v are together, the more each sees S[v, c] in place of one point. In a trial on a statue under
uffizi, light that bounced to gold of roughness 0.5, 0.7 and 1 erred by 13, 16 and 17 % without that, with 32 lobes, by
11, 7 and 6 with it; below 0.4 it changes nothing.

Sun et al. 2007, section 4.1, has up to four lobes about common axes, of at most 21 degrees, and a tensor for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops.cells import FEW, NARROWEST, Gloss, frames, octaves
from ptt.ops.constants import (
    CLOSE,
    HEAD_ON,
    LEVELS,
    MEETS,
    NORMAL,
    NOTHING,
    SECTORS,
    SHARPEST,
    SPREAD,
    TILTS,
    TINY,
)
from ptt.ops.hemispheres import Between, visible, visible_between
from ptt.ops.octahedral import corners, from_octahedral, hemi_octahedral, mix, octahedral
from ptt.ops.view import SurfaceBlocks, local_directions

SHARPNESS = (3 / math.radians(NARROWEST)) ** 2
"""The inverse variance of a lobe of level 1, of which a level more is half."""

BLUR = math.radians(2) ** 2
"""What the variance of a lobe is larger by where lamps are seen by way of another point, since the normal there is
right to about so much: in a trial on a statue under grace, gold of roughness 0.2 and 0.3 erred by 65 and 7.1 % without,
by 23 and 9.6 with it, and by 12 and 12 with 3 degrees."""

AT_ONCE = 4096  # points that are worked out together, so that they stay in the cache

Sky = Callable[[Tensor, Tensor], Tensor]
"""The share (n, k) that points see of lobes about local axes (n, k, 3) at levels (n, k)."""


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


class Around(NamedTuple):
    """What n points may see of each other, p points in all.

    mean (3, n): S of each of the n
    meets (n, MET) int32: which point each sees about the axes of a `HemiOctahedral` map, -1 for none, and the normal
        there (`transfer.meets_packed`)
    points (p, RECORD): of all: rows of the frame, and, as whole numbers, their rows of `seen` and the first of their
        region's in `tables`; zeros
    sent (p, SENT): of all: D, S, D of light that did not bounce before; zeros
    seen (s, words) int32: of all, as for `shine`
    others (s, MET) int32: `meets` of all, in the order of `seen`; None where light bounces once
    tables (regions * TILTS, ROW): a, s and w of the lobes that materials reflect as one; zero
    parts (regions * TILTS, PARTS, ROW): of the same as a few
    maps (LEVELS, cells, 4), lamps (m, 3), powers (m, c): as those of `GlossLight`
    through (s, m): how much of each lamp all see, in the order of `seen`
    """

    mean: Tensor
    meets: Tensor
    points: Tensor
    sent: Tensor
    seen: Tensor
    others: Tensor | None
    tables: Tensor
    parts: Tensor
    maps: Tensor
    lamps: Tensor
    powers: Tensor
    through: Tensor


def alone(lobes: int) -> float:
    """The level at which a lobe, of so many of a material, sees one point alone; from a level more on S alone."""
    return min(SPREAD - math.log2(lobes), LEVELS - 2)


def close(lobes: int) -> float:
    """What a lobe, of so many of a material, reflects of a surface from which that reflects as `PARTS` lobes."""
    return CLOSE * min(1, FEW / lobes)


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
    frame = points.frame.movedim(2, 0)  # shape: (n, 3, 3)
    parts = []
    for first in range(0, len(wo), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        near = None if around is None else around._replace(mean=around.mean[:, some], meets=around.meets[some])
        lit = light._replace(through=light.through[:, some])
        sky = _sky(seen, frame, some, between)
        parts.append(_shine(gloss, lit, frame[some], sky, wo[some], near))
    out = torch.cat(parts)
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


def _sky(seen: Tensor, frame: Tensor, some: slice, between: Between | None) -> Sky:
    """What some points see of the sky, with frames (n, 3, 3)."""
    if between is None:
        return partial(visible, seen[some])
    own = between._replace(rows=between.rows[some], weights=between.weights[some])
    return lambda axes, level: visible_between(seen, own, axes @ frame[some], level)


def _shine(gloss: Gloss, light: GlossLight, frame: Tensor, sky: Sky, wo: Tensor, around: Around | None) -> Tensor:
    """What points (n, ...) send out (n, c)."""
    table, turns = gloss.lobes
    index, weights = rows_of(wo, turns)
    row = mix(table.flatten(1), index, weights).unflatten(1, table.shape[1:])  # shape: (n, lobes, 4 + c)
    level = row[..., 3]
    axes = row[..., :3] @ frames(wo)
    through = sky(axes, level)
    about = blurred(light.maps, axes @ frame @ light.turn, level)
    about = about * through[..., None]
    if around is not None:
        spread = (level - alone(row.shape[1])).clamp(0, 1)[..., None]
        much = (row[..., 4:].mean(2) * (1 - through)).detach() / close(row.shape[1])
        closely = (much - 1).clamp(0, 1) * (alone(row.shape[1]) - level).detach().clamp(0, 1)
        surfaces = _from_points(around, frame, axes, light.turn, closely)
        surfaces = torch.lerp(surfaces, around.mean.T[:, None], spread)
        about = about + surfaces * (1 - through)[..., None]
    out: Tensor = (row[..., 4:] * about).sum(1)
    if not len(light.lamps):
        return out
    return out + _lamps(frame, wo, gloss.values, index, weights, light.lamps, light.powers, light.through)


class _Met(NamedTuple):
    """Points that others see: which (m,), their records (m, RECORD), local normals and directions of view (m, 3)."""

    number: Tensor
    record: Tensor
    normal: Tensor
    wo: Tensor


def _from_points(around: Around, frame: Tensor, axes: Tensor, turn: Tensor, closely: Tensor) -> Tensor:
    """B (n, k, c) that points (n, ...) see about their local axes (n, k, 3); 0 where they see none.

    closely (n, k): how far points are seen as `PARTS` lobes in place of one

    What is sent is taken against the axis, not from one vertex to the other, which lie beside where the axis begins and
    ends: in a trial on a statue of gold of roughness 0.2, from one to the other erred by 42 %, this by 25.
    """
    world = axes @ frame
    there, met = _met(around, around.meets, axes, world)
    sent = axes.new_zeros(*axes.shape[:2], around.maps.shape[2] - 1)
    sent = sent.index_put(there, _as_one_lobe(around, met, turn))
    if around.others is None or not bool((closely > 0).any()):
        return sent
    there, met = _met(around, around.meets, axes, world, closely > 0)
    parts = torch.zeros_like(sent).index_put(there, _as_parts(around, met, turn))
    return torch.lerp(sent, parts, closely[..., None])


def _met(
    around: Around, meets: Tensor, axes: Tensor, world: Tensor, closely: Tensor | None = None
) -> tuple[tuple[Tensor, Tensor], _Met]:
    """Which points see others (n, MET) about their axes (n, k, 3), local and in the world, that face them: their
    numbers and those of the axes, and what they see.

    closely (n, k) bool: axes that alone are asked for, by normals between cells; None for all, by the nearest cells
    """
    pair, second = _cell(axes)
    normal = _normals(meets, pair, second) if closely is None else _between_normals(meets, axes)
    number = meets.gather(1, pair + second).long()
    towards = normalize(world, dim=-1)  # between rows of a table axes are shorter
    seen = (number >= 0) & ((towards * normal).sum(-1) < 0)
    there = torch.nonzero(seen if closely is None else seen & closely, as_tuple=True)
    record = around.points[number[there]]
    frame = record[:, :9].unflatten(1, (3, 3))
    local = (frame @ torch.stack((normal[there], -towards[there]), 2)).unbind(2)
    return (there[0], there[1]), _Met(number[there], record, *local)


def _cell(axes: Tensor) -> tuple[Tensor, Tensor]:
    """Where the cells of local axes (n, k, 3) lie: the first word of the pair, and which of it."""
    column, row = ((hemi_octahedral(axes) + 1) * (MEETS / 2)).floor().clamp(0, MEETS - 1).long().unbind(-1)
    cell = row * MEETS + column
    return 3 * (cell >> 1), cell & 1


def _normals(meets: Tensor, pair: Tensor, second: Tensor) -> Tensor:
    """Unit normals (n, k, 3) of cells in words (n, MET), 0 where nothing is met."""
    word = meets.gather(1, pair + 2) >> 16 * second.int()
    coordinates = torch.stack(((word << 24) >> 24, (word << 16) >> 24), -1)
    normal = normalize(from_octahedral(coordinates.float() / NORMAL), dim=-1)
    return torch.where(coordinates[..., :1] == NOTHING, 0.0, normal)


def _between_normals(meets: Tensor, axes: Tensor) -> Tensor:
    """Unit normals (n, k, 3), bilinear between the cells around local axes (n, k, 3) in which something is met.

    In an ablation as above, with four lobes, gold of 0.2 erred by 8.2 % with those of the nearest cells, 6.3 with
    these, and 6.6 where axes hit.
    """
    cells, weights = corners(hemi_octahedral(axes), MEETS, wrap=False)
    own = [_normals(meets, 3 * (cell >> 1), cell & 1) for cell in cells.unbind(-1)]
    return normalize(torch.einsum("nkq,qnka->nka", weights, torch.stack(own).to(weights)), dim=-1)


def _as_one_lobe(around: Around, met: _Met, turn: Tensor) -> Tensor:
    """B (m, c) of points that reflect as one lobe, and see the mean of surfaces where the sky is hidden.

    The nearest row of the table and the nearest width serve: what comes of many such points is a mean. Normals are
    interpolated: in a trial on a statue of gold of roughness 0.2, 0.3 and 0.5 those of the vertices left 39, 35 and
    12 % of error in light that bounces, these 28, 26 and 10. Under a map with lamps, which are seen or are not, one
    share of visibility for the whole lobe left 50 and 24 % at 0.3 and 0.5, lamps apart leave 30 and 12.
    """
    sent = around.sent[met.number]
    table = around.tables[_rows(met)][:, None]
    return sent[:, :3] + _reflected(around, met, table, lambda axes, world: sent[:, None, 3:6], turn)


def _as_parts(around: Around, met: _Met, turn: Tensor) -> Tensor:
    """B (m, c) of points that reflect as `PARTS` lobes, each of which sees a point where the sky is hidden."""
    assert around.others is not None
    rows = met.record[:, 9].long()
    others = around.others[rows]

    def next_points(axes: Tensor, world: Tensor) -> Tensor:
        there, beyond = _met(around, others, axes, world)
        table = around.tables[_rows(beyond)][:, None]
        reflected = _reflected(around, beyond, table, lambda axes, world: torch.zeros_like(world), turn)
        sent = around.sent[beyond.number][:, 6:9] + reflected
        return torch.zeros_like(world).index_put(there, sent)

    return around.sent[met.number][:, :3] + _reflected(around, met, around.parts[_rows(met)], next_points, turn)


def _rows(met: _Met) -> Tensor:
    """The rows (m,) of tables nearest to directions of view."""
    cosine = (met.wo * met.normal).sum(1)
    return ((cosine * (TILTS - 0.5) - 0.5).round().clamp(0, TILTS - 1) + met.record[:, 10]).long()


def _reflected(
    around: Around, met: _Met, table: Tensor, surfaces: Callable[[Tensor, Tensor], Tensor], turn: Tensor
) -> Tensor:
    """What points reflect (m, c) by lobes, rows (m, j, ROW) of a table.

    surfaces: gives what is seen of surfaces about axes (m, j, 3), local and in the world
    """
    cosine = (met.wo * met.normal).sum(1, keepdim=True)
    flat = met.wo - cosine * met.normal
    sine = flat.square().sum(1, keepdim=True).clamp(min=HEAD_ON**2).sqrt()
    along = cosine / sine * flat + sine * met.normal
    across = torch.linalg.cross(met.normal, flat / sine)
    mirror = cosine * met.normal - flat
    axes = table[..., :3] @ torch.stack((along, across, mirror), 1)  # shape: (m, j, 3)
    level = table[..., 3].detach().round()
    row_seen = met.record[:, 9].long()
    through = (visible(around.seen[row_seen], axes, level) * (axes[..., 2] > 0))[..., None]
    world = axes @ met.record[:, :9].unflatten(-1, (3, 3))
    light = torch.lerp(surfaces(axes, world), blurred(around.maps, world @ turn, level), through)
    if len(around.lamps):
        about = 1 / (torch.exp2(level - 1)[..., None] / SHARPNESS + BLUR)
        lobe = about / (2 * math.pi) * torch.exp(about * (world @ around.lamps.T - 1))
        light = light + (lobe * around.through[row_seen][:, None]) @ around.powers
    return (table[..., 4:7] * light).sum(1)


def blurred(maps: Tensor, axes: Tensor, level: Tensor) -> Tensor:
    """E (n, k, 3) about axes (n, k, 3) at levels (n, k), linear between the maps (levels, cells, 4)."""
    cells = maps.shape[1]
    side = math.isqrt(cells)
    below = level.detach().floor().clamp(0, len(maps) - 2)
    index, weights = corners(octahedral(axes) * ((side - 2) / side), side, wrap=False)
    index = index + cells * below.long()[..., None]
    share = (level - below)[..., None]
    flat = maps.flatten(0, 1)
    both = torch.cat((index, index + cells), -1).flatten(0, 1)
    mixed = torch.cat((weights * (1 - share), weights * share), -1).flatten(0, 1)
    about: Tensor = mix(flat, both, mixed)[:, :3].reshape(axes.shape)
    return about


def reflected_lamps(
    position: Tensor,
    frame: Tensor,
    eye: Tensor,
    values: Tensor,
    lamps: Tensor,
    powers: Tensor,
    through: Tensor | None = None,
) -> Tensor:
    """What points reflect of lamps to the eye (n, c), for an eye (3,) or unit directions (3, n) to it.

    position (3, n), frame (3, 3, n): rows tangent, bitangent, normal
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
    return torch.cat(parts)


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
