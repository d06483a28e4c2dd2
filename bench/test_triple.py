"""pytest-benchmark suites of triple products: integrals, one frame, a change of light, an edited BRDF; each asserts its
error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import pytest
import torch

import ptt
from bench.table import setting
from bench.triple import on_floor
from ptt.ops import geodesic, haar, mesh, native, shade, triple
from ptt.ops.geodesic import Geodesic
from ptt.relight.triple_relighter import Storage

SKY = ptt.Environment.sun_sky(radius=10.0)
GIVEN = {"body": ptt.blinn_phong(0.3, 0.4, 30.0), "floor": ptt.lambert(0.5)}


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return on_floor(*mesh.sphere_mesh(4), 40)


@pytest.mark.parametrize("keep", [80, 320])
@pytest.mark.parametrize("strategy", ["top-only", "adaptive"])
def test_product(benchmark: Any, strategy: str, keep: int) -> None:
    """Of 4,000 points with 5120 coefficients each."""
    g = torch.Generator().manual_seed(0)
    f, h, k = (geodesic.analyse(torch.rand(4000, 5120, generator=g)) for _ in range(3))
    whole = triple.integral(f, h, k)
    if strategy == "top-only":
        values = [triple.top_only(x, keep) for x in (f, h, k)]
        got = benchmark(lambda: triple.quadrature(*values))
    else:
        a, b, c = (haar.truncate(x, keep, geodesic.areas(4).sqrt().float()) for x in (f, h, k))
        got = benchmark(lambda: native.adaptive(a, b, c, 5120))
    benchmark.extra_info.update(setting=setting())
    assert ptt.relative_rmse(got, whole) < 0.05


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("storage", get_args(Storage))
def test_frame(benchmark: Any, scene: ptt.Scene, level: int, storage: Storage) -> None:
    """Products and interpolation of 320 x 240 pixels."""
    assert scene.camera is not None
    pixels = ptt.GBuffer.of(scene, replace(scene.camera, width=320, height=240))
    relighter = ptt.TripleProductRelighter(scene, level, storage=storage, highlights="triangles")
    prepared = relighter.prepared(SKY, GIVEN, pixels)
    got = benchmark(lambda: native.shade(*prepared))
    benchmark.extra_info.update(setting=setting(), pixels=len(pixels.pixel))
    assert ptt.relative_rmse(got, shade.shade(*prepared)) < 2e-3


@pytest.mark.parametrize("level", [1, 2])
def test_change_of_light(benchmark: Any, scene: ptt.Scene, level: int) -> None:
    relighter = ptt.TripleProductRelighter(scene, level, highlights="triangles")
    angle = 0.0

    def turned() -> torch.Tensor:
        nonlocal angle
        angle += 1.0
        return relighter.incident(SKY.rotated(y=angle)).frames.to_dense()[0]

    assert bool(benchmark(turned).isfinite().all())


@pytest.mark.parametrize("shape", [ptt.BlinnPhong(30.0), ptt.Ward(0.1, 0.5)], ids=["isotropic", "brushed"])
def test_edited_brdf(benchmark: Any, scene: ptt.Scene, shape: Any) -> None:
    """A white furnace's share of it, toward the zenith, is the albedo."""
    relighter = ptt.TripleProductRelighter(scene, 2, highlights="triangles")
    table = benchmark.pedantic(lambda: relighter._table(shape), rounds=3)
    up = int(table.to_dense().sum(1).argmin())
    assert 0 < float(table.to_dense()[up].sum()) * 20 / Geodesic(2).cells < 1.1
