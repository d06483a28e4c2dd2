"""TransferRelighter: against the reference and a dense oracle, its caches, gradients, compiled form and refusals."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

import ptt
from ptt.models.cache import Cache

SKY = ptt.Environment.sun_sky(radius=10.0)


@pytest.fixture()
def relighter(small_model: ptt.TransferModel) -> ptt.TransferRelighter:
    return ptt.TransferRelighter(small_model)


def facing(scene: ptt.Scene) -> Tensor:
    return (scene.camera.toward(scene.vertices) * scene.normals).sum(1) > 0.05


def test_against_the_path_tracer(small_scene: ptt.Scene) -> None:
    """Untruncated, at 32 cells an edge, exponent 12: what remains is the cube map's and the tensor's resolution."""
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((12.0,)), ranks=(1, 24, 24), separated=0)
    model = ptt.compress(ptt.precompute(small_scene, resolution=32), None, brdf, clusters=None)
    radiance = ptt.TransferRelighter(model)(SKY, small_scene.materials, small_scene.camera)
    truth = ptt.reference.at_vertices(small_scene, SKY, small_scene.materials, small_scene.camera, samples=2048)
    at = facing(small_scene)
    assert ptt.relative_rmse(radiance[at], truth.mean[at]) < 0.04


def test_equation_3_written_out(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    """B = colour diffuse / pi U_0 + specular * outgoing . core . U, point by point, in float64."""
    model = relighter.model
    materials = {
        "ball": ptt.blinn_phong((0.1, 0.2, 0.3), (0.5, 0.4, 0.3), 9.0),
        "floor": small_scene.materials["floor"],
    }
    radiance = relighter(SKY, materials, small_scene.camera)
    u = relighter.incident(SKY).double()
    wo = torch.einsum("vij,vj->vi", model.frames, small_scene.camera.toward(model.positions))
    v_factors = model.brdf.outgoing(wo).double()
    core = model.brdf.matrix(ptt.BlinnPhong(9.0)).double()
    for v in range(0, len(model.positions), 37):
        material = materials["floor" if v < model.receivers.counts[0] else "ball"]
        for c in range(3):
            expected = material.diffuse[c] / torch.pi * model.colours[v, c] * u[c, 0, v]
            expected = expected + material.specular[c] * (v_factors[:, v] @ core @ u[c, 1:, v])
            assert float(radiance[v, c]) == pytest.approx(float(expected), rel=1e-4, abs=1e-6)


def test_linear_in_light_and_black_in_the_dark(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    def of(environment: ptt.Environment) -> Tensor:
        radiance: Tensor = relighter(environment, {}, small_scene.camera)
        return radiance

    whole = of(SKY)
    for factor in (1e-6, 1e6):
        assert torch.allclose(of(SKY.scaled(factor)) / factor, whole, rtol=1e-4, atol=1e-5)
    assert (of(ptt.Environment.constant(0.0)) == 0).all()
    spike = torch.zeros(32, 64, 3)
    spike[5, 40] = 1e5
    assert of(ptt.Environment(spike)).isfinite().all()


def test_caches_save_work_and_never_go_stale(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    """Each input in turn changes, is changed in place, and is changed back; always as a fresh relighter says."""

    def check(environment: ptt.Environment, materials: dict[str, ptt.Material], view: Any) -> None:
        fresh = ptt.TransferRelighter(relighter.model)
        assert torch.equal(relighter(environment, materials, view), fresh(environment, materials, view))

    ball = small_scene.materials["ball"]
    other = ptt.blinn_phong(0.2, 0.1, 3.0)
    light = ptt.Environment(SKY.map.clone())
    eye = torch.tensor([1.0, 2.0, 3.0])
    check(light, {"ball": ball}, eye)
    first = relighter.incident(light)
    check(light, {"ball": other}, eye)
    assert relighter.incident(light) is first  # kept through an edit of the material
    other.diffuse[0] = 0.9
    check(light, {"ball": other}, eye)
    eye[0] = -2.0
    check(light, {"ball": other}, eye)
    light.map[10] *= 3
    check(light, {"ball": other}, eye)
    assert relighter.incident(light) is not first
    check(light.rotated(y=40), {"ball": other}, eye)
    check(light, {"ball": ball}, small_scene.camera)
    check(light, {"ball": ball}, replace(small_scene.camera, eye=(0.0, 3.0, 0.1)))
    relighter.model.brdf.core.mul_(0.5)
    check(light, {"ball": ball}, eye)
    relighter.model.brdf.core.mul_(2.0)


def test_gradients_reach_light_weights_and_exponent(small_raw: ptt.RawTransfer, small_scene: ptt.Scene) -> None:
    """Against central differences in float64."""
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong(ptt.materials.spaces.MODERATE), ranks=(3, 6, 6), separated=0)
    relighter = ptt.TransferRelighter(ptt.compress(small_raw, 32, brdf, clusters=None)).double()
    eye = torch.tensor([1.0, 2.0, 3.0])
    texels = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(0))

    def loss(texels: Tensor, specular: Tensor, exponent: Tensor) -> Tensor:
        material = ptt.Material(0.3, specular, ptt.BlinnPhong(exponent))
        radiance: Tensor = relighter(ptt.Environment(texels), {"ball": material}, eye)
        return radiance[::7].square().sum()

    inputs = [texels, torch.tensor([0.2, 0.3, 0.4]), torch.tensor(5.5)]
    leaves = [x.clone().requires_grad_() for x in inputs]
    loss(*leaves).backward()
    for k, (row, step) in enumerate([((1, 3, 0), 1e-2), ((1,), 1e-2), ((), 1e-2)]):
        moved = [[x.clone() for x in inputs] for _ in range(2)]
        moved[0][k][row] += step
        moved[1][k][row] -= step
        numeric = (loss(*moved[0]) - loss(*moved[1])) / (2 * step)
        grad = leaves[k].grad
        assert grad is not None
        assert float(grad[row]) == pytest.approx(float(numeric), rel=5e-3)
    loss(*leaves).backward()  # no graph is kept from the first time


def test_inference_mode_results_do_not_leak_into_training(relighter: ptt.TransferRelighter) -> None:
    eye = torch.tensor([1.0, 2.0, 3.0])
    with torch.inference_mode():
        relighter(SKY, {}, eye)
    weight = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    relighter(SKY, {"ball": ptt.Material(weight)}, eye).sum().backward()
    assert weight.grad is not None and (weight.grad > 0).all()


def test_compiled_agrees_with_eager(small_model: ptt.TransferModel, small_scene: ptt.Scene) -> None:
    eager, compiled = (ptt.TransferRelighter(small_model, compiled=c) for c in (False, True))
    for eye in ([1.0, 2.0, 3.0], [-2.0, 1.0, 0.0]):
        a, b = (r(SKY, small_scene.materials, torch.tensor(eye)) for r in (eager, compiled))
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-6)


def test_a_g_buffer_is_refused(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    assert small_scene.camera is not None
    pixels = ptt.GBuffer.of(small_scene, small_scene.camera)
    with pytest.raises(ValueError, match="TransferRelighter relights vertices: view must be a Camera or a tensor"):
        relighter(SKY, {}, pixels)


def test_refusals(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    camera = small_scene.camera
    with pytest.raises(ValueError, match="no region knot; there are floor, ball"):
        relighter(SKY, {"knot": ptt.lambert()}, camera)
    with pytest.raises(ValueError, match="region floor is fixed"):
        relighter(SKY, {"floor": ptt.lambert(0.1)}, camera)
    with pytest.raises(ValueError, match="the model's space holds blinn-phong shapes, got cook-torrance"):
        relighter(SKY, {"ball": ptt.cook_torrance()}, camera)
    with pytest.raises(ValueError, match=r"view must be a Camera, \(3,\) or \(\d+, 3\), got \(2,\)"):
        relighter(SKY, {}, torch.zeros(2))
    for view in (torch.tensor([0.0, torch.nan, 0.0]), torch.zeros(relighter.model.positions.shape)):
        with pytest.raises(ValueError, match="view must be finite, and directions not zero"):
            relighter(SKY, {}, view)
    with pytest.raises(ValueError, match=r"materials must map regions to ptt\.Material, got int"):
        relighter(SKY, {"ball": 3}, camera)


def test_cache_keeps_nothing_that_carries_a_graph() -> None:
    cache = Cache()
    calls = []

    def compute() -> Tensor:
        calls.append(1)
        return torch.zeros(())

    x = torch.ones(100)
    cache(x, compute)
    cache(x, compute)
    assert len(calls) == 1
    cache(x.clone(), compute)
    assert len(calls) == 2  # large tensors are told apart by identity
    y = torch.ones(3)
    cache(y, compute)
    cache(y.clone(), compute)
    assert len(calls) == 3  # small ones by value
    y.requires_grad_()
    cache(y, compute)
    cache(y, compute)
    assert len(calls) == 5


def test_cache_keeps_as_many_results_as_it_is_told() -> None:
    cache = Cache(2)
    made: list[int] = []
    for k in (1, 2, 1, 2, 3, 2, 1):
        cache(k, partial(made.append, k))
    assert made == [1, 2, 3, 1]


def test_no_warnings_in_plain_use(small_model: ptt.TransferModel, small_scene: ptt.Scene) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ptt.TransferRelighter(small_model)(SKY, small_scene.materials, small_scene.camera)
