"""The parts of bench/machine.py that run in a process of their own: rows as JSON, one a line."""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import torch

import ptt
from bench.cases import CASES, PAPER
from bench.forms import FORMS, made
from bench.frames import balls, bytes_read, dressed, steps
from bench.table import ROOT, median_seconds, read_bandwidth, setting
from ptt.cli import kept_model
from ptt.ops import native
from ptt.ops.relight import LitRegion, Responses

NUMBERS = count(1)
SHARES = {"view": (350, 0.4), "view and BRDF": (150, 0.25), "view, BRDF and light": (80, 0.4)}
"""Goals: frames a second with AVX2, and the share of what reading the bytes allows; one of them."""


def row(what: str, value: float, unit: str, how: str, goal: str = "", **others: str) -> None:
    """Print a row."""
    print(json.dumps({"what": what, "value": value, "unit": unit, "how": f"{how}; {setting()}", "goal": goal} | others))


def instructions() -> str:
    """AVX2, or all that the processor has."""
    return "AVX2" if os.environ.get("PTT_MARCH") else torch.backends.cpu.get_cpu_capability()


def small() -> tuple[ptt.Scene, ptt.TransferRelighter]:
    """A small scene with lobes and two bounces."""
    scene = balls(2, 1, ptt.blinn_phong(0.3, 0.4, 24.0))
    raw = ptt.precompute(scene, 2, resolution=64, rays=64)
    space = ptt.BRDFSpace.blinn_phong()
    brdf = ptt.TensorBRDF.fit(space, ranks=(4, 16, 16), separated=4)
    return scene, ptt.TransferRelighter(ptt.compress(raw, 96, brdf, ptt.BRDFBasis.fit(space)))


def lights() -> None:
    """Seconds from a light that was never seen to a picture; the second of its size, then of its factors and sums."""
    scene, relighter = small()
    generator = torch.Generator().manual_seed(0)

    def seconds(light: ptt.Environment) -> float:
        start = time.perf_counter()
        relighter(light, scene.materials, scene.camera)
        return time.perf_counter() - start

    what = f"lights, {instructions()}"
    how = f"to a picture of {len(scene.vertices)} vertices with four lobes"
    for height, goal in ((512, 0.5), (2048, 2.0)):
        maps = [ptt.Environment(torch.rand(height, 2 * height, 3, generator=generator)) for _ in range(4)]
        size = f"{2 * height} x {height}"
        taken = [seconds(light) for light in maps]
        if height == 512:
            row(f"{what}, the first map of a process, {size}", taken[0], "s", how)
        row(f"{what}, a new map, {size}", statistics.median(taken[1:]), "s", f"{how}, median of 3", f"<= {goal}")
    a, b, *_ = maps
    changes: dict[str, Callable[[], ptt.Environment]] = {
        "a turn": lambda: a.rotated(y=next(NUMBERS)),
        "a factor": lambda: a.scaled(1 + 0.01 * next(NUMBERS)),
        "a tint": lambda: a.scaled((1.0, 0.9, 0.001 * next(NUMBERS))),
        "a sum": lambda: a + b.scaled(0.01 * next(NUMBERS)),
        "a sum, turned apart": lambda: a + b.rotated(y=next(NUMBERS)),
    }
    for name, change in changes.items():
        ready = median_seconds(lambda change=change: relighter(change(), scene.materials, scene.camera), 20)  # type: ignore[misc]
        row(f"{what}, {name} of lights that are ready", 1e3 * ready, "ms", how)


def traced_engine() -> tuple[ptt.Scene, ptt.TransferModel]:
    """The engine by the paper's settings."""
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "engine.toml")
    case = CASES["engine"]

    def trace() -> ptt.TransferModel:
        raw = ptt.precompute(scene, 2, progress=True)
        space = case.space()
        brdf = ptt.TensorBRDF.fit(space, ranks=case.ranks, separated=case.lobes)
        return ptt.compress(raw, 96, brdf, ptt.BRDFBasis.fit(space, case.functions), PAPER, progress=True)

    return scene, kept_model(scene, {"case": "engine", "clusters": repr(PAPER)}, trace)


