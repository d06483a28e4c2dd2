"""Sampling densities: they integrate to one, and what is drawn follows them."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from ptt.ops.brdf import ggx, ward
from ptt.reference.sampling import (
    BeckmannLobe,
    GGXLobe,
    Lobe,
    Mixture,
    PowerLobe,
    cosine_density,
    cosine_hemisphere,
    reflect,
)

POWERS = [PowerLobe(n) for n in (0.0, 1.0, 20.0, 1000.0, 1e5)]
BECKMANNS = [BeckmannLobe(m) for m in (0.01, 0.1, 0.5)]
WARDS = [BeckmannLobe(*m) for m in ((0.05, 0.4), (0.3, 0.02))]
GGXS = [GGXLobe(roughness) for roughness in (0.1, 0.3, 1.0)]
LOBES: list[Lobe] = [*POWERS, *BECKMANNS, *WARDS, *GGXS]
TILTS = (0.0, 30.0, 60.0, 85.0)


def tilted(degrees: float) -> Tensor:
    a = math.radians(degrees)
    return torch.tensor([math.sin(a) * 0.6, math.sin(a) * 0.8, math.cos(a)], dtype=torch.float64)


def half_vectors(finest: float, rings: int = 500, turns: int = 256) -> tuple[Tensor, Tensor]:
    """Half vectors (m, 3) and weights (m,) of a quadrature of the upper hemisphere.

    Gauss-Legendre in log(t + finest), t the angle to the normal, so that a lobe of width `finest` is resolved.
    """
    x, w = (torch.tensor(v) for v in np.polynomial.legendre.leggauss(rings))
    top = math.log1p(math.pi / 2 / finest)
    s = (x + 1) / 2 * top
    t = finest * s.expm1()
    dt = finest * s.exp() * w * top / 2
    phi = (torch.arange(turns, dtype=torch.float64) + 0.5) * (2 * math.pi / turns)
    x = t.sin()[:, None] * phi.cos()
    y = t.sin()[:, None] * phi.sin()
    weights = (dt * t.sin())[:, None].expand(-1, turns) * (2 * math.pi / turns)
    return torch.stack([x, y, t.cos()[:, None].expand(-1, turns)], -1).reshape(-1, 3), weights.reshape(-1)


def sphere(wo: Tensor, finest: float) -> tuple[Tensor, Tensor]:
    """Directions wi (m, 3) and weights (m,) of a quadrature of the whole sphere, fine about the mirror of wo.

    wi = reflect(wo, h) runs once over the sphere while h runs over the upper hemisphere; d wi = 4 |wo.h| dh.
    """
    h, weights = half_vectors(finest)
    return reflect(wo.expand_as(h), h), weights * 4 * (h @ wo).abs()


def width(lobe: Lobe) -> float:
    if isinstance(lobe, PowerLobe):
        return 1 / math.sqrt(lobe.exponent + 1)
    return float(lobe.roughness**2 if isinstance(lobe, GGXLobe) else min(lobe.mx, lobe.my or lobe.mx))


@pytest.mark.parametrize(("lobe", "tilt"), list(product(LOBES, TILTS)), ids=str)
def test_density_of_a_mixture_integrates_to_one(lobe: Lobe, tilt: float) -> None:
    wo = tilted(tilt)
    wi, weights = sphere(wo, 0.1 * width(lobe))
    total = (Mixture((lobe,), (0.7,)).density(wi, wo.expand_as(wi)) * weights).sum()
    assert float((cosine_density(wi) * weights).sum()) == pytest.approx(1, abs=1e-4)  # the quadrature itself
    assert float(total) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("lobe", LOBES, ids=str)
def test_density_of_half_vectors_integrates_to_one(lobe: Lobe) -> None:
    h, weights = half_vectors(0.1 * width(lobe))
    assert float((lobe.density(h) * weights).sum()) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("lobe", [*BECKMANNS, *WARDS], ids=str)
def test_beckmann_half_vectors_are_those_of_ward(lobe: BeckmannLobe) -> None:
    """At wi = wo = h, where vh = 1, Ward's BRDF is the density over 4 hz; the absolute bound is for denormals."""
    h, _ = half_vectors(0.1 * width(lobe))
    assert torch.allclose(lobe.density(h), 4 * h[:, 2] * ward(h, h, lobe.mx, lobe.my), rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("lobe", GGXS, ids=str)
def test_ggx_half_vectors_are_those_of_ggx(lobe: GGXLobe) -> None:
    """At wi = wo = h and f0 = 1 the BRDF is D / (4 hz sqrt(hz^2 + a^2 sin^2)); the density is D hz."""
    h, _ = half_vectors(0.1 * width(lobe))
    masked = 4 * h[:, 2] * torch.hypot(h[:, 2], lobe.roughness**2 * h[:, :2].norm(dim=1))
    assert torch.allclose(lobe.density(h), h[:, 2] * masked * ggx(h, h, 1.0, lobe.roughness), rtol=1e-9, atol=0)


@pytest.mark.parametrize("lobe", LOBES, ids=str)
def test_density_is_blind_to_the_sign_of_the_half_vector(lobe: Lobe) -> None:
    h, _ = half_vectors(0.1 * width(lobe))
    assert torch.equal(lobe.density(h), lobe.density(-h))


@pytest.mark.parametrize(("lobe", "tilt"), list(product([None, *LOBES], TILTS)), ids=str)
def test_samples_follow_the_density(lobe: Lobe | None, tilt: float) -> None:
    """The sample mean of a function is its integral against the density."""
    mixture = Mixture((lobe,), (0.7,)) if lobe else Mixture()
    wo = tilted(tilt)
    generator = torch.Generator().manual_seed(3)
    u = torch.rand(50_000, 3, generator=generator, dtype=torch.float64)
    drawn = mixture.sample(u, wo.expand(len(u), 3))
    assert torch.allclose(drawn.norm(dim=1), drawn.new_ones(()), atol=1e-9)
    mirror = wo * wo.new_tensor([-1.0, -1.0, 1.0])
    wi, weights = sphere(wo, 0.1 * (width(lobe) if lobe else 1.0))
    p = mixture.density(wi, wo.expand_as(wi)) * weights
    for moment in _moments(mirror, width(lobe) if lobe else 1.0):
        samples = moment(drawn)
        expected = float((moment(wi) * p).sum())
        error = float(samples.std()) / math.sqrt(len(u))
        assert abs(float(samples.mean()) - expected) < 4 * error + 1e-4


def _moments(mirror: Tensor, scale: float) -> list:  # type: ignore[type-arg]
    """Smooth bumps of three widths about the mirror direction, one off it, the height, and the spread along x."""
    beside = mirror + mirror.new_tensor([0.5, -0.3, 0.1]) * min(scale, 1.0)
    beside = beside / beside.norm()

    def bump(axis: Tensor, size: float):  # type: ignore[no-untyped-def]
        return lambda w: torch.exp(-((w - axis).square().sum(-1)) / (2 * size * size))

    bumps = [*(bump(mirror, scale * k) for k in (0.3, 1.0, 3.0)), bump(beside, scale)]
    return [*bumps, lambda w: w[..., 2], lambda w: w[..., 0] ** 2]


@pytest.mark.parametrize("lobe", LOBES, ids=str)
def test_float32_density_is_that_of_float64(lobe: Lobe) -> None:
    """Rounding wi moves a narrow lobe's argument: 1e-7 against its width, so 1e5 loses about 1e-3."""
    u = torch.rand(4096, 3, generator=torch.Generator().manual_seed(0))
    wo = tilted(50.0)
    mixture = Mixture((lobe,), (0.7,))
    wi = mixture.sample(u, wo.float().expand(4096, 3))
    wi = wi[wi[:, 2] > 0.01]
    single = mixture.density(wi, wo.float().expand_as(wi))
    double = mixture.density(wi.double(), wo.expand_as(wi))
    assert torch.isfinite(single).all()
    assert ((single - double).abs() / double).max() < 5e-3


def test_uniform_numbers_at_their_ends_give_finite_directions() -> None:
    last = 1 - 2.0**-24
    u = torch.tensor(list(product((0.0, last), repeat=3)))
    wo = tilted(60.0).float().expand(len(u), 3)
    for lobe in LOBES:
        wi = Mixture((lobe,), (0.5,)).sample(u, wo)
        assert torch.isfinite(wi).all()
        assert torch.isfinite(Mixture((lobe,), (0.5,)).density(wi, wo)).all()


def test_cosine_hemisphere_has_mean_two_thirds_up() -> None:
    """E[z] = integral of cos^2 / pi over the hemisphere = 2/3; z^2 is uniform, so Var z = 1/2 - 4/9 = 1/18."""
    u = torch.rand(100_000, 2, generator=torch.Generator().manual_seed(1))
    w = cosine_hemisphere(u)
    assert float(w[:, 2].mean()) == pytest.approx(2 / 3, abs=4 * math.sqrt(1 / 18 / 1e5))
    assert float(cosine_density(w[:1])) == pytest.approx(float(w[0, 2]) / math.pi)
    assert float(cosine_density(-w[:1])) == 0


def test_reflection_keeps_the_angle_and_is_blind_to_sign() -> None:
    h = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    wo = tilted(40.0).float().expand(64, 3)
    wi = reflect(wo, h)
    assert torch.allclose((wi * h).sum(1), (wo * h).sum(1), atol=1e-6)
    assert torch.allclose(torch.linalg.cross(wi + wo, h), torch.zeros(64, 3), atol=1e-6)
    assert torch.equal(wi, reflect(wo, -h))
