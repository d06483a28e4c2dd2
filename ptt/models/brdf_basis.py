"""A BRDF space in a few functions, lobes included: what indirect light reflects by (Sun et al. 2007, section 4.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ptt.materials.material import Material
from ptt.materials.shapes import Shape
from ptt.materials.spaces import BRDF, BRDFSpace
from ptt.ops import brdf
from ptt.ops.albedo import gauss_legendre, nodes

FUNCTIONS = 4
ENERGY = 4.0  # how much more than its shape an albedo counts
BANDS = 8  # of cells from the normal to the horizon: as wide as a texel of a cube map of 8 x 8, 11 degrees
TILTS = 24
TURNS = 7  # outgoing directions: by projected solid angle, and around the normal
FINEST = 1e-4
RINGS = 48
ARCS = 24  # of the quadrature over incident directions (`ops.albedo.nodes`)


class BRDFBasis(nn.Module):
    """f(wi, wo) ~ sum over p of H[p, c] b_p(wi, wo), b_0 = 1/pi, b_p = sum over h of mixture[h, p] f_h(wi, wo).

    space: the samples f_h
    mixture (h, p), table (h, p): of the specular functions, p of them, and the coefficients of every sample
    error (h,): |f_h - its approximation| / |f_h|, in the norm of the fit

    The norm has two scales, as indirect light comes as texels, and most receivers see little more than its sum:
    |f|^2 = integral over wo, by projected solid angle, of sum over C of r(C)^2 / solid angle of C + (ENERGY r)^2 / pi.
    r(C) = integral over C of f(wi, wo) cos(wi) dwi, C one of 163 cells of incident directions, 11 degrees wide; r, the
    sum of all, is the albedo. Lambert's 1/pi has norm 4.08. In this norm, the specular functions are the uncentred
    principal components of the samples, scaled to norm 1: orthonormal, linear, and zero is zero. Weights and colours
    stay outside.

    Example:
        >>> basis = BRDFBasis.fit(BRDFSpace.blinn_phong((2.0, 8.0, 32.0)), functions=3)
        >>> basis.coefficients(blinn_phong(0.2, 0.5, exponent=20.0)).shape
        torch.Size([4, 3])
    """

    mixture: Tensor
    table: Tensor
    error: Tensor

    def __init__(self, space: BRDFSpace, mixture: Tensor, table: Tensor, error: Tensor) -> None:
        super().__init__()
        self.space = space
        for name, tensor in {"mixture": mixture, "table": table, "error": error}.items():
            self.register_buffer(name, tensor)

    @classmethod
    def fit(cls, space: BRDFSpace, functions: int = FUNCTIONS) -> BRDFBasis:
        """The principal components of a space in the norm above, by a quadrature that resolves its lobes.

        functions: how many specular ones; where the space has fewer independent samples, the rest are zero

        Raises:
            ValueError: not in 1..samples.
        """
        if not 1 <= functions <= len(space.samples):
            raise ValueError(f"functions must be in 1..{len(space.samples)}, the samples, got {functions}")
        features = _features(space.samples)
        norms = features.norm(dim=1, keepdim=True).clamp(min=1e-300)
        size, vectors = principal(features / norms @ (features / norms).T, functions)
        mixture = vectors / size.clamp(min=1e-300).sqrt() * (size > 1e-13 * size[0]) / norms
        return cls(space, *_described(features, mixture, features))

    def with_brdf(self, name: str, brdf: BRDF | Material) -> BRDFBasis:
        """One more sample, a function f(wi, wo) or a material's shape by name, in the same functions.

        The functions stay, so what was precomputed with them does too; look at `error[-1]`.
        """
        space = self.space.with_brdf(name, brdf)
        features = _features(space.samples)
        mixture = nn.functional.pad(self.mixture.double(), (0, 0, 0, 1))
        mixture, table, error = _described(features, mixture, features[-1:])
        return BRDFBasis(space, mixture, torch.cat((self.table, table)), torch.cat((self.error, error)))

    def coefficients(self, material: Material) -> Tensor:
        """H (1 + p, 3) of a material, also between samples; differentiable in its weights and parameters."""
        specular = material.specular.to(self.table)
        row = self.table.new_zeros(self.table.shape[1]) if material.shape is None else self.of_shape(material.shape)
        return torch.cat((material.diffuse.to(self.table)[None], row[:, None] * specular))

    def of_shape(self, shape: Shape | Tensor) -> Tensor:
        """Coefficients (p,) of a shape, or of its coordinates (h,) in the space."""
        return self.space.resolved(shape).to(self.table) @ self.table

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """The functions (..., 1 + p) [1/sr] at local unit directions (..., 3), exact: sample by sample."""
        diffuse = brdf.lambert(*torch.broadcast_tensors(wi, wo))[..., None]
        specular = torch.zeros_like(diffuse).expand(*diffuse.shape[:-1], self.mixture.shape[1])
        for shape, weights in zip(self.space.samples, self.mixture.to(wi), strict=True):
            specular = specular + shape.evaluate(wi, wo)[..., None] * weights
        return torch.cat((diffuse, specular), -1)


def principal(gram: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The largest eigenvalues (p,), descending, and their vectors (h, p) of a float64 Gram matrix (h, h)."""
    values, vectors = torch.linalg.eigh(gram)
    return values.flip(0)[:count].clamp(min=0), vectors.flip(1)[:, :count]


