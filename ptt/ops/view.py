"""The view step: what points in blocks send to the eye, by outgoing factors and by lobes (Sun 2007, sections 3.3, 4.1).

    B[v, c] = sum over o of  V[o, wo] Q[c, o, v]
            + specular[c] sum over k of  rho_k(wo) E_k[c, a_k] cut_k[v, a_k]
            + specular[c] sum over k, s of  rho_k(wo) z_k[s] Y_s(a) I[c, s, v]

V: outgoing factors, V[0] = 1 for the diffuse part; rho_k: reflectance of lobe k, a_k(wo) its axis; E_k: the map blurred
by it; cut_k: its fractional visibility; I: the light of one and two bounces in harmonics, which z_k blurs, about the
mean a of the axes. A point that faces away sends what its mirror image above the horizon does, so that silhouettes
interpolate well.

Points are innermost, in blocks of w; n = b * w of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import harmonics, lobes
from ptt.ops.directions import toward
from ptt.ops.octahedral import corners, hemi_octahedral, mix, octahedral, tiles
from ptt.ops.relight import OutgoingLight

BYTE = 255.0


class SurfaceBlocks(NamedTuple):
    """The points of a region, in blocks.

    position (3, n); frame (3, 3, n): rows tangent, bitangent, normal; colour (3, n) of the surface, None for white
    cuts (n, cells) int32: cut_k, a byte each, cells in `tiles`
    place (v,) int64: where each point of the region lies among the n
    """

    position: Tensor
    frame: Tensor
    colour: Tensor | None
    cuts: Tensor
    place: Tensor


class LitLobes(NamedTuple):
    """The lobes of a region's material, k of them.

    which (k,) int64: of the bytes of the cuts; rho (turns * tilts, k); axes (tilts, 2 k): along, then up (`lobes.lean`)
    specular (c,)
    maps (k, cells, 4): E_k on a `bordered` octahedral map, three channels and a zero; turn (3, 3): of the light,
        world = turn @ map
    blurs (k, s): z_k
    """

    which: Tensor
    rho: Tensor
    axes: Tensor
    specular: Tensor
    maps: Tensor
    turn: Tensor
    blurs: Tensor


class ViewedRegion(NamedTuple):
    """What is seen of a region.

    points; eye (3,), or unit directions (3, n) to it
    sent: values (b, c, 1 + o + s, w), Q, then I; s = 0 where no lobe is lit by it
    lobes: None for a material without lobes
    """

    points: SurfaceBlocks
    eye: Tensor
    sent: OutgoingLight
    lobes: LitLobes | None


def view(regions: Sequence[ViewedRegion], outgoing: Tensor) -> Tensor:
    """B (v, c) of the points of all regions; outgoing (cells, o): V without the diffuse factor, on the disk grid."""
    return torch.cat([_radiance(*region, outgoing) for region in regions])


def _radiance(
    points: SurfaceBlocks, eye: Tensor, sent: OutgoingLight, gloss: LitLobes | None, outgoing: Tensor
) -> Tensor:
    wo = _toward(points, eye)
    values = sent.values.to(outgoing.dtype)
    o = 1 + outgoing.shape[1]
    factors = wo.new_zeros(wo.shape[1], 0)
    if o > 1:
        factors = mix(outgoing, *corners(wo.T[:, :2], _side(outgoing), wrap=False))
    diffuse = values[:, :, 0]
    if points.colour is not None:
        diffuse = diffuse * _blocks(points.colour, values)
    unit = sent.unit[:, None, None]
    out = unit * (diffuse + _products(_blocks(factors.T, values), values[:, :, 1:o]))
    if gloss is not None:
        tilts = len(gloss.axes)
        rho = mix(gloss.rho, *lobes.corners(wo.T, len(gloss.rho) // tilts, tilts))  # shape: (n, k)
        axes = lobes.lean(gloss.axes.T.unflatten(0, (2, -1)), wo.T)  # shape: (n, k, 3)
        seen = rho * _through(points.cuts, axes, gloss.which)
        to_light = torch.einsum("rcn,cd->nrd", points.frame, gloss.turn)  # from local axes to those of the map
        light = light_about(gloss.maps, axes @ to_light)
        lit = _blocks(_sums(seen, light).T, values)
        if values.shape[2] > o:
            axis = torch.nn.functional.normalize(_sums(rho, axes), dim=1)
            response = (rho @ gloss.blurs) * harmonics.evaluate(axis, round(gloss.blurs.shape[1] ** 0.5))
            lit = lit + unit * _products(_blocks(response.T, values), values[:, :, o:])
        out = out + lit * gloss.specular[:, None]
    return out.transpose(1, 2).flatten(0, 1).index_select(0, points.place)


def _toward(points: SurfaceBlocks, eye: Tensor) -> Tensor:
    """Local directions (3, n) to the eye."""
    local = (points.frame * toward(eye, points.position, 0)).sum(1)
    here = (local == 0).all(0)  # an eye in a point looks along its normal
    return torch.cat((local[:2], (local[2] + here.to(local))[None]))


def light_about(maps: Tensor, axes: Tensor) -> Tensor:
    """E_k (n, k, 3) about axes (n, k, 3) on maps (k, cells, 4)."""
    k, cells, _ = maps.shape
    n = math.isqrt(cells)
    first = cells * torch.arange(k, device=axes.device)
    index, weights = corners(octahedral(axes) * ((n - 2) / n), n, wrap=False, first=first)  # shape: (n, k, 4)
    return mix(maps.flatten(0, 1), index.flatten(0, 1), weights.flatten(0, 1))[:, :3].reshape(axes.shape)


def _through(cuts: Tensor, axes: Tensor, which: Tensor) -> Tensor:
    """Fractional visibility (n, k) about local axes (n, k, 3)."""
    n = _side(cuts.T)
    first = n * n * torch.arange(len(which), device=which.device)
    index, weights = corners(hemi_octahedral(axes), n, wrap=False, first=first)  # shape: (n, k, 4)
    bytes_ = 4 * tiles(n).to(which) + which[:, None]  # of every lobe's cells
    seen = cuts.view(torch.uint8).gather(1, bytes_.flatten()[index].flatten(1)).view_as(index)
    through: Tensor = torch.linalg.vecdot(seen.to(weights), weights).div(BYTE)
    return through


def _sums(weights: Tensor, values: Tensor) -> Tensor:
    """The sum over k (n, x) of weights (n, k) times values (n, k, x)."""
    return _products(weights[:, :, None], values[:, None])[:, 0]


def _products(factors: Tensor, values: Tensor) -> Tensor:
    """The sum over x (b, c, w) of factors (b, x, w) times values (b, c, x, w), one x after the other: no product of all
    is ever in memory."""
    if not factors.shape[1]:
        return values.sum(2)
    total = factors[:, None, 0] * values[:, :, 0]
    for x in range(1, factors.shape[1]):
        total = torch.addcmul(total, factors[:, None, x], values[:, :, x])
    return total


def _blocks(values: Tensor, like: Tensor) -> Tensor:
    """Values (x, n) as (b, x, w)."""
    blocks: Tensor = values.unflatten(1, (len(like), like.shape[-1])).transpose(0, 1)
    return blocks


def _side(table: Tensor) -> int:
    return math.isqrt(len(table))
