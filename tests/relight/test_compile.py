"""torch.compile(relighter): kernels stay as they are, torch's own steps are fused; no graph breaks, same answers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.utils import counters

import ptt
from ptt.relight.relighter import Relighter

pytestmark = pytest.mark.usefixtures("built")
SKY = ptt.Environment(
    nn.functional.avg_pool2d(ptt.Environment.sun_sky(radius=10.0).map.movedim(-1, 0), 8).movedim(0, -1)
)
EYES = (torch.tensor([1.0, 2.0, 3.0]), torch.tensor([-2.0, 1.0, 0.5]))
MATERIALS = (ptt.blinn_phong(0.3, 0.4, 12.0), ptt.blinn_phong((0.1, 0.5, 0.3), 0.6, 20.0))


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    torch._dynamo.reset()
    counters.clear()
    yield
    torch._dynamo.reset()


@pytest.fixture(params=["clusters", "points", "environment map", "triple product"])
def make(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Callable[[bool], Relighter]:
    """Each relighter, by kernels or by torch alone."""
    if request.param in ("clusters", "points"):
        model = request.getfixturevalue("clustered_model" if request.param == "clusters" else "small_model")
        return lambda compiled: ptt.TransferRelighter(model, compiled)
    if request.param == "environment map":

        def environment_map(compiled: bool) -> Relighter:
            rotation = ptt.LightRotation.build(16, 4, compiled=compiled)
            return ptt.EnvMapRelighter(small_scene, rotation, terms=16, views=16, compiled=compiled)

        return environment_map
    return lambda compiled: ptt.TripleProductRelighter(
        small_scene, 1, normals=6, twists=6, source=16, views=16, compiled=compiled
    )


def frames(relighter: Any) -> list[Tensor]:
    """After a change of view, of material, of both, and of the light."""
    return [
        relighter(light, {"ball": material}, eye)
        for light in (SKY, SKY.rotated(y=40))
        for material in MATERIALS
        for eye in EYES
    ]


@pytest.mark.parametrize("compiled", [True, False], ids=["kernels", "torch alone"])
def test_is_the_eager_one_without_a_graph_break(make: Callable[[bool], Relighter], compiled: bool) -> None:
    """The bound: the order of sums in float32; and where points send out int16, the last place of it."""
    relighter = make(compiled)
    wanted = frames(relighter)
    got = frames(torch.compile(make(compiled), backend="inductor" if compiled else "aot_eager"))
    assert not dict(counters["graph_break"])
    assert (counters["stats"]["unique_graphs"] == 0) == compiled  # where kernels are, nothing is left to fuse
    for one, other in zip(got, wanted, strict=True):
        assert torch.allclose(one, other, rtol=1e-5, atol=(1e-4 if compiled else 1e-5) * float(other.abs().max()))


def test_inductor_alone_is_the_eager_one(clustered_model: ptt.TransferModel) -> None:
    """Of the largest radiance: the order of sums, and of roundings to what the map is read at."""
    eager = ptt.TransferRelighter(clustered_model, compiled=False)
    alone = torch.compile(ptt.TransferRelighter(clustered_model, compiled=False))
    for eye in EYES:
        wanted = eager(SKY, {}, eye)
        assert torch.allclose(alone(SKY, {}, eye), wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))
    assert not dict(counters["graph_break"])


@pytest.mark.parametrize("compiled", [True, False], ids=["kernels", "torch alone"])
def test_the_steps_are_whole_graphs(clustered_model: ptt.TransferModel, compiled: bool) -> None:
    """The BRDF step's contraction and the view step trace with fullgraph in a function that calls them, kernels too."""
    steps = ptt.TransferRelighter(clustered_model, compiled).steps
    light = steps.incident(SKY)
    own = list(clustered_model.receivers.materials.values())
    tables = steps.materials(own)

    @torch.compile(fullgraph=True, backend="aot_eager")
    def frame(light: Any, tables: Any, eye: Tensor) -> Tensor:
        radiance: Tensor = steps.radiance(steps.contracted(light, tables), eye)
        return radiance

    wanted = steps.radiance(steps.exitant(light, own), EYES[0])
    assert torch.allclose(frame(light, tables, EYES[0]), wanted, rtol=1e-5, atol=5e-4 * float(wanted.abs().max()))
    assert counters["stats"]["unique_graphs"] == 1 and not dict(counters["graph_break"])


def test_caches_work_as_before(clustered_model: ptt.TransferModel) -> None:
    """Compiled or not, a step is not made again while what it was made from is unchanged."""
    relighter = ptt.TransferRelighter(clustered_model)
    compiled = torch.compile(relighter)
    compiled(SKY, {}, EYES[0])
    light = relighter.incident(SKY)
    compiled(SKY, {"ball": MATERIALS[0]}, EYES[1])
    assert relighter.incident(SKY) is light


def test_gradients_pass(clustered_model: ptt.TransferModel) -> None:
    weight = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    grads = []
    for relighter in (
        ptt.TransferRelighter(clustered_model),
        torch.compile(ptt.TransferRelighter(clustered_model), backend="aot_eager"),
    ):
        radiance = relighter(SKY, {"ball": ptt.Material(weight)}, EYES[0])
        grads.append(torch.autograd.grad(radiance.mean(), weight)[0])
    assert torch.allclose(grads[0], grads[1], rtol=1e-4)
    assert bool((grads[0] > 0).all())