def _described(features: Tensor, mixture: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mixture, coefficients and errors, float32, of wanted BRDFs (k, m) in functions mixed of others (h, m).

    Functions whose large parts of opposite sign cancel are orthonormal only as far as float32 holds the mixture: the
    coefficients solve for the functions as they are.
    """
    mixture = mixture.float()
    functions = mixture.double().T @ features
    overlaps = torch.linalg.pinv(functions @ functions.T, rtol=1e-9, hermitian=True)
    table = wanted @ functions.T @ overlaps
    error = (wanted - table @ functions).norm(dim=1) / wanted.norm(dim=1).clamp(min=1e-300)
    return mixture, table.float(), error.float()


def _features(samples: Sequence[Shape]) -> Tensor:
    """Of f_h (h, m), for every wo: what cells, then all of them, reflect, such that dot products are the norm's."""
    wo, outgoing = _outgoing()
    wi, incident = nodes(wo, FINEST, RINGS, ARCS)
    weights = outgoing[:, None] * incident
    cells, count = _cells(wi)
    cells = (cells + count * torch.arange(len(wo))[:, None]).flatten()
    count = count * len(wo)
    solid = cells.bincount((weights / wi[..., 2].clamp(min=1e-9)).flatten(), count)  # angles, times outgoing

    def seen(shape: Shape) -> Tensor:
        step = TURNS if shape.isotropic else 1  # the nodes turn with wo
        values = shape.evaluate(wi[::step], wo[::step, None].expand_as(wi[::step])).repeat_interleave(step, 0)
        reflected = cells.bincount((values * weights).flatten(), count)
        albedo = reflected.view(len(wo), -1).sum(1) / outgoing
        return torch.cat((reflected / solid.sqrt().clamp(min=1e-300), ENERGY * albedo * (outgoing / math.pi).sqrt()))

    return torch.stack([seen(shape) for shape in samples])


def _outgoing() -> tuple[Tensor, Tensor]:
    """Outgoing directions (o, 3), and their projected solid angles (o,)."""
    sin2, weights = gauss_legendre(TILTS, torch.zeros(0).double())
    sin, turns = torch.cartesian_prod(sin2.sqrt(), torch.arange(TURNS).double() * (2 * math.pi / TURNS)).T
    wo = torch.stack((sin * turns.cos(), sin * turns.sin(), (1 - sin * sin).sqrt()), 1)
    return wo, (weights * (math.pi / TURNS)).repeat_interleave(TURNS)


def _cells(wi: Tensor) -> tuple[Tensor, int]:
    """The cells (...) of directions (..., 3), and how many there are: bands by angle, cut into arcs about as long."""
    width = math.pi / 2 / BANDS
    arcs = torch.tensor([round(2 * math.pi * math.sin((k + 0.5) * width) / width) for k in range(BANDS)])
    band = (torch.acos(wi[..., 2].clamp(-1, 1)) / width).long().clamp(0, BANDS - 1)
    turned = (torch.atan2(wi[..., 1], wi[..., 0]) / (2 * math.pi) + 0.5).clamp(max=1 - 1e-12)
    return (arcs.cumsum(0) - arcs)[band] + (turned * arcs[band]).long(), int(arcs.sum())
