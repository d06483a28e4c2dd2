"""Real spherical harmonics, orthonormal on the sphere.

Order n has n^2 functions; number l (l + 1) + m for l < n, -l <= m <= l. z is the pole; m > 0 goes with cos(m phi),
m < 0 with sin(|m| phi), without the Condon-Shortley sign: numbers 1, 2, 3 are proportional to y, z, x.

- orthonormal: the integral of Y_a Y_b over the sphere is 1 if a = b, else 0
- addition: sum over m of Y_lm(a) Y_lm(b) = (2 l + 1) / (4 pi) P_l(a . b)
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor


def evaluate(directions: Tensor, order: int) -> Tensor:
    """The first order^2 harmonics (..., order^2) at unit directions (..., 3), in their dtype.

    They follow from the recurrence of the associated Legendre functions, scaled by sin^m (Sloan 2013), which is stable
    to high orders.

    Raises:
        ValueError: order < 1, or the last axis is not 3.
    """
    if order < 1:
        raise ValueError(f"order must be at least 1, got {order}")
    if directions.shape[-1:] != (3,):
        raise ValueError(f"directions must have shape (..., 3), got {tuple(directions.shape)}")
    x, y, z = directions.unbind(-1)
    out: list[Tensor] = [z] * (order * order)
    cosine = torch.ones_like(z)
    sine = torch.zeros_like(z)  # sin^m(theta) cos(m phi), sin^m(theta) sin(m phi)
    diagonal = 0.5 / math.sqrt(math.pi)
    for m in range(order):
        previous = torch.zeros_like(z)
        current = torch.full_like(z, diagonal)
        for l in range(m, order):  # noqa: E741 (the field's letter)
            if m == 0:
                out[l * (l + 1)] = current
            else:
                out[l * (l + 1) + m] = math.sqrt(2) * current * cosine
                out[l * (l + 1) - m] = math.sqrt(2) * current * sine
            a = math.sqrt((4 * (l + 1) ** 2 - 1) / ((l + 1) ** 2 - m * m))
            b = math.sqrt((l * l - m * m) / (4 * l * l - 1)) if l > m else 0.0
            previous, current = current, a * (z * current - b * previous)
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        diagonal *= math.sqrt((2 * m + 3) / (2 * m + 2))
    return torch.stack(out).movedim(0, -1)


def hemispherical(order: int) -> Tensor:
    """A (s, t), lower triangular, float64: Z_s = sum over t of A[s, t] Y_t is orthonormal on the hemisphere z > 0.

    The measure is cos(theta) dw. Z spans what the harmonics span, so an expansion in it is their best approximation of
    light that comes from above the horizon alone; an expansion in Y would smear that light below the horizon.
    Z_0 is constant, 1 / sqrt(pi).
    """
    nodes, shares = np.polynomial.legendre.leggauss(order + 1)
    z = torch.from_numpy(nodes / 2 + 0.5)
    weights = torch.from_numpy(shares * math.pi)  # of z in 0..1, times 2 pi
    turns = torch.arange(2 * order, dtype=torch.float64) * (math.pi / order)
    sine = (1 - z * z).sqrt()[:, None]
    around = torch.stack((sine * turns.cos(), sine * turns.sin(), z[:, None].expand(-1, 2 * order)), -1)
    y = evaluate(around, order)
    gram = torch.einsum("zps,zpt,z->st", y, y, weights * z / (2 * order))
    identity = torch.eye(order**2, dtype=torch.float64)
    inverse: Tensor = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), identity, upper=False)
    return inverse


def degrees(order: int) -> Tensor:
    """The degree (order^2,) int64 of each harmonic: 0, 1, 1, 1, 2, ..."""
    return torch.arange(order**2).double().sqrt().floor().long()


def zonal(angle: Tensor, order: int) -> Tensor:
    """Legendre polynomials P_l(cos angle) (order, ...) of degrees 0 to order - 1."""
    axis = torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), -1)
    middle = torch.arange(order) * (torch.arange(order) + 1)  # Y_l0
    norms = (4 * math.pi / (2 * torch.arange(order, dtype=torch.float64) + 1)).sqrt()
    return (evaluate(axis, order)[..., middle] * norms.to(angle)).movedim(-1, 0)
