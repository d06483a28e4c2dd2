"""Narrow lobes of a material: cells of f cos, by Lloyd's algorithm, for each direction of view (`ops.gloss`).

w_n is what a cell reflects, so that the sum of w_n is the albedo and constant light is exact; a_n is its mean
direction, and s_n its width. Tables are for cosines of wo to the normal, and azimuths of wo where f is anisotropic, and
in the frame of the mirror image of wo: along, which leans to the normal, across, and the mirror direction. There a lobe
changes little from one cosine to the next, so that the rows between are mixed.

Narrow lobes follow Krivanek and Colbert, Real-time shading with filtered importance sampling, 2008.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, reduce
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from ptt.ops.constants import HEAD_ON, LEVELS, PARTS, RINGS, ROW, SECTORS, SHARPEST, TILTS, TINY
from ptt.ops.transforms import beneath, outside

NARROWEST = 3.5  # degrees that the lobe of level 1 covers (three standard deviations); that of level 0 is a cell
SHARPNESS = (3 / math.radians(NARROWEST)) ** 2  # the inverse variance of a lobe of level 1; a level more halves it
TURNS = 24  # azimuths of wo of an anisotropic f
WIDENED = 1.1  # in a trial on ten shapes under three maps, the standard deviation of a lobe over that of its cell
ROUNDS = 4  # of Lloyd's algorithm from one cosine to the next
STEPS = 2047  # of a unit length, for cells; MASS_STEPS: of the largest mass
MASS_STEPS = 2**20
FIRST = 24  # rounds at the first
COSINE = 1e-3  # f below the horizon is as at this cosine, so that it may be interpolated up to the horizon

FEW, MANY = 16, 32  # lobes by default: of a material, and of a wide metal
WIDE = 62.0  # degrees that it covers as one lobe, as GGX of roughness 0.39: 16 lobes of it are 20 degrees wide
METAL = 0.2  # of the light from all around that it reflects

Reflects = Callable[[Tensor, Tensor], Tensor]
"""f(wi, wo) (..., c) [1/sr] of local unit directions (..., 3)."""


CellSums = Callable[[Tensor, Tensor, Sequence[int]], Tensor]
"""`cell_sums`, or its kernel."""


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


class Nodes(NamedTuple):
    """Directions of light about each wo of a table, mirror images of wo about `half_vectors`, which follow f as it
    becomes long and thin at the horizon: m of them, of which the second half of each ring mirrors the first.

    mirrored (tilts, 3, m): in the frame of the mirror direction
    wi (turns * tilts, m, 3): local, above the horizon, so that f may be interpolated up to it; of isotropic f m / 2
    wo (turns * tilts, 1, 3)
    measure (turns * tilts, m): cosine times solid angle; m / 2 as wi
    """

    mirrored: Tensor
    wi: Tensor
    wo: Tensor
    measure: Tensor


@cache
def nodes(turns: int) -> Nodes:
    """The nodes of tables for so many azimuths of wo, float32; 1 for isotropic f."""
    h, share = half_vectors()
    steep = outgoing(1)
    along = steep @ h.T  # shape: (t, m)
    mirrored = (2 * along[..., None] * h - steep[:, None]) @ frames(steep).transpose(1, 2)
    solid = (4 * along * share).clamp(min=0)
    wo = outgoing(turns)
    placed, kept = mirrored, solid
    if turns == 1:
        placed, kept = (_half(x) for x in (mirrored, solid))
    wi = placed.repeat(turns, 1, 1) @ frames(wo)
    measure = wi[..., 2].clamp(min=0) * kept.repeat(turns, 1)
    raised = normalize(torch.cat((wi[..., :2], wi[..., 2:].clamp(min=COSINE)), -1), dim=-1)
    made = mirrored.transpose(1, 2), raised, wo[:, None], measure
    return Nodes(*(x.float().contiguous() for x in made))


def _half(whole: Tensor) -> Tensor:
    """Of values (t, m, ...), those of the first half of the sectors."""
    half: Tensor = whole.unflatten(1, (RINGS, 2, SECTORS))
    return half[:, :, 0].flatten(1, 2)


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
    """A material on the nodes about each wo of its tables: f, and f cos times solid angle (turns * tilts, m, c).

    values: of isotropic f on the first half of the sectors
    """

    values: Tensor
    reflected: Tensor
    turns: int


def sampled(reflects: Reflects, isotropic: bool) -> Samples:
    """A material on the nodes about each wo of its tables."""
    turns = 1 if isotropic else TURNS
    _, wi, wo, measure = outside(nodes, turns)
    values = reflects(wi, wo.expand_as(wi))
    reflected = values * measure[..., None]
    return Samples(values, _both_halves(reflected) if isotropic else reflected, turns)


def _both_halves(half: Tensor) -> Tensor:
    """Values (t, m, c) of a function that is its own mirror image, from those of half of the sectors."""
    whole: Tensor = half.unflatten(1, (RINGS, 1, SECTORS)).expand(-1, -1, 2, -1, -1)
    return whole.flatten(1, 3)


def _table(found: Tensor) -> Tensor:
    """Axes, levels and weights (r, n, 4 + c) of lobes, from their first moments and sums (r, n, 3 + c)."""
    moments, reflected = found.split((3, found.shape[2] - 3), 2)
    length = torch.linalg.vector_norm(moments, dim=2, keepdim=True)
    up = moments.new_tensor([0.0, 0.0, 1.0])
    axes = torch.where(length > TINY, moments / length.clamp(min=TINY), up)
    level = (1 + 2 * torch.log2(_degrees(length, reflected) / NARROWEST)).clamp(0, LEVELS - 1)
    return torch.cat((axes, level, reflected), 2)


def _as_one_lobe(found: Tensor, turns: int) -> Tensor:
    """All lobes as one (TILTS, ROW), of the mean azimuth: a table as in `Lobes`, and a zero."""
    table = _table(found.sum(1, keepdim=True))[:, 0]
    return pad(table.unflatten(0, (turns, TILTS)).mean(0), (0, 1))


def _degrees(length: Tensor, reflected: Tensor) -> Tensor:
    """Degrees (..., 1) that lobes cover, from the lengths of first moments (..., 1) and sums (..., c)."""
    spread = (1 - length / reflected.sum(-1, keepdim=True).clamp(min=TINY)).clamp(1e-9, 1 - 1e-3)
    return torch.rad2deg(3 * WIDENED * (-torch.log1p(-spread)).sqrt())


def cell_sums(mirrored: Tensor, reflected: Tensor, counts: Sequence[int]) -> Tensor:
    """What each of n cells of a material reflects, by rows of its tables (turns * tilts, n, 3 + c): first moments of
    the directions mirrored (tilts, 3, m), and sums, of what is reflected from them (turns * tilts, m, c).

    counts: so many cells that are all of the material, and so many again; n in all

    The cells are those of Lloyd's algorithm, from the steepest view to the flattest, each beginning with the centres of
    the one before, so that a cell stays the same cell.
    """
    whole, masses = whole_numbers(mirrored, reflected)
    each = [[_cells(whole, mass, c) for c in first_centres(whole, mass, counts)] for mass in masses.split(len(whole))]
    directions = mirrored.transpose(1, 2).repeat(len(reflected) // len(mirrored), 1, 1)
    values = torch.cat((directions * reflected.sum(2, keepdim=True), reflected), 2)
    cells = [torch.cat(turns) for turns in zip(*each, strict=True)]
    inside = [torch.nn.functional.one_hot(own, n).to(values) for own, n in zip(cells, counts, strict=True)]
    return torch.cat(inside, 2).transpose(1, 2) @ values


def whole_numbers(mirrored: Tensor, reflected: Tensor) -> tuple[Tensor, Tensor]:
    """Directions (tilts, 3, m), and masses (rows, m) of what is reflected, as whole numbers, of which float32 holds
    products of directions and float64 all sums: in whatever order they are summed, cells are the same."""
    mass = reduce(torch.add, beneath(reflected).detach().unbind(2))  # five times as fast as a sum over rows of three
    share = mass / mass.amax(1, keepdim=True).clamp(min=TINY)
    return (mirrored * STEPS).round(), (share * MASS_STEPS).round()


def _cells(directions: Tensor, mass: Tensor, centres: Tensor) -> Tensor:
    """The cell 0..n-1 (t, m) of each node (t, 3, m), for masses (t, m), from centres (n, 3) to begin with."""
    found = []
    each = torch.arange(len(centres), device=centres.device)[:, None]
    rows = zip(directions.flip(0), mass.flip(0), [FIRST] + [ROUNDS] * (len(mass) - 1), strict=True)
    for towards, row, rounds in rows:
        weighed = (towards.double() * row).T
        for _ in range(rounds):
            inside = (centres @ towards).argmax(0) == each
            sums = inside.to(weighed) @ weighed
            length = torch.linalg.vector_norm(sums, dim=1, keepdim=True)
            centres = torch.where(length > 0, (sums * (STEPS / length)).round().to(centres), centres)
        found.append((centres @ towards).argmax(0))
    return torch.stack(found).flip(0)


def first_centres(directions: Tensor, mass: Tensor, counts: Sequence[int]) -> list[Tensor]:
    """Nodes (n, 3) to begin with, for so many cells and so many: each the one of the steepest view that those before it
    leave the largest error at."""
    last = directions[-1].T
    units = last / STEPS
    near = 2 - 2 * units @ normalize(mass[-1] @ units, dim=0)
    chosen = []
    for _ in range(max(counts)):
        chosen.append(int((near * mass[-1]).argmax()))
        near = torch.minimum(near, 2 - 2 * units @ units[chosen[-1]])
    return [last[chosen[:n]] for n in counts]


class Gloss(NamedTuple):
    """What a material reflects glossily.

    lobes: of all light but lamps
    values (turns * tilts, rings, sectors, c): the root of f for lamps
    whole (TILTS, ROW): all of it as one lobe; parts (TILTS, PARTS, ROW): as a few
    spread: degrees around the mirror direction within which half of what it reflects lies, seen straight on
    """

    lobes: Lobes
    values: Tensor
    whole: Tensor
    parts: Tensor
    spread: float


def gloss_of(reflects: Reflects, isotropic: bool, n: int | None = None, sums: CellSums = cell_sums) -> Gloss:
    """The tables of a material, with n lobes, None for `enough`; differentiable in f."""
    samples = sampled(reflects, isotropic)
    mirrored = outside(nodes, 1).mirrored
    n = n or enough(samples)
    found, few = sums(mirrored, samples.reflected, (n, PARTS) if isotropic else (n,)).tensor_split((n,), 1)
    lobes = Lobes(_table(found), samples.turns)
    whole = _as_one_lobe(found, samples.turns)
    parts = pad(_table(few), (0, 1)) if isotropic else in_parts(whole)
    return Gloss(lobes, roots(samples), whole, parts, spread(samples))


def in_parts(whole: Tensor) -> Tensor:
    """One lobe (TILTS, ROW) in place of `PARTS` (TILTS, PARTS, ROW): the others reflect nothing."""
    rest = whole[:, None].expand(-1, PARTS - 1, -1) * (torch.arange(ROW, device=whole.device) < 4)
    return torch.cat((whole[:, None], rest), 1)


def roots(samples: Samples) -> Tensor:
    """The root of f (turns * tilts, rings, sectors, c), for lamps."""
    sectors = SECTORS if samples.turns == 1 else 2 * SECTORS
    values: Tensor = samples.values.unflatten(1, (RINGS, sectors))
    return (values + TINY).sqrt()


def enough(samples: Samples) -> int:
    """How many lobes a material has by default: `FEW`, `MANY` where it is a metal and wide, seen straight on.

    A lobe sees light and what hides it apart from each other, as means over its width: of what a wide metal reflects
    16 lobes are so wide that this shows. A plastic reflects too little for it to show.
    """
    reflected = beneath(samples.reflected).detach()[TILTS - 1]
    length = torch.linalg.vector_norm(outside(nodes, 1).mirrored[TILTS - 1] @ reflected.sum(1, keepdim=True))
    albedo = reflected.sum(0)
    wide = bool(_degrees(length[None], albedo) > WIDE)
    return MANY if wide and bool(albedo.max() > METAL) else FEW


def spread(samples: Samples) -> float:
    """Degrees around the mirror direction within which half of what is reflected lies, seen straight on."""
    mass = beneath(samples.reflected).detach()[TILTS - 1].sum(1)
    cosine, order = outside(nodes, 1).mirrored[TILTS - 1, 2].sort(descending=True)
    inside = mass[order].cumsum(0)
    half = int((inside < inside[-1] / 2).sum())
    return math.degrees(math.acos(min(1.0, float(cosine[half]))))
