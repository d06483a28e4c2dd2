"""The relighting equation (Sun et al. 2007, equation 3), in the order of what changes:

    light   U0[c, e, i]    = sum over l of  L[c, l] T0[l, e, i]
            U1[c, q, e, s] = sum over l of  L[c, l] T1[l, q, e, s]           U2[c, qq', e] alike
    BRDF    A[c, e, s]     = sum over q of  H[q, c] U1[c, q, e, s]  +  [s = 0] sum of  H[q, c] H[q', c] U2[c, qq', e]
            Q[c, e, o]     = sum over i of  M[c, o, i] (U0[c, e, i] + sum over s of  C[s, i] A[c, e, s])
            I[c, e, s]     = A in orthonormal harmonics, which lobes reflect
    view    B[v, c]        = sum over o of  V[o, v] Q[c, o, v]               and the lobes (`ops.view`)

of every eigen-point e of every cluster k; points v are combinations of them. M is the BRDF tensor's core contracted
with a material's coordinates and weights, V its outgoing factors in each point's view direction; factor 0 of i and of o
is the diffuse part: M couples it to itself alone, and V[0] = 1. H and C: `models.slots` and `models.indirect`.
Points are innermost everywhere and the small axes stay outside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import haar
from ptt.ops.compiling import inlined
from ptt.ops.octahedral import corners, mix, octahedral
from ptt.ops.sparse import product


class OutgoingLight(NamedTuple):
    """What points in blocks send out: values (b, c, x, w) times the unit (b, c, x) of each row.

    Values of 16 bits have a row more, the last: what rounding took from the first, the diffuse one, which is the most
    of what is seen (on the engine rounding erred by 9e-6 without that row, and errs by 1e-6).
    """

    values: Tensor
    unit: Tensor

    def whole(self) -> OutgoingLight:
        """The same in floats, without the row more."""
        if self.values.is_floating_point():
            return self
        values = self.values * self.unit[..., None]
        first = values[:, :, :1] + values[:, :, -1:]
        return OutgoingLight(torch.cat((first, values[:, :, 1:-1]), 2), torch.ones_like(self.unit[:, :, :-1]))


def light_step(transfer: Tensor, lighting: Tensor, factors: int) -> Tensor:
    """U (c, i, v) from T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v), i < factors, and lighting (l, c)."""
    incident = product(transfer, lighting)
    return incident.T.reshape(lighting.shape[1], factors, -1)


def brdf_step(matrices: Tensor, incident: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Q (c, o, v) from M (c, r, o, i) and U (c, i, v); region r holds the points spans[r] = (first, end)."""
    parts = [matrices[:, r] @ incident[:, :, a:b] for r, (a, b) in enumerate(spans)]
    return torch.cat(parts, dim=2)


def lighting(fine: Tensor, turn: Tensor, directions: Tensor, shares: Tensor, shape: Sequence[int]) -> Tensor:
    """L (3, *shape), Haar coefficients of a map's means over the cells of a grid of that shape (..., n, n).

    fine (cells, 3 or 4): colours of an octahedral map; directions (4, 3, cells), shares (4, cells): of four samples
    turn (3, 3): of the light, world = turn @ map. Against `Environment.project`: exact for a constant; one bright texel
    keeps its energy to 1 or 2 %, and is blurred by about its own width.
    """
    index, weights = corners(
        octahedral(directions.transpose(1, 2) @ turn), math.isqrt(len(fine)), wrap=True
    )  # shape: (4, cells, 4)
    weights = weights * shares[..., None]
    texels = mix(fine, *(x.transpose(0, 1).flatten(1) for x in (index, weights)))[:, :3]
    return haar.analyse(texels.T.reshape(3, *shape))


