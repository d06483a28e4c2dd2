"""Gaussian specular lobes: the sharp part of a BRDF, around the mirror direction (Sun et al. 2007, section 4.1).

    f(wi, wo) ~ sum over k of  a_k(wo) G_k(angle between wi and the mirror image of wo)  +  f_r(wi, wo)
    G_k(t) = exp(-t^2 / (2 s_k^2)) where t <= 3 s_k, else 0;  3 s_k = 7, 14, 21 degrees, and 3.5 for the lobe of "0"

The 0-degree lobe stands for a perfect mirror: it is about as wide as a texel of a 6 x 64 x 64 cube map (1.4 degrees).
Amplitudes are kept as reflectances, a_k times the integral of G_k cos(th_i): between 0 and the albedo of f, they
interpolate well where the amplitudes themselves grow without bound, towards grazing.

1. Expectation-maximisation explains by Gaussians what of f stands out from the level outside: in every ring around the
   mirror direction its least value, so that what is left is nowhere negative. The last updates take the minimum over a
   Gaussian's support where maximisation takes the mean.
2. What still stands out inside of a cone of 3.5, 7, 14 or 21 degrees (lobes at grazing angles are longer than wide) is
   cut off at the level outside, and the lobe of that cone takes over the light that it reflects.

So f_r is smooth and never negative, and lobes and remainder together reflect as much as f: the furnace does not change.

Dempster et al. 1977; Sun et al. 2007, section 4.1 and Figure 4. The paper gives no more than the constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import harmonics
from ptt.ops.albedo import nodes

ANGLES = (0.0, 7.0, 14.0, 21.0)  # degrees that three standard deviations cover
MIRROR = 3.5  # degrees that the 0-degree lobe covers
RIM = 10 / 7  # of the widest lobe: where the level is taken that lobes stand out from
RINGS = (16, 32)  # inside of MIRROR, and from there to the rim
TURNS = 16
SWEEPS = 40
FINEST, NODES = 1e-4, 64  # of the quadrature of the light that a lobe reflects (`albedo.nodes`)
TINY = 1e-30
ISOTROPIC, ANISOTROPIC = (1, 64), (24, 32)  # azimuths and tilts at which lobes are tabulated


class Lobes(NamedTuple):
    """What is taken out of a BRDF for outgoing directions (...); k lobes.

    below (k, ...) [1/sr]: amplitudes of Gaussians that stay below f together
    levels (k, ...) [1/sr]: that the rest is cut off at inside of each lobe's cone
    """

    below: Tensor
    levels: Tensor


def separate(f: Callable[[Tensor, Tensor], Tensor], wo: Tensor, angles: Sequence[float] = ANGLES) -> Lobes:
    """The lobes of a BRDF f(wi, wo) [1/sr] for outgoing directions wo (..., 3) above the horizon.

    angles (k): ascending, in degrees; with none, nothing is separated
    """
    if not angles:
        return Lobes(*(wo.new_zeros(0, *wo.shape[:-1]) for _ in range(2)))
    rings, areas = _rings(RIM * max(*angles, 2 * MIRROR))
    directions = _around(mirror(wo), rings)  # shape: (..., t, turns, 3)
    above = directions[..., 2] > 0
    values = f(directions, wo[..., None, None, :])
    gaussians = torch.stack([gaussian(rings, a) for a in angles], 1).to(wo) * torch.tensor(angles).gt(0)
    below = _maximise(_least(values, above).cummin(-1).values, gaussians, areas.to(wo))
    rest = _least((values - (below @ gaussians.T)[..., None]).clamp(min=0), above)
    levels = [rest[..., rings > math.radians(angle or MIRROR)].amax(-1) for angle in angles]
    return Lobes(below.movedim(-1, 0), torch.stack(levels))


def separate_isotropic(f: Callable[[Tensor, Tensor], Tensor], wo: Tensor, angles: Sequence[float] = ANGLES) -> Lobes:
    """`separate` for wo (n, 3), once for each of their angles to the normal: what turning about it does not change."""
    cosines, rows = wo[:, 2].mul(1 << 20).round().unique(return_inverse=True)
    z = (cosines / (1 << 20)).clamp(max=1)
    few = separate(f, torch.stack(((1 - z * z).sqrt(), torch.zeros_like(z), z), -1), angles)
    return Lobes(*(part[:, rows] for part in few))


def remainder(values: Tensor, angle: Tensor, lobes: Lobes, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_r (...) from f's values (...) at angles (...) [rad] from the mirror direction; lobes (k, ...) of wo."""
    return _peel(values, angle, lobes, angles)[-1]


