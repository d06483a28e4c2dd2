"""Materials and BRDF spaces: ranges, configs that survive a round trip, coordinates between samples."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt import BlinnPhongSpace, materials

UP = torch.tensor([0.0, 0.0, 1.0])


def test_material_is_diffuse_over_pi_plus_specular_times_shape() -> None:
    m = ptt.blinn_phong((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 10.0)
    peak = float(ptt.BlinnPhong(10.0).evaluate(UP, UP))
    expected = torch.tensor([0.1, 0.2, 0.3]) / math.pi + peak * torch.tensor([0.4, 0.5, 0.6])
    assert torch.allclose(m.evaluate(UP, UP), expected)
    half = torch.tensor([0.5, 0.5, 0.5])
    assert torch.allclose(m.evaluate(UP, UP, half), expected - torch.tensor([0.1, 0.2, 0.3]) / math.pi / 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ptt.blinn_phong(exponent=-1), r"exponent must be finite and in \[0, 1e\+06\], got -1"),
        (lambda: ptt.blinn_phong(exponent=math.nan), "exponent must be finite"),
        (lambda: ptt.cook_torrance(m=0.0), r"m must be finite and in \[0.0001, 1\], got 0"),
        (lambda: ptt.cook_torrance(f0=1.5), r"f0 must be finite and in \[0, 1\], got 1.5"),
        (lambda: ptt.lambert(1.2), "diffuse must be finite and in"),
        (lambda: ptt.blinn_phong(specular=-0.1), "specular must be finite and at least 0"),
        (lambda: ptt.lambert((0.1, 0.2)), r"diffuse must be one number or \(3,\) linear RGB, got shape \(2,\)"),
        (lambda: ptt.Material(0.5, 0.5), "specular > 0 needs a shape"),
    ],
)
def test_out_of_range(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize(
    "material", [ptt.lambert(0.3), ptt.blinn_phong(0.1, (0.1, 0.2, 0.4), 7.0), ptt.cook_torrance(0.2, 0.9, 0.1, 0.25)]
)
def test_config_round_trip(material: ptt.Material) -> None:
    again = materials.from_config(materials.to_config(material))
    assert torch.equal(again.diffuse, material.diffuse) and torch.equal(again.specular, material.specular)
    assert again.shape == material.shape


def test_unknown_models_and_keys_list_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="model must be one of lambert, blinn-phong, cook-torrance, got 'phong'"):
        materials.from_config({"model": "phong"})
    with pytest.raises(ValueError, match=r"'shininess'; valid are diffuse, specular, exponent"):
        materials.from_config({"model": "blinn-phong", "shininess": 3})


def test_coordinates_reproduce_samples_and_are_linear_between_them() -> None:
    space = BlinnPhongSpace((1.0, 4.0, 10.0))
    assert space.coordinates(ptt.BlinnPhong(4.0)).tolist() == [0, 1, 0]
    assert torch.allclose(space.coordinates(ptt.BlinnPhong(5.5)), torch.tensor([0.0, 0.75, 0.25]).double())
    space = BlinnPhongSpace((3.0,))
    assert space.coordinates(ptt.BlinnPhong(3.0)).tolist() == [1]


def test_coordinates_carry_gradients() -> None:
    exponent = torch.tensor(5.0, requires_grad=True)
    BlinnPhongSpace((1.0, 4.0, 10.0)).coordinates(ptt.BlinnPhong(exponent))[2].backward()
    assert exponent.grad is not None and float(exponent.grad) == pytest.approx(1 / 6)


def test_space_refusals() -> None:
    with pytest.raises(ValueError, match=r"exponent must be in 1..64, the model's space, got 100"):
        BlinnPhongSpace().coordinates(ptt.BlinnPhong(100.0))
    with pytest.raises(ValueError, match="the model's space holds blinn-phong shapes, got cook-torrance"):
        BlinnPhongSpace().coordinates(ptt.CookTorrance(0.1, 0.3))
    with pytest.raises(ValueError, match="exponents must hold ascending values"):
        BlinnPhongSpace((3.0, 2.0))
