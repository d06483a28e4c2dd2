"""A relighter as a guest in a user's program: other threads, copies, another default type, maps that are written to."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import sys
import threading
from collections.abc import Iterator

import pytest
import torch

import ptt
from ptt.models.cache import Cache

EYE = torch.tensor([1.0, 2.0, 3.0])


@pytest.fixture
def often_switched() -> Iterator[None]:
    """Threads that take turns as often as Python lets them."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def test_a_cache_answers_each_thread_with_its_own(often_switched: None) -> None:
    cache = Cache()
    inputs = [torch.zeros(100), torch.ones(100)]
    wrong = []

    def ask(k: int) -> None:
        for _ in range(20000):
            if cache(inputs[k], lambda: k) != k:
                wrong.append(k)

    threads = [threading.Thread(target=ask, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_scenes_and_models_are_copied_at_any_moment(small_scene: ptt.Scene, small_model: ptt.TransferModel) -> None:
    assert small_scene.surface is not None  # which has been traced
    light = ptt.Environment.gradient_sky()
    relighter = ptt.TransferRelighter(small_model, compiled=False)
    expected = relighter(light, {}, EYE)
    for again in (copy.deepcopy(small_scene), pickle.loads(pickle.dumps(small_scene))):
        assert torch.equal(again.vertices, small_scene.vertices)
        assert again.surface.occluded(EYE[None], -EYE[None]).shape == (1,)
    for other in (copy.deepcopy(relighter), pickle.loads(pickle.dumps(relighter))):
        torch.testing.assert_close(other(light, {}, EYE), expected)


def test_a_forked_process_answers(small_model: ptt.TransferModel) -> None:
    """Where threads of OpenMP worked before the fork, which are not there after it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    relighter = ptt.TransferRelighter(small_model)
    light = ptt.Environment(torch.rand(128, 256, 3))
    expected = relighter(light, {}, EYE)
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()
    child = context.Process(target=lambda: answers.put(relighter(light.rotated(y=0), {}, EYE).numpy()))
    child.start()
    child.join(60)
    torch.set_num_threads(threads)
    if child.is_alive():
        child.kill()
        pytest.fail("the forked process hangs")
    torch.testing.assert_close(torch.from_numpy(answers.get()), expected)


def test_a_map_that_is_written_to_is_read_anew(small_model: ptt.TransferModel) -> None:
    """Through numpy, through `.data`, and in one texel, announced."""
    relighter = ptt.TransferRelighter(small_model, compiled=False)
    texels = torch.rand(16, 32, 3)
    light = ptt.Environment(texels)
    once = relighter(light, {}, EYE)
    texels.numpy()[:] *= 2
    torch.testing.assert_close(relighter(light, {}, EYE), 2 * once)
    texels.data.mul_(0.5)
    torch.testing.assert_close(relighter(light, {}, EYE), once)
    big = ptt.Environment(torch.zeros(256, 512, 3))
    assert not relighter(big, {}, EYE).any()
    big.map.numpy()[100, 101] = 1e4
    torch.autograd.graph.increment_version(big.map)
    assert relighter(big, {}, EYE).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("uffizi.hdr", {}, EYE),
            r"environment must be a ptt\.Environment \(Environment\.load reads a file\), got str",
        ),
        ((None, {}, EYE), "environment must be a ptt.Environment"),
        ((torch.rand(8, 16, 3), {}, EYE), "environment must be a ptt.Environment.*got Tensor"),
        ((ptt.Environment.constant(), {}, None), "view must be a Camera, a GBuffer or a tensor, got None"),
        ((ptt.Environment.constant(), {}, (1.0, 2.0, 3.0)), "view must be a Camera"),
        ((ptt.Environment.constant(), ptt.lambert(0.5), EYE), "materials must map regions to materials.*got Material"),
    ],
)
def test_wrong_types_are_named(small_model: ptt.TransferModel, arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ptt.TransferRelighter(small_model, compiled=False)(*arguments)


def test_a_colour_is_three_numbers() -> None:
    with pytest.raises(ValueError, match=r"diffuse must be one number or .* linear RGB, got '#ff0000'"):
        ptt.lambert("#ff0000")  # type: ignore[arg-type]


@pytest.fixture
def doubles() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def test_another_default_type_changes_nothing(small_scene: ptt.Scene, doubles: None) -> None:
    """Every entry works in a program whose default type is float64, and gives float32 where it did."""
    light = ptt.Environment(torch.rand(16, 32, 3, dtype=torch.float32) + 0.1)
    camera = small_scene.camera
    assert ptt.Environment.constant(1.0).map.dtype == torch.float32
    assert ptt.Environment.sun_sky().map.dtype == ptt.Environment.gradient_sky().map.dtype == torch.float32
    assert ptt.default_scene().vertices.dtype == torch.float32
    ptt.ambient_occlusion(small_scene)
    ptt.reference.at_vertices(small_scene, light, small_scene.materials, camera, samples=4, bounces=1)
    raw = ptt.precompute(small_scene, bounces=1, resolution=8, rays=16)
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((2.0, 8.0)), ranks=(2, 6, 6), separated=1, resolution=16)
    basis = ptt.BRDFBasis.fit(ptt.BRDFSpace.blinn_phong((2.0, 8.0)), 2)
    model = ptt.compress(raw, 32, brdf, basis, ptt.Clusters(60, 8, 32, 64))
    materials = {"ball": ptt.blinn_phong(0.3, 0.4, 5.0)}
    rotation = ptt.LightRotation.build(16, 4)
    for compiled in (False, True):
        relighters = (
            ptt.TransferRelighter(model, compiled),
            ptt.EnvMapRelighter(small_scene, rotation, terms=16, views=16, compiled=compiled),
            ptt.TripleProductRelighter(small_scene, 1, normals=6, twists=6, source=16, views=16, compiled=compiled),
        )
        for relighter in relighters:
            radiance = relighter(light.rotated(y=20), materials, camera)
            assert radiance.dtype == torch.float32 and bool(radiance.isfinite().all())
            ptt.render(small_scene, camera, radiance, light)