def reflectances(
    f: Callable[[Tensor, Tensor], Tensor], wo: Tensor, angles: Sequence[float] = ANGLES, turns: int = 32
) -> Tensor:
    """The fraction (k, ...) of the light from wo (..., 3) that each lobe of f reflects: what `remainder` lacks.

    turns: of the quadrature; an anisotropic f needs 20 times the ratio of its slopes. Good to 1 %, or 3 % of a lobe
        that is six times as long as wide
    """
    lobes = separate(f, wo, angles)
    wi, weights = nodes(wo, FINEST, NODES, turns)
    out = wo.double()[..., None, :].expand_as(wi)
    columns = Lobes(*(part.double()[..., None] for part in lobes))
    layers = _peel(f(wi, out), from_mirror(wi, out), columns, angles)
    below = [amplitude * response(wo, a) for a, amplitude in zip(angles, lobes.below, strict=True)]
    cut = [((outer - inner) * weights).sum(-1).to(wo) for outer, inner in pairwise(layers)]
    return torch.stack([a + b for a, b in zip(below, cut, strict=True)]) if angles else lobes.below


def _peel(values: Tensor, angle: Tensor, lobes: Lobes, angles: Sequence[float]) -> list[Tensor]:
    """f without its Gaussians, and then cut off in one cone after the other; the last is the remainder.

    Between the rings that they were fitted on, the Gaussians may pass f by some 1e-5 of it: 0 is left there.
    """
    for a, amplitude in zip(angles, lobes.below, strict=True):
        values = values - amplitude * gaussian(angle, a)
    layers = [values.clamp(min=0)]
    for a, level in zip(angles, lobes.levels, strict=True):
        cut = torch.minimum(layers[-1], level)
        layers.append(torch.where(angle < math.radians(a or MIRROR), cut, layers[-1]))
    return layers


