"""The light step and the BRDF step as operators; their plain functions are those of `ptt.ops.relight`.

The kernels are for float32 with three channels; what points send out is rounded to 16 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops import relight
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, GROUP, HARMONICS, WIDTH
from ptt.ops.native.arguments import STORED, contiguous, of_type, side, square
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator, refusal
from ptt.ops.relight import ArrivingLight, OutgoingLight, Responses

TRANSFER = (torch.float32, torch.float16, torch.bfloat16)
"""The types in which transfer is stored."""

# The map, turned, in Haar coefficients


@inlined
def lighting(fine: Tensor, turn: Tensor, directions: Tensor, shares: Tensor, shape: Sequence[int]) -> Tensor:
    """L (3, *shape), as `ptt.ops.relight.lighting`."""
    result: Tensor = _lighting(fine, turn, directions, shares, list(shape))
    return result


def _lighting_conditions(
    fine: Tensor, turn: Tensor, directions: Tensor, shares: Tensor, shape: Sequence[int]
) -> Conditions:
    cells = math.prod(shape)
    yield of_type(torch.float32, fine, turn, directions, shares), "the map and its samples must be float32"
    yield fine.ndim == 2 and fine.shape[1] == CHANNELS and square(len(fine)), "fine must be a square of four channels"
    yield cells % GROUP == 0, f"the grid must have a multiple of {GROUP} cells"
    yield turn.shape == (3, 3), "turn must be (3, 3)"
    yield directions.shape == (4, 3, cells), "directions must be (4, 3, cells)"
    yield shares.shape == (4, cells), "shares must be (4, cells)"


def _lighting_kernel(fine: Tensor, turn: Tensor, directions: Tensor, shares: Tensor, shape: Sequence[int]) -> Tensor:
    out = fine.new_empty(3, *shape)
    run(
        "lighting",
        fine=fine.contiguous(),
        turn=turn.contiguous(),
        directions=directions.contiguous(),
        shares=shares.contiguous(),
        out=out,
        side=side(len(fine)),
        squares=math.prod(shape[:-2]),
        n=shape[-1],
    )
    return out


_lighting = operator(
    "lighting(Tensor fine, Tensor turn, Tensor directions, Tensor shares, SymInt[] shape) -> Tensor",
    plain=lambda *arguments: relight.lighting(*arguments),
    kernel=_lighting_kernel,
    conditions=_lighting_conditions,
    fake=lambda fine, turn, directions, shares, shape: fine.new_empty(3, *shape),
)

# Transfer of eigen-points times light


@inlined
def light_eigen(transfer: Tensor, lighting: Tensor, columns: Tensor | None = None) -> Tensor:
    """U (k, c, x), as `ptt.ops.relight.light_eigen`; the kernel sums in float32."""
    result: Tensor = _light_eigen(transfer, lighting, columns)
    return result


def _light_eigen_conditions(transfer: Tensor, lighting: Tensor, columns: Tensor | None) -> Conditions:
    yield transfer.dtype in TRANSFER, "transfer must be float32, float16 or bfloat16"
    yield contiguous(transfer), "transfer must be contiguous"
    yield of_type(torch.float32, lighting), "lighting must be float32"
    k, rows, _ = transfer.shape
    if columns is None:
        yield lighting.shape in ((3, rows), (k, 3, rows)), "lighting must be (3, l) or (k, 3, l)"
    else:
        yield of_type(torch.int64, columns) and columns.shape == (k, rows), "columns must be (k, l), int64"
        yield lighting.ndim == 2 and len(lighting) == 3, "lighting must be (3, all l)"


def _light_eigen_kernel(transfer: Tensor, lighting: Tensor, columns: Tensor | None) -> Tensor:
    k, rows, x = transfer.shape
    out = lighting.new_empty(k, 3, x)
    run(
        "light_eigen",
        lighting=lighting.contiguous(),
        columns=None if columns is None else columns.contiguous(),
        transfer=transfer,
        out=out,
        cluster=0 if lighting.ndim == 2 else 3 * rows,
        channel=lighting.shape[-1],
        rows=rows,
        width=x,
        clusters=k,
        type=STORED[transfer.dtype],
    )
    return out


def _light_eigen_fake(transfer: Tensor, lighting: Tensor, columns: Tensor | None) -> Tensor:
    return lighting.new_empty(len(transfer), lighting.shape[-2], transfer.shape[2])


_light_eigen = operator(
    "light_eigen(Tensor transfer, Tensor lighting, Tensor? columns) -> Tensor",
    plain=lambda *arguments: relight.light_eigen(*arguments),
    kernel=_light_eigen_kernel,
    conditions=_light_eigen_conditions,
    fake=_light_eigen_fake,
)

# What points send out


@inlined
def exitant(
    arriving: ArrivingLight,
    h: Tensor,
    pairs: Tensor,
    coupling: Tensor,
    responses: Responses,
    weights: Tensor,
    cluster: Tensor,
    glossy: bool,
) -> OutgoingLight:
    """Values as `ptt.ops.relight.exitant`; those of the kernel are int16, in smaller blocks, with a row more.

    It is fastest where blocks of a cluster follow each other.
    """
    return OutgoingLight(*_exitant(*arriving, h, pairs, coupling, *responses, weights, cluster, glossy))


class _Exitant(NamedTuple):
    """What the schema says."""

    direct: Tensor
    one: Tensor
    two: Tensor
    h: Tensor
    pairs: Tensor
    coupling: Tensor
    to_factors: Tensor
    to_harmonics: Tensor
    weights: Tensor
    cluster: Tensor
    glossy: bool

    @property
    def row(self) -> int:
        """The length of what a point sends out: 1 + o, and the harmonics where they are asked for and there are any."""
        lit = self.glossy and (self.one.shape[2] > 0 or self.two.shape[2] > 0)
        return self.coupling.shape[1] + self.to_harmonics.shape[0] * lit


def _exitant_plain(*arguments: Any) -> OutgoingLight:
    g = _Exitant(*arguments)
    responses = Responses(g.to_factors, g.to_harmonics)
    arriving = ArrivingLight(g.direct, g.one, g.two)
    return relight.exitant(arriving, g.h, g.pairs, g.coupling, responses, g.weights, g.cluster, g.glossy)


def _exitant_conditions(*arguments: Any) -> Conditions:
    g = _Exitant(*arguments)
    k, c, e, i = g.direct.shape
    q = g.one.shape[2]
    p = g.two.shape[2]
    yield of_type(torch.float32, *g[:9]), "everything must be float32"
    yield contiguous(g.weights), "weights must be contiguous"
    yield c == 3, "there must be three channels"
    yield g.h.shape == (q, 3), "h must be (q, 3)"
    yield g.pairs.shape == (p, 3), "pairs must be (pairs, 3)"
    yield g.one.shape == (k, 3, q, e, HARMONICS), f"U1 must be (k, 3, q, e, {HARMONICS})"
    yield g.two.shape == (k, 3, p, e), "U2 must be (k, 3, p, e)"
    yield g.coupling.ndim == 3 and g.coupling.shape[::2] == (3, i), "coupling must be (3, 1 + o, 1 + i)"
    yield g.to_factors.shape == (HARMONICS, i), f"to_factors must be ({HARMONICS}, 1 + i)"
    yield g.to_harmonics.shape == (HARMONICS, HARMONICS), f"to_harmonics must be ({HARMONICS}, {HARMONICS})"
    yield g.weights.ndim == 3 and g.weights.shape[1] == e, "weights must be (b, e, w)"
    yield g.weights.shape[2] % WIDTH == 0, f"blocks must hold a multiple of {WIDTH} points"
    yield of_type(torch.int64, g.cluster) and g.cluster.shape == g.weights.shape[:1], "cluster must be (b,), int64"


def _exitant_kernel(*arguments: Any) -> tuple[Tensor, Tensor]:
    g = _Exitant(*arguments)
    values, unit = _in_groups(g)
    _, _, e, i = g.direct.shape
    b, _, width = g.weights.shape
    run(
        "exitant",
        direct=g.direct.contiguous(),
        one=g.one.contiguous(),
        two=g.two.contiguous(),
        h=g.h.contiguous(),
        pairs=g.pairs.contiguous(),
        coupling=g.coupling.contiguous(),
        to_factors=g.to_factors.contiguous(),
        to_harmonics=g.to_harmonics.contiguous(),
        weights=g.weights,
        cluster=g.cluster.contiguous(),
        out=values,
        unit=unit,
        blocks=b,
        eigen=e,
        factors=i,
        slots=g.one.shape[2],
        again=g.two.shape[2],
        outgoing=g.coupling.shape[1],
        x=g.row,
        width=width,
    )
    return values, unit


def _in_groups(g: _Exitant) -> tuple[Tensor, Tensor]:
    groups = g.weights.shape[0] * g.weights.shape[2] // GROUP
    values = g.direct.new_empty(groups, 3, g.row + 1, GROUP, dtype=torch.int16)
    return values, g.direct.new_empty(values.shape[:3])


def _exitant_fake(*arguments: Any) -> tuple[Tensor, Tensor]:
    g = _Exitant(*arguments)
    if g.direct.device.type == "cpu" and refusal(_exitant_conditions(*arguments), "exitant") is None:
        return _in_groups(g)
    rows = g.weights.shape[0], g.direct.shape[1], g.row
    return g.direct.new_empty(*rows, g.weights.shape[2]), g.direct.new_empty(rows)


_exitant = operator(
    "exitant(Tensor direct, Tensor one, Tensor two, Tensor h, Tensor pairs, Tensor coupling, Tensor to_factors, "
    "Tensor to_harmonics, Tensor weights, Tensor cluster, bool glossy) -> (Tensor, Tensor)",
    plain=_exitant_plain,
    kernel=_exitant_kernel,
    conditions=_exitant_conditions,
    fake=_exitant_fake,
)
