"""Glossy reflection of direct light as operators; their plain functions are those of `ptt.ops.gloss`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops import gloss as plain
from ptt.ops.compiling import inlined
from ptt.ops.constants import BITS, CHANNELS, GROUP, MOST_CELLS, RINGS, SECTORS, TILTS, WIDE_SIDE, WIDEST_SIDE
from ptt.ops.gloss import Gloss, GlossLight, Lobes
from ptt.ops.native.arguments import contiguous, of_type, side, square
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.view import SurfaceBlocks


WORDS = (BITS * BITS // 8 + WIDE_SIDE * WIDE_SIDE + WIDEST_SIDE * WIDEST_SIDE) // 4  # of what a point sees


@inlined
def shine(points: SurfaceBlocks, eye: Tensor, seen: Tensor, gloss: Gloss, light: GlossLight) -> Tensor:
    """B (v, c), as `ptt.ops.gloss.shine`."""
    table, turns = gloss.lobes
    result: Tensor = _shine(
        points.position, points.frame, points.place, eye, seen, table, turns, gloss.values, *light
    )
    return result


class _Shine(NamedTuple):
    """The arguments in the order of the schema."""

    position: Tensor
    frame: Tensor
    place: Tensor
    eye: Tensor
    seen: Tensor
    table: Tensor
    turns: int
    values: Tensor
    maps: Tensor
    turn: Tensor
    lamps: Tensor
    powers: Tensor


def _plain(*arguments: Any) -> Tensor:
    g = _Shine(*arguments)
    light = GlossLight(g.maps, g.turn, g.lamps, g.powers)
    return plain.shine(
        _points(g.position, g.frame, g.place), g.eye, g.seen, Gloss(Lobes(g.table, g.turns), g.values), light
    )


def _points(position: Tensor, frame: Tensor, place: Tensor) -> SurfaceBlocks:
    """Points of which neither colour nor cuts matter."""
    return SurfaceBlocks(position, frame, None, position.new_empty(0), place)


def _conditions(*arguments: Any) -> Conditions:
    g = _Shine(*arguments)
    n = g.position.shape[1]
    lobes = g.table.shape[1]
    reals = (g.position, g.eye, g.table, g.values, g.maps, g.turn)
    yield of_type(torch.float32, *reals), "points, tables and light must be float32"
    yield contiguous(g.position, g.table, g.values, g.maps), "points, tables and maps must be contiguous"
    yield from _of_lamps(g.frame, g.place, g.seen, g.lamps, g.powers)
    yield g.turns == 1, "f must be isotropic"
    yield g.position.shape == (3, g.frame.shape[2]), "position must be (3, n)"
    yield g.eye.shape in ((3,), (3, n)), "eye must be (3,) or (3, n)"
    yield g.table.shape == (TILTS, lobes, 7), f"the table of lobes must be ({TILTS}, lobes, 7)"
    yield 0 < lobes <= MOST_CELLS, f"there must be 1..{MOST_CELLS} lobes"
    yield g.values.shape == (TILTS, RINGS, SECTORS, 3), f"values must be ({TILTS}, {RINGS}, {SECTORS}, 3)"
    yield g.maps.ndim == 3 and len(g.maps) > 1 and g.maps.shape[2] == CHANNELS, "maps must be (levels, cells, 4)"
    yield g.maps.shape[1] > 1 and square(g.maps.shape[1]), "maps must be square"
    yield g.turn.shape == (3, 3), "turn must be (3, 3)"


def _of_lamps(frame: Tensor, place: Tensor, seen: Tensor, lamps: Tensor, powers: Tensor) -> Conditions:
    yield of_type(torch.float32, frame, lamps, powers), "frames and lamps must be float32"
    yield of_type(torch.int32, seen), "what is seen must be int32"
    yield of_type(torch.int64, place), "place must be int64"
    yield contiguous(frame, place, seen), "frames, places and what is seen must be contiguous"
    n = frame.shape[-1]
    yield frame.shape == (3, 3, n) and n % GROUP == 0, f"frame must be (3, 3, n), n a multiple of {GROUP}"
    yield seen.shape == (n, WORDS), f"what is seen must be (n, {WORDS})"
    yield lamps.shape == powers.shape == (len(lamps), 3), "lamps and powers must be (m, 3)"


def _kernel(*arguments: Any) -> Tensor:
    g = _Shine(*arguments)
    n = g.position.shape[1]
    out = g.position.new_empty(len(g.place), 3)
    run(
        "shine",
        position=g.position,
        frame=g.frame,
        eye=g.eye.contiguous(),
        table=g.table,
        values=g.values,
        maps=g.maps,
        turn=g.turn.contiguous(),
        lamps=g.lamps.contiguous(),
        powers=g.powers.contiguous(),
        seen=g.seen,
        place=g.place,
        line=g.position.new_empty(n, 3),
        out=out,
        n=n,
        points=len(out),
        sources=len(g.lamps),
        distant=g.eye.ndim == 2,
        lobes=g.table.shape[1],
        map=side(g.maps.shape[1]),
        levels=len(g.maps),
    )
    return out


_shine = operator(
    "shine(Tensor position, Tensor frame, Tensor place, Tensor eye, Tensor seen, Tensor table, int turns, "
    "Tensor values, Tensor maps, Tensor turn, Tensor lamps, Tensor powers) -> Tensor",
    plain=_plain,
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda position, frame, place, *others: position.new_empty(len(place), 3),
)

# What arrives of lamps


@inlined
def irradiance(points: SurfaceBlocks, seen: Tensor, lamps: Tensor, powers: Tensor) -> Tensor:
    """E (v, c), as `ptt.ops.gloss.irradiance`."""
    result: Tensor = _irradiance(points.frame, points.place, seen, lamps, powers)
    return result


def _irradiance_plain(frame: Tensor, place: Tensor, seen: Tensor, lamps: Tensor, powers: Tensor) -> Tensor:
    return plain.irradiance(_points(frame[0], frame, place), seen, lamps, powers)


def _irradiance_kernel(frame: Tensor, place: Tensor, seen: Tensor, lamps: Tensor, powers: Tensor) -> Tensor:
    n = frame.shape[2]
    out = frame.new_empty(len(place), 3)
    run(
        "irradiance",
        frame=frame,
        lamps=lamps.contiguous(),
        powers=powers.contiguous(),
        seen=seen,
        place=place,
        line=frame.new_empty(n, 3),
        out=out,
        n=n,
        points=len(out),
        sources=len(lamps),
    )
    return out


_irradiance = operator(
    "irradiance(Tensor frame, Tensor place, Tensor seen, Tensor lamps, Tensor powers) -> Tensor",
    plain=_irradiance_plain,
    kernel=_irradiance_kernel,
    conditions=_of_lamps,
    fake=lambda frame, place, *others: frame.new_empty(len(place), 3),
)

# Cells of f cos


@inlined
def cell_sums(mirrored: Tensor, reflected: Tensor, n: int) -> Tensor:
    """Moments and sums (turns * tilts, n, 6), as `ptt.ops.gloss.cell_sums`."""
    result: Tensor = _cell_sums(mirrored, reflected, n)
    return result


def _cell_conditions(mirrored: Tensor, reflected: Tensor, n: int) -> Conditions:
    yield of_type(torch.float32, mirrored, reflected), "directions and what is reflected must be float32"
    yield mirrored.ndim == 3 and mirrored.shape[1] == 3, "directions must be (tilts, 3, nodes)"
    yield reflected.shape[1:] == (mirrored.shape[2], 3), "what is reflected must be (turns * tilts, nodes, 3)"
    yield len(reflected) % len(mirrored) == 0, "there must be as many tilts of each turn"


def _cell_kernel(mirrored: Tensor, reflected: Tensor, n: int) -> Tensor:
    tilts, _, m = mirrored.shape
    whole, mass = plain.whole_numbers(mirrored, reflected)
    centres = torch.stack([plain.first_centres(whole, some, n) for some in mass.split(tilts)])
    out = _cell_fake(mirrored, reflected, n)
    run(
        "cell_sums",
        mirrored=mirrored.contiguous(),
        whole=whole.contiguous(),
        mass=mass.contiguous(),
        reflected=reflected.contiguous(),
        centres=centres.contiguous(),
        out=out,
        turns=len(centres),
        tilts=tilts,
        nodes=m,
        cells=n,
        first=plain.FIRST,
        rounds=plain.ROUNDS,
        steps=plain.STEPS,
    )
    return out


def _cell_fake(mirrored: Tensor, reflected: Tensor, n: int) -> Tensor:
    return reflected.new_empty(len(reflected), n, 3 + reflected.shape[2])


_cell_sums = operator(
    "cell_sums(Tensor mirrored, Tensor reflected, int n) -> Tensor",
    plain=lambda *arguments: plain.cell_sums(*arguments),
    kernel=_cell_kernel,
    conditions=_cell_conditions,
    fake=_cell_fake,
)
