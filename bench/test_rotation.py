"""pytest-benchmark suites of rotated light: operators, slices, one frame; each asserts its error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

from typing import Any, get_args

import pytest
import torch

import ptt
from bench.table import setting
from ptt.models.light_rotation import Operator
from ptt.ops import haar, mesh, slices
from ptt.ops.octahedral import Octahedral

LIGHT = ptt.Environment.sun_sky(radius=10.0)
MATERIAL = ptt.fitted("gold-metallic-paint")


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return ptt.Scene.from_mesh(*mesh.sphere_mesh(5), name="ball")


def coefficients(n: int) -> torch.Tensor:
    light = haar.analyse(LIGHT.project(Octahedral(n)).movedim(-1, 0))
    return torch.nn.functional.pad(light, (0, 0, 0, 0, 0, 1))


@pytest.mark.parametrize("n", [32, 64])
@pytest.mark.parametrize("operator", get_args(Operator))
def test_change_of_light(benchmark: Any, operator: Operator, n: int) -> None:
    rotate = ptt.LightRotation.build(n, 32, operator=operator)
    light = coefficients(n)
    benchmark.extra_info.update(setting=setting(), bytes=rotate.bytes)
    got = benchmark(lambda: rotate(light))
    assert ptt.relative_rmse(got, ptt.LightRotation.build(n, 32, compiled=False)(light)) < 1e-3


@pytest.mark.parametrize("operator", get_args(Operator))
def test_build(benchmark: Any, operator: Operator) -> None:
    rotate = benchmark.pedantic(lambda: ptt.LightRotation.build(32, 16, operator=operator), rounds=3)
    assert rotate.frames.shape == (256, 3, 3)


@pytest.mark.parametrize("kind", ["tabulate", "factorise"])
def test_slices(benchmark: Any, kind: str) -> None:
    assert MATERIAL.shape is not None
    make = getattr(slices, kind)
    f = MATERIAL.shape.evaluate
    cut = benchmark.pedantic(lambda: make(f, 32, 128, 64), rounds=3)
    whole = slices.tabulate(f, 32, 128, 1024).to_dense(1024)
    assert ptt.relative_rmse(cut.to_dense(1024), whole) < 0.1


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("step", ["view", "light"])
def test_frame(benchmark: Any, scene: ptt.Scene, step: str, compiled: bool) -> None:
    """10,000 vertices, 96 terms."""
    relighter = ptt.EnvMapRelighter(scene, ptt.LightRotation.build(64, 32, compiled=compiled))
    assert scene.camera is not None
    given = {"ball": MATERIAL}
    turn = iter(range(1, 100_000))
    if step == "view":
        benchmark(lambda: relighter(LIGHT, given, scene.camera.orbited(next(turn))))
    else:
        benchmark(lambda: relighter(LIGHT.rotated(y=next(turn)), given, scene.camera))
    benchmark.extra_info.update(setting=setting())
    exact = ptt.EnvMapRelighter(scene, ptt.LightRotation.build(64, 32), terms=1024)
    got = relighter(LIGHT, given, scene.camera)
    assert ptt.relative_rmse(got, exact(LIGHT, given, scene.camera)) < 0.05
