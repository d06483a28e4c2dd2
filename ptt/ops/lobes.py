"""Gaussian specular lobes: the sharp part of a BRDF, around the mirror direction (Sun et al. 2007, section 4.1).

    f(wi, wo) = sum over k of  a_k(wo) G_k(angle between wi and the mirror image of wo)  +  f_r(wi, wo)
    G_k(t) = exp(-t^2 / (2 s_k^2)) where t <= 3 s_k, else 0;  3 s_k = 7, 14, 21 degrees, and 3.5 for the lobe of "0"

The 0-degree lobe stands for a perfect mirror: it is narrower than a texel of a 6 x 64 x 64 cube map (1.4 degrees),
and its amplitude is that of a Gaussian with the same integral. The remainder f_r is never negative.

The amplitudes are what expectation-maximisation makes of the part of f that stands out: in rings around the mirror
direction, the least value of each ring, falling outwards, above the level at the rim of the widest lobe. A last
update takes the minimum where maximisation takes the mean, so that the sum of lobes stays below f everywhere.

Dempster et al. 1977; Sun et al. 2007, section 4.1 and Figure 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

ANGLES = (0.0, 7.0, 14.0, 21.0)  # degrees that three standard deviations cover
MIRROR = 3.5  # degrees: the 0-degree lobe takes what stands out inside, and is a Gaussian of that size
RIM = 10 / 7  # of the widest lobe: where the level is taken that lobes stand out from
RINGS = (24, 40)  # inside of MIRROR, and from there to the rim
TURNS = 24
SWEEPS = 40
TINY = 1e-30


class Lobes(NamedTuple):
    """amplitudes (k, ...) [1/sr], and the level (...) [1/sr] that the 0-degree lobe leaves inside of `MIRROR`."""

    amplitudes: Tensor
    level: Tensor


def separate(f: Callable[[Tensor, Tensor], Tensor], wo: Tensor, angles: Sequence[float] = ANGLES) -> Lobes:
    """The lobes of a BRDF f(wi, wo) [1/sr] for outgoing directions wo (..., 3) above the horizon.

    angles (k): ascending, in degrees; with none, nothing is separated
    """
    wide = torch.tensor([a for a in angles if a > 0], dtype=torch.float64)
    if not angles:
        return Lobes(wo.new_zeros(0, *wo.shape[:-1]), wo.new_full(wo.shape[:-1], math.inf))
    rings, areas = _rings(RIM * max(*angles, 2 * MIRROR))
    directions = _around(mirror(wo), rings)
    above = directions[..., 2] > 0
    values = f(directions, wo[..., None, None, :]) * above  # shape: (..., t, turns)
    envelope = values.masked_fill(~above, math.inf).amin(-1)
    envelope = torch.where(envelope.isinf(), 0.0, envelope).cummin(-1).values
    gaussians = gaussian(rings[:, None], wide).to(wo)  # shape: (t, k)
    amplitudes = _maximise(envelope, gaussians, areas.to(wo))
    level = values.new_full(wo.shape[:-1], math.inf)
    if len(wide) < len(angles):
        inside, smooth = RINGS[0], amplitudes @ gaussians.T
        level = (envelope - smooth)[..., inside:].amax(-1)
        over = ((values - smooth[..., None] - level[..., None, None]).clamp(min=0) * above).mean(-1)
        mass = over[..., :inside] @ areas[:inside].to(wo)
        amplitudes = torch.cat((mass[..., None] / integral(0.0), amplitudes), -1)
    return Lobes(amplitudes.movedim(-1, 0), level)


def remainder(values: Tensor, wi: Tensor, wo: Tensor, lobes: Lobes, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_r (...) from f's values (...) at wi and wo (..., 3), with the lobes (k, ...) of wo.

    Between the rings that lobes were fitted on, a lobe may pass f by some 1e-5 of it: f_r is 0 there.
    """
    angle = from_mirror(wi, wo)
    for a, amplitude in zip(angles, lobes.amplitudes, strict=True):
        if a > 0:
            values = values - amplitude * gaussian(angle, a)
    inside = angle < math.radians(MIRROR)
    return torch.where(inside, torch.minimum(values, lobes.level), values).clamp(min=0)


def evaluate(amplitudes: Tensor, wi: Tensor, wo: Tensor, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_s (...) [1/sr] at wi and wo (..., 3), from the amplitudes (k, ...) of wo; not cut at the horizon."""
    angle = from_mirror(wi, wo)
    parts = [amplitude * gaussian(angle, a) for a, amplitude in zip(angles, amplitudes, strict=True)]
    return torch.stack(parts).sum(0) if parts else torch.zeros_like(angle)


def gaussian(angle: Tensor, lobe: float | Tensor) -> Tensor:
    """G_k at angles [rad] from the mirror direction; lobe: k in degrees."""
    x = angle / sigma(lobe)
    return torch.exp(-x * x / 2) * (x <= 3)


def sigma(lobe: float | Tensor) -> float | Tensor:
    """Standard deviation [rad] of the lobe that covers so many degrees."""
    degrees = lobe if isinstance(lobe, Tensor) else (lobe or MIRROR)
    return degrees * (math.pi / 540)


def integral(lobe: float) -> float:
    """Of G_k over directions [sr]."""
    t = torch.linspace(0, 3 * float(sigma(lobe)), 1001, dtype=torch.float64)
    return float(torch.trapezoid(2 * math.pi * t.sin() * gaussian(t, lobe), t))


def mirror(wo: Tensor) -> Tensor:
    """The mirror image (..., 3) of wo about the normal."""
    return wo * wo.new_tensor([-1.0, -1.0, 1.0])


def from_mirror(wi: Tensor, wo: Tensor) -> Tensor:
    """Angle (...) [rad] between wi and the mirror image of wo, exact also where it is small."""
    m = mirror(wo)
    return torch.atan2(torch.linalg.cross(*torch.broadcast_tensors(wi, m)).norm(dim=-1), (wi * m).sum(-1))


def _maximise(envelope: Tensor, gaussians: Tensor, areas: Tensor) -> Tensor:
    """Amplitudes (..., k) of Gaussians (t, k) that explain what of an envelope (..., t) stands out from its end.

    Rings that no Gaussian reaches take no part. First the mean update of EM, which keeps the integral, then the
    minimum over each Gaussian's support, which keeps the sum below the envelope.
    """
    excess = envelope - envelope[..., -1:]
    count = gaussians.shape[1]
    amplitudes: Tensor = excess[..., :1].expand(*excess.shape[:-1], count) / max(count, 1)
    reached, share = gaussians > 0, gaussians * areas[:, None]
    for _ in range(SWEEPS if count else 0):
        ratio = excess / (amplitudes @ gaussians.T + TINY)
        amplitudes = amplitudes * (ratio @ share) / share.sum(0)
    for _ in range(SWEEPS if count else 0):
        ratio = excess / (amplitudes @ gaussians.T + TINY)
        least = torch.stack([ratio[..., support].amin(-1) for support in reached.T], -1)
        amplitudes = amplitudes * least
    return amplitudes


def _rings(rim: float) -> tuple[Tensor, Tensor]:
    """Angles (t,) [rad] of rings around the mirror direction out to a rim in degrees, and their areas (t,) [sr]."""
    edges = torch.cat(
        (
            torch.linspace(0, MIRROR, RINGS[0] + 1, dtype=torch.float64),
            torch.linspace(MIRROR, rim, RINGS[1] + 1, dtype=torch.float64)[1:],
        )
    ).deg2rad()
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
