"""The BRDF tensor: what it approximates, how well, and what it says of its own error."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor

import ptt
from ptt import BRDFSpace
from ptt.materials.material import Highlight
from ptt.materials.shapes import Shape
from ptt.models import tensor_brdf
from ptt.ops import brdf, lobes
from ptt.ops.albedo import albedo, nodes
from ptt.ops.sphere import Disk

SPACE = BRDFSpace.blinn_phong(tuple(2 ** (k / 4) for k in range(25)))


def cosine_directions(n: int, seed: int) -> Tensor:
    """Distributed by projected solid angle, the measure of the fit."""
    u = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed))
    r = u[:, 0].sqrt()
    phi = 2 * math.pi * u[:, 1]
    return torch.stack((r * phi.cos(), r * phi.sin(), (1 - u[:, 0]).clamp(min=1e-8).sqrt()), 1)


@pytest.fixture(scope="module")
def tensor() -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(SPACE, ranks=(4, 24, 24), separated=0)


@pytest.mark.parametrize("k", [0, 8, 16])
def test_stated_error_is_the_error_at_random_directions(tensor: ptt.TensorBRDF, k: int) -> None:
    shape = tensor.space.samples[k]
    wi = cosine_directions(100_000, 0)
    wo = cosine_directions(100_000, 1)
    exact = shape.evaluate(wi, wo)
    error = float((tensor.evaluate(shape, wi, wo) - exact).norm() / exact.norm())
    assert error == pytest.approx(float(tensor.error[k]), rel=0.2)
    assert error < 0.1


def test_reciprocal_up_to_its_error(tensor: ptt.TensorBRDF) -> None:
    wi = cosine_directions(10_000, 2)
    wo = cosine_directions(10_000, 3)
    shape = ptt.BlinnPhong(12.0)
    a = tensor.evaluate(shape, wi, wo)
    b = tensor.evaluate(shape, wo, wi)
    assert float((a - b).norm() / a.norm()) < 0.01


def test_more_factors_are_better_and_error_bounds_are_met() -> None:
    space = BRDFSpace.blinn_phong((2.0, 5.0, 10.0))
    errors = [float(ptt.TensorBRDF.fit(space, ranks=(3, n, n), resolution=24).error.norm()) for n in (4, 8, 16)]
    assert errors[0] > errors[1] > errors[2]
    bounded = ptt.TensorBRDF.fit(space, error=0.05, resolution=24)
    assert 0.01 < float(bounded.error.square().mean().sqrt()) <= 0.05


def test_zero_below_the_horizon(tensor: ptt.TensorBRDF) -> None:
    up = torch.tensor([[0.0, 0.6, 0.8]])
    down = torch.tensor([[0.0, 0.6, -0.8]])
    assert tensor.evaluate(ptt.BlinnPhong(5.0), up, up) > 0
    for wi, wo in [(up, down), (down, up), (down, down)]:
        assert tensor.evaluate(ptt.BlinnPhong(5.0), wi, wo) == 0


def relative_error(tensor: ptt.TensorBRDF, shape: Shape) -> float:
    """At random directions, in the measure of the fit."""
    wi = cosine_directions(50_000, 4)
    wo = cosine_directions(50_000, 5)
    exact = shape.evaluate(wi, wo)
    return float((tensor.evaluate(shape, wi, wo) - exact).norm() / exact.norm())


def error_under_lights(tensor: ptt.TensorBRDF, shape: Shape) -> float:
    """Of the light reflected from 200 soft lights of 8 degrees near the mirror direction, for several tilts."""
    seen = []
    for degrees in (0.0, 30.0, 60.0):
        wo = torch.tensor([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])
        wi, weights = nodes(wo, 1e-4, 100, 60)
        offsets = 0.25 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
        lights = torch.nn.functional.normalize(lobes.mirror(wo) + offsets, dim=1).double()
        light = torch.exp((lights @ wi.T - 1) / math.radians(8) ** 2)
        for f in (lambda i, o: tensor.evaluate(shape, i.float(), o.float()).double(), shape.evaluate):
            seen.append(light @ (f(wi, wo.double().expand_as(wi)) * weights))
    ours = torch.cat(seen[::2])
    exact = torch.cat(seen[1::2])
    return ptt.relative_rmse(ours, exact)


@pytest.mark.parametrize(("exponents", "gain"), [((60.0, 120.0, 200.0), 1.4), ((1000.0, 5000.0), 20.0)])
def test_lobes_show_what_the_factors_do_not(exponents: tuple[float, ...], gain: float) -> None:
    """Under soft lights 8 factors miss a quarter and more of a highlight, with lobes a fraction of that."""
    space = BRDFSpace.blinn_phong(exponents)
    without, with_lobes = (ptt.TensorBRDF.fit(space, (2, 8, 8), separated=k) for k in (0, 4))
    for shape in space.samples:
        assert error_under_lights(without, shape) > 0.2
        assert error_under_lights(with_lobes, shape) < error_under_lights(without, shape) / gain


def test_number_of_lobes_is_decided_by_error() -> None:
    matt = BRDFSpace.user({"matt": brdf.lambert})
    assert ptt.TensorBRDF.fit(matt, (1, 1, 1)).angles == ()
    dull = BRDFSpace.blinn_phong((1.0, 2.0, 4.0))
    assert ptt.TensorBRDF.fit(dull, (3, 8, 8)).angles == ()
    glossy = BRDFSpace.blinn_phong((50.0, 100.0, 200.0))
    assert len(ptt.TensorBRDF.fit(glossy, (3, 8, 8)).angles) >= 3
    few, none = (ptt.TensorBRDF.fit(glossy, error=0.1, separated=k) for k in (None, 0))
    assert few.angles and few.u_i.shape[0] < none.u_i.shape[0]


def test_white_furnace_of_tensor_and_lobes() -> None:
    """Albedos survive: within 4 % of the shape's own at moderate angles, from rough to mirror-like."""
    space = BRDFSpace(tuple(ptt.CookTorrance(0.9, m) for m in (0.01, 0.03, 0.1, 0.3)))
    tensor = ptt.TensorBRDF.fit(space, (4, 12, 12), separated=4)
    grid = Disk(400)
    wi = grid.directions().reshape(-1, 3).float()
    weight = grid.projected_solid_angles().flatten().float()
    for degrees in (0.0, 30.0, 60.0):
        wo = torch.tensor([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])
        for shape in space.samples:
            whole = float(albedo(shape.evaluate, wo))
            assert float((tensor.evaluate(shape, wi, wo) * weight).sum()) == pytest.approx(whole, rel=0.04)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_of_a_user_space_scales_the_values_and_nothing_else(scale: float) -> None:
    def scaled_by(factor: float, exponent: float, wi: Tensor, wo: Tensor) -> Tensor:
        return factor * brdf.blinn_phong(wi, wo, exponent)

    def named(factor: float) -> BRDFSpace:
        return BRDFSpace.user({str(n): partial(scaled_by, factor, n) for n in (10.0, 60.0)})

    plain, scaled = (ptt.TensorBRDF.fit(named(f), (2, 8, 8), separated=2) for f in (1.0, scale))
    wi = cosine_directions(1000, 6)
    wo = cosine_directions(1000, 7)
    for a, b in zip(plain.space.samples, scaled.space.samples, strict=True):
        values = scaled.evaluate(b, wi, wo) / scale
        assert torch.allclose(values, plain.evaluate(a, wi, wo), rtol=1e-3, atol=1e-3 * float(values.abs().max()))
    assert torch.allclose(plain.error, scaled.error, rtol=1e-3, atol=1e-5)


