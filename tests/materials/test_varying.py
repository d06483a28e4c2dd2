"""Materials that vary over a surface: shares that sum to one, layers that are exact at knots, configs, refusals."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import ptt
from ptt.materials import varying
from ptt.materials.material import LayersAt
from ptt.materials.varying import KNOTS, SurfaceMaterial, all_shares


def directions(count: int) -> tuple[Tensor, Tensor]:
    """Directions above the horizon (n, 3) twice."""
    random = torch.Generator().manual_seed(0)
    both = torch.randn(2, count, 3, generator=random, dtype=torch.float64)
    both[..., 2] = both[..., 2].abs() + 0.05
    wi, wo = torch.nn.functional.normalize(both, dim=2)
    return wi, wo


def by_layers(material: SurfaceMaterial, at: LayersAt, wi: Tensor, wo: Tensor) -> Tensor:
    """The BRDF (n, 3) as relighters have it: the layers' by their shares."""
    each = [layer.evaluate(wi, wo, at.colour) for layer in material.layers]
    return (torch.stack(each) * all_shares(material, at)).sum(0)


VALUES = torch.rand(2, 200, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
COLOUR = torch.rand(200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.3), (1.0, 0.2), (0.4, 0.7)])
def test_a_metal_that_is_the_same_everywhere(metallic: float, roughness: float) -> None:
    """At a point of a base colour it is `metal_rough` of base times that colour, by layers too."""
    wi, wo = directions(200)
    material = ptt.MetalRough((0.9, 0.5, 0.7), metallic, roughness, 0.05)
    at = material.at(torch.ones(2, 200).double(), COLOUR)
    exact = material.evaluate(wi, wo, COLOUR, torch.ones(2, 200).double())
    one = [
        ptt.metal_rough((material.base * c).tolist(), metallic, roughness, 0.05).evaluate(wi[k], wo[k])
        for k, c in enumerate(COLOUR)
    ]
    torch.testing.assert_close(exact, torch.stack(one), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(by_layers(material, at, wi, wo), exact, rtol=1e-5, atol=1e-7)


def test_layers_are_exact_at_knots() -> None:
    wi, wo = directions(200)
    knots = torch.tensor(KNOTS, dtype=torch.float64)[torch.arange(200) % len(KNOTS)]
    values = torch.stack((VALUES[0], knots))
    material = ptt.MetalRough(metallic_map=VALUES[0], roughness_map=knots)
    found = by_layers(material, material.at(values, COLOUR), wi, wo)
    torch.testing.assert_close(found, material.evaluate(wi, wo, COLOUR, values), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("roughness", [0.04, 0.1, 0.33, 0.9])
def test_layers_between_knots_reflect_as_much(roughness: float) -> None:
    """Under light of 1 from everywhere: the quadrature is that of the test, 64 x 128 directions about the mirror's."""
    from ptt.ops.albedo import nodes

    wo = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    wi, weights = nodes(wo, 1e-4, 64, 64)
    count = wi.shape[1]
    values = torch.tensor([[1.0], [roughness]], dtype=torch.float64).expand(2, count)
    colour = torch.tensor([[0.9, 0.5, 0.04]], dtype=torch.float64).expand(count, 3)
    material = ptt.MetalRough(roughness_map=torch.tensor([0.03, 1.0]))
    found = by_layers(material, material.at(values, colour), wi[0], wo.expand(count, 3))
    exact = material.evaluate(wi[0], wo.expand(count, 3), colour, values)
    albedos = [(value * weights[0][:, None]).sum(0) for value in (found, exact)]
    torch.testing.assert_close(*albedos, rtol=0.02, atol=0)


def test_shares_sum_to_one() -> None:
    """Colour by colour, in each group; what is left of the base colour is the dielectric's."""
    material = ptt.MetalRough((0.8, 0.6, 0.4), 0.9, 0.8, 0.06, VALUES[0], VALUES[1])
    at = material.at(VALUES, COLOUR)
    torch.testing.assert_close(at.shares.sum(0), torch.ones(200, 3).double(), rtol=0, atol=1e-6)
    assert (at.shares >= 0).all()
    diffuse = COLOUR * material.base * 0.94 * (1 - 0.9 * VALUES[0][:, None])
    torch.testing.assert_close(at.colour, diffuse, rtol=1e-6, atol=0)
    mixed = ptt.Mixed(ptt.ggx(f0=(0.9, 0.5, 0.1)), ptt.lambert(0.3), VALUES[0])
    shares = mixed.at(VALUES[:1], COLOUR).shares
    assert len(shares) == len(mixed.layers) == 3
    torch.testing.assert_close(shares[1] + shares[2], torch.ones(200, 3).double())


def test_what_is_dull_of_a_metal_is_its_mean() -> None:
    """By the specification of glTF, appendix B: base (1 - metallic) (1 - 0.04), of a map that is half metal."""
    half = ptt.MetalRough((0.8, 0.2, 0.1), metallic_map=torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(half.diffuse, torch.tensor([0.384, 0.096, 0.048]))
    assert not ptt.MetalRough(0.8).diffuse.any()


def test_mixed_is_linear() -> None:
    wi, wo = directions(200)
    first, second = ptt.ggx(0.2, f0=(0.9, 0.5, 0.1), roughness=0.3), ptt.blinn_phong(0.6, 0.2, 9.0)
    mixed = ptt.Mixed(first, second, VALUES[0])
    expected = torch.lerp(first.evaluate(wi, wo, COLOUR), second.evaluate(wi, wo, COLOUR), VALUES[0][:, None])
    torch.testing.assert_close(mixed.evaluate(wi, wo, COLOUR, VALUES[:1]), expected)
    found = by_layers(mixed, mixed.at(VALUES[:1], COLOUR), wi, wo)
    torch.testing.assert_close(found, expected)


def test_layers_only_of_the_roughnesses_that_there_are() -> None:
    few = ptt.MetalRough(roughness=0.5, roughness_map=ptt.Texture(torch.tensor([[[0.6], [0.7]]])))
    assert few.knots == (0.28, 0.35) and few.groups == ((0, 1, 2, 3),)
    assert ptt.MetalRough(roughness=0.43, roughness_map=torch.ones(3)).knots == (0.43,)
    assert ptt.MetalRough(roughness=0.0, roughness_map=torch.rand(3)).knots == (0.03,)
    assert ptt.MetalRough(roughness_map=torch.tensor([0.0, 1.0])).knots == KNOTS


def test_configs_come_back() -> None:
    """As plain values, but for the maps, which are told from others by their values."""
    maps = torch.rand(2, 9)
    for material in (
        ptt.MetalRough(0.5, 0.2, 0.3, (0.1, 0.2, 0.3), maps[0], maps[1]),
        ptt.MetalRough(roughness_map=maps[1]),
        ptt.Mixed(ptt.lambert(0.2), ptt.ggx(f0=(0.9, 0.5, 0.1)), maps[0]),
        ptt.ward(0.2),
    ):
        back = varying.from_config(json.loads(json.dumps(varying.to_config(material))), maps)
        assert varying.same(back, material)
    rough = ptt.MetalRough(0.5, 0.2, 0.3, roughness_map=maps[1])
    for other in (replace(rough, roughness=0.4), replace(rough, roughness_map=maps[0]), ptt.lambert(0.5)):
        assert not varying.same(rough, other)
    with pytest.raises(ValueError, match="unknown 'gloss'; valid are base, metallic"):
        varying.from_config({"model": "metal-rough", "gloss": 1})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"base": 1.5}, "base must be finite and in"),
        ({"metallic": -0.1}, "metallic must be"),
        ({"roughness": (0.1, 0.2, 0.3)}, "roughness must be one number"),
        ({"roughness_map": torch.tensor([[0.1, 1.2]])}, r"roughness_map must be finite and in \[0, 1\]"),
        ({"roughness_map": torch.rand(2, 2, 2)}, r"roughness_map must be a texture \(h, w\)"),
        ({"metallic_map": ptt.Texture(torch.rand(4, 4, 3))}, "metallic_map must be a ptt.Texture of one channel"),
        ({"metallic_map": "rust.png"}, "metallic_map must be a ptt.Texture of one channel"),
    ],
)
def test_refusals(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ptt.MetalRough(**arguments)  # type: ignore[arg-type]