def evaluate(reflected: Tensor, wi: Tensor, wo: Tensor, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_s (...) [1/sr] at wi and wo (..., 3), from the reflected fractions (k, ...) of wo; not cut at the horizon."""
    angle = from_mirror(wi, wo)
    value = torch.zeros_like(angle)
    for a, reflectance in zip(angles, reflected, strict=True):
        value = value + reflectance / response(wo, a) * gaussian(angle, a)
    return value


def tilts_and_turns(isotropic: bool) -> Tensor:
    """Outgoing directions (p, t, 3) of a table: azimuths, one of an isotropic BRDF, by angles to the normal."""
    p, t = ISOTROPIC if isotropic else ANISOTROPIC
    phi = torch.arange(p, dtype=torch.float64) * (2 * math.pi / p)
    theta = (torch.arange(t, dtype=torch.float64) + 0.5) * (math.pi / 2 / t)
    sin = theta.sin()
    return torch.stack((phi.cos()[:, None] * sin, phi.sin()[:, None] * sin, theta.cos().expand(p, -1)), -1)


def lookup(table: Tensor, wo: Tensor) -> Tensor:
    """Bilinear values (k, ...) of a table (k, p, t) over `tilts_and_turns`, at directions wo (..., 3)."""
    index, weights = corners(wo, *table.shape[1:])
    return (table.flatten(1)[:, index] * weights).sum(-1)


def corners(wo: Tensor, turns: int, tilts: int) -> tuple[Tensor, Tensor]:
    """Cells (..., j) int64, of a flat table over `tilts_and_turns`, and bilinear weights (..., j) at wo (..., 3)."""
    tilt = (torch.atan2(wo[..., :2].square().sum(-1).sqrt(), wo[..., 2]) * (2 * tilts / math.pi) - 0.5).clamp(
        0, tilts - 1
    )
    i = tilt.floor().clamp(max=max(tilts - 2, 0)).long()
    a = tilt - i
    index, weights = torch.stack((i, (i + 1).clamp(max=tilts - 1)), -1), torch.stack((1 - a, a), -1)
    if turns == 1:
        return index, weights
    turn = torch.atan2(wo[..., 1], wo[..., 0]) * (turns / (2 * math.pi)) % turns
    j, b = turn.floor(), (turn - turn.floor())[..., None]
    row = tilts * (j.long() % turns)[..., None]
    after = tilts * ((j.long() + 1) % turns)[..., None]
    return torch.cat((row + index, after + index), -1), torch.cat((weights * (1 - b), weights * b), -1)


def gaussian(angle: Tensor, lobe: float) -> Tensor:
    """G_k at angles (...) [rad] from the mirror direction; lobe: k in degrees."""
    x = angle / sigma(lobe)
    return torch.exp(-x * x / 2) * (x <= 3)


def sigma(lobe: float) -> float:
    """Standard deviation [rad] of the lobe that covers so many degrees."""
    return math.radians(lobe or MIRROR) / 3


@cache
def integral(lobe: float) -> float:
    """Of G_k over directions [sr]."""
    t = torch.linspace(0, 3 * sigma(lobe), 1001, dtype=torch.float64)
    return float(torch.trapezoid(2 * math.pi * t.sin() * gaussian(t, lobe), t))


@cache
def zonal(lobe: float, order: int) -> Tensor:
    """What G_k leaves of harmonics (order,) of each degree: the mean of P_l(cos t) under G_k; 1 of a perfect mirror."""
    if lobe == 0:
        return torch.ones(order, dtype=torch.float64)
    t = torch.linspace(0, 3 * sigma(lobe), 1001, dtype=torch.float64)
    weight = t.sin() * gaussian(t, lobe)
    legendre = harmonics.zonal(t, order)
    return torch.trapezoid(weight * legendre, t) / torch.trapezoid(weight, t)


def response(wo: Tensor, lobe: float) -> Tensor:
    """Integral (...) of G_k cos(th_i) over the hemisphere [sr] for wo (..., 3); of 0 degrees, a perfect mirror's."""
    if lobe == 0:
        return integral(0.0) * wo[..., 2].clamp(min=TINY)
    return lookup(_responses(lobe).to(wo), wo)[0]


@cache
def _responses(lobe: float, tilts: int = 512, rings: int = 128, turns: int = 128) -> Tensor:
    """Table (1, 1, tilts) of `response`."""
    theta = (torch.arange(tilts, dtype=torch.float64) + 0.5) * (math.pi / 2 / tilts)
    t = (torch.arange(rings, dtype=torch.float64) + 0.5) * (3 * sigma(lobe) / rings)
    phi = (torch.arange(turns, dtype=torch.float64) + 0.5) * (2 * math.pi / turns)
    cosine = theta.cos()[:, None, None] * t.cos()[:, None] + theta.sin()[:, None, None] * t.sin()[:, None] * phi.cos()
    weight = gaussian(t, lobe) * t.sin() * (6 * math.pi * sigma(lobe) / rings)
    return (cosine.clamp(min=0).mean(-1) @ weight)[None, None]


def mirror(wo: Tensor) -> Tensor:
    """The mirror image (..., 3) of wo about the normal."""
    return wo * wo.new_tensor([-1.0, -1.0, 1.0])


def from_mirror(wi: Tensor, wo: Tensor) -> Tensor:
    """Angle (...) [rad] between wi and the mirror image of wo, exact also where it is small."""
    return between(wi, mirror(wo))


def between(a: Tensor, b: Tensor) -> Tensor:
    """Angle (...) [rad] between directions (..., 3), exact also where it is small."""
    return torch.atan2(torch.linalg.cross(*torch.broadcast_tensors(a, b)).norm(dim=-1), (a * b).sum(-1))


def _least(values: Tensor, above: Tensor) -> Tensor:
    """Of values (..., t, turns) in each ring, the least above the horizon; 0 where none is."""
    least = values.masked_fill(~above, math.inf).amin(-1)
    return torch.where(least.isinf(), 0.0, least)


def _maximise(envelope: Tensor, gaussians: Tensor, areas: Tensor) -> Tensor:
    """Amplitudes (..., k) of Gaussians (t, k) that explain what of an envelope (..., t) stands out from its end.

    A Gaussian that is 0 everywhere takes no part: its amplitude is 0.
    """
    scale = envelope[..., :1].clamp(min=torch.finfo(envelope.dtype).tiny)
    excess = (envelope - envelope[..., -1:]) / scale
    used = torch.nonzero(gaussians.amax(0))[:, 0]
    shapes = gaussians[:, used]
    amplitudes: Tensor = excess[..., :1].expand(*excess.shape[:-1], len(used)) / max(len(used), 1)
    share = shapes * areas[:, None]
    for _ in range(SWEEPS if len(used) else 0):
        ratio = excess / (amplitudes @ shapes.T + TINY)
        amplitudes = amplitudes * (ratio @ share) / share.sum(0)
    for _ in range(SWEEPS if len(used) else 0):
        ratio = excess / (amplitudes @ shapes.T + TINY)
        amplitudes = amplitudes * torch.stack([ratio[..., support].amin(-1) for support in shapes.T > 0], -1)
    return torch.zeros(*excess.shape[:-1], gaussians.shape[1]).to(excess).index_copy(-1, used, amplitudes * scale)


def _rings(rim: float) -> tuple[Tensor, Tensor]:
    """Angles (t,) [rad] of rings around the mirror direction out to a rim in degrees, and their areas (t,) [sr]."""
    inner = torch.linspace(0, MIRROR, RINGS[0] + 1, dtype=torch.float64)
    outer = torch.linspace(MIRROR, rim, RINGS[1] + 1, dtype=torch.float64)
    edges = torch.cat((inner, outer[1:])).deg2rad()
    middle, half = (edges[1:] + edges[:-1]) / 2, edges.diff() / 2
    return middle, 4 * math.pi * middle.sin() * half.sin()


def _around(axis: Tensor, rings: Tensor) -> Tensor:
    """Unit directions (..., t, turns, 3) at the given angles from unit axes (..., 3)."""
    z = axis.new_tensor([0.0, 0.0, 1.0]).expand_as(axis)
    across = torch.linalg.cross(z, axis)
    length = across.norm(dim=-1, keepdim=True)
    x = torch.where(length > 1e-6, across / length.clamp(min=1e-6), axis.new_tensor([1.0, 0.0, 0.0]))
    y = torch.linalg.cross(axis, x)
    turns = (torch.arange(TURNS, dtype=torch.float64) + 0.5) * (2 * math.pi / TURNS)
    circle = turns.cos().to(axis)[:, None] * x[..., None, :] + turns.sin().to(axis)[:, None] * y[..., None, :]
    sin, cos = rings.sin().to(axis)[:, None, None], rings.cos().to(axis)[:, None, None]
    directions: Tensor = sin * circle[..., None, :, :] + cos * axis[..., None, None, :]
    return directions
