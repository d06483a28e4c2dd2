"""The part of a BRDF that Gaussian lobes take over, and the axes about which they show it (Sun et al. 2007, 4.1).

    f(wi, wo) = f_s + f_r:  f_r is smooth and never negative, f_s is what stands out about the mirror direction
    f_s(wi, wo) cos(wi) ~ sum over k of  rho_k(wo) G_k(angle between wi and a_k(wo)) / integral of G_k

1. Expectation-maximisation explains by Gaussians what of f stands out from the level outside. It sees the least value
   of f in every ring around the mirror direction, so that what is left is nowhere negative. The last updates take the
   minimum over a Gaussian's support where maximisation takes the mean.
2. What still stands out inside of a cone of 3.5, 7, 14 or 21 degrees (lobes at grazing angles are longer than wide) is
   cut off at the level outside. Lobes and remainder together reflect as much as f: the furnace does not change.
3. Seen from near the horizon, f_s is no longer round, and the cosine and the horizon take its lower half: its middle
   lies above the mirror direction. Expectation-maximisation again, of a mixture of Gaussians of known widths, finds the
   light rho_k that each lobe reflects and its axis a_k, which may lean towards the normal or from it. What it keeps is
   all light and its mean direction. All BRDFs of a space share their axes: reflectances mix, axes would not.

In a trial at 3 degrees above the horizon under courtyard.exr, with three of the papers' materials, lobes about the
mirror direction erred by 43 to 48 %, lobes that lean by 2 to 6 % (docs/brdf.md).

Dempster et al. 1977; Sun et al. 2007, section 4.1 and Figure 4. The paper gives no more than the constraints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import lobes
from ptt.ops.albedo import nodes
from ptt.ops.constants import TINY
from ptt.ops.lobes import ANGLES, MIRROR, gaussian, mirror

Function = Callable[[Tensor, Tensor], Tensor]

# Nodes and sweeps trade time for accuracy: `lobe_light` states what they reach.
RIM = 10 / 7  # radius over that of the widest lobe at which the level is taken that lobes stand out from
RINGS = (16, 32)  # rings around the mirror direction inside of MIRROR, and from there to the rim
TURNS = 16  # directions on each ring
SWEEPS = 40  # updates of the Gaussians about the mirror direction (step 1), of either kind
FINEST_ANGLE = 1e-4  # [rad] half angle that the quadrature of the light resolves (`albedo.nodes`)
NODES = 64  # half angles of that quadrature on either side of the horizon's bound
ARCS = {True: 16, False: 32}  # azimuths of that quadrature, by whether the BRDF is isotropic
MIXTURE_STEPS = 24  # updates of the mixture of leaning Gaussians (step 3)
LEAST = 1e-3  # share of the light below which a lobe is dropped, so that it need not be looked up
PRIOR = 0.001  # share of the light that each lobe counts besides about the mirror direction: it steadies weak axes


class SeparatedLobes(NamedTuple):
    """What is taken out of a BRDF for outgoing directions (...); k lobes.

    below (k, ...) [1/sr]: amplitudes of Gaussians whose sum stays below f
    levels (k, ...) [1/sr]: level at which the rest is cut off inside of each lobe's cone
    """

    below: Tensor
    levels: Tensor


def separate(f: Function, wo: Tensor, angles: Sequence[float] = ANGLES) -> SeparatedLobes:
    """The lobes of a BRDF f(wi, wo) [1/sr] for outgoing directions wo (..., 3) above the horizon.

    angles (k): widths of the lobes, ascending [degrees]; with none, nothing is separated
    """
    if not angles:
        return SeparatedLobes(*(wo.new_zeros(0, *wo.shape[:-1]) for _ in range(2)))
    rings, areas = _rings(RIM * max(*angles, 2 * MIRROR))
    directions = _around(mirror(wo), rings)  # shape: (..., t, turns, 3)
    above = directions[..., 2] > 0
    values = f(directions, wo[..., None, None, :])
    gaussians = torch.stack([gaussian(rings, a) for a in angles], 1).to(wo) * torch.tensor(angles).gt(0)
    below = _maximise(_least(values, above).cummin(-1).values, gaussians, areas.to(wo))
    rest = _least((values - (below @ gaussians.T)[..., None]).clamp(min=0), above)
    levels = [rest[..., rings > math.radians(angle or MIRROR)].amax(-1) for angle in angles]
    return SeparatedLobes(below.movedim(-1, 0), torch.stack(levels))


def separate_isotropic(f: Function, wo: Tensor, angles: Sequence[float] = ANGLES) -> SeparatedLobes:
    """`separate` of an isotropic BRDF for wo (n, 3), found once for each of their angles to the normal."""
    cosines, rows = wo[:, 2].mul(1 << 20).round().unique(return_inverse=True)
    z = (cosines / (1 << 20)).clamp(max=1)
    few = separate(f, torch.stack(((1 - z * z).sqrt(), torch.zeros_like(z), z), -1), angles)
    return SeparatedLobes(*(part[:, rows] for part in few))


def remainder(values: Tensor, angle: Tensor, found: SeparatedLobes, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_r (...) [1/sr] from f's values (...) at angles (...) [rad] from the mirror direction; found (k, ...) for wo."""
    return _peel(values, angle, found, angles)[-1]


