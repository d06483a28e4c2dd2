"""The reflection of Mitsuba 3's BSDFs as functions of local directions, where no shape of ptt's own is theirs.

Each is a small frozen dataclass that is called as f(wi, wo) [1/sr], without the cosine, for unit directions (..., 3) of
which z is the normal; `named` makes a shape of one. Facets reflect F D G / (4 cos cos) with Smith's masking of each
direction by itself, where `ptt.ops.brdf.ggx` has the height-correlated one.

Walter, Marschner, Li and Torrance 2007; Burley 2012 and 2015 (`principled`); Mitsuba's own source for all constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ptt.materials.shapes import Named
from ptt.ops.brdf import half_vector

LEAST = 1e-6  # cosines are raised to this before they divide


def named(function: Callable[[Tensor, Tensor], Tensor], isotropic: bool = True) -> Named:
    """The shape of one of the functions below: its name holds all of the parameters."""
    return Named(repr(function), function, isotropic)


@dataclass(frozen=True)
class Facets:
    """D G / (4 cos cos): facets that reflect all of the light.

    alpha_u, alpha_v: slopes along tangent and bitangent; ggx: says whether they are GGX, else Beckmann's
    """

    alpha_u: float
    alpha_v: float
    ggx: bool

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        h = half_vector(wi, wo)
        slope2 = (h[..., 0] / self.alpha_u) ** 2 + (h[..., 1] / self.alpha_v) ** 2
        cos2 = h[..., 2].clamp(min=LEAST) ** 2
        d = (slope2 + cos2) ** -2 if self.ggx else torch.exp(-slope2 / cos2) / cos2**2
        flat = 4 * math.pi * self.alpha_u * self.alpha_v * _cos(wi) * _cos(wo)
        return d * self._seen(wi) * self._seen(wo) / flat

    def _seen(self, v: Tensor) -> Tensor:
        """Smith's share (...) of the facets that a direction sees; Beckmann's by Walter's rational function."""
        tan2 = ((self.alpha_u * v[..., 0]) ** 2 + (self.alpha_v * v[..., 1]) ** 2) / _cos(v) ** 2
        if self.ggx:
            return 2 / (1 + (1 + tan2).sqrt())
        a = tan2.clamp(min=1e-12).rsqrt()
        return torch.where(a >= 1.6, 1.0, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2))


@dataclass(frozen=True)
class ConductorFacets:
    """Facets of a metal, of the complex index of refraction eta + i k in one colour."""

    facets: Facets
    eta: float
    k: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        return self.facets(wi, wo) * fresnel_conductor(_cos_half(wi, wo), self.eta, self.k)


@dataclass(frozen=True)
class DielectricFacets:
    """Facets of a dielectric, of relative index of refraction eta."""

    facets: Facets
    eta: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        return self.facets(wi, wo) * fresnel(_cos_half(wi, wo), self.eta)


@dataclass(frozen=True)
class GrazingFacets:
    """Facets that reflect grazing light alone: Schlick's (1 - cos)^5, of the refracted angle where eta < 1."""

    facets: Facets
    eta: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        cos = _cos_half(wi, wo)
        if self.eta < 1:
            cos = _refracted(cos, self.eta)
        return self.facets(wi, wo) * schlick(cos)


@dataclass(frozen=True)
class Beneath:
    """t(wi) t(wo) / pi: matt light from beneath a smooth interface of relative index eta, t = 1 - Fresnel."""

    eta: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        return self.through(_cos(wi)) * self.through(_cos(wo)) / math.pi

    def through(self, cos: Tensor) -> Tensor:
        """The share (...) of the light that the interface lets through at cosines (...)."""
        return 1 - fresnel(cos, self.eta)


