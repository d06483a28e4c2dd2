"""Analytic BRDFs: reciprocity, energy, the horizon, gradients and float32, over the whole range of the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops import brdf
from ptt.ops.albedo import albedo
from ptt.ops.sphere import Disk

EXPONENTS = (0, 0.5, 1, 20, 1e3, 1e6)
SLOPES = (1e-4, 0.01, 0.05, 0.3, 1.0)
F0S = (0.0, 0.04, 1.0)
SHAPES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "lambert": brdf.lambert,
    **{f"blinn-phong {n:g}": partial(brdf.blinn_phong, exponent=n) for n in EXPONENTS},
    **{f"cook-torrance {f0:g} {m:g}": partial(brdf.cook_torrance, f0=f0, m=m) for f0 in F0S for m in SLOPES},
    **{f"ward {a:g}": partial(brdf.ward, ax=a) for a in SLOPES},
    "ward 0.5:0.05": partial(brdf.ward, ax=0.5, ay=0.05),
    "ward 0.0001:0.001": partial(brdf.ward, ax=1e-4, ay=1e-3),
    **{f"ggx {f0:g} {r:g}": partial(brdf.ggx, f0=f0, roughness=r) for f0 in F0S for r in SLOPES},
}
ANGLES = (0.0, 10.0, 30.0, 45.0, 60.0, 75.0, 85.0, 88.0, 89.0, 89.9, 89.99, 89.999)


def hemisphere(n: int, seed: int = 0) -> Tensor:
    d = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    d[:, 2].abs_()
    return torch.nn.functional.normalize(d, dim=1)


def tilted(degrees: float, azimuth: float = 0.0) -> Tensor:
    t = math.radians(degrees)
    x = math.sin(t) * math.cos(azimuth)
    y = math.sin(t) * math.sin(azimuth)
    return torch.tensor([x, y, math.cos(t)], dtype=torch.float64)


def near_mirror() -> tuple[Tensor, Tensor]:
    """Pairs (n, 3) whose half vectors lie 1e-9 to 1 from the normal, so that every lobe is met, and random ones."""
    wi = hemisphere(4000)
    spread = torch.logspace(-9, 0, 2000, dtype=torch.float64)[:, None]
    mirrored = wi[:2000] * wi.new_tensor([-1.0, -1.0, 1.0]) + spread * hemisphere(2000, 2)
    return wi, torch.cat([torch.nn.functional.normalize(mirrored, dim=1), hemisphere(2000, 1)])


def extremes() -> tuple[Tensor, Tensor]:
    """All pairs of the normal, 45, 89 and 89.999 degrees at three azimuths: wi = wo, mirrored and across."""
    d = torch.stack([tilted(t, p) for t in (0.0, 45.0, 89.0, 89.999) for p in (0.0, math.pi, 1.0)])
    i, j = torch.cartesian_prod(torch.arange(len(d)), torch.arange(len(d))).T
    return d[i], d[j]


@pytest.mark.parametrize("name", SHAPES)
def test_reciprocal_non_negative_and_finite(name: str) -> None:
    for wi, wo in (near_mirror(), extremes()):
        value = SHAPES[name](wi, wo)
        assert value.isfinite().all() and (value >= 0).all() and (value > 0).any()
        assert torch.allclose(value, SHAPES[name](wo, wi), rtol=1e-9, atol=0)


def test_opposite_directions_have_the_normal_between_them() -> None:
    """With gradients that are finite; others the bisector, of unit length, from the nearest to opposite ones on."""
    wi = normalize(torch.tensor([[0.3, 0.2, 0.9], [0.6, 0.0, 0.8], [1.0, 0.0, 1e-6]], dtype=torch.float64), dim=1)
    wo = torch.stack((-wi[0], wi[1] * wi.new_tensor([-1, -1, 1]), wi[2] * wi.new_tensor([-1, -1, 1]))).requires_grad_()
    h = brdf.half_vector(wi, wo)
    assert torch.allclose(h, wi.new_tensor([0.0, 0.0, 1.0]).expand_as(h))
    h.sum().backward()
    assert wo.grad is not None and bool(wo.grad.isfinite().all())
    assert torch.allclose(brdf.half_vector(wi, wi), wi)


@pytest.mark.parametrize("name", [n for n in SHAPES if ":" not in n])
def test_isotropic(name: str) -> None:
    """Turning rounds the directions by 1e-16, a half vector by 1e-14 (v.h > 0.01): 1e-6 of a lobe of width 1e-8."""
    wi, wo = near_mirror()
    wide = (wi + wo).norm(dim=1) > 0.02
    c = math.cos(0.7)
    s = math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    value = SHAPES[name](wi, wo)[wide]
    atol = 1e-12 * float(value.max())
    assert torch.allclose(SHAPES[name](wi @ turn.T, wo @ turn.T)[wide], value, rtol=4e-6, atol=atol)


@pytest.mark.parametrize("name", SHAPES)
def test_zero_at_and_below_the_horizon(name: str) -> None:
    up = tilted(0)
    side = tilted(90.0) * torch.tensor([1.0, 1.0, 0.0])
    down = tilted(135)
    for a, b in [(up, side), (up, down), (down, down), (down, up)]:
        assert SHAPES[name](a, b) == 0


def test_albedo_of_lambert_is_one_and_that_of_wide_lobes_is_the_disks() -> None:
    """Two oracles: the integral of cos / pi, and an independent quadrature, the disk of projected solid angles."""
    wo = torch.stack([tilted(t, 0.3) for t in ANGLES])
    assert torch.allclose(albedo(brdf.lambert, wo), wo.new_ones(()), rtol=0, atol=1e-6)
    grid = Disk(600)
    wi = grid.directions().reshape(-1, 3)
    weight = grid.projected_solid_angles().flatten()
    for name in ("blinn-phong 20", "cook-torrance 0.04 0.3", "ward 0.3", "ward 0.5:0.05", "ggx 1 1"):
        for direction in wo[[0, 4]]:
            dense = float((SHAPES[name](wi, direction) * weight).sum())
            assert float(albedo(SHAPES[name], direction, turns=200)) == pytest.approx(dense, abs=2e-4)


@pytest.mark.parametrize("name", [n for n in SHAPES if " 0.04 " not in n])
def test_albedo_has_converged(name: str) -> None:
    """The accuracy that its docstring states, against a quarter more nodes (other ones)."""
    wo = torch.stack([tilted(t, 0.3) for t in ANGLES[2::4] + ANGLES[-1:]])
    turns = 200 if ":" in name else 48
    error = (albedo(SHAPES[name], wo, turns=turns) - albedo(SHAPES[name], wo, rings=200, turns=turns * 5 // 4)).abs()
    assert error.max() < 5e-4 and error[:2].max() < 2e-4
    if "cook" not in name:
        assert error.max() < 2e-4 and (":" in name or error[:2].max() < 1e-7)


@pytest.mark.parametrize("exponent", [0, 1e-3, 0.5, 1, 2, 8, 64, 1e3, 1e4, 1e6])
def test_blinn_phong_albedo_is_one_at_normal_incidence_and_falls_with_the_angle(exponent: float) -> None:
    value = albedo(lambda i, o: brdf.blinn_phong(i, o, exponent), torch.stack([tilted(t) for t in ANGLES]))
    assert float(value[0]) == pytest.approx(1, abs=1e-7)
    assert value.diff().max() < 1e-6 and value.max() < 1 + 1e-6
    if exponent == 1e6:
        assert torch.allclose(value, torch.tensor(ANGLES).double().deg2rad().cos() ** 2, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", [n for n in SHAPES if n.startswith(("ward", "ggx"))])
def test_ward_and_ggx_albedos_are_at_most_one(name: str) -> None:
    """Ward in the bounded form by its construction; GGX because Smith masking only takes away."""
    for azimuth in (0.0, math.pi / 2) if ":" in name else (0.3,):
        wo = torch.stack([tilted(t, azimuth) for t in ANGLES])
        value = albedo(SHAPES[name], wo, turns=200 if ":" in name else 48)
        assert value[:7].max() < 1 + 1e-6 and value.max() < 1 + 2e-4  # the quadrature's error beyond 85 degrees


@pytest.mark.parametrize("a", SLOPES)
def test_ward_and_ggx_albedos_at_normal_incidence(a: float) -> None:
    """With u = tan^2 th_h, wi.z = (1 - u)/(1 + u): Ward's is the integral of exp(-u / a^2) (1 - u) / a^2 over 0..1.

    GGX at roughness 1 and f0 = 1: D = 1/pi, masking 1/(2 (1 + n.l)): the integral of x / (1 + x) over 0..1.
    """
    ward = float(albedo(lambda i, o: brdf.ward(i, o, a), tilted(0)))
    assert ward == pytest.approx(1 - a * a * (1 - math.exp(-1 / max(a * a, 1e-3))), abs=1e-7)
    assert float(albedo(SHAPES["ggx 1 1"], tilted(0))) == pytest.approx(1 - math.log(2), abs=1e-7)


@pytest.mark.parametrize("m", SLOPES)
def test_cook_torrance_albedo_is_at_most_four_over_pi(m: float) -> None:
    """V-grooves conserve energy with 1/(4 pi) for 1/pi^2; metal reaches the bound where the lobe is cut or narrow.

    At normal incidence, u as above: 4/pi times the integral of exp(-u / m^2) / m^2 F min(1, 2 (1 - u)/(1 + u)).
    """
    wo = torch.stack([tilted(t) for t in ANGLES])
    x, w = np.polynomial.legendre.leggauss(200)
    for f0 in F0S:
        value = albedo(partial(brdf.cook_torrance, f0=f0, m=m), wo)
        normal = 0.0
        for a, b in ((0.0, 1 / 3), (1 / 3, 1.0)):
            b = min(b, max(a, 40 * m * m))
            u = (a + b) / 2 + (b - a) / 2 * x
            f = f0 + (1 - f0) * (1 - 1 / np.sqrt(1 + u)) ** 5
            shape = np.exp(-u / m**2) / m**2 * f * np.minimum(1, 2 * (1 - u) / (1 + u))
            normal += 4 / math.pi * float((shape * w).sum()) * (b - a) / 2
        assert float(value[0]) == pytest.approx(normal, abs=2e-4)  # as `albedo` states: the kink of G
        assert value.max() < 4 / math.pi + 5e-4
    assert float(value.max()) == pytest.approx(4 / math.pi, abs=1e-3)


def test_cook_torrance_is_the_formula_of_the_fitted_table() -> None:
    """Written out at one pair of directions, term by term, in plain Python."""
    wi = tilted(30)
    wo = tilted(-50)
    f0 = 0.2
    m = 0.3
    h = (wi + wo) / (wi + wo).norm()
    th = math.acos(float(h[2]))
    vh = float(wo @ h)
    d = math.exp(-(math.tan(th) ** 2) / m**2) / (m**2 * math.cos(th) ** 4)
    f = f0 + (1 - f0) * (1 - vh) ** 5
    nl = float(wi[2])
    nv = float(wo[2])
    g = min(1.0, 2 * float(h[2]) * nv / vh, 2 * float(h[2]) * nl / vh)
    assert float(brdf.cook_torrance(wi, wo, f0, m)) == pytest.approx(d * f * g / (math.pi**2 * nl * nv), rel=1e-12)


def test_anisotropic_ward_turns_with_its_axes() -> None:
    """Swapping the slopes is turning both directions by 90 degrees; equal slopes are isotropic."""
    wi = hemisphere(500)
    wo = hemisphere(500, 1)
    turn = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    swapped = brdf.ward(wi @ turn.T, wo @ turn.T, 0.5, 0.1)
    assert torch.allclose(swapped, brdf.ward(wi, wo, 0.1, 0.5), rtol=1e-9)
    assert torch.equal(brdf.ward(wi, wo, 0.3, 0.3), brdf.ward(wi, wo, 0.3))
    assert not torch.allclose(brdf.ward(wi, wo, 0.1, 0.5), brdf.ward(wi, wo, 0.5, 0.1), rtol=0.1)


def test_ggx_is_the_formula_of_gltf() -> None:
    """D, G2 = 2 nl nv / (..) and F written out in plain Python, f = D G F / (4 nl nv)."""
    wi = tilted(40)
    wo = tilted(-25)
    f0 = 0.1
    roughness = 0.5
    h = (wi + wo) / (wi + wo).norm()
    a2 = roughness**4
    nl = float(wi[2])
    nv = float(wo[2])
    nh = float(h[2])
    vh = float(wo @ h)
    d = a2 / (math.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    smith = [(-1 + math.sqrt(1 + a2 * (1 / c**2 - 1))) / 2 for c in (nl, nv)]
    f = f0 + (1 - f0) * (1 - vh) ** 5
    expected = d * f / (1 + sum(smith)) / (4 * nl * nv)
    assert float(brdf.ggx(wi, wo, f0, roughness)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", [n for n in SHAPES if "1e+06" not in n and "0.0001" not in n])
def test_float32_agrees_with_float64(name: str) -> None:
    wi = hemisphere(500)
    wo = torch.nn.functional.normalize(wi * torch.tensor([-1.0, -1.0, 1.0]) + 0.02 * hemisphere(500, 2), dim=1)
    wi32 = wi.float()
    wo32 = wo.float()
    exact = SHAPES[name](wi32.double(), wo32.double())
    assert torch.allclose(SHAPES[name](wi32, wo32).double(), exact, rtol=2e-3, atol=1e-5 * float(exact.max()))


def test_float32_peak_of_the_narrowest_ggx() -> None:
    """At the normal f = D / 4 = 1 / (4 pi a^2) with a = 1e-8: a^4 = 1e-32 is still a float32."""
    up = torch.tensor([0.0, 0.0, 1.0])
    assert float(brdf.ggx(up, up, 1.0, 1e-4)) == pytest.approx(1e16 / (4 * math.pi), rel=1e-5)


@pytest.mark.parametrize(
    "model", [brdf.cook_torrance, brdf.ward, brdf.ggx, lambda i, o, n, _: brdf.blinn_phong(i, o, 50 * n)]
)
def test_gradients(model: Callable[..., Tensor]) -> None:
    wi = hemisphere(5)
    wo = hemisphere(5, 1)
    a, b = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.3, 0.4))
    assert torch.autograd.gradcheck(lambda x, y: model(wi, wo, x, y), (a, b))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("width", [1e-4, 1.0])
@pytest.mark.parametrize("f0", [0.0, 1.0])
def test_gradients_are_finite_at_the_extremes(f0: float, width: float, dtype: torch.dtype) -> None:
    """Of all four models, at all pairs of extreme directions and with either or both of them below the horizon."""
    a, b = extremes()
    wi, wo = (x.to(dtype) for x in (torch.cat([a, a, -a]), torch.cat([b, -b, -b])))
    x, y = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in (f0, width))
    models = (
        brdf.cook_torrance(wi, wo, x, y),
        brdf.ggx(wi, wo, x, y),
        brdf.ward(wi, wo, y),
        brdf.ward(wi, wo, y, 1.0),
        brdf.blinn_phong(wi, wo, 1e6 * x),
    )
    for value in models:
        assert (value[len(a) :] == 0).all()
        used = [p for p in torch.autograd.grad(value.sum(), (x, y), allow_unused=True) if p is not None]
        assert used and all(p.isfinite() for p in used)


@pytest.mark.parametrize("name", SHAPES)
def test_finite_in_float32_also_next_to_the_horizon(name: str) -> None:
    assert all(SHAPES[name](wi.float(), wo.float()).isfinite().all() for wi, wo in (near_mirror(), extremes()))
    for z in (1e-3, 1e-6, 1e-9, 1e-12):
        a = torch.tensor([1.0, 0.0, z])
        b = torch.tensor([-1.0, 0.0, z])
        for wi, wo in [(a, b), (a, a), (b, torch.tensor([0.0, 1.0, z]))]:
            assert SHAPES[name](wi, wo).isfinite()
