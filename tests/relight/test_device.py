"""Relighters on another device: the light, materials and eye may stay where they are, and the answer is the same."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import ptt
from ptt.relight.relighter import Relighter

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
SKY = ptt.Environment.sun_sky(radius=8.0)
EYE = torch.tensor([1.0, 2.0, 3.0])
MATERIALS = {"ball": ptt.blinn_phong((0.1, 0.5, 0.3), 0.6, 20.0)}


@pytest.fixture(params=["points", "clusters", "lobes", "environment map", "float", "16-bit", "8-bit", "triples, lobes"])
def make(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Callable[[], Relighter]:
    """Each relighter, in each storage."""
    kind = request.param
    if kind == "points":
        model = request.getfixturevalue("small_model")
        return lambda: ptt.TransferRelighter(model)
    if kind == "clusters":
        model = request.getfixturevalue("clustered_model")
        return lambda: ptt.TransferRelighter(model)
    if kind == "lobes":
        model = ptt.compress(request.getfixturevalue("small_bounced"), editable=list(MATERIALS.values()))
        return lambda: ptt.TransferRelighter(model)
    if kind == "environment map":
        rotation = ptt.LightRotation.build(16, 4)
        return lambda: ptt.EnvMapRelighter(small_scene, rotation, terms=16, views=16)
    lobes = kind == "triples, lobes"
    return lambda: ptt.TripleProductRelighter(
        small_scene,
        1,
        normals=6,
        twists=6,
        source=16,
        views=16,
        highlights="lobes" if lobes else "triangles",
        storage="float" if lobes else kind,
    )


def of(relighter: Relighter, light: ptt.Environment) -> Tensor:
    radiance: Tensor = relighter(light, MATERIALS, EYE)
    return radiance


def test_another_device_gives_the_same_picture(make: Callable[[], Relighter]) -> None:
    """To 5e-3 of the maximum, what 16-bit kernels round; the map may be on either device."""
    here = of(make(), SKY)
    there = make().to("cuda")
    for light in (SKY, ptt.Environment(SKY.map.cuda())):
        found = of(there, light)
        assert found.device.type == "cuda"
        assert float((found.cpu() - here).abs().max()) < 5e-3 * float(here.abs().max())


def test_a_model_that_has_moved_gives_the_same_picture(small_bounced: ptt.RawTransfer) -> None:
    """With a relighter made of it afterwards."""
    for highlights in ("tensor", "lobes"):
        model = ptt.compress(small_bounced, editable=list(MATERIALS.values()), highlights=highlights)
        here = of(ptt.TransferRelighter(model), SKY)
        there = of(ptt.TransferRelighter(model.to("cuda")), SKY)
        assert float((there.cpu() - here).abs().max()) < 5e-3 * float(here.abs().max())


def test_another_device_gives_the_same_gradient(make: Callable[[], Relighter]) -> None:
    """Of the picture by the map, which stays on the CPU; a map of its own for each, since a light is kept."""
    gradients = []
    for device in ("cpu", "cuda"):
        texels = SKY.map.clone().requires_grad_()
        of(make().to(device), ptt.Environment(texels)).sum().backward()
        assert texels.grad is not None
        gradients.append(texels.grad)
    here, there = gradients
    assert ptt.relative_rmse(there, here) < 5e-3
