"""What points send to others that see them where the sky is hidden, each by its own narrow lobes (`ptt.ops.gloss`).

y_n, the point that v sees along a_n (`Around`), sends to v what is diffuse, D, and what its material reflects
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
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops.cells import FEW, SHARPNESS
from ptt.ops.constants import CLOSE, EDGE, HEAD_ON, LEVELS, MEETS, NORMAL, NOTHING, SPREAD, TILTS
from ptt.ops.hemispheres import split
from ptt.ops.octahedral import corners, from_octahedral, hemi_octahedral
from ptt.ops.view import blurred

BLUR = math.radians(2) ** 2
"""What the variance of a lobe is larger by where lamps are seen by way of another point, since the normal there is
right to about so much: in a trial on a statue under grace, gold of roughness 0.2 and 0.3 erred by 65 and 7.1 % without,
by 23 and 9.6 with it, and by 12 and 12 with 3 degrees."""


class Around(NamedTuple):
    """What n points may see of each other, p points in all.

    mean (3, n): S of each of the n
    meets (n, MET) int32: which point each sees about the axes of a `HemiOctahedral` map, -1 for none, and the normal
        there (`transfer.meets`)
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


class _Met(NamedTuple):
    """Points that others see: which (m,), their records (m, RECORD), local normals and directions of view (m, 3)."""

    number: Tensor
    record: Tensor
    normal: Tensor
    wo: Tensor


def from_points(around: Around, frame: Tensor, axes: Tensor, turn: Tensor, closely: Tensor) -> Tensor:
    """B (n, k, c) that points (n, ...) see about their local axes (n, k, 3): nothing of what faces away from them, and
    where none is met the mean of all that they see, since what hides a part of a lobe need not lie about any one axis.

    closely (n, k): how far points are seen as `PARTS` lobes in place of one

    At an edge the face beside a vertex rises above the horizon of its normal and hides what is beyond, its back turned
    to what shines there. In a trial on a statue under uffizi, gold of roughness 0.1, 0.2, 0.3 and 0.5 in views of less
    than 20 degrees erred by 43, 36, 26 and 9.5 % in total with the mean there, too; by 16, 11, 9.2 and 6.2 without.

    What is sent is taken against the axis, not from one vertex to the other, which lie beside where the axis begins and
    ends: in a trial on a statue of gold of roughness 0.2, from one to the other erred by 42 %, this by 25.
    """
    world = axes @ frame
    there, met = _met(around, around.meets, axes, world)
    none = _numbers(around.meets, axes) < 0
    mean = torch.where(none[..., None], around.mean.T[:, None], 0.0)
    sent = mean.index_put(there, _as_one_lobe(around, met, turn))
    if around.others is None or not bool((closely > 0).any()):
        return sent
    there, met = _met(around, around.meets, axes, world, closely > 0)
    parts = mean.index_put(there, _as_parts(around, met, turn))
    return torch.lerp(sent, parts, closely[..., None])


def _met(
    around: Around, meets: Tensor, axes: Tensor, world: Tensor, closely: Tensor | None = None
) -> tuple[tuple[Tensor, Tensor], _Met]:
    """Which points see others (n, MET) about their axes (n, k, 3), local and in the world, that face them: their
    numbers and those of the axes, and what they see.

    closely (n, k) bool: axes that alone are asked for, by normals between cells; None for all, by the nearest cells
    """
    normal = _normals(meets, *_cell(axes)) if closely is None else _between_normals(meets, axes)
    number = _numbers(meets, axes).long()
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


def _numbers(meets: Tensor, axes: Tensor) -> Tensor:
    """The points (n, k) in words (n, MET) that lie about local axes (n, k, 3), by their numbers; -1 for none."""
    pair, second = _cell(axes)
    return meets.gather(1, pair + second)


def _normals(meets: Tensor, pair: Tensor, second: Tensor) -> Tensor:
    """Unit normals (n, k, 3) of cells in words (n, MET), 0 where nothing is met."""
    word = meets.gather(1, pair + 2) >> 16 * second.int()
    coordinates = torch.stack(((word << 24) >> 24, (word << 16) >> 24), -1)
    normal = normalize(from_octahedral(coordinates.float() / NORMAL), dim=-1)
    return torch.where(coordinates[..., :1] == NOTHING, 0.0, normal)


def _between_normals(meets: Tensor, axes: Tensor) -> Tensor:
    """Unit normals (n, k, 3) about local axes (n, k, 3), bilinear between the cells around each whose normals turn away
    from that of the nearest by no more than a smooth surface's (`EDGE`).

    In a trial under uffizi gold of roughness 0.2 erred in total, on a statue, a dragon and an engine, by 8.0, 17.9 and
    25.5 % with these, by 9.7, 18.0 and 27.7 with those of the nearest cells, and by 8.4, 19.6 and 39.4 between all
    cells, which rounds edges off.
    """
    cells, weights = corners(hemi_octahedral(axes), MEETS, wrap=False)
    normals = torch.stack([_normals(meets, 3 * (cell >> 1), cell & 1) for cell in cells.unbind(-1)], 2).to(weights)
    nearest = normals.gather(2, weights.argmax(-1)[..., None, None].expand(-1, -1, -1, 3))
    smooth = (normals * nearest).sum(-1) > EDGE
    return normalize(torch.einsum("nkq,nkqa->nka", weights * smooth, normals), dim=-1)


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
    frame = met.record[:, :9].unflatten(-1, (3, 3))
    sky = split(around.seen[row_seen], axes, level)
    through = (sky.share * (axes[..., 2] > 0))[..., None]
    world = axes @ frame
    light = torch.lerp(surfaces(axes, world), blurred(around.maps, sky.seen @ frame @ turn, level), through)
    if len(around.lamps):
        about = 1 / (torch.exp2(level - 1)[..., None] / SHARPNESS + BLUR)
        lobe = about / (2 * math.pi) * torch.exp(about * (world @ around.lamps.T - 1))
        light = light + (lobe * around.through[row_seen][:, None]) @ around.powers
    return (table[..., 4:7] * light).sum(1)