def test_a_new_brdf_keeps_the_factors_and_the_others() -> None:
    space = BRDFSpace.blinn_phong((5.0, 20.0, 40.0))
    old = ptt.TensorBRDF.fit(space, (3, 12, 12), separated=4)
    new = old.with_brdf("mine", ptt.blinn_phong(exponent=20.0))
    assert torch.equal(old.u_i, new.u_i) and torch.equal(old.u_o, new.u_o)
    assert float(new.error[-1]) <= float(old.error[1]) * (1 + 1e-4)
    assert relative_error(new, new.space.samples[-1]) == pytest.approx(relative_error(old, space.samples[1]), rel=0.05)
    wi = cosine_directions(100, 8)
    wo = cosine_directions(100, 9)
    assert torch.allclose(new.evaluate(space.samples[0], wi, wo), old.evaluate(space.samples[0], wi, wo), atol=1e-6)


def test_a_new_material_of_two_highlights_is_the_two_one_after_the_other() -> None:
    old = ptt.TensorBRDF.fit(BRDFSpace.blinn_phong((5.0, 20.0, 40.0)), (3, 12, 12), separated=4)
    basis = ptt.BRDFBasis.fit(old.space, 3)
    highlights = [Highlight(0.3, ptt.BlinnPhong(n)) for n in (8.0, 30.0)]
    material = ptt.Material(0.1, 0.0, None, *highlights)
    both, both_bases = old.with_brdf("mine", material), basis.with_brdf("mine", material)
    wi, wo = cosine_directions(100, 8), cosine_directions(100, 9)
    for row, highlight in enumerate(highlights, 3):
        alone = ptt.Material(0.1, highlight.colour, highlight.shape)
        one, one_basis = old.with_brdf("mine", alone), basis.with_brdf("mine", alone)
        torch.testing.assert_close(both.error[row], one.error[3])
        torch.testing.assert_close(both_bases.table[row], one_basis.table[3])
        seen = both.evaluate(both.space.samples[row], wi, wo)
        torch.testing.assert_close(seen, one.evaluate(one.space.samples[3], wi, wo))


