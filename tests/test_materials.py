"""Materials and BRDF spaces: ranges, configs that survive a round trip, coordinates between samples."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt import materials

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
    with pytest.raises(
        ValueError, match="model must be one of lambert, blinn-phong, cook-torrance, ward, ggx, got 'phong'"
    ):
        materials.from_config({"model": "phong"})
    with pytest.raises(ValueError, match=r"'shininess'; valid are diffuse, specular, exponent"):
        materials.from_config({"model": "blinn-phong", "shininess": 3})