class LobeLight(NamedTuple):
    """The light that lobes take over from BRDFs h, for outgoing directions t, at nodes n.

    wo (t, 3), wi (t, n, 3) float32: outgoing directions, and the nodes
    light (t, h, n): f_s cos dwi, as a share of `total`
    shares (t, h, k): share of the light in each lobe's cone by step 2
    total (t, h) float64: sum of the light over the nodes
    """

    wo: Tensor
    wi: Tensor
    light: Tensor
    shares: Tensor
    total: Tensor


def lobe_light(
    functions: Sequence[Function], wo: Tensor, angles: Sequence[float] = ANGLES, turns: int = 32
) -> LobeLight:
    """The light that the lobes of BRDFs take over, for outgoing directions wo (t, 3) above the horizon.

    turns: azimuths of the quadrature; an anisotropic f needs 20 times the ratio of its slopes

    The light is accurate to 1 %, or to 3 % for a lobe that is six times as long as wide.
    """
    wi, weights = nodes(wo, FINEST_ANGLE, NODES, turns)
    out = wo.double()[:, None].expand_as(wi)
    angle = lobes.from_mirror(wi, out)
    light = []
    shares = []
    for f in functions:
        found = separate(f, wo, angles)
        columns = SeparatedLobes(*(part.double()[..., None] for part in found))
        layers = _peel(f(wi, out), angle, columns, angles)
        below = [amplitude * gaussian(angle, a) for a, amplitude in zip(angles, columns.below, strict=True)]
        cut = [outer - inner for outer, inner in pairwise(layers)]
        parts = torch.stack([(a + b) * weights for a, b in zip(below, cut, strict=True)])
        light.append(parts.sum(0))
        shares.append(parts.sum(-1).T)
    total = torch.stack(light, 1).sum(-1)
    scale = total.clamp(min=torch.finfo(total.dtype).tiny)[..., None]
    return LobeLight(
        wo.float(),
        wi.float(),
        (torch.stack(light, 1) / scale).float(),
        (torch.stack(shares, 1) / scale).float(),
        total,
    )


