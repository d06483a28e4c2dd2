"""Glossy reflection of direct light by narrow lobes, each with a light and a visibility of its own, and lamps apart.

    B[v, c] = sum over n of  w_n[c](wo) E[c](a_n, s_n) V_v(a_n, s_n)
            + sum over m of  f[c](d_m, wo) cos(d_m) V_v(d_m) P_m[c]

The lobes of a material are cells of f cos, by Lloyd's algorithm: w_n is what a cell reflects, so that the sum of w_n is
the albedo and constant light is exact; a_n is its mean direction, and s_n its width. E is the light blurred to a width
(`levels`), V_v the share of it that point v sees. What is small and bright in the light, lamps of power P_m, is
reflected by f itself.

Tables are for cosines of wo to the normal, and azimuths of wo where f is anisotropic, and in the frame of the mirror
image of wo: along, which leans to the normal, across, and the mirror direction. There a lobe changes little from one
cosine to the next, so that the rows between are mixed.

Sun et al. 2007, section 4.1, has up to four lobes about common axes, of at most 21 degrees, and a tensor for the rest.
Narrow lobes follow Krivanek and Colbert, Real-time shading with filtered importance sampling, 2008.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops.constants import BITS, HEAD_ON, LEVELS, RINGS, SECTORS, SHARPEST, TILTS, TINY
from ptt.ops.octahedral import corners, hemi_octahedral, mix, octahedral, tiles
from ptt.ops.transforms import beneath, outside
from ptt.ops.view import BYTE, SurfaceBlocks, local_directions

NARROWEST = 3.5  # degrees that the lobe of level 1 covers (three standard deviations); that of level 0 is a cell
TURNS = 24  # azimuths of wo of an anisotropic f
SPREAD = 1.1  # in a trial on ten shapes under three maps, the standard deviation of a lobe over that of its cell
ROUNDS = 4  # of Lloyd's algorithm from one cosine to the next
FIRST = 24  # rounds at the first
COSINE = 1e-3  # f below the horizon is as at this cosine, so that it may be interpolated up to the horizon

CUT_ANGLES = (7.0, 14.0, 28.0)  # degrees that the lobes cover of which `SurfaceBlocks.cuts` has the visible share
AT_ONCE = 4096  # points that are worked out together, so that they stay in the cache

SHARP = 2.5  # degrees, the radius of a lamp (`ptt.light.lamps.INNER`)

Reflects = Callable[[Tensor, Tensor], Tensor]
"""f(wi, wo) (..., c) [1/sr] of local unit directions (..., 3)."""


class Lobes(NamedTuple):
    """The lobes of a material: table (turns * tilts, n, 4 + c): along, across, mirror; level; w_n of each channel."""

    table: Tensor
    turns: int


def width(level: float) -> float:
    """Degrees that the lobe of a level covers, three standard deviations."""
    return NARROWEST * 2 ** ((level - 1) / 2)


@cache
def rings() -> Tensor:
    """Edges (RINGS + 1,), float64, of the rings about the normal, in squared tangents of the half vector's tilt."""
    edges = octaves_back(SHARPEST + torch.arange(1, RINGS, dtype=torch.float64) / 4)
    return torch.cat((edges.new_zeros(1), edges, edges.new_tensor([math.inf])))


def octaves(x: Tensor) -> Tensor:
    """A logarithm to base two that is linear between powers of two: of 2^e (1 + m), e + m."""
    mantissa, exponent = torch.frexp(x)
    return exponent.to(x) + 2 * mantissa - 2


def octaves_back(y: Tensor) -> Tensor:
    """The inverse of `octaves`."""
    whole = y.floor()
    return torch.ldexp(1 + y - whole, whole.int())


