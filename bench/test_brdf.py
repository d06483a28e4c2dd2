"""pytest-benchmark suites of BRDF spaces: Tucker, lobes, an edited parameter, a new BRDF; each asserts its error.

pytest bench --benchmark-columns=median,iqr,rounds
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import ptt
from bench.table import setting
from ptt.ops import lobes, separation, tucker

Benchmark = Callable[..., Any]


@pytest.fixture(scope="module")
def fitted() -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(ptt.BRDFSpace.fitted(), (4, 8, 8), separated=4)


def record(benchmark: Any, error: float) -> None:
    benchmark.extra_info.update(error=error, setting=setting())


@pytest.mark.parametrize("method", ["hosvd", "st-hosvd", "hooi"])
def test_tucker(benchmark: Benchmark, method: tucker.Method) -> None:
    space = ptt.BRDFSpace.blinn_phong()
    d = torch.nn.functional.normalize(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)).abs(), dim=1)
    tensor = torch.stack([shape.evaluate(d, d[:, None]) for shape in space.samples])
    fit = benchmark(tucker.decompose, tensor, ranks=(3, 24, 24), method=method)
    error = tucker.relative_error(fit, tensor)
    record(benchmark, error)
    assert error < 0.2


def test_lobes(benchmark: Benchmark) -> None:
    shape = ptt.CookTorrance(0.5, 0.1)
    peaks, _ = benchmark(separation.tables, [shape.evaluate], True)
    whole = ptt.ops.albedo.albedo(shape.evaluate, lobes.tilts_and_turns(isotropic=True)[0, 0])
    share = float(peaks[0, :, 0, 0].sum() / whole)
    record(benchmark, share)
    assert 0.5 < share < 1


def test_edited_parameter(benchmark: Benchmark, fitted: ptt.TensorBRDF) -> None:
    shape = fitted.space.at(F0=0.3, m=0.2)
    matrix, tables = benchmark(lambda: (fitted.matrix(shape), fitted.lobe_tables(shape)))
    record(benchmark, float(fitted.error.max()))
    assert matrix.isfinite().all() and tables.isfinite().all()


def test_new_brdf(benchmark: Benchmark, fitted: ptt.TensorBRDF) -> None:
    larger = benchmark.pedantic(fitted.with_brdf, ("new", ptt.fitted("nickel")), rounds=3)  # type: ignore[attr-defined]
    record(benchmark, float(larger.error[-1]))
    nickel = list(fitted.space.materials).index("nickel")
    assert float(larger.error[-1]) <= float(fitted.error[nickel]) * 1.001
