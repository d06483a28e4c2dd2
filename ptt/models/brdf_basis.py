"""A BRDF space in a few functions, lobes included: what indirect light reflects by (Sun et al. 2007, section 4.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ptt.materials import Material
from ptt.ops import brdf
from ptt.ops.albedo import gauss_legendre, nodes
from ptt.shapes import Shape
from ptt.spaces import BRDF, BRDFSpace

FUNCTIONS = 4
TILTS, TURNS = 24, 7  # outgoing directions: by projected solid angle, and around the normal where it matters
FINEST, RINGS, ARCS = 1e-4, 48, 24  # of the quadrature over incident directions (`ops.albedo.nodes`)


class BRDFBasis(nn.Module):
    """f(wi, wo) ~ sum over p of H[p, c] b_p(wi, wo), b_0 = 1/pi, b_p = sum over h of mixture[h, p] f_h(wi, wo).

    space: the samples f_h
    mixture (h, p), table (h, p): of the specular functions, p of them, and the coefficients of every sample
    error (h,): |f_h - its approximation| / |f_h|, in L2 by projected solid angle

    The specular functions are the uncentred principal components of the samples, each scaled to norm 1: orthonormal,
    linear, and zero is zero. Weights and colours stay outside.

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
        """The principal components of a space by a quadrature that resolves its lobes.

        functions: how many specular ones; where the space has fewer independent samples, the rest are zero

        Raises:
            ValueError: not in 1..samples.
        """
        if not 1 <= functions <= len(space.samples):
            raise ValueError(f"functions must be in 1..{len(space.samples)}, the samples, got {functions}")
        values, weights = _values(space.samples, space.isotropic)
        gram = values * weights @ values.T
        norms = gram.diagonal().sqrt().clamp(min=1e-300)
        size, vectors = principal(gram / norms / norms[:, None], functions)
        mixture = vectors / size.clamp(min=1e-300).sqrt() * (size > 1e-13 * size[0]) / norms[:, None]
        return cls(space, *_described(values, weights, mixture, values))

    def with_brdf(self, name: str, brdf: BRDF | Material) -> BRDFBasis:
        """One more sample, a function f(wi, wo) or a material's shape by name, in the same functions.

        The functions stay, so what was precomputed with them does too; look at `error[-1]`.
        """
        space = self.space.with_brdf(name, brdf)
        values, weights = _values(space.samples, space.isotropic)
        mixture = nn.functional.pad(self.mixture.double(), (0, 0, 0, 1))
        mixture, table, error = _described(values, weights, mixture, values[-1:])
        return BRDFBasis(space, mixture, torch.cat((self.table, table)), torch.cat((self.error, error)))

    def coefficients(self, material: Material) -> Tensor:
        """H (1 + p, 3) of a material, also between samples; differentiable in its weights and parameters."""
        specular = material.specular.to(self.table)
        row = self.table.new_zeros(self.table.shape[1]) if material.shape is None else self.of_shape(material.shape)
        return torch.cat((material.diffuse.to(self.table)[None], row[:, None] * specular))

    def of_shape(self, shape: Shape) -> Tensor:
        """Coefficients (p,) of a shape."""
        return self.space.coordinates(shape).to(self.table) @ self.table

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


def _described(values: Tensor, weights: Tensor, mixture: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mixture, coefficients and errors, float32, of wanted BRDFs (k, m) in functions mixed of others (h, m).

    Functions whose large parts of opposite sign cancel are orthonormal only as far as float32 holds the mixture: the
    coefficients solve for the functions as they are.
    """
    mixture = mixture.float()
    functions = mixture.double().T @ values
    overlaps = torch.linalg.pinv(functions * weights @ functions.T, rtol=1e-9, hermitian=True)
    table = wanted * weights @ functions.T @ overlaps
    missed = ((wanted - table @ functions).square() @ weights).sqrt()
    norms = (wanted.square() @ weights).sqrt().clamp(min=1e-300)
    return mixture, table.float(), (missed / norms).float()


def _values(samples: Sequence[Shape], isotropic: bool) -> tuple[Tensor, Tensor]:
    """f_h (h, m) at pairs of directions, and the weights (m,) of an integral over both projected hemispheres."""
    sin2, weights = gauss_legendre(TILTS, torch.zeros(0).double())
    turns = torch.zeros(1).double() if isotropic else torch.arange(TURNS, dtype=torch.float64) * (2 * math.pi / TURNS)
    sin, cos = sin2.sqrt()[:, None], (1 - sin2).sqrt()[:, None]
    wo = torch.stack((sin * turns.cos(), sin * turns.sin(), cos.expand(-1, len(turns))), -1).reshape(-1, 3)
    outgoing = (weights * (math.pi / len(turns))).repeat_interleave(len(turns))
    wi, incident = nodes(wo, FINEST, RINGS, ARCS)
    wo = wo[:, None].expand_as(wi)

    def evaluate(shape: Shape) -> Tensor:
        step = len(turns) if shape.isotropic else 1  # the nodes turn with wo
        return shape.evaluate(wi[::step], wo[::step]).repeat_interleave(step, 0).flatten()

    values = torch.stack([evaluate(shape) for shape in samples])
    return values, (outgoing[:, None] * incident).flatten()
