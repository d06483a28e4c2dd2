"""The view step: what points in blocks send to the eye, by outgoing factors and by lobes (Sun 2007, sections 3.3, 4.1).

    B[v, c] = sum over o of  V[o, wo] Q[c, o, v]
            + specular[c] sum over k of  rho_k(wo) E_k[c, mirror] cut_k[v, mirror]
            + specular[c] sum over k, s of  rho_k(wo) z_k[s] Y_s(mirror) I[c, s, v]

V: outgoing factors, V[0] = 1 for the diffuse part; rho_k: reflectance of lobe k; E_k: the map blurred by it; cut_k: its
fractional visibility; I: the light of one and two bounces in harmonics, which z_k blurs. A point that faces away sends
what its mirror image above the horizon does, so that silhouettes interpolate well.

Points are innermost, in blocks of w; n = b * w of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import harmonics, lobes
from ptt.ops.octahedral import corners, hemi_octahedral, mix, octahedral, tiles
from ptt.ops.relight import Sent

BYTE = 255.0
NEAR = 1e-12  # an eye in a point looks along its normal


class Points(NamedTuple):
    """Of a region, in blocks.

    position (3, n); frame (3, 3, n): rows tangent, bitangent, normal; colour (3, n) of the surface, None for white
    cuts (n, cells) int32: cut_k, a byte each, cells in `tiles`
    place (v,) int64: where each point of the region lies among the n
    """

    position: Tensor
    frame: Tensor
    colour: Tensor | None
    cuts: Tensor
    place: Tensor


class Gloss(NamedTuple):
    """The lobes of a region's material, k of them.

    which (k,) int64: of the bytes of the cuts; rho (turns * tilts, k), tilts: of the table; specular (c,)
    maps (cells, k * c): E_k on an octahedral map; turn (3, 3): of the light, world = turn @ map
    blurs (k, s): z_k
    """

    which: Tensor
    rho: Tensor
    tilts: int
    specular: Tensor
    maps: Tensor
    turn: Tensor
    blurs: Tensor


def view(points: Points, eye: Tensor, outgoing: Tensor, sent: Sent, gloss: Gloss | None) -> Tensor:
    """B (v, c).

    eye (3,), or unit directions (3, n) to it
    outgoing (cells, o): V without the diffuse factor, on the disk grid
    sent: values (b, c, 1 + o + s, w), Q, then I; s = 0 where no lobe is lit by it
    """
    wo, axis = directions(points, eye)
    values, o = sent.values.to(outgoing.dtype), 1 + outgoing.shape[1]
    factors = mix(outgoing, *corners(wo.T[:, :2], _side(outgoing), wrap=False))
    diffuse = values[:, :, 0]
    if points.colour is not None:
        diffuse = diffuse * _blocks(points.colour, values)
    unit = sent.unit[:, None, None]
    out = unit * (diffuse + (_blocks(factors.T, values)[:, None] * values[:, :, 1:o]).sum(2))
    if gloss is not None:
        mirror = torch.stack((-wo[0], -wo[1], wo[2].abs()), 1)
        rho = mix(gloss.rho, *lobes.corners(wo.T, len(gloss.rho) // gloss.tilts, gloss.tilts))  # shape: (n, k)
        light = mix(gloss.maps, *corners(octahedral(axis.T @ gloss.turn), _side(gloss.maps), wrap=True))
        seen = rho * _through(points.cuts, mirror, gloss.which)
        lit = _blocks((seen[..., None] * light.unflatten(1, (-1, 3))).sum(1).T, values)
        if values.shape[2] > o:
            response = (rho @ gloss.blurs) * harmonics.evaluate(mirror, round(gloss.blurs.shape[1] ** 0.5))
            lit = lit + unit * (_blocks(response.T, values)[:, None] * values[:, :, o:]).sum(2)
        out = out + lit * gloss.specular[:, None]
    return out.transpose(1, 2).flatten(0, 1).index_select(0, points.place)


def directions(points: Points, eye: Tensor) -> tuple[Tensor, Tensor]:
    """Local directions to the eye (3, n), and the mirror directions in the world (3, n)."""
    toward = eye
    if eye.ndim == 1:
        away = eye[:, None] - points.position + NEAR * points.frame[2]
        toward = away * away.square().sum(0).clamp(min=1e-30).rsqrt()
    wo = (points.frame * toward).sum(1)
    return wo, 2 * wo[2] * points.frame[2] - toward


def _through(cuts: Tensor, mirror: Tensor, which: Tensor) -> Tensor:
    """Fractional visibility (n, k) about mirror directions (n, 3)."""
    index, weights = corners(hemi_octahedral(mirror), _side(cuts.T), wrap=False)
    words = cuts.gather(1, tiles(_side(cuts.T)).to(index.device)[index])  # shape: (n, 4)
    parts = [((words >> (8 * k)) & 255).to(weights) * weights for k in range(4)]
    through: Tensor = torch.stack([part.sum(1) for part in parts], 1).index_select(1, which).div(BYTE)
    return through


def _blocks(values: Tensor, like: Tensor) -> Tensor:
    """Values (x, n) as (b, x, w)."""
    blocks: Tensor = values.unflatten(1, (len(like), like.shape[-1])).transpose(0, 1)
    return blocks


def _side(table: Tensor) -> int:
    return math.isqrt(len(table))
