"""Random directions with known densities, in the local frame (z is the normal); pure functions of uniform numbers.

A `Mixture` draws from the cosine hemisphere or reflects the outgoing direction about a half vector drawn from a lobe.
Densities are per solid angle [1/sr], over the whole sphere: a reflected direction may lie below the horizon, where
BRDFs are zero. Laws, for every mixture and every wo above the horizon:

- the density integrates to 1 over the sphere
- directions drawn by `sample` have that density

Example:
    >>> mixture = Mixture((PowerLobe(100.0),), (0.5,))
    >>> wo = torch.tensor([[0.0, 0.6, 0.8]])
    >>> wi = mixture.sample(torch.tensor([[0.2, 0.0, 0.0]]), wo)  # reflected about the normal itself
    >>> [round(c, 6) for c in wi[0].tolist()]
    [0.0, -0.6, 0.8]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from ptt.ops.brdf import half_vector

NARROW = 1e-6  # the least cosine by which a density is divided


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Unit directions (n, 3) above the horizon with density cos / pi; u (n, 2) uniform in [0, 1)."""
    return _around_z(u[:, 0], u[:, 1])


def cosine_density(wi: Tensor) -> Tensor:
    """The density (n,) of `cosine_hemisphere` at wi (n, 3): cos / pi, 0 below the horizon."""
    return wi[..., 2].clamp(min=0) / math.pi


@dataclass(frozen=True)
class PowerLobe:
    """Half vectors with density (n + 1) / (2 pi) cos(th_h)^n: those of Blinn-Phong with the exponent n >= 0."""

    exponent: float | Tensor

    def sample(self, u: Tensor) -> Tensor:
        """Half vectors (n, 3), unit, above the horizon, for u (n, 2) uniform in [0, 1)."""
        return _around_z(-torch.expm1(torch.log1p(-u[:, 0]) * (2 / (self.exponent + 1))), u[:, 1])

    def density(self, h: Tensor) -> Tensor:
        """The density (n,) of h (n, 3) and of -h; it takes sin^2 from x and y, as 1 - z^2 cancels for narrow lobes."""
        log_cos2 = torch.log1p(-_sin2(h).clamp(max=1 - NARROW))
        return torch.exp(log_cos2 * (self.exponent / 2)) * ((self.exponent + 1) / (2 * math.pi))


@dataclass(frozen=True)
class BeckmannLobe:
    """Half vectors with density exp(-(hx^2 / mx^2 + hy^2 / my^2) / hz^2) / (pi mx my hz^3): Beckmann's facets, Ward's.

    mx, my: slopes along tangent and bitangent, > 0; my defaults to mx (isotropic)

    hx/hz and hy/hz are normally distributed, with variances mx^2 / 2 and my^2 / 2.

    Ward 1992; Walter, Marschner, Li and Torrance 2007, equations 28, 29.
    """

    mx: float | Tensor
    my: float | Tensor | None = None

    def sample(self, u: Tensor) -> Tensor:
        """Half vectors (n, 3), unit, above the horizon, for u (n, 2) uniform in [0, 1)."""
        return _facets((-torch.log1p(-u[:, 0])).sqrt(), u[:, 1], *self._slopes())

    def density(self, h: Tensor) -> Tensor:
        """The density (n,) of h (n, 3) and of -h."""
        mx, my = self._slopes()
        cos = h[..., 2].abs().clamp(min=NARROW)
        slope2 = ((h[..., 0] / mx) ** 2 + (h[..., 1] / my) ** 2) / cos**2
        return torch.exp(-slope2) / (math.pi * mx * my * cos**3)

    def _slopes(self) -> tuple[float | Tensor, float | Tensor]:
        return self.mx, self.mx if self.my is None else self.my


@dataclass(frozen=True)
class GGXLobe:
    """Half vectors with density D cos(th_h), D = a^2 / (pi (a^2 cos^2 th_h + sin^2 th_h)^2) and a = roughness^2 > 0.

    Trowbridge and Reitz 1975; Walter, Marschner, Li and Torrance 2007, equations 33, 35, 36.
    """

    roughness: float | Tensor

    def sample(self, u: Tensor) -> Tensor:
        """Half vectors (n, 3), unit, above the horizon, for u (n, 2) uniform in [0, 1)."""
        a = self.roughness**2
        return _facets((u[:, 0] / (1 - u[:, 0])).sqrt(), u[:, 1], a, a)

    def density(self, h: Tensor) -> Tensor:
        """The density (n,) of h (n, 3) and of -h."""
        a = self.roughness**2
        cos = h[..., 2].abs()
        return (a / ((a * cos) ** 2 + _sin2(h))) ** 2 * cos / math.pi


Lobe = PowerLobe | BeckmannLobe | GGXLobe


@dataclass(frozen=True)
class Mixture:
    """The cosine hemisphere, and with probability `shares[k]` reflection about half vectors from `lobes[k]`."""

    lobes: tuple[Lobe, ...] = ()
    shares: tuple[float, ...] = ()

    def sample(self, u: Tensor, wo: Tensor) -> Tensor:
        """Unit directions wi (n, 3) for wo (n, 3); u (n, 3) uniform in [0, 1): the first chooses, the others place."""
        wi = cosine_hemisphere(u[:, 1:])
        for lobe, end in reversed(list(zip(self.lobes, accumulate(self.shares), strict=True))):
            wi = torch.where(u[:, :1] < end, reflect(wo, lobe.sample(u[:, 1:])), wi)
        return wi

    def density(self, wi: Tensor, wo: Tensor) -> Tensor:
        """Density (n,) [1/sr] of wi (n, 3) for wo (n, 3)."""
        density = (1 - sum(self.shares)) * cosine_density(wi)
        for lobe, share in zip(self.lobes, self.shares, strict=True):
            density = density + share * reflected_density(lobe, wi, wo)
        return density


def reflect(wo: Tensor, h: Tensor) -> Tensor:
    """The mirror image (n, 3) of wo (n, 3) about h (n, 3), which is the same about -h."""
    return 2 * (wo * h).sum(-1, keepdim=True) * h - wo


def reflected_density(lobe: Lobe, wi: Tensor, wo: Tensor) -> Tensor:
    """Density (n,) of wi = reflect(wo, h) with h drawn from the lobe: the density of h times 1 / (4 |wo.h|)."""
    h = half_vector(wi, wo)
    return lobe.density(h) / (4 * (wo * h).sum(-1).clamp(min=NARROW))


def _around_z(sin2: Tensor, turn: Tensor) -> Tensor:
    """Unit vectors (n, 3) above the horizon, by the squared sine of their angle to z and their turn (0..1) around z."""
    sin = sin2.sqrt()
    angle = turn * (2 * math.pi)
    return torch.stack([sin * angle.cos(), sin * angle.sin(), (1 - sin2).clamp(min=0).sqrt()], -1)


def _facets(slope: Tensor, turn: Tensor, mx: float | Tensor, my: float | Tensor) -> Tensor:
    """Unit vectors (n, 3) along (mx slope cos, my slope sin, 1) for turns (0..1) around z."""
    angle = turn * (2 * math.pi)
    x = mx * slope * angle.cos()
    y = my * slope * angle.sin()
    return torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)


def _sin2(h: Tensor) -> Tensor:
    """sin^2 of the angle to z."""
    return h[..., 0] ** 2 + h[..., 1] ** 2
