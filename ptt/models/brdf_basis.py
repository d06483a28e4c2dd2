"""A BRDF space in a few functions, lobes included, by which indirect light is reflected (Sun et al. 2007, 4.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ptt.materials.material import Material
from ptt.materials.shapes import Shape
from ptt.materials.spaces import BRDF, BRDFSpace
from ptt.models import kept
from ptt.ops import brdf, kinds
from ptt.ops.albedo import gauss_legendre, nodes

FUNCTIONS = 4  # specular ones, as in the paper
ENERGY = 4.0  # weight of the albedo against the shape: without it four functions left albedos 29 % wrong, with it 7 %
BANDS = 8  # of cells from the normal to the horizon: as wide as a texel of a cube map of 8 x 8, 11 degrees
TILTS = 24  # outgoing directions by projected solid angle
TURNS = 7  # outgoing directions around the normal
FINEST_ANGLE = 1e-4  # [rad] half angle that the quadrature over incident directions resolves (`ops.albedo.nodes`)
RINGS = 48  # half angles of that quadrature on either side of the horizon's bound
ARCS = 24  # azimuths of that quadrature
ROUNDING = 1e-13  # share of the largest eigenvalue of a float64 Gram matrix: smaller ones are rounding


class BRDFBasis(nn.Module):
    """f(wi, wo) ~ sum over p of H[p, c] b_p(wi, wo), b_0 = 1/pi, b_p = sum over h of mixture[h, p] f_h(wi, wo).

    space: the samples f_h
    mixture (h, p): shares of the samples in the p specular functions
    table (h, p): coefficients of every sample
    error (h,): |f_h - its approximation| / |f_h|, in the norm of the fit

    The norm has two scales, since indirect light comes as texels, and most receivers see little more than its sum:
    |f|^2 = integral over wo, by projected solid angle, of sum over C of r(C)^2 / solid angle of C + (ENERGY r)^2 / pi.
    r(C) = integral over C of f(wi, wo) cos(wi) dwi, with C one of 163 cells of incident directions, 11 degrees wide;
    their sum r is the albedo. Lambert's 1/pi has norm 4.08. In this norm, the specular functions are the uncentred
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
    def fit(cls, space: BRDFSpace, functions: int | None = None) -> BRDFBasis:
        """The principal components of a space in the norm above, by a quadrature that resolves its lobes.

        functions: number of specular functions; where the space has fewer independent samples, the rest are zero.
            Default: four, or as many as there are samples

        The result is kept as that of `TensorBRDF.fit`.

        Raises:
            ValueError: functions are not in 1..samples.
        """
        kinds.check("space", space, BRDFSpace)
        functions = min(FUNCTIONS, len(space.samples)) if functions is None else functions
        if not 1 <= functions <= len(space.samples):
            raise ValueError(f"functions must be in 1..{len(space.samples)}, the samples, got {functions}")
        settings = {"functions": functions}
        return cls(space, **kept.fit("BRDF basis", space, settings, lambda: cls._fitted(space, functions)))

    @staticmethod
    def _fitted(space: BRDFSpace, functions: int) -> dict[str, Tensor]:
        """The parts of `fit`."""
        features = _features(space.samples)
        norms = features.norm(dim=1, keepdim=True).clamp(min=1e-300)
        size, vectors = principal(features / norms @ (features / norms).T, functions)
        mixture = vectors / size.clamp(min=1e-300).sqrt() * (size > ROUNDING * size[0]) / norms
        mixture, table, error = _coefficients_of(features, features, mixture)
        return {"mixture": mixture, "table": table, "error": error}

    def with_brdf(self, name: str, brdf: BRDF | Material) -> BRDFBasis:
        """The basis with more samples, a function f(wi, wo) or the shapes of a material's highlights, by name.

        The functions stay, and so does what was precomputed with them; the last of `error` say how well they suit them.
        """
        space = self.space.with_brdf(name, brdf)
        old = len(self.space.samples)
        features = _features(space.samples)
        mixture = nn.functional.pad(self.mixture.double(), (0, 0, 0, len(features) - old))
        mixture, table, error = _coefficients_of(features[old:], features, mixture)
        return BRDFBasis(space, mixture, torch.cat((self.table, table)), torch.cat((self.error, error)))

    def coefficients(self, material: Material) -> Tensor:
        """H (1 + p, 3) of a material, which may lie between samples; differentiable in its weights and parameters."""
        highlights = self.space.highlights(material)
        parts = [self.of_shape(weights)[:, None] * colour.to(self.table) for weights, colour in highlights]
        specular = sum(parts[1:], parts[0]) if parts else self.table.new_zeros(self.table.shape[1], 3)
        return torch.cat((material.diffuse.to(self.table)[None], specular))

    def of_shape(self, shape: Shape | Tensor) -> Tensor:
        """Coefficients (p,) of a shape, or of its coordinates (h,) in the space."""
        return self.space.resolved(shape).to(self.table) @ self.table

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """The functions (..., 1 + p) [1/sr] at local unit directions (..., 3), exactly: sample by sample."""
        diffuse = brdf.lambert(*torch.broadcast_tensors(wi, wo))[..., None]
        specular = torch.zeros_like(diffuse).expand(*diffuse.shape[:-1], self.mixture.shape[1])
        for shape, weights in zip(self.space.samples, self.mixture.to(wi), strict=True):
            specular = specular + shape.evaluate(wi, wo)[..., None] * weights
        return torch.cat((diffuse, specular), -1)


