"""Eager, compiled and by kernels: one answer in every evaluator and storage, linear in the light, true gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import ptt
from ptt.relight.relighter import Relighter

pytestmark = pytest.mark.usefixtures("built")
SKY = ptt.Environment.sun_sky(radius=8.0)
EYE = torch.tensor([1.0, 2.0, 3.0])
MATERIALS = {"ball": ptt.blinn_phong((0.1, 0.5, 0.3), 0.6, 20.0)}
AGREE = 5e-4  # of the maximum


@pytest.fixture(
    params=[
        *("float32", "float16", "bfloat16", "lobes", "points"),
        *("environment map", "environment map, lamps in the map"),
        *("float", "16-bit", "8-bit", "triples, lobes"),
    ],
    ids=lambda kind: f"{kind} triples" if kind in ("float", "16-bit", "8-bit") else kind,
)
def make(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Callable[[bool], Relighter]:
    """Each relighter, in each storage, by kernels or by torch alone."""
    kind = request.param
    if kind == "points":
        model = request.getfixturevalue("small_model")
        return lambda compiled: ptt.TransferRelighter(model, compiled)
    if kind == "lobes":
        bounced = ptt.compress(request.getfixturevalue("small_bounced"), editable=list(MATERIALS.values()))
        return lambda compiled: ptt.TransferRelighter(bounced, compiled)
    if kind in ("float32", "float16", "bfloat16"):
        clusters = ptt.Clusters(60, 8, 32, 128, getattr(torch, kind))
        brdf, basis = request.getfixturevalue("glossy")
        model = ptt.compress(request.getfixturevalue("small_bounced"), 64, brdf, basis, clusters)
        return lambda compiled: ptt.TransferRelighter(model, compiled)
    if kind.startswith("environment map"):
        rotation = ptt.LightRotation.build(16, 4)
        lamps = kind == "environment map"
        return lambda compiled: ptt.EnvMapRelighter(
            small_scene, rotation, terms=16, views=16, lamps=lamps, compiled=compiled
        )
    lobes = kind == "triples, lobes"
    return lambda compiled: ptt.TripleProductRelighter(
        small_scene,
        1,
        normals=6,
        twists=6,
        source=16,
        views=16,
        highlights="lobes" if lobes else "triangles",
        storage="float" if lobes else kind,
        compiled=compiled,
    )


def of(relighter: Any, light: ptt.Environment = SKY) -> Tensor:
    radiance: Tensor = relighter(light, MATERIALS, EYE)
    return radiance


def difference(one: Tensor, other: Tensor) -> float:
    """The largest, of the maximum."""
    return float((one - other).abs().max() / other.abs().max())


def test_all_forms_agree(make: Callable[[bool], Relighter]) -> None:
    eager = of(make(False))
    torch._dynamo.reset()
    for form in (make(True), torch.compile(make(False), backend="aot_eager"), torch.compile(make(True))):
        assert difference(of(form), eager) < AGREE


@pytest.mark.parametrize("compiled", [False, True])
def test_an_eye_sees_what_directions_to_it_see(
    make: Callable[[bool], Relighter], small_scene: ptt.Scene, compiled: bool
) -> None:
    """At the corners of all triangles that are turned to it; elsewhere highlights may be missing, and nothing else."""
    relighter = make(compiled)
    a, b, c = small_scene.vertices[small_scene.faces].unbind(1)
    turned = (torch.linalg.cross(b - a, c - a) * (EYE - a)).sum(1) > 0
    corners = small_scene.faces[turned].unique()
    towards = EYE - relighter.positions
    seen, whole = (relighter(SKY, MATERIALS, view) for view in (EYE, towards))
    assert difference(seen[corners], whole[corners]) < 1e-5
    matt = {name: ptt.lambert(0.5) for name in MATERIALS}
    seen, whole = (relighter(SKY, matt, view) for view in (EYE, towards))
    assert difference(seen, whole) < 1e-5


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "kernels"])
def test_a_brighter_light_is_brighter_by_its_factor(make: Callable[[bool], Relighter], compiled: bool) -> None:
    """A factor is exact; a map times a number is another map, which differs in the order of sums alone."""
    relighter = make(compiled)
    once = of(relighter)
    for factor in (1e-6, 0.37, 1e6):
        assert ptt.relative_rmse(of(relighter, SKY.scaled(factor)) / factor, once) < 1e-6
        again = ptt.Environment(SKY.map * factor)
        assert ptt.relative_rmse(of(relighter, again) / factor, once) < 1e-5


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "kernels"])
def test_lights_add_up(make: Callable[[bool], Relighter], compiled: bool) -> None:
    """To 1e-5, by kernels, which round highlights to 16 bits, in the root mean square. What is taken for a lamp depends
    on the map around it, so that a sum has others, where they are kept apart."""
    relighter = make(compiled)
    lamp = ptt.Environment.area_light((0.2, 0.9, -0.4), 30.0, (1.0, 2.0, 0.5))
    rounded = isinstance(relighter, ptt.TripleProductRelighter) and relighter.storage != torch.float32
    whole = ptt.Environment(SKY.map + lamp.map)
    bound = 1e-5 if not rounded else AGREE if relighter.storage == torch.float16 else 5e-3
    if isinstance(relighter, ptt.TransferRelighter) and relighter.model.highlights == "lobes":
        bound = 1e-2
    if isinstance(relighter, ptt.TripleProductRelighter) and relighter.narrow:
        bound = 1e-2
    if isinstance(relighter, ptt.EnvMapRelighter) and relighter.light.lamps:
        bound = 2e-2  # cells of 11 degrees
    error = ptt.relative_rmse if compiled else difference
    assert error(of(relighter, whole), of(relighter) + of(relighter, lamp)) < bound


def test_finite_differences_are_the_gradient(make: Callable[[bool], Relighter]) -> None:
    """In float32, to 1 %: of a region of the map, and of a weight; tables in few bits are exact with gradients."""
    relighter = make(False)
    texels = SKY.map.clone().requires_grad_()
    weight = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    step = torch.zeros_like(texels)
    step[40:80] = SKY.map[40:80]

    def total(shift: float, more: float) -> Tensor:
        light = ptt.Environment(texels + shift * step)
        material = ptt.Material(weight + more, 0.4, MATERIALS["ball"].shape)
        radiance: Tensor = relighter(light, {"ball": material}, EYE)
        return radiance.double().sum()

    total(0, 0).backward()
    assert texels.grad is not None and weight.grad is not None
    h = 0.05
    by_light = (total(h, 0) - total(-h, 0)).item() / (2 * h)
    assert float((texels.grad * step).sum()) == pytest.approx(by_light, rel=0.01)
    by_weight = (total(0, h) - total(0, -h)).item() / (2 * h)
    assert float(weight.grad.sum()) == pytest.approx(by_weight, rel=0.01)