def engine() -> None:
    """Frames a second of every form, and the share of what reading the bytes at the measured rate allows."""
    scene, model = traced_engine()
    light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / "uffizi.hdr")
    material = CASES["engine"].materials()["moderate"]
    what = f"engine, {instructions()}"
    bandwidth = read_bandwidth()
    row(f"{what}, read bandwidth", bandwidth / 1e9, "GB/s", "sum of 400 MB")
    rates: dict[str, dict[str, float]] = {}
    for form, (kernels, fused) in FORMS.items():
        relighter = ptt.TransferRelighter(model, kernels)
        read = bytes_read(model, relighter, light, dressed(scene, material))
        rates[form] = {}
        for step, frame in steps(made(relighter, fused), scene, light, material).items():
            seconds = median_seconds(frame, 40 if kernels else 8)
            rates[form][step] = 1 / seconds
            limit = bandwidth / read[step]
            aside = f"{limit:.0f} frames/s to read {read[step] / 1e6:.3g} MB"
            how = f"{len(scene.vertices)} vertices, paper's settings, lobes, {material.shape}"
            row(f"{what}, {form}, {step}", 1 / seconds, "frames/s", how, limit=aside)
            if form == "kernels":
                frames, share = SHARES[step]
                how = f"or {frames} frames/s, of which it has {1 / seconds / frames:.2f}"
                row(f"{what}, {form}, {step}, share of the limit", 1 / seconds / limit, "", how, f">= {share}")
    for step, rate in rates["kernels"].items():
        row(f"{what}, kernels over eager, {step}", rate / rates["eager"][step], "", "same run", "<= 10")
    bounds(what, model, scene, light, material)


def bounds(
    what: str, model: ptt.TransferModel, scene: ptt.Scene, light: ptt.Environment, material: ptt.Material
) -> None:
    """What bounds the kernels where it is not the bytes: arithmetic, and work that a second thread halves."""
    relighter = ptt.TransferRelighter(model)
    steps: Any = relighter.steps
    lit = steps.incident(light)
    sent = steps.exitant(lit, list(dressed(scene, material).values()))
    square = torch.rand(2048, 2048)
    peak = 2 * 2048**3 / median_seconds(lambda: square @ square)
    seconds = products = 0.0
    of_harmonics = Responses(steps.to_factors, steps.to_harmonics)
    for region, arriving, layers in zip(model.clustered, lit.arriving, sent.layers, strict=True):
        layer = layers[0]
        coupling = torch.rand(3, 1 + len(model.brdf.u_o), arriving.direct.shape[3])
        h = torch.rand(len(region.slots), 3), torch.rand(len(region.pairs), 3)
        glossy = layer.lobes is not None
        lit = LitRegion(arriving, *h, coupling, region.weights, region.cluster, glossy)
        call = partial(native.exitants, [lit], of_harmonics)
        seconds += median_seconds(call, 40)
        products += 2 * region.weights.numel() * 3 * (layer.sent.values.shape[2] - 1)
    how = f"{products / 1e6:.0f} million products and sums a frame from eigen-points to points, those of eigen-points"
    how = f"{how} aside; torch's 2048 x 2048 ones: {peak / 1e9:.0f} GFLOP/s"
    row(f"{what}, exitant over torch's product of matrices, rate of arithmetic", products / seconds / peak, "", how)
    eye = torch.tensor(scene.camera.eye)
    spent = []
    for threads in (1, torch.get_num_threads()):
        torch.set_num_threads(threads)
        spent.append(median_seconds(lambda: steps.radiance(sent, eye), 40))
    how = "the kernel alone: near 1 where bytes bound it, near the number of threads where its own work does"
    row(f"{what}, view, all threads over one", spent[0] / spent[1], "", how)


def compression() -> None:
    """Milliseconds a vertex from rays to a model."""
    scene = ptt.default_scene()
    space = ptt.BRDFSpace.blinn_phong()
    brdf = ptt.TensorBRDF.fit(space, ranks=(4, 16, 16), separated=3)
    basis = ptt.BRDFBasis.fit(space)
    v = len(scene.vertices)
    start = time.perf_counter()
    raw = ptt.precompute(scene, 2)
    traced = time.perf_counter()
    ptt.compress(raw, 96, brdf, basis)
    done = time.perf_counter()
    what = f"compression, {instructions()}"
    how = f"default scene, {v} vertices, two bounces, 512 rays, default settings, fits not counted"
    row(f"{what}, rays", 1e3 * (traced - start) / v, "ms a vertex", how)
    row(f"{what}, compression", 1e3 * (done - traced) / v, "ms a vertex", how, "<= 12")


PARTS: dict[str, Callable[[], None]] = {"lights": lights, "engine": engine, "compression": compression}

if __name__ == "__main__":
    PARTS[sys.argv[1]]()
