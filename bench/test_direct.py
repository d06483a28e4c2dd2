"""pytest-benchmark suites of the direct route: visibility, T0, one relit frame; each asserts its error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch

import ptt
from bench.table import setting
from ptt.ops import transfer
from ptt.ops.sphere import Cube

Benchmark = Callable[..., Any]
GRID = Cube(64)
DIRECTIONS = GRID.directions().reshape(-1, 3)


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return ptt.default_scene()


@pytest.fixture(scope="module")
def brdf() -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong(ptt.materials.spaces.MODERATE), ranks=(4, 24, 24), separated=0)


@pytest.fixture(scope="module")
def model(scene: ptt.Scene, brdf: ptt.TensorBRDF) -> ptt.TransferModel:
    raw = ptt.precompute(scene, index=torch.arange(0, len(scene.vertices), 8))
    return ptt.compress(raw, 96, brdf, clusters=None)


def record(benchmark: Any, error: float) -> None:
    benchmark.extra_info.update(error=error, setting=setting())


def hidden(scene: ptt.Scene, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Whether any triangle lies along each ray (n,): all of them tried in float64 (Moeller and Trumbore 1997)."""
    a, b, c = scene.vertices.double()[scene.faces].unbind(1)
    out = []
    for o, d in zip(origins, directions, strict=True):
        p = torch.linalg.cross(d.expand_as(a), c - a)
        scale = (p * (b - a)).sum(1)
        q = torch.linalg.cross(o - a, b - a)
        u = ((o - a) * p).sum(1) / scale
        v = (q @ d) / scale
        t = (q * (c - a)).sum(1) / scale
        out.append(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any())
    return torch.stack(out)


def test_visibility(benchmark: Any, scene: ptt.Scene) -> None:
    """128 vertices of the floor: about 1.5 million rays a round. The error is the share of 500 rays that differ."""
    middle = (scene.vertices[:, [0, 2]].norm(dim=1) + 9 * scene.vertex_region).argsort()[:128]
    points = scene.vertices[middle]
    normals = scene.normals[middle]
    bits = benchmark(transfer.visibility, scene.surface, points, normals, DIRECTIONS)
    above = (normals.double() @ DIRECTIONS.T > 0).nonzero()
    pick = above[torch.randperm(len(above), generator=torch.Generator().manual_seed(0))[:500]].unbind(1)
    origins = scene.surface.offset(points, normals)[pick[0]]
    expected = ~hidden(scene, origins, DIRECTIONS[pick[1]])
    error = float((transfer.unpack(bits, GRID.cells)[pick] != expected).double().mean())
    record(benchmark, error)
    assert 0.1 < float(expected.double().mean()) < 0.9
    assert error <= 0.002


def test_t0(benchmark: Any, scene: ptt.Scene, brdf: ptt.TensorBRDF) -> None:
    """T0 of 4 vertices of the knot and its truncation; the error is in the diffuse light under the sky."""
    first = int((scene.vertex_region == scene.region_index("knot")).nonzero()[0])
    raw = ptt.precompute(scene, index=torch.arange(first, first + 4))
    model = benchmark(ptt.compress, raw, 96, brdf, clusters=None)
    light = scene.environment
    assert light is not None
    exact = ptt.compress(raw, None, brdf, clusters=None)
    kept, whole = (ptt.TransferRelighter(m).incident(light)[:, 0] for m in (model, exact))
    error = ptt.relative_rmse(kept, whole)
    record(benchmark, error)
    assert error < 0.05


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "torch.compile"])
@pytest.mark.parametrize("changed", ["view", "material", "light"])
def test_relit_frame(benchmark: Any, scene: ptt.Scene, model: ptt.TransferModel, changed: str, compiled: bool) -> None:
    """One frame after a change; the error is against the same model in float64."""
    relighter: Any = ptt.TransferRelighter(model)
    if compiled:
        relighter = torch.compile(relighter)
    light = scene.environment
    camera = scene.camera
    steps = iter(range(1_000_000))
    assert light is not None and camera is not None

    def frame() -> object:
        step = next(steps)
        knot = ptt.blinn_phong(0.1, 0.5, 20 + step * 1e-5) if changed == "material" else scene.materials["knot"]
        view = camera.orbited(1e-3 * step) if changed == "view" else camera
        return relighter(light.rotated(y=1e-3 * step) if changed == "light" else light, {"knot": knot}, view)

    frame()  # compiles
    benchmark(frame)
    double = ptt.TransferRelighter(copy.deepcopy(model)).double()
    exact = double(light, scene.materials, camera)
    error = ptt.relative_rmse(relighter(light, scene.materials, camera), exact)
    record(benchmark, error)
    assert error < 1e-4