def principal(gram: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The largest eigenvalues (p,), descending, and their vectors (h, p) of a float64 Gram matrix (h, h)."""
    values, vectors = torch.linalg.eigh(gram)
    return values.flip(0)[:count].clamp(min=0), vectors.flip(1)[:, :count]


def _coefficients_of(wanted: Tensor, features: Tensor, mixture: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mixture (h, p) rounded to float32, and coefficients (k, p) and errors (k,) of BRDFs by their features (k, m).

    features (h, m), mixture (h, p): the samples', and the functions that are mixed of these

    Functions whose large parts of opposite sign cancel are orthonormal only as far as float32 holds the mixture, so the
    coefficients solve for the functions as rounding leaves them.
    """
    mixture = mixture.float()
    functions = mixture.double().T @ features
    overlaps = torch.linalg.pinv(functions @ functions.T, rtol=1e-9, hermitian=True)
    table = wanted @ functions.T @ overlaps
    error = (wanted - table @ functions).norm(dim=1) / wanted.norm(dim=1).clamp(min=1e-300)
    return mixture, table.float(), error.float()


def _features(samples: Sequence[Shape]) -> Tensor:
    """Features (h, m) of f_h whose dot products are those of the norm: for every wo, light by cells, then albedos."""
    wo, outgoing = _outgoing()
    wi, incident = nodes(wo, FINEST_ANGLE, RINGS, ARCS)
    weights = outgoing[:, None] * incident
    cells, count = _cells(wi)
    cells = (cells + count * torch.arange(len(wo))[:, None]).flatten()  # every wo has cells of its own
    count = count * len(wo)
    solid = cells.bincount((weights / wi[..., 2].clamp(min=1e-9)).flatten(), count)  # solid angles times outgoing

    def features_of(shape: Shape) -> Tensor:
        step = TURNS if shape.isotropic else 1  # the nodes turn with wo
        values = shape.evaluate(wi[::step], wo[::step, None].expand_as(wi[::step])).repeat_interleave(step, 0)
        reflected = cells.bincount((values * weights).flatten(), count)
        albedo = reflected.view(len(wo), -1).sum(1) / outgoing
        by_cell = reflected / solid.sqrt().clamp(min=1e-300)
        return torch.cat((by_cell, ENERGY * albedo * (outgoing / math.pi).sqrt()))

    return torch.stack([features_of(shape) for shape in samples])


def _outgoing() -> tuple[Tensor, Tensor]:
    """Outgoing directions (o, 3), and the projected solid angles (o,) that they stand for."""
    sin2, weights = gauss_legendre(TILTS, torch.zeros(0).double())
    sin, turns = torch.cartesian_prod(sin2.sqrt(), torch.arange(TURNS).double() * (2 * math.pi / TURNS)).T
    wo = torch.stack((sin * turns.cos(), sin * turns.sin(), (1 - sin * sin).sqrt()), 1)
    return wo, (weights * (math.pi / TURNS)).repeat_interleave(TURNS)


def _cells(wi: Tensor) -> tuple[Tensor, int]:
    """The cells (...) of directions (..., 3), and their number: bands by angle, cut into arcs about as long as wide."""
    width = math.pi / 2 / BANDS
    arcs = torch.tensor([round(2 * math.pi * math.sin((k + 0.5) * width) / width) for k in range(BANDS)])
    band = (torch.acos(wi[..., 2].clamp(-1, 1)) / width).long().clamp(0, BANDS - 1)
    turned = (torch.atan2(wi[..., 1], wi[..., 0]) / (2 * math.pi) + 0.5).clamp(max=1 - 1e-12)
    return (arcs.cumsum(0) - arcs)[band] + (turned * arcs[band]).long(), int(arcs.sum())
