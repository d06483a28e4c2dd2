"""The light step and the BRDF step as operators; their plain functions are those of `ptt.ops.relight`.

The kernels are for float32 with three channels; what points send out is rounded to 16 bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ptt.ops import relight
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, GROUP, HARMONICS, WIDTH
from ptt.ops.native.arguments import STORED, contiguous, of_type, side, square
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator, refusal
from ptt.ops.relight import ArrivingLight, LitRegion, OutgoingLight, Responses

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
def light_eigens(
    transfers: Sequence[Tensor], lightings: Sequence[Tensor], columns: Sequence[Tensor | None]
) -> list[Tensor]:
    """U (k, c, x) of each, as `ptt.ops.relight.light_eigens`; the kernel sums in float32."""
    result: list[Tensor] = _light_eigens(list(transfers), list(lightings), list(columns))
    return result


def _light_eigen_conditions(
    transfers: Sequence[Tensor], lightings: Sequence[Tensor], columns: Sequence[Tensor | None]
) -> Conditions:
    for transfer, lighting, chosen in zip(transfers, lightings, columns, strict=True):
        yield transfer.dtype in TRANSFER, "transfer must be float32, float16 or bfloat16"
        yield contiguous(transfer), "transfer must be contiguous"
        yield of_type(torch.float32, lighting), "lighting must be float32"
        k, rows, _ = transfer.shape
        if chosen is None:
            yield lighting.shape in ((3, rows), (k, 3, rows)), "lighting must be (3, l) or (k, 3, l)"
        else:
            yield of_type(torch.int64, chosen) and chosen.shape == (k, rows), "columns must be (k, l), int64"
            yield lighting.ndim == 2 and len(lighting) == 3, "lighting must be (3, all l)"


def _light_eigen_kernel(
    transfers: Sequence[Tensor], lightings: Sequence[Tensor], columns: Sequence[Tensor | None]
) -> list[Tensor]:
    found = _light_eigen_fake(transfers, lightings, columns)
    for transfer, lighting, chosen, out in zip(transfers, lightings, columns, found, strict=True):
        k, rows, x = transfer.shape
        run(
            "light_eigen",
            lighting=lighting.contiguous(),
            columns=None if chosen is None else chosen.contiguous(),
            transfer=transfer,
            out=out,
            cluster=0 if lighting.ndim == 2 else 3 * rows,
            channel=lighting.shape[-1],
            rows=rows,
            width=x,
            clusters=k,
            type=STORED[transfer.dtype],
        )
    return found


def _light_eigen_fake(
    transfers: Sequence[Tensor], lightings: Sequence[Tensor], columns: Sequence[Tensor | None]
) -> list[Tensor]:
    return [
        lighting.new_empty(len(transfer), lighting.shape[-2], transfer.shape[2])
        for transfer, lighting in zip(transfers, lightings, strict=True)
    ]


_light_eigens = operator(
    "light_eigens(Tensor[] transfers, Tensor[] lightings, Tensor?[] columns) -> Tensor[]",
    plain=lambda *arguments: relight.light_eigens(*arguments),
    kernel=_light_eigen_kernel,
    conditions=_light_eigen_conditions,
    fake=_light_eigen_fake,
    calls="light_eigen",
)

# What points send out


@inlined
def exitants(regions: Sequence[LitRegion], responses: Responses) -> list[OutgoingLight]:
    """Values of each as `ptt.ops.relight.exitants`; those of the kernel are int16, in smaller blocks, with a row more.

    It is fastest where blocks of a cluster follow each other.
    """
    columns: tuple[list[Any], ...] = tuple([] for _ in range(len(COLUMNS)))
    for (direct, one, two), *others in regions:
        for column, value in zip(columns, (direct, one, two, *others), strict=True):
            column.append(value)
    values, units = _exitants(*columns, *responses)
    return [OutgoingLight(*each) for each in zip(values, units, strict=True)]


COLUMNS = (*ArrivingLight._fields, *LitRegion._fields[1:])


def _lit(*columns: Sequence[Any]) -> list[LitRegion]:
    """The regions whose members are given column by column, in the order of the schema."""
    return [LitRegion(ArrivingLight(*row[:3]), *row[3:]) for row in zip(*columns, strict=True)]


def _row(region: LitRegion, responses: Responses) -> int:
    """The length of what a point sends out: 1 + o, and the harmonics where they are asked for and there are any."""
    lit = region.glossy and (region.arriving.one.shape[2] > 0 or region.arriving.two.shape[2] > 0)
    return region.coupling.shape[1] + responses.to_harmonics.shape[0] * lit


def _exitant_plain(*arguments: Any) -> tuple[list[Tensor], list[Tensor]]:
    *columns, to_factors, to_harmonics = arguments
    sent = relight.exitants(_lit(*columns), Responses(to_factors, to_harmonics))
    return [values for values, _ in sent], [unit for _, unit in sent]


def _exitant_conditions(*arguments: Any) -> Conditions:
    *columns, to_factors, to_harmonics = arguments
    yield of_type(torch.float32, to_factors, to_harmonics), "responses must be float32"
    yield to_harmonics.shape == (HARMONICS, HARMONICS), f"to_harmonics must be ({HARMONICS}, {HARMONICS})"
    for (direct, one, two), h, pairs, coupling, weights, cluster, _ in _lit(*columns):
        k, c, e, i = direct.shape
        q = one.shape[2]
        p = two.shape[2]
        yield of_type(torch.float32, direct, one, two, h, pairs, coupling, weights), "everything must be float32"
        yield contiguous(weights), "weights must be contiguous"
        yield c == 3, "there must be three channels"
        yield h.shape == (q, 3), "h must be (q, 3)"
        yield pairs.shape == (p, 3), "pairs must be (pairs, 3)"
        yield one.shape == (k, 3, q, e, HARMONICS), f"U1 must be (k, 3, q, e, {HARMONICS})"
        yield two.shape == (k, 3, p, e), "U2 must be (k, 3, p, e)"
        yield coupling.ndim == 3 and coupling.shape[::2] == (3, i), "coupling must be (3, 1 + o, 1 + i)"
        yield to_factors.shape == (HARMONICS, i), f"to_factors must be ({HARMONICS}, 1 + i)"
        yield weights.ndim == 3 and weights.shape[1] == e, "weights must be (b, e, w)"
        yield weights.shape[2] % WIDTH == 0, f"blocks must hold a multiple of {WIDTH} points"
        yield of_type(torch.int64, cluster) and cluster.shape == weights.shape[:1], "cluster must be (b,), int64"


def _exitant_kernel(*arguments: Any) -> tuple[list[Tensor], list[Tensor]]:
    *columns, to_factors, to_harmonics = arguments
    to_factors = to_factors.contiguous()
    to_harmonics = to_harmonics.contiguous()
    found = []
    for region in _lit(*columns):
        (direct, one, two), h, pairs, coupling, weights, cluster, _ = region
        row = _row(region, Responses(to_factors, to_harmonics))
        values, unit = _in_groups(weights, row)
        run(
            "exitant",
            direct=direct.contiguous(),
            one=one.contiguous(),
            two=two.contiguous(),
            h=h.contiguous(),
            pairs=pairs.contiguous(),
            coupling=coupling.contiguous(),
            to_factors=to_factors,
            to_harmonics=to_harmonics,
            weights=weights,
            cluster=cluster.contiguous(),
            out=values,
            unit=unit,
            blocks=weights.shape[0],
            eigen=weights.shape[1],
            factors=direct.shape[3],
            slots=one.shape[2],
            again=two.shape[2],
            outgoing=coupling.shape[1],
            x=row,
            width=weights.shape[2],
        )
        found.append((values, unit))
    return [values for values, _ in found], [unit for _, unit in found]


def _in_groups(weights: Tensor, row: int) -> tuple[Tensor, Tensor]:
    groups = weights.shape[0] * weights.shape[2] // GROUP
    values = weights.new_empty(groups, 3, row + 1, GROUP, dtype=torch.int16)
    return values, weights.new_empty(values.shape[:3])


def _exitant_fake(*arguments: Any) -> tuple[list[Tensor], list[Tensor]]:
    *columns, to_factors, to_harmonics = arguments
    responses = Responses(to_factors, to_harmonics)
    by_kernel = to_factors.device.type == "cpu" and refusal(_exitant_conditions(*arguments), "exitant") is None
    found = []
    for region in _lit(*columns):
        row = _row(region, responses)
        if by_kernel:
            found.append(_in_groups(region.weights, row))
        else:
            rows = len(region.weights), region.arriving.direct.shape[1], row
            found.append((region.weights.new_empty(*rows, region.weights.shape[2]), region.weights.new_empty(rows)))
    return [values for values, _ in found], [unit for _, unit in found]


_exitants = operator(
    "exitants(Tensor[] direct, Tensor[] one, Tensor[] two, Tensor[] h, Tensor[] pairs, Tensor[] coupling, "
    "Tensor[] weights, Tensor[] cluster, bool[] glossy, Tensor to_factors, Tensor to_harmonics) "
    "-> (Tensor[], Tensor[])",
    plain=_exitant_plain,
    kernel=_exitant_kernel,
    conditions=_exitant_conditions,
    fake=_exitant_fake,
    calls="exitant",
)
