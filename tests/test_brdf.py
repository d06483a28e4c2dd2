"""Analytic BRDFs: reciprocity, energy, the horizon, and float32 against float64 at the extremes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from ptt.ops import brdf
from ptt.ops.sphere import Disk

SHAPES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "lambert": brdf.lambert,
    **{f"blinn-phong {n:g}": (lambda i, o, n=n: brdf.blinn_phong(i, o, n)) for n in (0, 1, 20, 1e3, 1e6)},
    **{
        f"cook-torrance {f0:g} {m:g}": (lambda i, o, f0=f0, m=m: brdf.cook_torrance(i, o, f0, m))
        for f0 in (0.0, 0.1, 1.0)
        for m in (1e-4, 0.05, 0.3, 1.0)
    },
    **{f"ward {a:g}": (lambda i, o, a=a: brdf.ward(i, o, a)) for a in (1e-4, 0.05, 0.3, 1.0)},
    **{
        f"ggx {f0:g} {r:g}": (lambda i, o, f0=f0, r=r: brdf.ggx(i, o, f0, r))
        for f0 in (0.0, 0.04, 1.0)
        for r in (1e-2, 0.1, 0.4, 1.0)
    },
}


def hemisphere(n: int, seed: int = 0) -> Tensor:
    d = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    d[:, 2].abs_()
    return torch.nn.functional.normalize(d, dim=1)


def tilted(degrees: float) -> Tensor:
    return torch.tensor([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))]).double()


@pytest.mark.parametrize("name", SHAPES)
def test_reciprocal_non_negative_isotropic_and_finite(name: str) -> None:
    f = SHAPES[name]
    wi, wo = hemisphere(2000), hemisphere(2000, 1)
    wi = torch.cat((wi, tilted(89.999)[None], tilted(0)[None], tilted(89.999)[None]))
    wo = torch.cat((wo, tilted(89.999)[None], tilted(0)[None], tilted(0)[None]))
    value = f(wi, wo)
    assert value.isfinite().all() and (value >= 0).all()
    assert torch.allclose(value, f(wo, wi), rtol=1e-9)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    assert torch.allclose(f(wi @ turn.T, wo @ turn.T), value, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_zero_at_and_below_the_horizon(name: str) -> None:
    up, side, down = tilted(0), tilted(90.0) * torch.tensor([1.0, 1.0, 0.0]), tilted(135)
    for a, b in [(up, side), (up, down), (down, down), (down, up)]:
        assert SHAPES[name](a, b) == 0


@pytest.mark.parametrize("exponent", [0.0, 1.0, 8.0, 64.0, 200.0])
def test_blinn_phong_albedo_is_one_at_normal_incidence_and_never_more(exponent: float) -> None:
    """The documented normalisation: the integral of f cos over the hemisphere, by the disk's measure."""
    grid = Disk(600)
    wi, weight = grid.directions().reshape(-1, 3), grid.projected_solid_angles().flatten()
    albedo = [float((brdf.blinn_phong(wi, tilted(t), exponent) * weight).sum()) for t in (0, 20, 45, 70, 85)]
    assert abs(albedo[0] - 1) < 2e-3
    assert max(albedo) < 1 + 2e-3


def test_cook_torrance_is_the_formula_of_the_fitted_table() -> None:
    """Written out at one pair of directions, term by term, in plain Python."""
    wi, wo, f0, m = tilted(30), tilted(-50), 0.2, 0.3
    h = (wi + wo) / (wi + wo).norm()
    th, vh = math.acos(float(h[2])), float(wo @ h)
    d = math.exp(-(math.tan(th) ** 2) / m**2) / (m**2 * math.cos(th) ** 4)
    f = f0 + (1 - f0) * (1 - vh) ** 5
    nl, nv = float(wi[2]), float(wo[2])
    g = min(1.0, 2 * float(h[2]) * nv / vh, 2 * float(h[2]) * nl / vh)
    assert float(brdf.cook_torrance(wi, wo, f0, m)) == pytest.approx(d * f * g / (math.pi**2 * nl * nv), rel=1e-12)


@pytest.mark.parametrize("m", [0.05, 0.1])
def test_cook_torrance_albedo_of_a_mirror_like_metal_is_four_over_pi(m: float) -> None:
    """Without masking, and with F = 1, f cos dwi = D cos(th_h) dwh 4 / pi^2, and D cos dwh integrates to pi."""
    grid = Disk(1500)
    wi, weight = grid.directions().reshape(-1, 3), grid.projected_solid_angles().flatten()
    albedo = float((brdf.cook_torrance(wi, tilted(0), 1.0, m) * weight).sum())
    assert albedo == pytest.approx(4 / math.pi, rel=0.02)