def test_an_anisotropic_brdf_joins_isotropic_ones() -> None:
    old = ptt.TensorBRDF.fit(BRDFSpace.ward((0.2, 0.4, 0.8)), (3, 16, 16), separated=4)
    new = old.with_brdf("brushed", ptt.ward(ax=0.3, ay=0.9))
    up, along, across = (torch.tensor([v]) for v in ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, 0.6, 0.8)))
    shape = new.space.samples[-1]
    assert float(shape.evaluate(across, up)) > 2.5 * float(shape.evaluate(along, up))
    assert float(new.evaluate(shape, across, up)) > 2.5 * float(new.evaluate(shape, along, up))


def test_slices_give_what_memory_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    space = BRDFSpace.blinn_phong((5.0, 10.0, 20.0))
    whole = ptt.TensorBRDF.fit(space, (3, 12, 12), separated=0, resolution=16)
    monkeypatch.setattr(tensor_brdf, "IN_MEMORY", 0.0)
    sliced = ptt.TensorBRDF.fit(space, (3, 12, 12), separated=0, resolution=16)
    assert torch.allclose(whole.error, sliced.error, rtol=0.05)


def test_bytes_ranks_and_broadcasting(tensor: ptt.TensorBRDF) -> None:
    assert tensor.bytes == sum(b.nbytes for b in tensor.buffers())
    with pytest.raises(ValueError, match=r"ranks must be in 1\.\.length"):
        ptt.TensorBRDF.fit(BRDFSpace.blinn_phong((5.0,)), ranks=(2, 4, 4), separated=0)
    wi = cosine_directions(6, 10).reshape(2, 3, 3)
    wo = cosine_directions(3, 11)
    assert tensor.evaluate(ptt.BlinnPhong(5.0), wi, wo).shape == (2, 3)


@pytest.mark.parametrize(
    "samples",
    [
        (ptt.BlinnPhong(0.0), ptt.BlinnPhong(1e6)),
        (ptt.CookTorrance(0.0, 1e-4), ptt.CookTorrance(1.0, 1.0), ptt.CookTorrance(1.0, 1e-4)),
        (ptt.GGX(0.0, 1e-4), ptt.GGX(1.0, 1.0), ptt.GGX(1.0, 0.01)),
        (ptt.Ward(1e-4), ptt.Ward(1.0)),
        (ptt.CookTorrance(0.5, 0.3),),
    ],
    ids=lambda s: s[0].model,
)
def test_extremes_stay_finite_and_lobes_reflect_at_most_the_albedo(
    samples: tuple[Shape, ...],
) -> None:
    tensor = ptt.TensorBRDF.fit(BRDFSpace(samples), (1, 6, 6), separated=4, resolution=16)
    assert all(buffer.isfinite().all() for buffer in tensor.buffers())
    assert (tensor.peaks >= 0).all() and float(tensor.peaks.sum(1).max()) < 4 / math.pi * 1.02
    wi = cosine_directions(1000, 12)
    wo = cosine_directions(1000, 13)
    wi = torch.cat((wi, lobes.mirror(wo), torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1e-5]])))
    wo = torch.cat((wo, wo, torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 1e-5]])))
    for shape in samples:
        assert tensor.evaluate(shape, wi, wo).isfinite().all()
