"""Materials and BRDF spaces: ranges, configs that survive a round trip, coordinates between samples."""

from __future__ import annotations

import json
import math

import pytest
import torch

import ptt
from ptt.materials import material as materials
from ptt.materials import shapes
from ptt.ops import brdf

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
        (lambda: ptt.ward(ax=0.0), r"ax must be finite and in \[0.0001, 1\], got 0"),
        (lambda: ptt.ward(ax=0.2, ay=1.5), r"ay must be finite and in \[0.0001, 1\], got 1.5"),
        (lambda: ptt.ggx(roughness=0.0), r"roughness must be finite and in \[0.0001, 1\], got 0"),
        (lambda: ptt.ggx(roughness=torch.tensor(1.01)), "roughness must be finite"),
        (lambda: ptt.ggx(f0=-0.1), r"f0 must be finite and in \[0, 1\], got -0.1"),
        (lambda: ptt.Blend((ptt.Ward(0.2),), (-1.0,)), "weights must be finite and at least 0, got -1"),
        (lambda: ptt.Blend((ptt.Ward(0.2),), (1.0, 2.0)), "weights must be one per shape, got 2 for 1"),
        (lambda: ptt.Blend((), ()), "weights must be one per shape, got 0 for 0"),
        (lambda: ptt.lambert(1.2), "diffuse must be finite and in"),
        (lambda: ptt.blinn_phong(specular=-0.1), "specular must be finite and at least 0"),
        (lambda: ptt.lambert((0.1, 0.2)), r"diffuse must be one number or \(3,\) linear RGB, got shape \(2,\)"),
        (lambda: ptt.Material(0.5, 0.5), "specular > 0 needs a shape"),
    ],
)
def test_out_of_range(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize("material", [
    ptt.lambert(0.3),
    ptt.blinn_phong(0.1, (0.1, 0.2, 0.4), 7.0),
    ptt.cook_torrance(0.2, 0.9, 0.1, 0.25),
    ptt.ward(0.1, (0.1, 0.2, 0.3), 0.3),
    ptt.ward(0.1, 0.2, 0.3, 0.05),
    ptt.ggx(0.0, 1.0, 0.9, 0.3),
    ptt.Material(0.1, (0.3, 0.2, 0.1), ptt.Named("mine")),
    ptt.Material(0.1, 0.3, ptt.Named("brushed", isotropic=False)),
    ptt.Material(0.1, 0.3, ptt.Blend((ptt.Named("mine"), ptt.Named("other")), (0.25, 0.75))),
    ptt.Material(0.1, 0.3, ptt.Blend((ptt.Blend((ptt.GGX(0.1, 0.2),), (2.0,)), ptt.Ward(0.1)), (0.25, 0.75))),
], ids=lambda m: repr(m.shape))  # fmt: skip
def test_config_round_trip(material: ptt.Material) -> None:
    """Through JSON, as saved files hold them."""
    again = materials.from_config(json.loads(json.dumps(materials.to_config(material))))
    assert torch.equal(again.diffuse, material.diffuse) and torch.equal(again.specular, material.specular)
    assert again.shape == material.shape
    if again.shape is not None and material.shape is not None:
        assert again.shape.isotropic == material.shape.isotropic


def test_config_of_tensors_is_plain(recwarn: pytest.WarningsRecorder) -> None:
    def leaf(value: float) -> torch.Tensor:
        return torch.tensor(value, dtype=torch.float64, requires_grad=True)

    blend = ptt.Blend((ptt.GGX(leaf(0.25), leaf(0.5)), ptt.Ward(leaf(0.125))), (leaf(0.5), leaf(2.0)))
    plain = ptt.Blend((ptt.GGX(0.25, 0.5), ptt.Ward(0.125)), (0.5, 2.0))
    assert shapes.to_config(blend) == shapes.to_config(plain)
    assert shapes.from_config(shapes.to_config(blend)) == plain
    assert not recwarn.list


def test_a_named_one_comes_back_without_its_function() -> None:
    mine = ptt.Material(0.1, 0.3, ptt.Named("mine", lambda i, o: i[..., 2] * o[..., 2]))
    assert float(mine.evaluate(UP, UP)[0]) == pytest.approx(0.1 / math.pi + 0.3)
    again = materials.from_config(materials.to_config(mine))
    with pytest.raises(ValueError, match="the BRDF 'mine' came from a saved model, without its function"):
        again.evaluate(UP, UP)


@pytest.mark.parametrize("config", [
    {"model": "blend"},
    {"model": "blend", "shapes": [{"model": "ward", "ax": 0.1}], "weights": [1.0], "sum": 1},
    {"model": "blend", "shapes": [{"model": "phong"}], "weights": [1.0]},
    {"model": "named"},
    {"model": "named", "name": "a", "exponent": 3},
    {"model": "ggx", "f0": 0.1},
    {"model": "ward", "m": 0.1},
    {},
], ids=str)  # fmt: skip
def test_shape_configs_refused(config: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"shape\.model must be one of .*blend, got|shape of model"):
        shapes.from_config(config)


@pytest.mark.parametrize("shape", [
    ptt.Ward(0.3), ptt.Ward(0.3, 0.1), ptt.GGX(0.2, 0.4), ptt.Blend((ptt.Ward(0.3), ptt.GGX(0.2, 0.4)), (0.5, 2.0)),
], ids=repr)  # fmt: skip
def test_shapes_evaluate_their_model(shape: shapes.Shape) -> None:
    """Against `ops.brdf` by hand, at directions off every symmetry plane; zero below the horizon."""
    wi, wo = (torch.nn.functional.normalize(torch.tensor(v), dim=0) for v in ((0.3, -0.5, 0.7), (-0.6, 0.2, 0.9)))
    by_hand = {
        ptt.Ward(0.3): brdf.ward(wi, wo, 0.3, 0.3),
        ptt.Ward(0.3, 0.1): brdf.ward(wi, wo, 0.3, 0.1),
        ptt.GGX(0.2, 0.4): brdf.ggx(wi, wo, 0.2, 0.4),
    }
    expected = by_hand.get(shape, 0.5 * by_hand[ptt.Ward(0.3)] + 2 * by_hand[ptt.GGX(0.2, 0.4)])
    assert float(shape.evaluate(wi, wo)) == pytest.approx(float(expected), rel=1e-6) and float(expected) > 0
    assert float(shape.evaluate(wi, -wo)) == float(shape.evaluate(-wi, wo)) == 0
    assert shape.isotropic == (shape != ptt.Ward(0.3, 0.1))


def test_ward_is_brushed_along_the_tangent_if_ax_is_larger() -> None:
    """ax is the slope along x: the lobe is wide where the half vector tilts towards x."""
    along, across = (torch.tensor([x, y, 0.8]) for x, y in ((0.6, 0.0), (0.0, 0.6)))
    brushed = ptt.ward(0.0, 1.0, 0.4, 0.1)
    assert float(brushed.evaluate(along, UP)[0]) > 2 * float(brushed.evaluate(across, UP)[0])


@pytest.mark.parametrize(("function", "message"), [
    (lambda i, o: -i[..., 2], "must be finite and >= 0 above the horizon"),
    (lambda i, o: i[..., 2] * math.nan, "must be finite and >= 0"),
    (lambda i, o: i, r"must return \(7,\), got \(7, 3\)"),
    (lambda i, o: i[..., 2:], r"must return \(7,\), got \(7, 1\)"),
])  # fmt: skip
def test_named_functions_refused(function: object, message: str) -> None:
    with pytest.raises(ValueError, match=f"the BRDF 'mine' {message}"):
        ptt.Named("mine", function).evaluate(UP.expand(7, 3), UP.expand(7, 3))  # type: ignore[arg-type]


def test_named_functions_count_above_the_horizon_alone() -> None:
    shape = ptt.Named("mine", lambda i, o: torch.where(i[..., 2] * o[..., 2] > 0, 2.0, math.nan))
    assert shape.evaluate(torch.stack((UP, -UP)), UP).tolist() == [2, 0]


def test_gradients_reach_ward_ggx_and_blend() -> None:
    wi, wo = (
        torch.nn.functional.normalize(torch.tensor(v).double(), dim=0) for v in ((0.3, -0.5, 0.7), (-0.6, 0.2, 1))
    )

    def value(ax: torch.Tensor, ay: torch.Tensor, f0: torch.Tensor, r: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        return ptt.Blend((ptt.Ward(ax, ay), ptt.GGX(f0, r)), (0.5, w)).evaluate(wi, wo)

    at = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.3, 0.5, 0.2, 0.6, 1.5)]
    assert torch.autograd.gradcheck(value, at)


def test_unknown_models_and_keys_list_the_valid_ones() -> None:
    with pytest.raises(
        ValueError, match="model must be one of lambert, blinn-phong, cook-torrance, ward, ggx, got 'phong'"
    ):
        materials.from_config({"model": "phong"})
    with pytest.raises(ValueError, match=r"'shininess'; valid are diffuse, specular, exponent"):
        materials.from_config({"model": "blinn-phong", "shininess": 3})
