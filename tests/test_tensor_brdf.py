"""The BRDF tensor: what it approximates, how well, and what it says of its own error."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import ptt
from ptt import BRDFSpace

SPACE = BRDFSpace.blinn_phong(tuple(2 ** (k / 4) for k in range(25)))


def cosine_directions(n: int, seed: int) -> Tensor:
    """Distributed by projected solid angle, the measure of the fit."""
    u = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed))
    r, phi = u[:, 0].sqrt(), 2 * math.pi * u[:, 1]
    return torch.stack((r * phi.cos(), r * phi.sin(), (1 - u[:, 0]).clamp(min=1e-8).sqrt()), 1)


@pytest.fixture(scope="module")
def tensor() -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(SPACE, ranks=(4, 24, 24), separated=0)


@pytest.mark.parametrize("k", [0, 8, 16])
def test_stated_error_is_the_error_at_random_directions(tensor: ptt.TensorBRDF, k: int) -> None:
    shape = tensor.space.samples[k]
    wi, wo = cosine_directions(100_000, 0), cosine_directions(100_000, 1)
    exact = shape.evaluate(wi, wo)
    error = float((tensor.evaluate(shape, wi, wo) - exact).norm() / exact.norm())
    assert error == pytest.approx(float(tensor.error[k]), rel=0.2)
    assert error < 0.1


def test_reciprocal_up_to_its_error(tensor: ptt.TensorBRDF) -> None:
    wi, wo = cosine_directions(10_000, 2), cosine_directions(10_000, 3)
    shape = ptt.BlinnPhong(12.0)
    a, b = tensor.evaluate(shape, wi, wo), tensor.evaluate(shape, wo, wi)
    assert float((a - b).norm() / a.norm()) < 0.01


def test_more_factors_are_better_and_error_bounds_are_met() -> None:
    space = BRDFSpace.blinn_phong((2.0, 5.0, 10.0))
    errors = [float(ptt.TensorBRDF.fit(space, ranks=(3, n, n), resolution=24).error.norm()) for n in (4, 8, 16)]
    assert errors[0] > errors[1] > errors[2]
    bounded = ptt.TensorBRDF.fit(space, error=0.05, resolution=24)
    assert 0.01 < float(bounded.error.square().mean().sqrt()) <= 0.05


def test_zero_below_the_horizon(tensor: ptt.TensorBRDF) -> None:
    up, down = torch.tensor([[0.0, 0.6, 0.8]]), torch.tensor([[0.0, 0.6, -0.8]])
    assert tensor.evaluate(ptt.BlinnPhong(5.0), up, up) > 0
    for wi, wo in [(up, down), (down, up), (down, down)]:
        assert tensor.evaluate(ptt.BlinnPhong(5.0), wi, wo) == 0