@cache
def half_vectors() -> tuple[Tensor, Tensor]:
    """Half vectors (rings * 2 * sectors, 3) about the normal, x towards wo, and their solid angles, float64.

    The second half of a ring's sectors is the mirror image of the first.
    """
    edges = rings()
    square = octaves_back(SHARPEST + 0.125 + torch.arange(RINGS, dtype=torch.float64) / 4)
    phi = (torch.arange(SECTORS, dtype=torch.float64) + 0.5) * (math.pi / SECTORS)
    cosine = (1 + square).rsqrt()[:, None]
    sine = square.sqrt()[:, None] * cosine
    half = torch.stack((sine * phi.cos(), sine * phi.sin(), cosine.expand(-1, SECTORS)), -1)
    whole = torch.cat((half, half * half.new_tensor([1, -1, 1])), 1)
    heights = (1 + edges).rsqrt()
    share = (heights[:-1] - heights[1:]) * (math.pi / SECTORS)
    return whole.flatten(0, 1), share[:, None].expand(-1, 2 * SECTORS).flatten()


@cache
def nodes() -> tuple[Tensor, Tensor]:
    """Directions wi (TILTS, nodes, 3) in the frame of the mirror direction, and their solid angles (TILTS, nodes).

    They are the mirror images of wo about `half_vectors`, which follow f as it becomes long and thin at the horizon.
    """
    h, share = half_vectors()
    wo = outgoing(1)
    along = wo @ h.T  # shape: (t, nodes)
    wi = 2 * along[..., None] * h - wo[:, None]
    local = wi @ frames(wo).transpose(1, 2)
    return local, (4 * along * share).clamp(min=0)


def outgoing(turns: int) -> Tensor:
    """Directions wo (turns * TILTS, 3), float64, of the rows of a table."""
    z = (torch.arange(TILTS, dtype=torch.float64) + 0.5) / (TILTS - 0.5)  # from near the horizon to the normal itself
    phi = torch.arange(turns, dtype=torch.float64) * (2 * math.pi / turns)
    s = (1 - z * z).sqrt()
    return torch.stack((phi.cos()[:, None] * s, phi.sin()[:, None] * s, z.expand(turns, -1)), -1).flatten(0, 1)


def frames(wo: Tensor) -> Tensor:
    """Rows along, across and mirror (..., 3, 3), local, of directions wo (..., 3); one below the horizon has those of
    its mirror image above."""
    x, y, z = wo[..., 0], wo[..., 1], wo[..., 2].abs()
    s = (x * x + y * y).sqrt()
    steep = s < HEAD_ON
    u = torch.where(steep, 1.0, x / s.clamp(min=HEAD_ON))
    v = torch.where(steep, 0.0, y / s.clamp(min=HEAD_ON))
    zero = torch.zeros_like(z)
    rows = (torch.stack(row, -1) for row in ((z * u, z * v, s), (-v, u, zero), (-x, -y, z)))
    return torch.stack(tuple(rows), -2)


class Samples(NamedTuple):
    """A material on the nodes: f (turns * tilts, nodes, c), and f cos times solid angle."""

    values: Tensor
    reflected: Tensor
    turns: int


def sampled(reflects: Reflects, isotropic: bool) -> Samples:
    """A material on the nodes about each wo of its tables."""
    turns = 1 if isotropic else TURNS
    wo = outgoing(turns)
    directions, share = outside(nodes)
    if isotropic:
        directions = directions.unflatten(1, (RINGS, 2, SECTORS))[:, :, 0].flatten(1, 2)
    wi = (directions.repeat(turns, 1, 1) @ frames(wo)).float()  # shape: (t, nodes, 3)
    raised = normalize(torch.cat((wi[..., :2], wi[..., 2:].clamp(min=COSINE)), -1), dim=-1)
    values = reflects(raised, wo.float()[:, None].expand_as(raised))
    cosine = wi[..., 2:].clamp(min=0)
    if isotropic:
        values, cosine = (_mirrored(x) for x in (values, cosine))
    return Samples(values, values * cosine * share.float().repeat(turns, 1)[..., None], turns)


