"""Glossy reflection of direct light as an operator; its plain function is `ptt.ops.gloss.shine`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops import gloss as plain
from ptt.ops.compiling import inlined
from ptt.ops.constants import BITS, CHANNELS, GROUP, MOST_CELLS, RINGS, SECTORS, TILE, TILTS
from ptt.ops.gloss import Gloss, GlossLight, Lobes
from ptt.ops.native.arguments import contiguous, of_type, side, square
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.view import SurfaceBlocks


@inlined
def shine(points: SurfaceBlocks, eye: Tensor, bits: Tensor, gloss: Gloss, light: GlossLight) -> Tensor:
    """B (v, c), as `ptt.ops.gloss.shine`."""
    position, frame, _, cuts, place = points
    table, turns = gloss.lobes
    result: Tensor = _shine(position, frame, cuts, place, eye, bits, table, turns, gloss.values, *light)
    return result


class _Shine(NamedTuple):
    """The arguments in the order of the schema."""

    position: Tensor
    frame: Tensor
    cuts: Tensor
    place: Tensor
    eye: Tensor
    bits: Tensor
    table: Tensor
    turns: int
    values: Tensor
    maps: Tensor
    turn: Tensor
    lamps: Tensor
    powers: Tensor


def _plain(*arguments: Any) -> Tensor:
    g = _Shine(*arguments)
    points = SurfaceBlocks(g.position, g.frame, None, g.cuts, g.place)
    light = GlossLight(g.maps, g.turn, g.lamps, g.powers)
    return plain.shine(points, g.eye, g.bits, Gloss(Lobes(g.table, g.turns), g.values), light)


def _conditions(*arguments: Any) -> Conditions:
    g = _Shine(*arguments)
    n = g.position.shape[1]
    lobes = g.table.shape[1]
    reals = (g.position, g.frame, g.eye, g.table, g.values, g.maps, g.turn, g.lamps, g.powers)
    yield of_type(torch.float32, *reals), "points, tables and light must be float32"
    yield of_type(torch.int32, g.cuts, g.bits), "cuts and bits must be int32"
    yield of_type(torch.int64, g.place), "place must be int64"
    large = (g.position, g.frame, g.cuts, g.place, g.bits, g.table, g.values, g.maps)
    yield contiguous(*large), "points, tables and maps must be contiguous"
    yield g.turns == 1, "f must be isotropic"
    yield n % GROUP == 0, f"points must come in multiples of {GROUP}"
    yield g.position.shape == (3, n), "position must be (3, n)"
    yield g.frame.shape == (3, 3, n), "frame must be (3, 3, n)"
    yield g.eye.shape in ((3,), (3, n)), "eye must be (3,) or (3, n)"
    yield g.cuts.ndim == 2 and len(g.cuts) == n, "cuts must be (n, cells)"
    yield square(g.cuts.shape[1]) and side(g.cuts.shape[1]) % TILE == 0, "cuts must be a square of whole tiles"
    yield g.bits.shape == (n, BITS * BITS // 32), f"bits must be (n, {BITS * BITS // 32})"
    yield g.table.shape == (TILTS, lobes, 7), f"the table of lobes must be ({TILTS}, lobes, 7)"
    yield 0 < lobes <= MOST_CELLS, f"there must be 1..{MOST_CELLS} lobes"
    yield g.values.shape == (TILTS, RINGS, SECTORS, 3), f"values must be ({TILTS}, {RINGS}, {SECTORS}, 3)"
    yield g.maps.ndim == 3 and len(g.maps) > 1 and g.maps.shape[2] == CHANNELS, "maps must be (levels, cells, 4)"
    yield g.maps.shape[1] > 1 and square(g.maps.shape[1]), "maps must be square"
    yield g.turn.shape == (3, 3), "turn must be (3, 3)"
    yield g.lamps.shape == g.powers.shape == (len(g.lamps), 3), "lamps and powers must be (m, 3)"


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
        cuts=g.cuts,
        bits=g.bits,
        place=g.place,
        line=g.position.new_empty(n, 3),
        out=out,
        n=n,
        points=len(out),
        sources=len(g.lamps),
        distant=g.eye.ndim == 2,
        lobes=g.table.shape[1],
        cells=side(g.cuts.shape[1]),
        map=side(g.maps.shape[1]),
        levels=len(g.maps),
    )
    return out


_shine = operator(
    "shine(Tensor position, Tensor frame, Tensor cuts, Tensor place, Tensor eye, Tensor bits, Tensor table, int turns, "
    "Tensor values, Tensor maps, Tensor turn, Tensor lamps, Tensor powers) -> Tensor",
    plain=_plain,
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda position, frame, cuts, place, *others: position.new_empty(len(place), 3),
)