@dataclass(frozen=True)
class BeneathRough:
    """The same beneath a rough interface.

    facets, eta: those of the interface
    table: t at even cosines from 0 to 1, linear in between, 1 straight on
    """

    facets: Facets
    eta: float
    table: tuple[float, ...] = field(repr=False)

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        return self.through(wi[..., 2]) * self.through(wo[..., 2]) / math.pi

    def through(self, cos: Tensor) -> Tensor:
        """What the interface lets through (...) at cosines (...), relative to straight on."""
        values = torch.tensor(self.table, dtype=cos.dtype, device=cos.device)
        at = cos.clamp(0, 1) * (len(values) - 1)
        low = at.long().clamp(max=len(values) - 2)
        return torch.lerp(values[low], values[low + 1], at - low)


@dataclass(frozen=True)
class PrincipledDiffuse:
    """The diffuse part of `principled`, for a white base colour: retro-reflection, and its flattened form."""

    roughness: float
    flatness: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        fi = schlick(wi[..., 2])
        fo = schlick(wo[..., 2])
        retro = 2 * self.roughness * _cos_half(wi, wo) ** 2
        rough = (1 - fi / 2) * (1 - fo / 2) + retro * (fo + fi + fo * fi * (retro - 1))
        inside = (1 + fo * (retro / 2 - 1)) * (1 + fi * (retro / 2 - 1))
        flat = 1.25 * (inside * (1 / (_cos(wi) + _cos(wo)) - 0.5) + 0.5)
        return (rough + self.flatness * (flat - rough)) / math.pi


@dataclass(frozen=True)
class PrincipledCoat:
    """The clear coat of `principled`, of weight 1: GTR1 of slope alpha, masked as GGX of slope 1/4."""

    alpha: float

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        less = self.alpha**2 - 1
        cos2 = half_vector(wi, wo)[..., 2] ** 2
        d = less / (math.pi * math.log(self.alpha**2) * (1 + less * cos2))
        grazing = schlick(_cos_half(wi, wo))
        mask = Facets(0.25, 0.25, True)
        return 0.25 * d * (0.04 + 0.96 * grazing) * mask._seen(wi) * mask._seen(wo)


@dataclass(frozen=True)
class PrincipledSheen:
    """The sheen of `principled`, of weight 1."""

    def __call__(self, wi: Tensor, wo: Tensor) -> Tensor:
        return schlick(_cos_half(wi, wo))


def fresnel(cos: Tensor, eta: float) -> Tensor:
    """What a dielectric of relative index of refraction eta reflects (...) at cosines (...) >= 0, unpolarised."""
    inside = _refracted(cos, eta)
    across = (cos - eta * inside) / (cos + eta * inside)
    along = (eta * cos - inside) / (eta * cos + inside)
    return (across**2 + along**2) / 2


def fresnel_conductor(cos: Tensor, eta: float, k: float) -> Tensor:
    """What a metal of index of refraction eta + i k reflects (...) at cosines (...) > 0, unpolarised."""
    cos2 = cos**2
    sin2 = 1 - cos2
    real = eta**2 - k**2 - sin2
    size = (real**2 + (2 * eta * k) ** 2).sqrt()
    a = ((size + real) / 2).clamp(min=0).sqrt()
    twice = 2 * cos * a
    across = (size + cos2 - twice) / (size + cos2 + twice)
    along = across * (size * cos2 + sin2**2 - twice * sin2) / (size * cos2 + sin2**2 + twice * sin2)
    return (across + along) / 2


def schlick(cos: Tensor) -> Tensor:
    """(1 - cos)^5 (...)."""
    return (1 - cos).clamp(0, 1) ** 5


def _refracted(cos: Tensor, eta: float) -> Tensor:
    """The cosine (...) of the refracted direction, 0 where all of the light is reflected."""
    return (1 - (1 - cos**2) / eta**2).clamp(min=0).sqrt()


def _cos(v: Tensor) -> Tensor:
    """The cosine (...) to the normal, kept from 0."""
    return v[..., 2].clamp(min=LEAST)


def _cos_half(wi: Tensor, wo: Tensor) -> Tensor:
    """The cosine (...) between either direction and their half vector."""
    length: Tensor = (wi + wo).norm(dim=-1)
    return (length / 2).clamp(LEAST, 1)