def axes_of(rows: Sequence[LobeLight], angles: Sequence[float]) -> Tensor:
    """Axes (2, k, t) of lobes (`lobes.lean`) by step 3, common to all BRDFs.

    rows: the light of one azimuth each, all for the same tilts t of `lobes.tilts_and_turns`
    """
    theta = torch.atan2(rows[0].wo[:, :2].norm(dim=1), rows[0].wo[:, 2]).double()
    most = torch.stack([row.total.amax() for row in rows]).amax().clamp(min=torch.finfo(torch.float64).tiny)
    shares = [row.shares for row in rows]
    bend = theta.new_zeros(len(angles), len(theta))
    mirrors = [mirror(row.wo) for row in rows]
    rises = [_rise(axis) for axis in mirrors]
    for _ in range(MIXTURE_STEPS):
        table = _table(theta, bend)
        along = torch.zeros_like(bend)
        up = torch.zeros_like(bend)
        for i, (row, axis, rise) in enumerate(zip(rows, mirrors, rises, strict=True)):
            density = _density(lobes.lean(table, row.wo), row.wi, angles)
            weighted = shares[i] * (row.total / most).float()[..., None]
            ratio, shares[i] = _step(row.light, shares[i], density)
            moment = (density * (weighted.mT @ ratio)) @ row.wi  # shape: (t, k, 3)
            along += (moment @ axis[..., None])[..., 0].T + PRIOR * weighted.sum((1, 2))
            up += (moment @ rise[..., None])[..., 0].T
        bend = torch.atan2(_smooth(up), _smooth(along).clamp(min=TINY))
    return _table(theta, bend)


def reflectances(light: LobeLight, angles: Sequence[float], axes: Tensor) -> Tensor:
    """The fraction (h, k, t), float64, of the light from wo that each lobe reflects; axes (2, k, t) (`lobes.lean`)."""
    density = _density(lobes.lean(axes, light.wo), light.wi, angles)
    shares = light.shares
    for _ in range(MIXTURE_STEPS):
        _, shares = _step(light.light, shares, density)
    shares = (shares.double() - LEAST).clamp(min=0)
    shares = shares / shares.sum(-1, keepdim=True).clamp(min=TINY)
    return (shares * light.total[..., None]).permute(1, 2, 0)


def tables(
    functions: Sequence[Function], isotropic: bool, angles: Sequence[float] = ANGLES, axes: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Reflectances (h, k, p, t) of BRDFs over `lobes.tilts_and_turns`, and the axes (2, k, t) of their lobes, float32.

    axes: default: those that suit these BRDFs
    """
    polar = lobes.tilts_and_turns(isotropic)
    if not angles:
        return polar.new_zeros(len(functions), 0, *polar.shape[:2]).float(), polar.new_zeros(
            2, 0, polar.shape[1]
        ).float()
    rows = [lobe_light(functions, wo, angles, ARCS[isotropic]) for wo in polar.float()]
    axes = axes_of(rows, angles).float() if axes is None else axes
    return torch.stack([reflectances(row, angles, axes) for row in rows], 2).float(), axes


def _step(light: Tensor, shares: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
    """One update of the mixture: the light (t, h, n) over what it shows there, and the next shares (t, h, k)."""
    ratio = light / (shares @ density).clamp(min=TINY)
    return ratio, shares * (ratio @ density.mT)


def _rise(axis: Tensor) -> Tensor:
    """Directions (t, 3) at right angles to unit axes (t, 3) that lead to the normal."""
    return torch.nn.functional.normalize(axis.new_tensor([0.0, 0.0, 1.0]) - axis * axis[:, 2:], dim=1)


def _density(axes: Tensor, wi: Tensor, angles: Sequence[float]) -> Tensor:
    """G_k over its integral (t, k, n), up to a constant factor, at wi (t, n, 3) about axes (t, k, 3)."""
    variance = axes.new_tensor([lobes.sigma(a) ** 2 for a in angles])[:, None]
    return ((axes @ wi.mT - 1) / variance).exp() / variance


def _table(theta: Tensor, bend: Tensor) -> Tensor:
    """Axes (2, k, t) at angles theta (t,) to the normal, bent (k, t) from the mirror direction towards it."""
    return torch.stack(((theta - bend).sin() / theta.sin(), (theta - bend).cos()))


def _smooth(values: Tensor) -> Tensor:
    """Values (k, t) mixed with their neighbours', so that axes do not jump from one tilt to the next."""
    padded = torch.nn.functional.pad(values[None], (1, 1), mode="replicate")[0]
    return padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]


