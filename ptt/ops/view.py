"""The view step: what points in blocks send to the eye, by outgoing factors and by lobes (Sun 2007, sections 3.3, 4.1).

    B[v, c] = sum over o of  V[o, wo] Q[c, o, v]
            + specular[c] sum over k of  rho_k(wo) E_k[c, a_k] cut_k[v, a_k]
            + specular[c] sum over k, s of  rho_k(wo) z_k[s] Y_s(a) I[c, s, v]

V: outgoing factors, V[0] = 1 for the diffuse part; rho_k: reflectance of lobe k, a_k(wo) its axis; E_k: the map blurred
by it; cut_k: its fractional visibility; I: the light of one and two bounces in harmonics, which z_k blurs, about the
mean a of the axes. A point that faces away sends what its mirror image above the horizon does, so that silhouettes
interpolate well; one whose triangles all do so (`faces_eye`) sends what is diffuse alone.

Points are innermost, in blocks of w; n = b * w of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import harmonics, lobes
from ptt.ops.constants import TINY
from ptt.ops.directions import faces_eye, toward
from ptt.ops.octahedral import corners, hemi_octahedral, mix, octahedral, sampled, tiled_columns, tiled_rows
from ptt.ops.relight import OutgoingLight
from ptt.ops.transfer import lookup
from ptt.ops.transforms import chosen

BYTE = 255.0
_POINTS = 1 << 16  # that are worked out together: in a trial of 62,777, four parts took 1.7 times as long as one


class SurfaceBlocks(NamedTuple):
    """The points of a region, in blocks.

    position (3, n); frame (3, 3, n): rows tangent, bitangent, normal; dip (n,): `mesh.dips`
    colour (3, n) of the surface, None for white
    cuts (n, cells) int32: cut_k, a byte each, cells in `tiles`
    place (v,) int64: where each point of the region lies among the n
    point (n,) int32: which point lies there, -1 for none (`points_at`)
    """

    position: Tensor
    frame: Tensor
    dip: Tensor
    colour: Tensor | None
    cuts: Tensor
    place: Tensor
    point: Tensor


def points_at(place: Tensor, n: int) -> Tensor:
    """Which point (n,) int32 lies at each of n places, -1 for none, of the places (v,) of points."""
    point = torch.full((n,), -1, dtype=torch.int32, device=place.device)
    point[place] = torch.arange(len(place), dtype=torch.int32, device=place.device)
    return point


class LitLobes(NamedTuple):
    """The lobes of a region's material, k of them.

    which (k,) int64: of the bytes of the cuts; rho (turns * tilts, k); axes (tilts, 2 k): along, then up (`lobes.lean`)
    specular (c,)
    maps (k, cells, 4): E_k on a `bordered` octahedral map, three channels and a zero; None for light that bounced alone
    turn (3, 3): of the light, world = turn @ map
    blurs (k, s): z_k
    """

    which: Tensor
    rho: Tensor
    axes: Tensor
    specular: Tensor
    maps: Tensor | None
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
    return torch.cat([_seen(region, outgoing) for region in regions])


def _seen(region: ViewedRegion, outgoing: Tensor) -> Tensor:
    """B (v, c) of the points of a region: what is diffuse of all, and the rest of blocks in which some face the eye."""
    region = region._replace(sent=region.sent.whole())
    points, eye, sent, _ = region
    wo = local_directions(points.position, points.frame, eye)
    diffuse = sent.values[:, :, 0].to(outgoing.dtype) * sent.unit[:, :, 0, None]
    if points.colour is not None:
        diffuse = diffuse * _blocks(points.colour, diffuse)
    facing = _blocks(faces_eye(points.dip, wo[2], eye)[None], diffuse)  # shape: (b, 1, w)
    rows = chosen(facing.flatten(1).any(1), max(1, _POINTS // diffuse.shape[-1]))
    parts = [_glossy(region, _blocks(wo, diffuse)[some], some, outgoing) * facing[some] for some in rows]
    radiance = diffuse.index_add(0, torch.cat(rows), torch.cat(parts))
    return radiance.transpose(1, 2).flatten(0, 1).index_select(0, points.place)


def _glossy(region: ViewedRegion, towards: Tensor, some: Tensor, outgoing: Tensor) -> Tensor:
    """What some blocks (b,) of a region reflect glossily (b, c, w) to local directions (b, 3, w)."""
    points, _, sent, gloss = region
    rows = sent.values.shape[2]
    factors = lookup(outgoing.T.unflatten(1, (_side(outgoing), -1)), towards)
    glossy = _products(factors, sent, some, 1)
    if gloss is None:
        return glossy
    rho, leant = _leant(gloss, towards)
    sideways = -_in_line(towards[:, :2])
    axes = torch.cat((leant[0] * sideways[:, None], leant[1:]))
    lit = torch.zeros_like(glossy)
    if gloss.maps is not None:
        at = (some[:, None] * towards.shape[2] + torch.arange(towards.shape[2], device=some.device)).flatten()
        seen = rho * _through(points.cuts, at, axes, gloss.which)
        frame = _in_line(_blocks(points.frame.flatten(0, 1), sent.values)[some]).unflatten(0, (3, 3))
        plane = torch.stack((_sums(frame[:2], sideways[:, None]), frame[2]))  # of all axes
        about = _sums((gloss.turn.T @ plane)[:, :, None], leant[:, None])
        light = light_about(gloss.maps, about.permute(2, 1, 0))
        lit = _blocks(_sums(seen[:, None], light.permute(1, 2, 0)), towards)
    if rows > 1 + outgoing.shape[1]:
        mean = _sums(rho[:, None], axes.transpose(0, 1))
        axis = mean / mean.square().sum(0).clamp(min=TINY).sqrt()
        response = (gloss.blurs.T @ rho) * harmonics.evaluate(axis.T, round(gloss.blurs.shape[1] ** 0.5)).T
        lit = lit + _products(_blocks(response, towards), sent, some, 1 + outgoing.shape[1])
    return glossy + lit * gloss.specular[:, None]


def local_directions(position: Tensor, frame: Tensor, eye: Tensor) -> Tensor:
    """Local directions (3, n) to the eye, of points at positions (3, n) with frames (3, 3, n)."""
    local = _sums(frame.transpose(0, 1), toward(eye, position, 0)[:, None])
    here = (local == 0).all(0)  # an eye in a point looks along its normal
    return torch.cat((local[:2], (local[2] + here.to(local))[None]))


def _leant(gloss: LitLobes, wo: Tensor) -> tuple[Tensor, Tensor]:
    """rho_k (k, n), and how far axes lie along the mirror direction and up (2, k, n), at local wo (b, 3, w)."""
    towards = wo.transpose(1, 2)
    rho = lobes.lookup(gloss.rho.T.unflatten(1, (-1, len(gloss.axes))), towards)
    leant = lobes.lookup(gloss.axes.T[:, None], towards)
    return rho.flatten(1), leant.unflatten(0, (2, -1)).flatten(2)


def light_about(maps: Tensor, axes: Tensor) -> Tensor:
    """E_k (n, k, 3) about axes (n, k, 3) on maps (k, cells, 4)."""
    n = math.isqrt(maps.shape[1])
    tables = maps[..., :3].unflatten(1, (n, n)).movedim(3, 1)  # shape: (k, 3, n, n)
    return sampled(tables, octahedral(axes).permute(1, 2, 0) * ((n - 2) / n)).permute(2, 0, 1)


def blurred(maps: Tensor, axes: Tensor, level: Tensor) -> Tensor:
    """E (n, k, 3) about axes (n, k, 3) at levels (n, k), linear between the maps (levels, cells, 4)."""
    cells = maps.shape[1]
    side = math.isqrt(cells)
    below = level.detach().floor().clamp(0, len(maps) - 2)
    index, weights = corners(octahedral(axes) * ((side - 2) / side), side, wrap=False)
    index = index + cells * below.long()[..., None]
    share = (level - below)[..., None]
    flat = maps.flatten(0, 1)
    both = torch.cat((index, index + cells), -1).flatten(0, 1)
    mixed = torch.cat((weights * (1 - share), weights * share), -1).flatten(0, 1)
    about: Tensor = mix(flat, both, mixed)[:, :3].reshape(axes.shape)
    return about


def _through(cuts: Tensor, at: Tensor, axes: Tensor, which: Tensor) -> Tensor:
    """Fractional visibility (k, n) of some points (n,) about local axes (3, k, n)."""
    n = _side(cuts.T)
    x, y = ((hemi_octahedral(axes.movedim(0, -1)) + 1) * (n / 2) - 0.5).clamp(0, n - 1).unbind(-1)
    column, row = (along.floor().clamp(max=n - 2) for along in (x, y))
    cell = (row * n + column).long().flatten()
    lines = torch.arange(n, device=cuts.device)
    places = (tiled_rows(lines, n)[:, None] + tiled_columns(lines)).long().flatten()
    bytes_ = cuts.view(torch.uint8)
    first = (bytes_.shape[1] * at + which[:, None]).flatten()
    values = bytes_.flatten()

    def seen(further: int) -> Tensor:
        place = torch.add(first, places[further:].index_select(0, cell), alpha=4)
        return values.index_select(0, place).to(axes).view_as(x)

    over, under = (torch.lerp(seen(line), seen(line + 1), x - column) for line in (0, n))
    return torch.lerp(over, under, y - row) / BYTE


def _sums(factors: Tensor, values: Tensor) -> Tensor:
    """The sum over x (...) of factors times values (x, ...), one x after the other: no product of all is ever in
    memory."""
    total = factors[0] * values[0]
    for x in range(1, len(factors)):
        total = torch.addcmul(total, factors[x], values[x])
    return total


def _products(factors: Tensor, sent: OutgoingLight, some: Tensor, first: int) -> Tensor:
    """The sum over x (b, c, w) of factors (b, x, w) times what some blocks (b,) send out in rows from the first on; one
    row after the other, so that what it is made from stays in the cache."""
    total = factors.new_zeros(len(some), sent.values.shape[1], factors.shape[2])
    for x in range(factors.shape[1]):
        row = sent.values[:, :, first + x].index_select(0, some).to(factors.dtype)
        total = torch.addcmul(
            total, factors[:, x, None], row * sent.unit[:, :, first + x].index_select(0, some)[..., None]
        )
    return total


def _blocks(values: Tensor, like: Tensor) -> Tensor:
    """Values (x, n) as (b, x, w)."""
    blocks: Tensor = values.unflatten(1, (len(like), like.shape[-1])).transpose(0, 1)
    return blocks


def _in_line(blocks: Tensor) -> Tensor:
    """Values (b, x, w) as (x, n)."""
    return blocks.transpose(0, 1).flatten(1)


def _side(table: Tensor) -> int:
    return math.isqrt(len(table))
