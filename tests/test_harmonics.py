"""Real spherical harmonics: orthonormality, the addition theorem, and scipy as an independent package."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import eval_legendre, sph_harm_y
from torch import Tensor

from ptt.ops import harmonics


def quadrature(order: int) -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials of degree 2 * order exactly: Gauss in z, even in phi."""
    z, w = np.polynomial.legendre.leggauss(order + 1)
    phi = np.arange(2 * order + 2) * (2 * math.pi / (2 * order + 2))
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    s = np.sqrt(1 - z * z)
    weights = np.repeat(w, 2 * order + 2) * (2 * math.pi / (2 * order + 2))
    return torch.from_numpy(np.stack([s * np.cos(phi), s * np.sin(phi), z], -1)), torch.from_numpy(weights)


@pytest.mark.parametrize("order", [1, 4, 30])
def test_orthonormal(order: int) -> None:
    d, w = quadrature(order)
    y = harmonics.evaluate(d, order)
    gram = y.T @ (y * w[:, None])
    assert torch.allclose(gram, torch.eye(order * order, dtype=torch.float64), atol=1e-12)


def test_addition_theorem() -> None:
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 3, dtype=torch.float64), dim=-1)
    products = harmonics.evaluate(a, 12) * harmonics.evaluate(b, 12)
    for l in range(12):  # noqa: E741
        legendre = torch.from_numpy(eval_legendre(l, (a * b).sum(-1).numpy()))
        band = products[:, l * l : (l + 1) ** 2].sum(-1)
        assert torch.allclose(band, (2 * l + 1) / (4 * math.pi) * legendre, atol=1e-12)


def test_against_scipy() -> None:
    """scipy's complex functions carry (-1)^m; the real ones are sqrt(2) times real and imaginary parts."""
    d, _ = quadrature(7)
    theta, phi = torch.acos(d[:, 2]).numpy(), torch.atan2(d[:, 1], d[:, 0]).numpy()
    ours = harmonics.evaluate(d, 6).numpy()
    for l in range(6):  # noqa: E741
        for m in range(l + 1):
            theirs = (-1) ** m * sph_harm_y(l, m, theta, phi) * (math.sqrt(2) if m else 1)
            np.testing.assert_allclose(ours[:, l * (l + 1) + m], theirs.real, atol=1e-12)
            if m:
                np.testing.assert_allclose(ours[:, l * (l + 1) - m], theirs.imag, atol=1e-12)


def test_first_order_is_y_z_x_and_the_pole_is_finite() -> None:
    d = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(harmonics.evaluate(d, 2)[:, 1:], math.sqrt(3 / (4 * math.pi)) * d[:, [1, 2, 0]])
    assert harmonics.evaluate(d, 64).isfinite().all()


def test_refusals() -> None:
    with pytest.raises(ValueError, match="order must be at least 1, got 0"):
        harmonics.evaluate(torch.zeros(2, 3), 0)
    with pytest.raises(ValueError, match=r"directions must have shape \(..., 3\), got \(2, 2\)"):
        harmonics.evaluate(torch.zeros(2, 2), 2)
