"""Gaussian lobes: what is taken out is what is put back, the remainder is smooth and not negative, nothing is lost."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ptt.materials.shapes import GGX, BlinnPhong, CookTorrance, Shape, Ward
from ptt.ops import brdf, harmonics, lobes, separation
from ptt.ops.albedo import nodes

SHAPES: list[Shape] = [
    BlinnPhong(20.0),
    BlinnPhong(200.0),
    BlinnPhong(5000.0),
    CookTorrance(0.05, 0.15),
    CookTorrance(0.9, 0.3),
    CookTorrance(0.6, 0.01),
    GGX(0.04, 0.3),
    GGX(1.0, 0.1),
    Ward(0.1),
    Ward(0.05, 0.3),
]
TILTS = (0.0, 30.0, 60.0, 80.0, 88.0)


def tilted(degrees: float, turn: float = 0.0) -> Tensor:
    a = math.radians(degrees)
    b = math.radians(turn)
    return torch.tensor([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)], dtype=torch.float64)


OUT = torch.stack([tilted(t, turn) for t in TILTS for turn in (0.0, 50.0)])


TABLE = lobes.tilts_and_turns(isotropic=True)[0]
STRAIGHT = torch.stack((torch.ones(4, 64), TABLE[:, 2].expand(4, -1)))  # axes that are the mirror direction
GLOSSY = CookTorrance(0.138, 0.233)


def at_wo(found: separation.SeparatedLobes) -> separation.SeparatedLobes:
    return separation.SeparatedLobes(*(part[..., None] for part in found))


def reflectances(f: separation.Function, wo: Tensor) -> Tensor:
    """(k, t) of lobes about the mirror direction."""
    return separation.reflectances(separation.lobe_light([f], wo), lobes.ANGLES, STRAIGHT)[0]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("count", [1, 3, 4])
def test_lobes_and_remainder_reflect_as_much_as_the_brdf(shape: Shape, count: int) -> None:
    """The white furnace, direction by direction: what the lobes reflect is what the remainder lacks."""
    angles = lobes.ANGLES[:count]
    found = separation.separate(shape.evaluate, OUT, angles)
    wi, weights = nodes(OUT, finest=1e-5, rings=300, turns=200)
    wo = OUT[:, None].expand_as(wi)
    values = shape.evaluate(wi, wo)
    rest = separation.remainder(values, lobes.from_mirror(wi, wo), at_wo(found), angles)
    whole = (values * weights).sum(-1)
    left = (rest * weights).sum(-1)
    reflected = separation.lobe_light([shape.evaluate], OUT, angles, 32 if shape.isotropic else 160).total[:, 0]
    assert torch.allclose(reflected + left, whole, rtol=0.01 if shape.isotropic else 0.03)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_remainder_is_between_zero_and_the_brdf_and_flat_at_the_mirror_direction(shape: Shape) -> None:
    found = separation.separate(shape.evaluate, OUT)
    wi, _ = nodes(OUT, finest=1e-4, rings=100, turns=50)
    wo = OUT[:, None].expand_as(wi)
    values = shape.evaluate(wi, wo)
    rest = separation.remainder(values, lobes.from_mirror(wi, wo), at_wo(found))
    assert (rest >= 0).all() and (rest <= values * (1 + 1e-9)).all()
    assert (rest.masked_fill(lobes.from_mirror(wi, wo) >= math.radians(21), 0) <= found.levels[-1][:, None]).all()


def test_diffuse_has_no_lobes() -> None:
    assert float(separation.lobe_light([brdf.lambert], OUT).total.abs().max()) < 1e-12


def test_one_gaussian_is_found_again() -> None:
    """A BRDF that is one lobe of 14 degrees on a matt ground is explained by it; at normal incidence, exactly round."""
    up = tilted(0.0)[None]

    def f(wi: Tensor, wo: Tensor) -> Tensor:
        return 0.1 + 3.0 * lobes.gaussian(lobes.from_mirror(wi, wo), 14.0)

    found = reflectances(f, up)[:, 0]
    assert float(found[2] / lobes.response(up, 14.0)) == pytest.approx(3.0, rel=0.05)
    assert float(found.sum() - found[2]) < 0.05 * float(found[2])


def test_a_mirror_goes_to_the_lobe_of_zero_degrees() -> None:
    found = reflectances(CookTorrance(1.0, 0.003).evaluate, tilted(30.0)[None])
    assert float(found[0] / found.sum()) > 0.99


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_invariance(scale: float) -> None:
    shape = CookTorrance(0.5, 0.1)
    plain, straight = separation.tables([shape.evaluate], True)
    scaled, axes = separation.tables([lambda wi, wo: shape.evaluate(wi, wo) * scale], True)
    assert torch.allclose(scaled / scale, plain, rtol=0, atol=1e-4)  # float32 decides what is left out
    assert torch.allclose(axes, straight, atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_lobes_reflect_all_that_they_take_over(shape: Shape) -> None:
    light = separation.lobe_light([shape.evaluate], TABLE, turns=16)
    axes = separation.axes_of([light], lobes.ANGLES)
    found = separation.reflectances(light, lobes.ANGLES, axes)
    assert torch.allclose(found.sum(1).T, light.total, rtol=1e-9, atol=1e-12)
    leant = lobes.lean(axes, light.wo)
    assert torch.allclose(leant.norm(dim=2), torch.ones(64, 4), atol=1e-5) and (leant[..., 2] > 0).all()


def test_axes_meet_the_middle_of_the_light() -> None:
    """The mean direction of what is taken over is that of the Gaussians about their axes."""
    light = separation.lobe_light([GLOSSY.evaluate], TABLE, turns=16)
    axes = separation.axes_of([light], lobes.ANGLES)
    shares = separation.reflectances(light, lobes.ANGLES, axes)[0].T / light.total  # shape: (t, k)
    shrunk = torch.tensor([float(lobes.zonal(a or lobes.MIRROR, 2)[1]) for a in lobes.ANGLES])
    ours = ((shares * shrunk)[..., None] * lobes.lean(axes, light.wo)).sum(1)
    exact = (light.light[:, 0, :, None] * light.wi).sum(1)
    straight = ((shares * shrunk)[..., None] * lobes.mirror(light.wo)[:, None]).sum(1)
    assert float(lobes.angle_between(ours, exact.double()).max()) < math.radians(2)
    assert float(lobes.angle_between(straight, exact.double())[-8:].min()) > math.radians(4)


@pytest.mark.parametrize("degrees", [75.0, 83.0, 87.0])
def test_near_the_horizon_lobes_lean_to_where_the_light_comes_from(degrees: float) -> None:
    """200 soft lights of 8 degrees: by quadrature over f_s, and by the Gaussians about their axes, about the mirror's.

    A light and a Gaussian of variances s and t about axes x apart meet in one of s + t, exp(-x^2 / 2 (s + t)), nearly.
    """
    wo = tilted(degrees)[None]
    light = separation.lobe_light([GLOSSY.evaluate], wo)
    _, axes = separation.tables([GLOSSY.evaluate], True)
    offsets = 0.4 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    lights = torch.nn.functional.normalize(lobes.mirror(wo).float() + offsets + torch.tensor([0.0, 0.0, 0.15]), dim=1)
    size = math.radians(8) ** 2
    exact = ((lights @ light.wi[0].T - 1) / size).exp() @ light.light[0, 0]

    def shown(table: Tensor) -> Tensor:
        shares = separation.reflectances(light, lobes.ANGLES, table)[0, :, 0] / light.total[0]
        wide = size + torch.tensor([lobes.sigma(a) ** 2 for a in lobes.ANGLES])
        seen = (((lights @ lobes.lean(table, wo.float())[0].T - 1) / wide).exp() * size / wide).double() @ shares
        error: Tensor = (seen - exact).norm() / exact.norm()
        return error

    assert float(shown(axes)) < 0.06
    assert float(shown(axes)) < float(shown(STRAIGHT.float())) / 3


@pytest.mark.parametrize("lean", [0.0, 10.0])
@pytest.mark.parametrize("degrees", [0.0, 40.0, 70.0, 89.0])
@pytest.mark.parametrize("k", range(4))
def test_evaluated_lobes_reflect_their_fraction(k: int, degrees: float, lean: float) -> None:
    """The integral of f_s cos over the hemisphere; that of 0 degrees is a mirror's, which a wide cone only nears."""
    if k == 0 and degrees > 80:
        pytest.skip("a cone of 3.5 degrees is cut by the horizon, a mirror is not")
    if degrees < lean:
        pytest.skip("beyond the normal")
    wo = tilted(degrees)
    tilt = torch.acos(TABLE[:, 2])
    axes = torch.stack(((tilt - math.radians(lean)).sin() / tilt.sin(), (tilt - math.radians(lean)).cos()))
    wi, weights = nodes(wo, finest=1e-2, rings=400, turns=400)
    reflected = torch.nn.functional.one_hot(torch.tensor(k), 4).double()
    reflected = reflected[:, None].expand(-1, len(wi))
    axes = axes[:, None].expand(-1, 4, -1)
    value = lobes.evaluate(reflected, axes, wi, wo.expand_as(wi))
    assert float((value * weights).sum()) == pytest.approx(1.0, abs=0.01)