def _mirrored(half: Tensor) -> Tensor:
    """Values (t, nodes, c) of a function that is its own mirror image, from those of half of the sectors."""
    whole: Tensor = half.unflatten(1, (RINGS, 1, SECTORS)).expand(-1, -1, 2, -1, -1)
    return whole.flatten(1, 3)


def lobes_of(samples: Samples, n: int) -> Lobes:
    """n lobes of a material; differentiable in its samples."""
    directions = outside(nodes)[0].float()
    mass = beneath(samples.reflected).detach().sum(2)
    cells = torch.cat([_cells(directions, part, n) for part in mass.split(TILTS)])  # shape: (t, nodes)
    directions = directions.repeat(samples.turns, 1, 1)
    inside = torch.nn.functional.one_hot(cells, n).to(mass)
    reflected = torch.einsum("tmn,tmc->tnc", inside, samples.reflected)
    weights = samples.reflected.sum(2)
    sums = torch.einsum("tmn,tm,tmx->tnx", inside, weights, directions)
    length = torch.linalg.vector_norm(sums, dim=2, keepdim=True)
    total = reflected.sum(2, keepdim=True)
    up = directions.new_tensor([0.0, 0.0, 1.0])
    axes = torch.where(length > TINY, sums / length.clamp(min=TINY), up)
    spread = (1 - length / total.clamp(min=TINY)).clamp(1e-9, 1 - 1e-3)
    degrees = torch.rad2deg(3 * SPREAD * (-torch.log1p(-spread)).sqrt())
    level = (1 + 2 * torch.log2(degrees / NARROWEST)).clamp(0, LEVELS - 1)
    return Lobes(torch.cat((axes, level, reflected), 2), samples.turns)


def _cells(directions: Tensor, mass: Tensor, n: int) -> Tensor:
    """The cell 0..n-1 of each node (t, m, 3), for masses (t, m); from the steepest view to the flattest, each beginning
    with the centres of the one before, so that a cell stays the same cell."""
    centres = _apart(directions[-1], mass[-1], n)
    found = []
    rows = zip(directions.flip(0), mass.flip(0), [FIRST] + [ROUNDS] * (len(mass) - 1), strict=True)
    for directions, row, rounds in rows:
        weighed = directions * row[:, None]
        for _ in range(rounds):
            cell = (directions @ centres.T).argmax(1)
            sums = torch.zeros_like(centres).index_add_(0, cell, weighed)
            length = torch.linalg.vector_norm(sums, dim=1, keepdim=True)
            centres = torch.where(length > TINY, sums / length.clamp(min=TINY), centres)
        found.append((directions @ centres.T).argmax(1))
    return torch.stack(found).flip(0)


def _apart(directions: Tensor, mass: Tensor, n: int) -> Tensor:
    """n nodes (n, 3) to begin with: each the one that the others leave the largest error at."""
    near = 2 - 2 * directions @ normalize(mass @ directions, dim=0)
    chosen = []
    for _ in range(n):
        chosen.append(int((near * mass).argmax()))
        near = torch.minimum(near, 2 - 2 * directions @ directions[chosen[-1]])
    return directions[chosen]


