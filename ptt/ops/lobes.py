"""Gaussian specular lobes: the sharp part of a BRDF, about axes near the mirror direction (Sun et al. 2007, 4.1).

    f_s(wi, wo) cos(wi) ~ sum over k of  rho_k(wo) G_k(angle between wi and a_k(wo)) / integral of G_k
    G_k(t) = exp(-t^2 / (2 s_k^2)) where t <= 3 s_k, else 0;  3 s_k = 7, 14, 21 degrees, and 3.5 for the lobe of "0"

The 0-degree lobe stands for a perfect mirror: it is about as wide as a texel of a 6 x 64 x 64 cube map (1.4 degrees).
rho_k is a reflectance: it lies between 0 and the albedo of f, so it interpolates well towards grazing, where amplitudes
would grow without bound. The axis a_k is the mirror image of wo, leant towards the normal or from it in the plane of
the two: near the horizon, which cuts lobes, light comes from above the mirror direction. `ops.separation` finds both.

Tables hold rho and the axes for angles of wo to the normal, and rho for azimuths too (`tilts_and_turns`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from ptt.ops import harmonics
from ptt.ops.constants import TINY
from ptt.ops.octahedral import sampled

ANGLES = (0.0, 7.0, 14.0, 21.0)  # degrees that three standard deviations cover
MIRROR = 3.5  # degrees that the 0-degree lobe covers
ISOTROPIC = (1, 64)  # azimuths and tilts of wo at which the lobes of isotropic BRDFs are tabulated
ANISOTROPIC = (24, 32)  # azimuths and tilts of wo for other BRDFs


def evaluate(reflected: Tensor, axes: Tensor, wi: Tensor, wo: Tensor, angles: Sequence[float] = ANGLES) -> Tensor:
    """f_s (...) [1/sr] at wi and wo (..., 3), the sum of round lobes; the horizon does not cut it.

    reflected (k, ...): fractions rho_k of the light from wo
    axes (2, k, t): table of the axes (`lean`)
    """
    towards = lean(axes, wo)
    value = torch.zeros_like(wi[..., 0] + wo[..., 0])
    for k, (angle, reflectance) in enumerate(zip(angles, reflected, strict=True)):
        axis = towards[..., k, :]
        value = value + reflectance / response(axis, angle) * gaussian(angle_between(wi, axis), angle)
    return value


def lean(axes: Tensor, wo: Tensor) -> Tensor:
    """Axes a_k (..., k, 3), about unit, for directions wo (..., 3): (-along x, -along y, up).

    axes (2, k, t): along and up by the tilt of wo; 1 and the cosine of that tilt give the mirror direction

    A direction below the horizon has the axes of its mirror image above.
    """
    along, up = lookup(axes.flatten(0, 1)[:, None], wo).chunk(2)  # shape: (k, ...)
    x, y, _ = wo.unbind(-1)
    return torch.stack((-along * x, -along * y, up)).movedim((0, 1), (-1, -2))


def tilts_and_turns(isotropic: bool) -> Tensor:
    """Outgoing directions (p, t, 3) of a table: p azimuths (one for an isotropic BRDF) by t angles to the normal."""
    p, t = ISOTROPIC if isotropic else ANISOTROPIC
    phi = torch.arange(p, dtype=torch.float64) * (2 * math.pi / p)
    theta = (torch.arange(t, dtype=torch.float64) + 0.5) * (math.pi / 2 / t)
    sin = theta.sin()
    return torch.stack((phi.cos()[:, None] * sin, phi.sin()[:, None] * sin, theta.cos().expand(p, -1)), -1)


def lookup(table: Tensor, wo: Tensor) -> Tensor:
    """Bilinear values (k, ...) of a table (k, p, t) over `tilts_and_turns`, at directions wo (..., 3).

    A direction below the horizon has the values of its mirror image above.
    """
    k, turns, _ = table.shape
    x, y, z = wo.unbind(-1)
    tilt = torch.atan2((x * x + y * y).sqrt(), z.abs()) * (4 / math.pi) - 1
    turn = torch.zeros_like(tilt)
    if turns > 1:
        table = torch.cat((table[:, -1:], table, table[:, :1]), 1)
        turn = (torch.atan2(y, x) * (turns / (2 * math.pi)) % turns * 2 + 3) / (turns + 2) - 1
    rows = math.prod(x.shape[:-1]), math.prod(x.shape[-1:])
    at = torch.stack((tilt, turn)).reshape(2, *rows).transpose(0, 1)  # shape: (b, 2, w)
    values = sampled(table.to(at).expand(len(at), -1, -1, -1), at)
    return values.transpose(0, 1).reshape(k, *x.shape)


def gaussian(angle: Tensor, lobe: float) -> Tensor:
    """G_k at angles (...) [rad] from its axis; lobe: the degrees that it covers."""
    x = angle / sigma(lobe)
    return torch.exp(-x * x / 2) * (x <= 3)


def sigma(lobe: float) -> float:
    """Standard deviation [rad] of the lobe that covers so many degrees."""
    return math.radians(lobe or MIRROR) / 3


@cache
def integral(lobe: float) -> float:
    """The integral of G_k over directions [sr]."""
    t = torch.linspace(0, 3 * sigma(lobe), 1001, dtype=torch.float64)
    return float(torch.trapezoid(2 * math.pi * t.sin() * gaussian(t, lobe), t))


@cache
def zonal(lobe: float, order: int) -> Tensor:
    """Factors (order,) by which G_k scales harmonics of each degree: means of P_l(cos t) under it; 1 for a mirror."""
    if lobe == 0:
        return torch.ones(order, dtype=torch.float64)
    t = torch.linspace(0, 3 * sigma(lobe), 1001, dtype=torch.float64)
    weight = t.sin() * gaussian(t, lobe)
    legendre = harmonics.zonal(t, order)
    return torch.trapezoid(weight * legendre, t) / torch.trapezoid(weight, t)


def response(axis: Tensor, lobe: float) -> Tensor:
    """Integrals (...) [sr] of G_k cos(th_i) over the hemisphere about axes (..., 3); at 0 degrees those of a mirror."""
    if lobe == 0:
        return integral(0.0) * axis[..., 2].clamp(min=TINY)
    return lookup(_responses(lobe).to(axis), axis)[0]


@cache
def _responses(lobe: float, tilts: int = 512, rings: int = 128, turns: int = 128) -> Tensor:
    """Table (1, 1, tilts) of `response` over angles of the axis to the normal."""
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
    return angle_between(wi, mirror(wo))


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Angle (...) [rad] between directions (..., 3), exact also where it is small."""
    return torch.atan2(torch.linalg.cross(*torch.broadcast_tensors(a, b)).norm(dim=-1), (a * b).sum(-1))