def test_lookup_reproduces_its_nodes_and_wraps_around() -> None:
    directions = lobes.tilts_and_turns(isotropic=False)
    table = torch.rand(2, *directions.shape[:2], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(lobes.lookup(table, directions), table, atol=1e-9)
    nearly = torch.tensor([[0.6, -1e-9, 0.8]], dtype=torch.float64)
    exactly = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    assert torch.allclose(lobes.lookup(table, nearly), lobes.lookup(table, exactly), atol=1e-6)


@pytest.mark.parametrize("lobe", lobes.ANGLES)
def test_zonal_is_what_a_lobe_leaves_of_harmonics(lobe: float) -> None:
    """Funk and Hecke: the mean of Y_s under G_k about an axis is zonal[degree of s] Y_s(axis).

    By midpoints on a polar grid about the axis, sin(t) dt dphi, independent of Legendre polynomials. The lobe of 0
    degrees is a mirror: 1 throughout, though `gaussian` gives it a width. 21 degrees leave about 1 - l (l + 1) s^2 / 2.
    """
    order = 5
    rings = 400
    turns = 64
    axis = tilted(50.0, 20.0)
    across = torch.linalg.cross(axis, tilted(0.0))
    across = across / across.norm()
    t = (torch.arange(rings, dtype=torch.float64) + 0.5) * (3 * lobes.sigma(lobe) / rings)
    phi = torch.arange(turns, dtype=torch.float64) * (2 * math.pi / turns)
    circle = phi.cos()[:, None] * across + phi.sin()[:, None] * torch.linalg.cross(axis, across)
    d = t.cos()[:, None, None] * axis + t.sin()[:, None, None] * circle
    weight = (lobes.gaussian(t, lobe) * t.sin())[:, None, None]
    mean = (harmonics.evaluate(d, order) * weight).sum((0, 1)) / (weight.sum() * turns)
    found = lobes.zonal(lobe, order)
    assert found.shape == (order,) and found.dtype == torch.float64
    if lobe == 0:
        assert torch.equal(found, torch.ones_like(found))
    else:
        left = found[harmonics.degrees(order)]
        assert torch.allclose(mean, left * harmonics.evaluate(axis, order), rtol=0, atol=1e-6)
        assert (found.diff() < 0).all() and float(found[0]) == pytest.approx(1.0, abs=1e-12)
