"""Narrow lobes as operators; their plain functions are those of `ptt.ops.gloss`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops import gloss as plain
from ptt.ops.around import BLUR, Around, alone, close
from ptt.ops.cells import SHARPNESS, Gloss, Lobes
from ptt.ops.compiling import inlined
from ptt.ops.constants import (
    CHANNELS,
    CORNERS,
    GROUP,
    LEVELS,
    MET,
    MOST_CELLS,
    PARTS,
    RECORD,
    RINGS,
    ROW,
    SECTORS,
    SENT,
    TILTS,
)
from ptt.ops.gloss import GlossLight
from ptt.ops.hemispheres import RISEN, Between, side_of
from ptt.ops.native.arguments import contiguous, of_type, side, square
from ptt.ops.native.hemispheres import of_hemispheres
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.view import SurfaceBlocks


@inlined
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
    """B (v, c), as `ptt.ops.gloss.shine`."""
    table, turns = gloss.lobes
    where = (None, None, None) if between is None else tuple(between)
    other = (None,) * len(Around._fields) if around is None else tuple(around)
    lit = (gloss.values, *light, share)
    own = (points.position, points.frame, points.dip, points.place, points.point)
    result: Tensor = _shine(*own, eye, seen, table, turns, *lit, *where, *other)
    return result


class _Shine(NamedTuple):
    """The arguments in the order of the schema."""

    position: Tensor
    frame: Tensor
    dip: Tensor
    place: Tensor
    point: Tensor
    eye: Tensor
    seen: Tensor
    table: Tensor
    turns: int
    values: Tensor
    maps: Tensor
    turn: Tensor
    lamps: Tensor
    powers: Tensor
    through: Tensor
    share: Tensor | None
    rows: Tensor | None
    weights: Tensor | None
    places: Tensor | None
    mean: Tensor | None
    meets: Tensor | None
    records: Tensor | None
    sent: Tensor | None
    all_seen: Tensor | None
    others: Tensor | None
    tables: Tensor | None
    parts: Tensor | None
    rest: Tensor | None
    near: Tensor | None
    near_powers: Tensor | None
    near_through: Tensor | None


WHERE = slice(_Shine._fields.index("rows"), _Shine._fields.index("places") + 1)  # of points between places


def _plain(*arguments: Any) -> Tensor:
    g = _Shine(*arguments)
    light = GlossLight(g.maps, g.turn, g.lamps, g.powers, g.through)
    points = SurfaceBlocks(g.position, g.frame, g.dip, None, g.position.new_empty(0), g.place, g.point)
    gloss = Gloss(Lobes(g.table, g.turns), g.values, g.table[:0], g.table[:0], spread=90.0)
    around = None if g.meets is None else Around(*arguments[-len(Around._fields) :])
    between = Between(*arguments[WHERE]) if g.rows is not None else None
    return plain.shine(points, g.eye, g.seen, gloss, light, around, g.share, between)


def _conditions(*arguments: Any) -> Conditions:
    g = _Shine(*arguments)
    n = g.position.shape[1]
    lobes = g.table.shape[1]
    reals = (g.position, g.eye, g.table, g.values, g.maps, g.turn)
    yield of_type(torch.float32, *reals), "points, tables and light must be float32"
    yield contiguous(g.position, g.table, g.values, g.maps), "points, tables and maps must be contiguous"
    yield of_type(torch.int32, g.point) and contiguous(g.point), "point must be int32, contiguous"
    yield of_type(torch.float32, g.frame, g.dip, g.lamps, g.powers, g.through), "frames and lamps must be float32"
    yield contiguous(g.frame, g.dip, g.through), "frames and what is seen of lamps must be contiguous"
    yield g.frame.shape == (3, 3, n) and n % GROUP == 0, f"frame must be (3, 3, n), n a multiple of {GROUP}"
    yield g.dip.shape == g.point.shape == (n,), "dip and point must be (n,)"
    yield from of_hemispheres(g.seen)
    yield g.lamps.shape == g.powers.shape == (len(g.lamps), 3), "lamps and powers must be (m, 3)"
    yield g.through.shape == (len(g.lamps), n), "what is seen of lamps must be (m, n)"
    yield g.position.shape == (3, n), "position must be (3, n)"
    yield g.eye.shape in ((3,), (3, n)), "eye must be (3,) or (3, n)"
    yield g.table.shape == (g.turns * TILTS, lobes, 7), f"the table of lobes must be (turns * {TILTS}, lobes, 7)"
    yield 0 < lobes <= MOST_CELLS, f"there must be 1..{MOST_CELLS} lobes"
    yield from _of_values(g.values, g.turns)
    yield g.maps.ndim == 3 and g.maps.shape[::2] == (LEVELS, CHANNELS), f"maps must be ({LEVELS}, cells, 4)"
    yield g.maps.shape[1] > 1 and square(g.maps.shape[1]), "maps must be square"
    yield g.turn.shape == (3, 3), "turn must be (3, 3)"
    if g.share is not None:
        yield of_type(torch.float32, g.share) and contiguous(g.share), "shares must be float32, contiguous"
        yield g.share.shape == (3, n), "shares must be (3, n)"
    if g.rows is None:
        yield len(g.seen) == n, "what is seen must be (n, words)"
    else:
        yield from _of_between(g, Between(*arguments[WHERE]))
    if g.meets is not None:
        yield from _of_around(g, Around(*arguments[-len(Around._fields) :]))


def _of_values(values: Tensor, turns: int) -> Conditions:
    """The root of f, for so many azimuths of wo."""
    rows, sectors = turns * TILTS, SECTORS if turns == 1 else 2 * SECTORS
    yield values.shape == (rows, RINGS, sectors, 3), f"values must be ({rows}, {RINGS}, {sectors}, 3)"


def _of_between(g: _Shine, between: Between) -> Conditions:
    rows, weights, frames = between
    yield g.meets is None, "points between places show no light of others"
    yield of_type(torch.int32, rows) and of_type(torch.float32, weights, frames), "rows must be int32"
    yield contiguous(*between), "where points lie must be contiguous"
    yield rows.shape == weights.shape == (g.position.shape[1], rows.shape[-1]), "rows and weights must be (n, k)"
    yield 1 <= rows.shape[1] <= CORNERS, f"points must lie between 1..{CORNERS} places"
    yield frames.shape == (len(g.seen), 3, 3), "the frames of places must be (places, 3, 3)"


def _of_around(g: _Shine, around: Around) -> Conditions:
    mean, meets, points, sent, seen, others, tables, parts, maps, lamps, powers, through = around
    reals = (mean, points, sent, tables, parts, maps, lamps, powers, through)
    yield of_type(torch.float32, *reals), "all around must be float32"
    whole = (meets, seen) if others is None else (meets, seen, others)
    yield of_type(torch.int32, *whole), "what points see, and which points, must be int32"
    yield contiguous(*reals, *whole), "what lies around must be contiguous"
    yield mean.shape == g.position.shape, "the mean of surfaces must be (3, n)"
    yield meets.shape == (g.position.shape[1], MET), f"meets must be (n, {MET})"
    yield points.shape == (len(points), RECORD), f"points must be (p, {RECORD})"
    yield sent.shape == (len(points), SENT), f"what is sent must be (p, {SENT})"
    yield seen.shape[1] == g.seen.shape[1], "what all see must be laid out as what is seen"
    yield 4 * seen.numel() < 2**31, "what all see must have fewer than 2^31 bytes"
    if others is not None:
        yield others.shape == (len(seen), MET), f"what others meet must be (s, {MET})"
        yield MET * len(seen) < 2**31, "what others meet must have fewer than 2^31 words"
    yield tables.ndim == 2 and tables.shape[1] == ROW, f"tables must be (regions * {TILTS}, {ROW})"
    yield parts.shape == (len(tables), PARTS, ROW), f"parts must be (regions * {TILTS}, {PARTS}, {ROW})"
    yield maps.shape == g.maps.shape, "the maps of the light must have one size"
    yield lamps.shape == powers.shape == (len(lamps), 3), "lamps and powers must be (m, 3)"
    yield through.shape == (len(seen), len(lamps)), "what all see of lamps must be (s, m)"
    yield through.numel() < 2**31, "what all see of lamps must have fewer than 2^31 numbers"


def _kernel(*arguments: Any) -> Tensor:
    g = _Shine(*arguments)
    n = g.position.shape[1]
    out = g.position.new_empty(len(g.place), 3)
    run(
        "shine",
        position=g.position,
        frame=g.frame,
        dip=g.dip,
        eye=g.eye.contiguous(),
        table=g.table,
        values=g.values,
        maps=g.maps,
        turn=g.turn.contiguous(),
        lamps=g.lamps.contiguous(),
        powers=g.powers.contiguous(),
        through=g.through,
        seen=g.seen,
        share=g.share,
        rows=g.rows,
        weights=g.weights,
        places=g.places,
        mean=g.mean,
        meets=g.meets,
        records=g.records,
        sent=g.sent,
        all_seen=g.all_seen,
        others=g.others,
        tables=g.tables,
        parts=g.parts,
        rest=g.rest,
        near=g.near,
        near_powers=g.near_powers,
        near_through=g.near_through,
        point=g.point,
        out=out,
        n=n,
        points=len(out),
        sources=len(g.lamps),
        near_sources=0 if g.near is None else len(g.near),
        sharpness=SHARPNESS,
        blur=BLUR,
        alone=alone(g.table.shape[1]),
        close=close(g.table.shape[1]),
        rise=1 / RISEN,
        bits=side_of(g.seen),
        each=0 if g.rows is None else g.rows.shape[1],
        distant=g.eye.ndim == 2,
        turns=g.turns,
        lobes=g.table.shape[1],
        map=side(g.maps.shape[1]),
    )
    return out


_shine = operator(
    "shine(Tensor position, Tensor frame, Tensor dip, Tensor place, Tensor point, Tensor eye, Tensor seen, "
    "Tensor table, int turns, Tensor values, Tensor maps, Tensor turn, Tensor lamps, Tensor powers, Tensor through, "
    "Tensor? share, Tensor? rows, Tensor? weights, Tensor? places, "
    "Tensor? mean, Tensor? meets, Tensor? records, Tensor? sent, Tensor? all_seen, Tensor? others, Tensor? tables, "
    "Tensor? parts, Tensor? rest, Tensor? near, Tensor? near_powers, Tensor? near_through) -> Tensor",
    plain=_plain,
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda position, frame, dip, place, *others: position.new_empty(len(place), 3),
)

# What is reflected of lamps alone


@inlined
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
    """B (n, c), as `ptt.ops.gloss.reflected_lamps`."""
    result: Tensor = _reflected_lamps(position, frame, dip, eye, values, lamps, powers, through)
    return result


class _ReflectedLamps(NamedTuple):
    """The arguments in the order of the schema."""

    position: Tensor
    frame: Tensor
    dip: Tensor
    eye: Tensor
    values: Tensor
    lamps: Tensor
    powers: Tensor
    through: Tensor | None


def _reflected_conditions(*arguments: Any) -> Conditions:
    g = _ReflectedLamps(*arguments)
    n = g.position.shape[1]
    yield of_type(torch.float32, *arguments[:7]), "points and lamps must be float32"
    yield contiguous(g.position, g.frame, g.dip, g.values), "points and values must be contiguous"
    yield g.position.shape == (3, n) and n % GROUP == 0, f"position must be (3, n), n a multiple of {GROUP}"
    yield g.frame.shape == (3, 3, n) and g.dip.shape == (n,), "frame must be (3, 3, n), and dip (n,)"
    yield g.eye.shape in ((3,), (3, n)), "eye must be (3,) or (3, n)"
    yield from _of_values(g.values, len(g.values) // TILTS)
    yield g.lamps.shape == g.powers.shape == (len(g.lamps), 3), "lamps and powers must be (m, 3)"
    if g.through is not None:
        yield of_type(torch.float32, g.through) and contiguous(g.through), "what is seen must be float32, contiguous"
        yield g.through.shape == (len(g.lamps), n), "what is seen of lamps must be (m, n)"


def _reflected_kernel(*arguments: Any) -> Tensor:
    g = _ReflectedLamps(*arguments)
    out = g.position.new_empty(g.position.shape[1], 3)
    run(
        "reflected_lamps",
        position=g.position,
        frame=g.frame,
        dip=g.dip,
        eye=g.eye.contiguous(),
        values=g.values,
        lamps=g.lamps.contiguous(),
        powers=g.powers.contiguous(),
        through=g.through,
        out=out,
        n=len(out),
        sources=len(g.lamps),
        distant=g.eye.ndim == 2,
        turns=len(g.values) // TILTS,
    )
    return out


_reflected_lamps = operator(
    "reflected_lamps(Tensor position, Tensor frame, Tensor dip, Tensor eye, Tensor values, Tensor lamps, "
    "Tensor powers, Tensor? through) -> Tensor",
    plain=lambda *arguments: plain.reflected_lamps(*arguments),
    kernel=_reflected_kernel,
    conditions=_reflected_conditions,
    fake=lambda position, frame, dip, eye, values, *others: position.new_empty(position.shape[1], values.shape[3]),
)

# How much of lamps is seen


@inlined
def lamp_visibility(visible: Tensor, cells: Tensor, shares: Tensor) -> Tensor:
    """Shares (m, n), as `ptt.ops.gloss.lamp_visibility`."""
    result: Tensor = _lamp_visibility(visible, cells, shares)
    return result


def _lamp_conditions(visible: Tensor, cells: Tensor, shares: Tensor) -> Conditions:
    yield of_type(torch.int32, visible) and of_type(torch.int64, cells), "visible must be int32, and cells int64"
    yield of_type(torch.float32, shares), "shares must be float32"
    yield contiguous(visible, cells, shares), "visible, cells and shares must be contiguous"
    n = visible.shape[-1]
    yield visible.ndim == 2 and n % GROUP == 0, f"visible must be (words, n), n a multiple of {GROUP}"
    yield cells.ndim == 2 and cells.shape == shares.shape, "cells and shares must be (m, k)"


def _lamp_fake(visible: Tensor, cells: Tensor, shares: Tensor) -> Tensor:
    return shares.new_empty(len(cells), visible.shape[1])


def _lamp_kernel(visible: Tensor, cells: Tensor, shares: Tensor) -> Tensor:
    out = _lamp_fake(visible, cells, shares)
    sources, each = cells.shape
    n = visible.shape[1]
    run("lamp_visibility", visible=visible, cells=cells, shares=shares, out=out, n=n, sources=sources, each=each)
    return out


_lamp_visibility = operator(
    "lamp_visibility(Tensor visible, Tensor cells, Tensor shares) -> Tensor",
    plain=lambda *arguments: plain.lamp_visibility(*arguments),
    kernel=_lamp_kernel,
    conditions=_lamp_conditions,
    fake=_lamp_fake,
)
