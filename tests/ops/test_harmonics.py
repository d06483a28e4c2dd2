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
    theta = torch.acos(d[:, 2]).numpy()
    phi = torch.atan2(d[:, 1], d[:, 0]).numpy()
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


@pytest.mark.parametrize(("order", "atol"), [(1, 1e-13), (2, 1e-12), (4, 1e-10), (7, 1e-6)])
def test_hemispherical_ones_are_orthonormal_under_the_cosine(order: int, atol: float) -> None:
    """The integral over z > 0 of Z_a Z_b cos(theta) is 1 if a = b, else 0; Z_0 is constant, with integral of 1 pi.

    By Gauss-Legendre in theta, where cos(theta) dw = sin(theta) cos(theta) dtheta dphi is smooth, unlike the code's
    in z; phi is even, and turned so that no node is a node of the code's. The Gram matrix's condition number grows
    28-fold with each order, and the error with it: 3e4 at order 4, 6e8 at order 7.
    """
    t, w = np.polynomial.legendre.leggauss(60)
    t = (t + 1) * math.pi / 4
    w = w * math.pi / 4
    phi = (np.arange(4 * order) + 0.3) * (math.pi / (2 * order))
    weights = torch.from_numpy(np.repeat(w * np.sin(t) * np.cos(t), len(phi)) * (math.pi / (2 * order)))
    t, phi = (x.ravel() for x in np.meshgrid(t, phi, indexing="ij"))
    d = torch.from_numpy(np.stack([np.sin(t) * np.cos(phi), np.sin(t) * np.sin(phi), np.cos(t)], -1))
    change = harmonics.hemispherical(order)
    z = harmonics.evaluate(d, order) @ change.T
    assert torch.allclose(z.T @ (z * weights[:, None]), torch.eye(order**2, dtype=torch.float64), rtol=0, atol=atol)
    assert torch.allclose(z[:, 0], torch.full_like(z[:, 0], 1 / math.sqrt(math.pi)), rtol=0, atol=1e-13)
    assert change.dtype == torch.float64 and (change.diagonal() > 0).all()
    assert not change.triu(1).any()


def test_hemispherical_second_function_by_hand() -> None:
    """Z_2, of the zonal Y_10 ~ z, is z less its mean, normalised; in the measure cos dw / pi = 2 z dz, 0 < z < 1,

    the mean of z is 2/3, its variance 1/2 - 4/9 = 1/18: Z_2 = (z - 2/3) sqrt(18 / pi).
    """
    d = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64, generator=torch.manual_seed(0)), dim=1)
    found = harmonics.evaluate(d, 2) @ harmonics.hemispherical(2).T
    assert torch.allclose(found[:, 2], (d[:, 2] - 2 / 3) * math.sqrt(18 / math.pi), rtol=0, atol=1e-12)


def test_hemispherical_table_is_the_callers_own() -> None:
    """What a caller does to it, no other sees."""
    kept = harmonics.hemispherical(3).clone()
    harmonics.hemispherical(3).zero_()
    assert torch.equal(harmonics.hemispherical(3), kept)


def test_degrees() -> None:
    """2 l + 1 harmonics of degree l, in turn."""
    expected = [degree for degree in range(40) for _ in range(2 * degree + 1)]
    assert harmonics.degrees(40).tolist() == expected
    assert harmonics.degrees(1).dtype == torch.int64


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_zonal_is_legendre(dtype: torch.dtype, atol: float) -> None:
    angle = torch.linspace(0, math.pi, 33, dtype=dtype).reshape(3, 11)
    found = harmonics.zonal(angle, 12)
    assert found.shape == (12, 3, 11) and found.dtype == dtype
    expected = eval_legendre(np.arange(12)[:, None, None], np.cos(angle.double().numpy()))
    assert torch.allclose(found.double(), torch.from_numpy(expected), rtol=0, atol=atol)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="order must be at least 1, got 0"):
        harmonics.evaluate(torch.zeros(2, 3), 0)
    with pytest.raises(ValueError, match=r"directions must have shape \(..., 3\), got \(2, 2\)"):
        harmonics.evaluate(torch.zeros(2, 2), 2)