def _peel(values: Tensor, angle: Tensor, found: SeparatedLobes, angles: Sequence[float]) -> list[Tensor]:
    """Layers of f: without its Gaussians, then cut off in one cone after the other; the last is the remainder.

    Between the rings on which they were fitted the Gaussians may exceed f by some 1e-5 of it: 0 is left there.
    """
    for a, amplitude in zip(angles, found.below, strict=True):
        values = values - amplitude * gaussian(angle, a)
    layers = [values.clamp(min=0)]
    for a, level in zip(angles, found.levels, strict=True):
        cut = torch.minimum(layers[-1], level)
        layers.append(torch.where(angle < math.radians(a or MIRROR), cut, layers[-1]))
    return layers


def _least(values: Tensor, above: Tensor) -> Tensor:
    """The least value (..., t) above the horizon of each ring's values (..., t, turns); 0 where none is above."""
    least = values.masked_fill(~above, math.inf).amin(-1)
    return torch.where(least.isinf(), 0.0, least)


def _maximise(envelope: Tensor, gaussians: Tensor, areas: Tensor) -> Tensor:
    """Amplitudes (..., k) of Gaussians (t, k) that explain what of an envelope (..., t) stands out from its end.

    A Gaussian that is 0 everywhere gets the amplitude 0.
    """
    scale = envelope[..., :1].clamp(min=torch.finfo(envelope.dtype).tiny)
    excess = (envelope - envelope[..., -1:]) / scale
    used = torch.nonzero(gaussians.amax(0))[:, 0]
    shapes = gaussians[:, used]
    amplitudes: Tensor = excess[..., :1].expand(*excess.shape[:-1], len(used)) / max(len(used), 1)
    share = shapes * areas[:, None]
    sweeps = SWEEPS if len(used) else 0
    for _ in range(sweeps):
        ratio = excess / (amplitudes @ shapes.T + TINY)
        amplitudes = amplitudes * (ratio @ share) / share.sum(0)
    for _ in range(sweeps):
        ratio = excess / (amplitudes @ shapes.T + TINY)
        amplitudes = amplitudes * torch.stack([ratio[..., support].amin(-1) for support in shapes.T > 0], -1)
    return torch.zeros(*excess.shape[:-1], gaussians.shape[1]).to(excess).index_copy(-1, used, amplitudes * scale)


def _rings(rim: float) -> tuple[Tensor, Tensor]:
    """Angles (t,) [rad] of rings around the mirror direction out to a rim in degrees, and their areas (t,) [sr]."""
    inner = torch.linspace(0, MIRROR, RINGS[0] + 1, dtype=torch.float64)
    outer = torch.linspace(MIRROR, rim, RINGS[1] + 1, dtype=torch.float64)
    edges = torch.cat((inner, outer[1:])).deg2rad()
    middle = (edges[1:] + edges[:-1]) / 2
    half = edges.diff() / 2
    return middle, 4 * math.pi * middle.sin() * half.sin()


def _around(axis: Tensor, rings: Tensor) -> Tensor:
    """Unit directions (..., t, turns, 3) on rings at angles (t,) [rad] from unit axes (..., 3)."""
    z = axis.new_tensor([0.0, 0.0, 1.0]).expand_as(axis)
    across = torch.linalg.cross(z, axis)
    length = across.norm(dim=-1, keepdim=True)
    x = torch.where(length > 1e-6, across / length.clamp(min=1e-6), axis.new_tensor([1.0, 0.0, 0.0]))
    y = torch.linalg.cross(axis, x)
    turns = (torch.arange(TURNS, dtype=torch.float64) + 0.5) * (2 * math.pi / TURNS)
    circle = turns.cos().to(axis)[:, None] * x[..., None, :] + turns.sin().to(axis)[:, None] * y[..., None, :]
    sin = rings.sin().to(axis)[:, None, None]
    cos = rings.cos().to(axis)[:, None, None]
    directions: Tensor = sin * circle[..., None, :, :] + cos * axis[..., None, None, :]
    return directions