def light_eigen(transfer: Tensor, lighting: Tensor, columns: Tensor | None = None) -> Tensor:
    """U (k, c, x) from T (k, l, x) of eigen-points and lighting (k, c, l) or (c, l), in the type of the lighting.

    columns (k, l): which of the lighting (c, ..) those l are, one choice a cluster
    T is stored in as few bits as one likes; products and sums are the lighting's, whatever the processor is fast at.
    """
    if columns is not None:
        lighting = lighting.index_select(1, columns.flatten()).unflatten(1, columns.shape).transpose(0, 1)
    return torch.matmul(lighting, transfer.to(lighting.dtype))


@inlined
def light_eigens(
    transfers: Sequence[Tensor], lightings: Sequence[Tensor], columns: Sequence[Tensor | None]
) -> list[Tensor]:
    """`light_eigen` of each."""
    return [light_eigen(*each) for each in zip(transfers, lightings, columns, strict=True)]


class ArrivingLight(NamedTuple):
    """At the eigen-points of a region under one light: U0 (k, c, e, 1 + i), U1 (k, c, q, e, s), U2 (k, c, pairs, e)."""

    direct: Tensor
    one: Tensor
    two: Tensor


class Responses(NamedTuple):
    """What arriving harmonics become: C (s, 1 + i) to incident factors, and (s, s) to orthonormal harmonics."""

    to_factors: Tensor
    to_harmonics: Tensor


def eigen(
    arriving: ArrivingLight, h: Tensor, pairs: Tensor, coupling: Tensor, responses: Responses, glossy: bool
) -> Tensor:
    """Q, and then I if glossy, (k, c, e, 1 + o + s), of eigen-points; s = 0 where no light is reflected to them.

    h (q, c): H of the slots that U1 is for; pairs (pairs, c): their products for U2; coupling (c, 1 + o, 1 + i): M
    """
    direct, one, two = arriving
    if not one.shape[2] and not two.shape[2]:
        return direct @ coupling.transpose(1, 2)
    light = (h.T[:, None] @ one.flatten(3)).unflatten(3, one.shape[3:])[:, :, 0]
    if two.shape[2]:
        again = (pairs.T[:, None] @ two)[:, :, 0]
        light = torch.cat((light[..., :1] + again[..., None], light[..., 1:]), -1)
    sent = (direct + light @ responses.to_factors) @ coupling.transpose(1, 2)
    return torch.cat((sent, light @ responses.to_harmonics), 3) if glossy else sent


def expand(eigen: Tensor, weights: Tensor, cluster: Tensor) -> OutgoingLight:
    """Values (b, c, x, w) of points from those of eigen-points (k, c, e, x), weights (b, e, w) and cluster (b,)."""
    rows = eigen.transpose(2, 3).flatten(1, 2).index_select(0, cluster)  # shape: (b, c * x, e)
    values = (rows @ weights).unflatten(1, (eigen.shape[1], eigen.shape[3]))
    return OutgoingLight(values, values.new_ones(values.shape[:3]))


def exitant(
    arriving: ArrivingLight,
    h: Tensor,
    pairs: Tensor,
    coupling: Tensor,
    weights: Tensor,
    cluster: Tensor,
    glossy: bool,
    responses: Responses,
) -> OutgoingLight:
    """Q, and then I if glossy, of points in blocks: `eigen` of the eigen-points, and `expand` of it."""
    return expand(eigen(arriving, h, pairs, coupling, responses, glossy), weights, cluster)


class LitRegion(NamedTuple):
    """A region's points under one light with one material, as `exitant` takes them."""

    arriving: ArrivingLight
    h: Tensor
    pairs: Tensor
    coupling: Tensor
    weights: Tensor
    cluster: Tensor
    glossy: bool


@inlined
def exitants(regions: Sequence[LitRegion], responses: Responses) -> list[OutgoingLight]:
    """`exitant` of each."""
    return [exitant(*region, responses) for region in regions]


def view_step(outgoing: Tensor, sent: Tensor) -> Tensor:
    """B (v, c) from V (o, v) and Q (c, o, v)."""
    return (outgoing * sent).sum(1).T.contiguous()
