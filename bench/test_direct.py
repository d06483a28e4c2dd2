"""pytest-benchmark suites of the direct route: visibility, T0, one relit frame; each asserts its error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

import ptt
from bench.table import setting
from ptt.ops import haar, transfer
from ptt.ops.sphere import Cube

Benchmark = Callable[..., Any]
GRID = Cube(64)
DIRECTIONS, SOLID = GRID.directions().reshape(-1, 3), GRID.solid_angles().flatten()


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return ptt.Scene.default()


@pytest.fixture(scope="module")
def model(scene: ptt.Scene) -> ptt.TransferModel:
    raw = ptt.precompute(scene, index=torch.arange(0, len(scene.vertices), 8))
    return ptt.compress(raw, 96)


def record(benchmark: Any, error: float) -> None:
    benchmark.extra_info.update(error=error, setting=setting())


def test_visibility(benchmark: Any, scene: ptt.Scene) -> None:
    """128 vertices of the ball: about 1.5 million rays a round. Its top sees half of the sphere."""
    first = scene.vertex_region.tolist().index(scene.region_index("ball"))
    rows = slice(first, first + 128)
    bits = benchmark(transfer.visibility, scene.surface, scene.vertices[rows], scene.normals[rows], DIRECTIONS)
    top = int(scene.normals[rows, 1].argmax())
    seen = transfer.unpack(bits, GRID.cells)[top]
    error = abs(float(SOLID[seen].sum()) / (2 * math.pi) - 1)
    record(benchmark, error)
    assert error < 0.1


def test_t0(benchmark: Any, scene: ptt.Scene) -> None:
    """T0 of one vertex, its wavelets and their truncation to 96; the error is the T0's own, in L2."""
    raw = ptt.precompute(scene, index=torch.tensor([0]))
    visible, frames = transfer.unpack(raw.visible, GRID.cells), raw.receivers.frames
    factors = ptt.TensorBRDF.fit(ptt.BlinnPhongSpace(), ranks=(4, 24, 24)).u_i

    def t0() -> tuple[torch.Tensor, haar.Truncated]:
        whole = transfer.direct_transfer(visible, frames, DIRECTIONS.float(), SOLID.float(), factors)
        coefficients = haar.analyse(whole.reshape(-1, *GRID.shape)).reshape(len(factors) + 1, -1)
        return coefficients, haar.truncate(coefficients, 96)

    whole, kept = benchmark(t0)
    error = float((whole - kept.to_dense(GRID.cells)).norm() / whole.norm())
    record(benchmark, error)
    assert error < 0.2


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize("changed", ["view", "material", "light"])
def test_relit_frame(benchmark: Any, scene: ptt.Scene, model: ptt.TransferModel, changed: str, compiled: bool) -> None:
    """One frame after a change; the error is against the same model in float64."""
    relighter = ptt.TransferRelighter(model, compiled=compiled)
    light, camera, steps = scene.environment, scene.camera, iter(range(1_000_000))
    assert light is not None and camera is not None

    def frame() -> torch.Tensor:
        step = next(steps)
        knot = ptt.blinn_phong(0.1, 0.5, 20 + step * 1e-5) if changed == "material" else scene.materials["knot"]
        view = camera.orbited(1e-3 * step) if changed == "view" else camera
        return relighter(light.rotated(y=1e-3 * step) if changed == "light" else light, {"knot": knot}, view)

    frame()  # compiles
    benchmark(frame)
    exact = ptt.TransferRelighter(
        ptt.TransferModel(model.receivers, model.brdf, model.resolution, model.t0, model.truncation_error)
    ).double()(light, scene.materials, camera)
    model.float()
    error = ptt.relative_rmse(relighter(light, scene.materials, camera), exact)
    record(benchmark, error)
    assert error < 1e-4
