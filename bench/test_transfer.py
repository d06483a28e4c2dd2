"""pytest-benchmark suites of the route with bounces and clusters: its stages, one relit frame; each asserts its error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

import ptt
from bench.frames import balls, dressed, steps
from bench.table import setting
from ptt.transfer.assembly import Transfer

LIGHT = ptt.Environment.sun_sky(radius=10.0)
MATERIAL = ptt.blinn_phong(0.3, 0.4, 12.0)
CLUSTERS = ptt.Clusters(points=250, eigenvectors=16, lighting=16)


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    return balls(2, 2, MATERIAL)


@pytest.fixture(scope="module")
def raw(scene: ptt.Scene) -> ptt.RawTransfer:
    return ptt.precompute(scene, 2, resolution=16, rays=64)


@pytest.fixture(scope="module")
def transfer(raw: ptt.RawTransfer) -> Transfer:
    space = ptt.BRDFSpace.blinn_phong((1.0, 4.0, 12.0, 40.0))
    return ptt.assemble(raw, ptt.TensorBRDF.fit(space, ranks=(3, 8, 8), separated=3), ptt.BRDFBasis.fit(space, 3), 64)


@pytest.fixture(scope="module")
def exact(transfer: Transfer) -> ptt.TransferModel:
    """With as many eigenvectors as a cluster has points, nearly."""
    whole = ptt.Clusters(points=60, eigenvectors=60, lighting=128, columns=1536, storage=torch.float32)
    return ptt.cluster(transfer, whole)


def record(benchmark: Any, error: float) -> None:
    benchmark.extra_info.update(error=error, setting=setting())


def test_assembly(benchmark: Any, raw: ptt.RawTransfer, transfer: Transfer) -> None:
    """T0, T1 and T2 of all points; the error is that of two runs against each other: there is no chance in it."""
    again = benchmark.pedantic(ptt.assemble, (raw, transfer.brdf, transfer.basis, 64), rounds=2)
    error = ptt.relative_rmse(again.indirect.one.float(), transfer.indirect.one.float())
    record(benchmark, error)
    assert error < 1e-6


def test_clusters(benchmark: Any, scene: ptt.Scene, transfer: Transfer, exact: ptt.TransferModel) -> None:
    """Clustered PCA and the reduction of the lighting; the error is that of the relit scene."""
    model = benchmark.pedantic(ptt.cluster, (transfer, CLUSTERS), rounds=3)
    assert scene.camera is not None
    ours, truth = (ptt.TransferRelighter(m)(LIGHT, dressed(scene, MATERIAL), scene.camera) for m in (model, exact))
    error = ptt.relative_rmse(ours, truth)
    record(benchmark, error)
    assert error < 0.1


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize("changed", ["view", "view and BRDF", "view, BRDF and light"])
def test_relit_frame(benchmark: Any, scene: ptt.Scene, transfer: Transfer, changed: str, compiled: bool) -> None:
    """One frame after a change; the error is against eager products of float32."""
    relighter = ptt.TransferRelighter(ptt.cluster(transfer, CLUSTERS), compiled=compiled)
    frame = steps(relighter, scene, LIGHT, MATERIAL)[changed]
    frame()  # builds the kernels
    benchmark(frame)
    stored = ptt.cluster(transfer, ptt.Clusters(250, 16, 16, storage=torch.float32))
    assert scene.camera is not None
    truth = ptt.TransferRelighter(stored)(LIGHT, dressed(scene, MATERIAL), scene.camera)
    error = ptt.relative_rmse(relighter(LIGHT, dressed(scene, MATERIAL), scene.camera), truth)
    record(benchmark, error)
    assert error < 5e-3