@pytest.mark.parametrize("slope", [0.1, 0.3, 0.6, 1.0])
def test_ward_and_ggx_albedos_are_at_most_one(slope: float) -> None:
    """Ward in the bounded form by its construction; GGX with F = 1 because Smith masking only takes away."""
    grid = Disk(1500)
    wi, weight = grid.directions().reshape(-1, 3), grid.projected_solid_angles().flatten()
    for degrees in (0, 30, 60, 80):
        for value in (brdf.ward(wi, tilted(degrees), slope), brdf.ggx(wi, tilted(degrees), 1.0, slope**0.5)):
            assert float((value * weight).sum()) < 1.005


def test_ward_and_ggx_reflect_nearly_all_at_normal_incidence_when_smooth() -> None:
    grid = Disk(1500)
    wi, weight = grid.directions().reshape(-1, 3), grid.projected_solid_angles().flatten()
    assert float((brdf.ward(wi, tilted(0), 0.1) * weight).sum()) == pytest.approx(1.0, abs=0.03)
    assert float((brdf.ggx(wi, tilted(0), 1.0, 0.3) * weight).sum()) == pytest.approx(1.0, abs=0.03)


def test_anisotropic_ward_turns_with_its_axes() -> None:
    """Swapping the slopes is turning both directions by 90 degrees; equal slopes are isotropic."""
    wi, wo = hemisphere(500), hemisphere(500, 1)
    turn = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    swapped = brdf.ward(wi @ turn.T, wo @ turn.T, 0.5, 0.1)
    assert torch.allclose(swapped, brdf.ward(wi, wo, 0.1, 0.5), rtol=1e-9)
    assert torch.equal(brdf.ward(wi, wo, 0.3, 0.3), brdf.ward(wi, wo, 0.3))
    assert not torch.allclose(brdf.ward(wi, wo, 0.1, 0.5), brdf.ward(wi, wo, 0.5, 0.1), rtol=0.1)


def test_ggx_is_the_formula_of_gltf() -> None:
    """D, G2 = 2 nl nv / (..) and F written out in plain Python, f = D G F / (4 nl nv)."""
    wi, wo, f0, roughness = tilted(40), tilted(-25), 0.1, 0.5
    h = (wi + wo) / (wi + wo).norm()
    a2, nl, nv, nh, vh = roughness**4, float(wi[2]), float(wo[2]), float(h[2]), float(wo @ h)
    d = a2 / (math.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    smith = [(-1 + math.sqrt(1 + a2 * (1 / c**2 - 1))) / 2 for c in (nl, nv)]
    f = f0 + (1 - f0) * (1 - vh) ** 5
    expected = d * f / (1 + sum(smith)) / (4 * nl * nv)
    assert float(brdf.ggx(wi, wo, f0, roughness)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", [n for n in SHAPES if "1e+06" not in n and "0.0001" not in n])
def test_float32_agrees_with_float64(name: str) -> None:
    wi = hemisphere(500)
    wo = torch.nn.functional.normalize(wi * torch.tensor([-1.0, -1.0, 1.0]) + 0.02 * hemisphere(500, 2), dim=1)
    wi32, wo32 = wi.float(), wo.float()
    exact = SHAPES[name](wi32.double(), wo32.double())
    assert torch.allclose(SHAPES[name](wi32, wo32).double(), exact, rtol=2e-3, atol=1e-5 * float(exact.max()))


@pytest.mark.parametrize(
    "model", [brdf.cook_torrance, brdf.ward, brdf.ggx, lambda i, o, n, _: brdf.blinn_phong(i, o, 50 * n)]
)
def test_gradients(model: Callable[..., Tensor]) -> None:
    wi, wo = hemisphere(5), hemisphere(5, 1)
    a, b = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.3, 0.4))
    assert torch.autograd.gradcheck(lambda x, y: model(wi, wo, x, y), (a, b))


@pytest.mark.parametrize("name", SHAPES)
def test_finite_in_float32_next_to_the_horizon(name: str) -> None:
    for z in (1e-3, 1e-6, 1e-9, 1e-12):
        a, b = torch.tensor([1.0, 0.0, z]), torch.tensor([-1.0, 0.0, z])
        for wi, wo in [(a, b), (a, a), (b, torch.tensor([0.0, 1.0, z]))]:
            assert SHAPES[name](wi, wo).isfinite()