def rows_of(wo: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Rows (n, j) int64 of tables over `outgoing`, and their weights (n, j), at wo (n, 3)."""
    at = (wo[:, 2].abs() * (TILTS - 0.5) - 0.5).clamp(0, TILTS - 1)
    i = at.floor().clamp(max=TILTS - 2).long()
    a = at - i
    index = torch.stack((i, i + 1), -1)
    weights = torch.stack((1 - a, a), -1)
    if turns == 1:
        return index, weights
    turn = torch.atan2(wo[:, 1], wo[:, 0]) * (turns / (2 * math.pi)) % turns
    j = turn.floor()
    b = (turn - j)[:, None]
    row = TILTS * (j.long() % turns)[:, None]
    after = TILTS * ((j.long() + 1) % turns)[:, None]
    return torch.cat((row + index, after + index), -1), torch.cat((weights * (1 - b), weights * b), -1)


class Gloss(NamedTuple):
    """What a material reflects glossily.

    lobes: of all light but lamps
    values (turns * tilts, rings, sectors, c): the root of f for lamps
    sharp: says whether half of what it reflects lies so close to the mirror direction that lamps are seen as areas
    """

    lobes: Lobes
    values: Tensor
    sharp: bool = False


class GlossLight(NamedTuple):
    """A light for lobes.

    maps (LEVELS, cells, 4): blurred to each width, on `bordered` octahedral maps; turn (3, 3): world = turn @ map
    lamps (m, 3), powers (m, c): of lamps, which the maps are without, in the world
    """

    maps: Tensor
    turn: Tensor
    lamps: Tensor
    powers: Tensor


def gloss_of(reflects: Reflects, isotropic: bool, n: int) -> Gloss:
    """The tables of a material, with n lobes; differentiable in f."""
    samples = sampled(reflects, isotropic)
    sectors = SECTORS if isotropic else 2 * SECTORS
    values = samples.values.unflatten(1, (RINGS, 2 * SECTORS))[:, :, :sectors]
    return Gloss(lobes_of(samples, n), (values + TINY).sqrt(), _is_sharp(samples))


def _is_sharp(samples: Samples) -> bool:
    """Tell whether, seen straight on, half of what is reflected lies within `SHARP` degrees of the mirror direction."""
    mass = beneath(samples.reflected).detach()[TILTS - 1].sum(1)
    near = outside(nodes)[0][TILTS - 1, :, 2].to(mass) > math.cos(math.radians(SHARP))
    return bool(mass[near].sum() > mass.sum() / 2)


def shine(points: SurfaceBlocks, eye: Tensor, bits: Tensor, gloss: Gloss, light: GlossLight) -> Tensor:
    """What points send of direct light to the eye (v, c), for an eye (3,) or unit directions (3, n) to it.

    bits (n, BITS * BITS / 32) int32: what is seen of the hemisphere, a bit for each cell of a `HemiOctahedral` map
    """
    wo = local_directions(points, eye).T
    frame = points.frame.movedim(2, 0)  # shape: (n, 3, 3)
    split = (each.split(AT_ONCE) for each in (frame, points.cuts, bits, wo))
    parts = [_shine(gloss, light, *some) for some in zip(*split, strict=True)]
    return torch.cat(parts).index_select(0, points.place)


def _shine(gloss: Gloss, light: GlossLight, frame: Tensor, cuts: Tensor, bits: Tensor, wo: Tensor) -> Tensor:
    """What points (n, ...) send out (n, c)."""
    table, turns = gloss.lobes
    index, weights = rows_of(wo, turns)
    row = mix(table.flatten(1), index, weights).unflatten(1, table.shape[1:])  # shape: (n, lobes, 4 + c)
    level = row[..., 3]
    axes = row[..., :3] @ frames(wo)
    seen = visible(cuts, bits, axes, level)
    about = blurred(light.maps, axes @ frame @ light.turn, level)
    out: Tensor = (row[..., 4:] * about * seen[..., None]).sum(1)
    if not len(light.lamps):
        return out
    return out + _lamps(frame, bits, wo, gloss, index, weights, light)


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


def visible(cuts: Tensor, bits: Tensor, axes: Tensor, level: Tensor) -> Tensor:
    """The share (n, k) that points see of lobes about local axes (n, k, 3): bits at level 1, wider ones of the cuts."""
    n = math.isqrt(cuts.shape[1])
    index, weights = corners(hemi_octahedral(axes), n, wrap=False)  # shape: (n, k, 4)
    words = cuts.gather(1, tiles(n).to(index)[index].flatten(1)).view_as(index)
    wide = [(words >> (8 * k) & 255).to(weights).mul(weights).sum(-1) / BYTE for k in range(len(CUT_ANGLES))]
    shares = torch.stack((bits_at(bits, axes), *wide), -1)  # shape: (n, k, 4)
    at = ((level - 1) / 2).clamp(0, len(CUT_ANGLES))
    below = at.detach().floor().clamp(max=len(CUT_ANGLES) - 1)
    low, high = (shares.gather(2, (below.long() + up)[..., None])[..., 0] for up in (0, 1))
    seen: Tensor = torch.lerp(low, high, at - below)
    return seen


def bits_at(bits: Tensor, axes: Tensor) -> Tensor:
    """The bilinear mean (n, k) of bits about local directions (n, k, 3)."""
    index, weights = corners(hemi_octahedral(axes), BITS, wrap=False)
    words = bits.gather(1, (index >> 5).flatten(1)).view_as(index)
    seen: Tensor = ((words >> (index & 31)) & 1).to(weights).mul(weights).sum(-1)
    return seen


def _lamps(
    frame: Tensor, bits: Tensor, wo: Tensor, gloss: Gloss, rows: Tensor, shares: Tensor, light: GlossLight
) -> Tensor:
    """What points reflect of lamps (n, c), by rows (n, j) of the table of f and their shares (n, j)."""
    wi = light.lamps.to(frame) @ frame.transpose(1, 2)  # shape: (n, m, 3)
    lit = wi[..., 2].clamp(min=0) * bits_at(bits, wi)
    index, weights = _on_nodes(wi, wo, gloss)
    t, r, s, c = gloss.values.shape
    every = (rows[:, None, :, None] * (r * s) + index[:, :, None]).flatten(2).flatten(0, 1)
    mixed = (shares[:, None, :, None] * weights[:, :, None]).flatten(2).flatten(0, 1)
    root = mix(gloss.values.reshape(t * r * s, c), every, mixed).unflatten(0, wi.shape[:2])
    sent: Tensor = (root * root * lit[..., None] * light.powers.to(root)).sum(1)
    return sent


def _on_nodes(wi: Tensor, wo: Tensor, gloss: Gloss) -> tuple[Tensor, Tensor]:
    """Cells (n, m, 4) of rings and sectors, and their weights, at local directions wi (n, m, 3) and wo (n, 3)."""
    _, r, s, _ = gloss.values.shape
    upper = torch.cat((wo[:, :2], wo[:, 2:].abs()), 1)[:, None]
    h = (wi + upper) @ _towards(wo).transpose(1, 2)
    square = (h[..., :2].square().sum(-1) / h[..., 2].square().clamp(min=TINY)).clamp(min=TINY)
    ring = ((octaves(square) - SHARPEST) * 4 - 0.5).clamp(0, r - 1)
    sector = torch.atan2(h[..., 1], h[..., 0]) * (SECTORS / math.pi) - 0.5
    i, j = ring.detach().floor().clamp(max=r - 2), sector.detach().floor()
    a, b = ring - i, sector - j
    row = s * i.long()
    left, right = (_sector(j.long() + on, s) for on in (0, 1))
    weights = torch.stack(((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b), -1)
    return torch.stack((row + left, row + right, row + s + left, row + s + right), -1), weights


def _sector(number: Tensor, stored: int) -> Tensor:
    """Where the sector of a number is stored; those of the second half turn follow the first, or are its mirror."""
    number = number % (2 * SECTORS)
    return torch.where(number < SECTORS, number, SECTORS + stored - 1 - number)


def _towards(wo: Tensor) -> Tensor:
    """Rows (n, 3, 3) that turn about the normal, so that wo (n, 3) lies over x."""
    across = frames(wo)[:, 1]
    flat = torch.stack((across[:, 1], -across[:, 0], across[:, 2]), 1)
    up = torch.zeros_like(flat)
    up[:, 2] = 1
    return torch.stack((flat, across, up), 1)
