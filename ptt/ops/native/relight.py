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

# What eigen-points send out


@inlined
def eigen(
    arriving: ArrivingLight, h: Tensor, pairs: Tensor, coupling: Tensor, responses: Responses, glossy: bool
) -> Tensor:
    """Q and I (k, c, e, 1 + o + s), as `ptt.ops.relight.eigen`."""
    result: Tensor = _eigen(*arriving, h, pairs, coupling, *responses, glossy)
    return result


class _Eigen(NamedTuple):
    """What the schema says."""

    direct: Tensor
    one: Tensor
    two: Tensor
    h: Tensor
    pairs: Tensor
    coupling: Tensor
    to_factors: Tensor
    to_harmonics: Tensor
    glossy: bool


def _eigen_plain(*arguments: Any) -> Tensor:
    direct, one, two, h, pairs, coupling, to_factors, to_harmonics, glossy = arguments
    arriving = ArrivingLight(direct, one, two)
    responses = Responses(to_factors, to_harmonics)
    return relight.eigen(arriving, h, pairs, coupling, responses, glossy)


def _eigen_conditions(*arguments: Any) -> Conditions:
    g = _Eigen(*arguments)
    k, c, e, i = g.direct.shape
    q = g.one.shape[2]
    p = g.two.shape[2]
    yield of_type(torch.float32, *g[:-1]), "everything must be float32"
    yield c == 3, "there must be three channels"
    yield g.h.shape == (3, q), "h must be (3, q)"
    yield g.pairs.shape == (3, p), "pairs must be (3, p)"
    yield g.one.shape == (k, 3, q, e, HARMONICS), f"U1 must be (k, 3, q, e, {HARMONICS})"
    yield g.two.shape == (k, 3, p, e), "U2 must be (k, 3, p, e)"
    yield g.coupling.ndim == 3 and g.coupling.shape[::2] == (3, i), "coupling must be (3, 1 + o, 1 + i)"
    yield g.to_factors.shape == (HARMONICS, i), f"to_factors must be ({HARMONICS}, 1 + i)"
    yield g.to_harmonics.shape == (HARMONICS, HARMONICS), f"to_harmonics must be ({HARMONICS}, {HARMONICS})"


def _eigen_kernel(*arguments: Any) -> Tensor:
    g = _Eigen(*arguments)
    out = _eigen_fake(*arguments)
    k, _, e, i = g.direct.shape
    width = out.shape[3]
    padded = width + -width % GROUP
    factors = g.coupling.shape[1]
    from_direct = g.coupling.new_zeros(3, i, padded)
    from_direct[..., :factors] = g.coupling.transpose(1, 2)
    from_light = g.to_factors @ from_direct  # shape: (3, s, padded)
    if width > factors:
        from_light[..., factors:width] = g.to_harmonics
    run(
        "eigen",
        direct=g.direct.contiguous(),
        one=g.one.contiguous(),
        two=g.two.contiguous(),
        h=g.h.contiguous(),
        pairs=g.pairs.contiguous(),
        from_direct=from_direct,
        from_light=from_light,
        out=out,
        clusters=k,
        eigen=e,
        factors=i,
        slots=g.one.shape[2],
        again=g.two.shape[2],
        width=width,
        padded=padded,
    )
    return out


def _eigen_fake(*arguments: Any) -> Tensor:
    g = _Eigen(*arguments)
    k, c, e, _ = g.direct.shape
    lit = g.glossy and (g.one.shape[2] > 0 or g.two.shape[2] > 0)
    return g.direct.new_empty(k, c, e, g.coupling.shape[1] + len(g.to_harmonics) * lit)


_eigen = operator(
    "eigen(Tensor direct, Tensor one, Tensor two, Tensor h, Tensor pairs, Tensor coupling, Tensor to_factors, "
    "Tensor to_harmonics, bool glossy) -> Tensor",
    plain=_eigen_plain,
    kernel=_eigen_kernel,
    conditions=_eigen_conditions,
    fake=_eigen_fake,
)

# From eigen-points to points


@inlined
def expand(eigen: Tensor, weights: Tensor, cluster: Tensor) -> OutgoingLight:
    """Values as `ptt.ops.relight.expand`; those of the kernel are int16, in smaller blocks."""
    return OutgoingLight(*_expand(eigen, weights, cluster))


def _expand_conditions(eigen: Tensor, weights: Tensor, cluster: Tensor) -> Conditions:
    yield of_type(torch.float32, eigen, weights), "eigen and weights must be float32"
    yield contiguous(weights), "weights must be contiguous"
    yield weights.shape[1] == eigen.shape[2], "weights must be (b, e, w)"
    yield weights.shape[2] % WIDTH == 0, f"blocks must hold a multiple of {WIDTH} points"
    yield of_type(torch.int64, cluster) and cluster.shape == weights.shape[:1], "cluster must be (b,), int64"


def _expand_kernel(eigen: Tensor, weights: Tensor, cluster: Tensor) -> tuple[Tensor, Tensor]:
    values, unit = _in_groups(eigen, weights)
    b, e, w = weights.shape
    run(
        "expand",
        eigen=eigen.contiguous(),
        weights=weights,
        cluster=cluster.contiguous(),
        out=values,
        unit=unit,
        blocks=b,
        channels=eigen.shape[1],
        factors=e,
        x=eigen.shape[3],
        width=w,
    )
    return values, unit


def _in_groups(eigen: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    groups = len(weights) * weights.shape[2] // GROUP
    values = eigen.new_empty(groups, eigen.shape[1], eigen.shape[3], GROUP, dtype=torch.int16)
    return values, eigen.new_empty(values.shape[:3])


def _expand_fake(eigen: Tensor, weights: Tensor, cluster: Tensor) -> tuple[Tensor, Tensor]:
    if eigen.device.type == "cpu" and refusal(_expand_conditions(eigen, weights, cluster), "expand") is None:
        return _in_groups(eigen, weights)
    rows = len(weights), eigen.shape[1], eigen.shape[3]
    return eigen.new_empty(*rows, weights.shape[2]), eigen.new_empty(rows)


_expand = operator(
    "expand(Tensor eigen, Tensor weights, Tensor cluster) -> (Tensor, Tensor)",
    plain=lambda *arguments: relight.expand(*arguments),
    kernel=_expand_kernel,
    conditions=_expand_conditions,
    fake=_expand_fake,
)
