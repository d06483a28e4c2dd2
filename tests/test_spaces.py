"""BRDF spaces: coordinates between samples, names, paths, and the fitted table."""

from __future__ import annotations

from importlib import resources

import pytest
import torch

import ptt
from ptt import BRDFSpace
from ptt.ops import brdf

FITTED = BRDFSpace.fitted()
PLANE = torch.tensor([[s.f0, s.m] for s in FITTED.samples], dtype=torch.float64)
TABLE = resources.files("ptt").joinpath("data", "ngan_cooktorrance.csv").read_text().splitlines()


def test_coordinates_reproduce_samples_and_are_linear_between_them() -> None:
    space = BRDFSpace.blinn_phong((1.0, 4.0, 10.0))
    assert space.coordinates(ptt.BlinnPhong(4.0)).tolist() == [0, 1, 0]
    assert torch.allclose(space.coordinates(ptt.BlinnPhong(5.5)), torch.tensor([0.0, 0.75, 0.25]).double())
    space = BRDFSpace.blinn_phong((3.0,))
    assert space.coordinates(ptt.BlinnPhong(3.0)).tolist() == [1]


def test_coordinates_carry_gradients() -> None:
    exponent = torch.tensor(5.0, requires_grad=True)
    BRDFSpace.blinn_phong((1.0, 4.0, 10.0)).coordinates(ptt.BlinnPhong(exponent))[2].backward()
    assert exponent.grad is not None and float(exponent.grad) == pytest.approx(1 / 6)


def test_space_refusals() -> None:
    with pytest.raises(ValueError, match=r"exponent must be in 1..200, the model's space, got 300"):
        BRDFSpace.blinn_phong().coordinates(ptt.BlinnPhong(300.0))
    with pytest.raises(ValueError, match="the model's space holds blinn-phong shapes, got cook-torrance"):
        BRDFSpace.blinn_phong().coordinates(ptt.CookTorrance(0.1, 0.3))
    with pytest.raises(ValueError, match="exponents must hold ascending values"):
        BRDFSpace.blinn_phong((3.0, 2.0))


@pytest.mark.parametrize("space", [BRDFSpace.blinn_phong(), FITTED], ids=["blinn-phong", "fitted"])
def test_a_sample_is_its_own_coordinate(space: BRDFSpace) -> None:
    for h in range(0, len(space.samples), 5):
        weights = space.coordinates(space.samples[h])
        assert float(weights[h]) == pytest.approx(1.0, abs=1e-6)
        assert float(weights.abs().sum()) == pytest.approx(1.0, abs=1e-6)


def test_coordinates_are_barycentric_in_the_plane() -> None:
    """Inside the hull the weighted samples lie at the point itself; everywhere at most three weigh, none below 0."""
    plane = PLANE
    for f0, m in torch.rand(200, 2, generator=torch.Generator().manual_seed(0)).double().tolist():
        weights = FITTED.coordinates(ptt.CookTorrance(f0, max(m, 1e-3)))
        assert (weights >= 0).all() and int((weights > 0).sum()) <= 3
        assert float(weights.sum()) == pytest.approx(1.0)
    inside = plane[:3].mean(0) * 0.5 + plane[10:13].mean(0) * 0.5
    reached = FITTED.coordinates(ptt.CookTorrance(*inside.tolist())) @ plane
    assert torch.allclose(reached, inside, atol=1e-9)


def test_outside_of_the_hull_the_nearest_point_in_it() -> None:
    """Against a dense sampling of all segments between samples, which the hull's border is part of."""
    plane = PLANE
    point = torch.tensor([0.9, 0.95], dtype=torch.float64)
    reached = FITTED.coordinates(ptt.CookTorrance(0.9, 0.95)) @ plane
    t = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None, None, None]
    segments = plane[:, None] + t * (plane[None] - plane[:, None])
    assert float((reached - point).norm()) == pytest.approx(float((segments - point).norm(dim=-1).min()), abs=1e-3)


def test_coordinates_of_the_plane_carry_gradients() -> None:
    f0 = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    m = torch.tensor(0.15, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: FITTED.coordinates(ptt.CookTorrance(a, b)), (f0, m), eps=1e-7)


def test_names_give_the_published_numbers_in_merl_colours() -> None:
    """gold-metallic-paint, the file's row times (1, 1.15, 1.66)."""
    gold = ptt.fitted("gold-metallic-paint")
    row = next(r for r in TABLE if r.startswith("gold-metallic-paint,")).split(",")
    kd, ks = ([float(x) * s for x, s in zip(part, (1, 1.15, 1.66), strict=True)] for part in (row[1:4], row[4:7]))
    assert gold.diffuse.tolist() == pytest.approx(kd)
    assert gold.specular.tolist() == pytest.approx(ks)
    assert gold.shape == ptt.CookTorrance(float(row[7]), float(row[8]))
    up = torch.tensor([0.0, 0.0, 1.0])
    peak = float(brdf.cook_torrance(up, up, float(row[7]), float(row[8])))
    expected = [d / torch.pi + s * peak for d, s in zip(gold.diffuse.tolist(), gold.specular.tolist(), strict=True)]
    assert gold.evaluate(up, up).tolist() == pytest.approx(expected, rel=1e-5)


def test_a_wrong_name_suggests_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"no material 'gold-metal-paint' among 86; near it: .*gold-metallic-paint"):
        ptt.fitted("gold-metal-paint")


def test_paths_reach_both_ends_in_even_steps() -> None:
    a, b = FITTED.samples[3], FITTED.samples[40]
    path = FITTED.path(a, b, 5)
    assert path[0].f0 == pytest.approx(a.f0) and path[-1].m == pytest.approx(b.m)
    exponents = [shape.exponent for shape in BRDFSpace.blinn_phong().path(ptt.BlinnPhong(2.0), ptt.BlinnPhong(10.0), 5)]
    assert exponents == pytest.approx([2, 4, 6, 8, 10])
    with pytest.raises(ValueError, match=r"exponent must be in 1\.\.200"):
        BRDFSpace.blinn_phong().at(exponent=201.0)
