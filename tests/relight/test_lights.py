"""Turns, factors, tints and sums of lights that are ready cost nothing new in any relighter, and are what they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import ptt
from ptt.light import prefiltered
from ptt.relight.relighter import Relighter

SKY = ptt.Environment.gradient_sky()
LAMP = ptt.Environment(ptt.Environment.area_light((0.6, 0.7, 0.2), 20.0, (3.0, 2.0, 1.0)).map[::2, ::2].contiguous())
TINT = torch.tensor([2.0, 0.5, 1.0])
EYE = torch.tensor([1.0, 2.0, 3.0])
MATERIALS = {"ball": ptt.blinn_phong(0.3, 0.4, 12.0)}


@pytest.fixture(params=["clusters", "clusters, eager", "points", "environment map", "triple product"])
def relighter(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Relighter:
    if request.param == "points":
        return ptt.TransferRelighter(request.getfixturevalue("small_model"))
    if request.param.startswith("clusters"):
        return ptt.TransferRelighter(request.getfixturevalue("clustered_model"), compiled="eager" not in request.param)
    if request.param == "environment map":
        return ptt.EnvMapRelighter(small_scene, ptt.LightRotation.build(16, 4), terms=16, views=16)
    return ptt.TripleProductRelighter(small_scene, 1, normals=6, twists=6, source=16, views=16, storage="float")


def test_relighting_is_linear_in_lights(relighter: Relighter) -> None:
    """Of the maximum: what points send out is rounded to 16 bits by kernels; a turned sum looks lobes up twice."""

    def of(light: ptt.Environment) -> Tensor:
        radiance: Tensor = relighter(light, MATERIALS, EYE)
        return radiance

    turned = LAMP.rotated(x=25, y=130)
    whole = SKY.scaled(TINT) + LAMP.scaled(0.5).rotated(x=25, y=130)
    parts = TINT * of(SKY) + 0.5 * of(turned)
    assert torch.allclose(of(whole), parts, rtol=0, atol=2e-3 * float(parts.max()))
    alike = SKY.scaled(TINT) + LAMP
    parts = TINT * of(SKY) + of(LAMP)
    assert torch.allclose(of(alike), parts, rtol=0, atol=5e-4 * float(parts.max()))


def test_no_map_is_made_ready_twice(relighter: Relighter, monkeypatch: pytest.MonkeyPatch) -> None:
    if isinstance(relighter, ptt.TransferRelighter) and not len(relighter.model.regions):
        pytest.skip("the model of points projects every light anew")
    made: list[Tensor] = []
    make: Callable[..., Any] = prefiltered._made

    def counted(texels: Tensor, *others: Any) -> Any:
        made.append(texels)
        return make(texels, *others)

    monkeypatch.setattr(prefiltered, "_made", counted)
    a = ptt.Environment(SKY.map.clone())
    b = ptt.Environment(LAMP.map.clone())
    for light in (a, b, a.scaled(2.0), a.scaled(TINT).rotated(y=20), a + b.rotated(x=70), b, a):
        relighter(light, MATERIALS, EYE)
    assert [id(texels) for texels in made] == [id(a.map), id(b.map)]
    before = relighter(a, MATERIALS, EYE)
    a.map.mul_(2)
    assert torch.allclose(relighter(a, MATERIALS, EYE), 2 * before, rtol=1e-3)
    assert len(made) == 3


def test_gradients_reach_a_factor(relighter: Relighter) -> None:
    """Against the other side of linearity: the gradient of the sum over colours c of radiance by the tint."""
    tint = TINT.clone().requires_grad_()
    radiance = relighter(SKY.scaled(tint), MATERIALS, EYE)
    radiance.sum().backward()
    assert tint.grad is not None
    expected = relighter(SKY, MATERIALS, EYE).sum(0)
    assert torch.allclose(tint.grad, expected, rtol=2e-3)
