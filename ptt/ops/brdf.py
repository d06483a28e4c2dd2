"""Analytic BRDFs: f(wi, wo) in 1/sr without the cosine, monochrome, in the local frame (z is the normal).

Every function takes unit directions wi (..., 3) and wo (..., 3) that point away from the surface and parameters
that broadcast against (...); it returns (...), zero where either direction is at or below the horizon, and is
differentiable in its parameters. Reciprocal: f(wi, wo) = f(wo, wi).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def lambert(wi: Tensor, wo: Tensor) -> Tensor:
    """1/pi: reflects all of the light, equally in all directions (albedo 1)."""
    return _above(wi, wo) / math.pi


def blinn_phong(wi: Tensor, wo: Tensor, exponent: Tensor | float) -> Tensor:
    """Normalised Blinn-Phong: c(n) cos(th_h)^n, with c(n) = (n + 2)(n + 4) / (8 pi (n + 2^(-n/2))).

    exponent: n >= 0. The albedo is exactly 1 at normal incidence for every n and falls off towards grazing
    (n = 0 is Lambert: 1 everywhere).

    Blinn 1977; the normalisation is Sloan's and Hoffman's exact integral (Real-Time Rendering, 3rd ed., 7.6).
    """
    n = torch.as_tensor(exponent, dtype=wi.dtype, device=wi.device)
    scale = (n + 2) * (n + 4) / (8 * math.pi * (n + torch.exp2(-n / 2)))
    h = half_vector(wi, wo)
    log_cos2 = torch.log1p(-_sin2(h).clamp(max=1 - 1e-30 if h.dtype == torch.float64 else 1 - 1e-7))
    return scale * torch.exp(n / 2 * log_cos2) * _above(wi, wo)


def cook_torrance(wi: Tensor, wo: Tensor, f0: Tensor | float, m: Tensor | float) -> Tensor:
    """Cook-Torrance in the convention of Ngan et al. 2005: D F G / (pi^2 (n.l)(n.v)).

    D = exp(-tan^2 th_h / m^2) / (m^2 cos^4 th_h), Beckmann; F = f0 + (1 - f0)(1 - v.h)^5, Schlick;
    G = min(1, 2 n.h n.v / v.h, 2 n.h n.l / v.h), V-grooves.

    f0: reflectance at normal incidence, 0..1. m: slope of the facets, > 0 (the fitted table has 0.01..0.6).
    At f0 = 1 and small m the albedo at normal incidence is 4 / pi: the convention's 1/pi^2 stands where the
    energy-conserving form has 1/(4 pi), so a specular weight of pi/4 reflects all of the light.

    Cook and Torrance 1981; Ngan, Durand and Matusik 2005.
    """
    f0, m = (torch.as_tensor(p, dtype=wi.dtype, device=wi.device) for p in (f0, m))
    h = half_vector(wi, wo)
    nh, nl, nv = h[..., 2].clamp(min=1e-12), wi[..., 2].clamp(min=0), wo[..., 2].clamp(min=0)
    vh = (wo * h).sum(-1).clamp(min=1e-12)
    d = torch.exp(-_sin2(h) / (nh * m) ** 2) / (m * nh * nh) ** 2
    f = f0 + (1 - f0) * (1 - vh).clamp(min=0) ** 5
    grazing = 2 * nh / (vh * torch.maximum(nl, nv).clamp(min=1e-12))  # G / (n.l n.v) where a groove blocks
    g = torch.minimum(1 / (nl * nv).clamp(min=1e-24), grazing)
    return d * f * g * _above(wi, wo) / math.pi**2


def half_vector(wi: Tensor, wo: Tensor) -> Tensor:
    """The unit vector between wi and wo (..., 3); the normal where they are opposite."""
    h = wi + wo
    length = h.norm(dim=-1, keepdim=True)
    return torch.where(length > 1e-12, h / length.clamp(min=1e-12), h.new_tensor([0.0, 0.0, 1.0]))


def _sin2(h: Tensor) -> Tensor:
    """sin^2 of the angle to the normal, from x and y: 1 - z^2 would cancel for narrow lobes."""
    return h[..., 0] ** 2 + h[..., 1] ** 2


def _above(wi: Tensor, wo: Tensor) -> Tensor:
    return ((wi[..., 2] > 0) & (wo[..., 2] > 0)).to(wi.dtype)
