"""Indirect light that follows every edit: every figure of it, as rows of bench/results/transfer.csv.

    PTT_DATA=... python -m bench.transfer                   # about 50 minutes on two cores
    PTT_DATA=... python -m bench.transfer --only engine     # or suzanne, dragon, caustic, growth
    python -m bench.transfer --quick                        # under a minute: a ball over a floor alone

Needs the extra `bench` (Mitsuba), and PTT_DATA with meshes and maps. Pictures go to docs/images. Every scene has a
process of its own, so that its peak memory is known.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import ptt
from bench.against import IMAGES, caustic, facing, pictures, right
from bench.cases import CASES, LIGHTS, OWN, PAPER, Case, blinn_phong_materials
from bench.frames import against_mitsuba, dressed, exponents, fused, growth, naive, speed, step_times
from bench.table import ROOT, Table, setting
from ptt.ops import mesh
from ptt.scene.parts import Part

CONFIGS = ROOT / "scripts" / "configs"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute: a ball over a floor alone")
    parser.add_argument("--only", nargs="+", choices=[*CASES, *OTHERS], help="scenes whose rows are made anew")
    arguments = parser.parse_args()
    IMAGES.mkdir(parents=True, exist_ok=True)
    if arguments.quick:
        rows = quick()
        Table("transfer_quick").rows.extend(rows)
        return
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    for name in arguments.only or (*CASES, *OTHERS):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            table = Table("transfer")
            table.rows = pool.submit(OTHERS.get(name, scene_rows), name).result()
            table.replace(name, (*CASES, *OTHERS))


def scene_rows(name: str) -> list[dict[str, str]]:
    """All rows of one scene."""
    warnings.simplefilter("ignore")
    table = Table("transfer")
    case = CASES[name]
    scene = ptt.load_scene(CONFIGS / f"{name}.toml")
    data = Path(os.environ["PTT_DATA"]) / "hdri"
    lights = {key: ptt.Environment.load(data / file) for key, file in LIGHTS.items()}
    raw, transfer, models = built(table, name, scene, case)
    right(table, name, scene, case, lights, raw, transfer, models, case.vertices, case.samples)
    pictures(name, scene, case, lights, models["own"])
    material = case.materials()["moderate"]
    speed(table, name, scene, material, (case.table[0], case.table[4]), lights["uffizi"], models)
    stability(table, name, scene, case, lights["uffizi"], models["own"], transfer)
    if name == "suzanne":
        figure_9(table, name, scene, case, lights["uffizi"], transfer)
    if name == "engine":
        fused(table, name, scene, material, lights["uffizi"], models["paper"])
        naive(table, name, transfer)
        against_mitsuba(table, name, scene, lights["uffizi"])
    return table.rows


def quick() -> list[dict[str, str]]:
    """The same functions on a small scene, written nowhere: a check that the bench runs."""
    table = Table("transfer_quick")
    body, faces = mesh.sphere_mesh(2, 0.5)
    parts = [
        Part("floor", *mesh.plane_mesh(3.0, 20), material=ptt.lambert(0.6), editable=False),
        Part("ball", body + torch.tensor([0.0, 0.6, 0.0]), faces, material=ptt.blinn_phong(0.3, 0.4, 12.0)),
    ]
    scene = ptt.Scene.from_parts(parts, camera=ptt.Camera((1.5, 2.0, 3.0), (0.0, 0.4, 0.0), width=160, height=120))
    space = ptt.BRDFSpace.blinn_phong((1.0, 4.0, 16.0, 64.0, 200.0))
    case = Case(lambda: space, (3, 8, 8), 3, 4, blinn_phong_materials, ("none", 1, 1, (1, 1), (1, 1, 1)))
    lights = {"sky": ptt.Environment.sun_sky(radius=10.0)}
    raw, transfer, models = built(table, "quick", scene, case)
    right(table, "quick", scene, case, lights, raw, transfer, models, vertices=100, samples=256)
    speed(table, "quick", scene, case.materials()["moderate"], ("none", (1, 1, 1)), lights["sky"], models)
    fused(table, "quick", scene, case.materials()["moderate"], lights["sky"], models["paper"])
    stability(table, "quick", scene, case, lights["sky"], models["own"], transfer)
    return table.rows


def built(
    table: Table, name: str, scene: ptt.Scene, case: Case
) -> tuple[ptt.RawTransfer, Any, dict[str, ptt.TransferModel]]:
    """Precomputation and compression: time, memory, storage."""
    paper, vertices, megabytes, hours, _ = case.table
    v = len(scene.vertices)
    space = case.space()
    start = time.perf_counter()
    raw = ptt.precompute(scene, 2, progress=True)
    traced = time.perf_counter()
    own_model = ptt.compress(raw, editable=[space], clusters=OWN, progress=True)
    own = time.perf_counter() - start
    own_peak = peak_memory()
    aside = tempfile.TemporaryDirectory()
    path = Path(aside.name) / "own.safetensors"
    own_model.save(path)
    del own_model  # so that the peak is that of one model at a time
    begun = time.perf_counter()
    brdf = ptt.TensorBRDF.fit(space, ranks=case.ranks, separated=case.lobes)
    basis = ptt.BRDFBasis.fit(space, case.functions)
    fitted = time.perf_counter()
    transfer = ptt.assemble(raw, brdf, basis, 96, progress=True)
    assembled = time.perf_counter()
    models = {"tensor": ptt.cluster(transfer, OWN, progress=True)}
    done = time.perf_counter()
    models["paper"] = ptt.cluster(transfer, PAPER)
    paper_seconds = time.perf_counter() - done
    if name == "engine":
        models["paper-16"] = ptt.cluster(transfer, replace(PAPER, eigenvectors=16))
    slots = len(models["tensor"].slots)
    how = f"{v} vertices, {slots} slots, tensor {case.ranks}, {case.lobes} lobes; {setting()}"
    what = f"{name}, precomputation"
    table.row(f"{what}, rays", traced - start, "s", how)
    table.row(f"{what}, fits of tensor and basis", fitted - begun, "s", how)
    table.row(f"{what}, T0 T1 T2 of all points", assembled - fitted, "s", how)
    table.row(f"{what}, clusters", done - assembled, "s", f"own settings; {how}")
    table.row(f"{what}, clusters of 1000 points", paper_seconds, "s", how)
    goal = "" if case.seconds is None else f"<= {case.seconds:g}"
    said = f"{sum(hours) * 3600:g} s ({paper}, {vertices:g} vertices)"
    table.row(f"{what}, all", traced - start + done - begun, "s", f"own settings; {how}", goal, paper=said)
    by_default = f"narrow lobes, the default; {v} vertices; {setting()}"
    table.row(f"{what}, all, own", own, "s", by_default, goal, paper=said)
    table.row(f"{what}, peak memory, own", own_peak, "GiB", by_default, "<= 12")
    table.row(f"{what}, peak memory", peak_memory(), "GiB", how, "<= 12")
    models = {"own": ptt.TransferModel.load(path), **models}
    aside.cleanup()
    for key, model in models.items():
        clusters = sum(len(region.columns) for region in model.clustered)
        eigenvectors = model.clustered[0].eigenvectors
        dimensions = model.clustered[0].lighting.shape[2]
        how = f"{clusters} clusters, {eigenvectors} eigenvectors, {dimensions} lighting dimensions, bfloat16"
        goal = f"<= {megabytes:g}"
        said = f"{megabytes:g} MB ({paper})"
        table.row(f"{name}, storage, {key}", model.bytes / 1e6, "MB", how, goal, paper=said)
        table.row(f"{name}, storage of visibility, {key}", _visibility(model) / 1e6, "MB", how)
    return raw, transfer, models


def peak_memory() -> float:
    """The most memory that this process has had so far, in GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 2**30


def _visibility(model: ptt.TransferModel) -> int:
    """Bytes of what highlights see of the sky, and of other points."""
    return sum(
        part.nbytes for region in model.clustered for part in (region.cuts, region.seen, region.meets, region.sky)
    )


def grown(name: str) -> list[dict[str, str]]:
    """Cost as vertices and regions grow."""
    table = Table("transfer")
    growth(table)
    return table.rows


def stability(
    table: Table,
    name: str,
    scene: ptt.Scene,
    case: Case,
    light: ptt.Environment,
    model: ptt.TransferModel,
    transfer: Any,
) -> None:
    """Lights a million times as dim and as bright, a sun in one texel, 16-bit storage, black regions."""
    relighter = ptt.TransferRelighter(model)
    materials = dressed(scene, case.materials()["moderate"])

    def of(environment: ptt.Environment) -> Tensor:
        relit: Tensor = relighter(environment, materials, scene.camera)
        return relit

    whole = of(light)
    for factor in (1e-6, 1e6):
        error = ptt.relative_rmse(of(light.scaled(factor)) / factor, whole)
        table.row(f"{name}, light times {factor:g}", error, "relative RMSE", "of the answer over the factor", "<= 1e-5")
    sun = light.map.clone()
    sun[len(sun) // 4, 10] = 1e5
    finite = float(of(ptt.Environment(sun)).isfinite().float().mean())
    table.row(f"{name}, a sun of 1e5 in one texel", finite, "share of finite values", "", ">= 1")
    black = dressed(scene, ptt.lambert(0.0))
    finite = float(relighter(light, black, scene.camera).isfinite().float().mean())
    table.row(f"{name}, black editable regions", finite, "share of finite values", "", ">= 1")
    if name in ("suzanne", "quick"):
        exact = ptt.TransferRelighter(ptt.cluster(transfer, replace(OWN, storage=torch.float32)))
        exactly = exact(light, materials, scene.camera)
        for storage in (torch.float16, torch.bfloat16):
            rounded = ptt.cluster(transfer, replace(OWN, storage=storage))
            error = ptt.relative_rmse(ptt.TransferRelighter(rounded)(light, materials, scene.camera), exactly)
            how = "against float32; the same clusters"
            table.row(f"{name}, storage in {str(storage)[6:]}", error, "relative RMSE", how)


def figure_9(table: Table, name: str, scene: ptt.Scene, case: Case, light: ptt.Environment, transfer: Any) -> None:
    """Error against clusters, eigenvectors and lighting dimensions; time of each step, and its exponents."""
    materials = dressed(scene, case.materials()["moderate"])
    full = replace(OWN, points=100, eigenvectors=96, lighting=128, columns=4096, storage=torch.float32)
    truth = ptt.TransferRelighter(ptt.cluster(transfer, full))(light, materials, scene.camera)
    seen = facing(scene, len(scene.vertices))
    times: dict[str, list[tuple[float, dict[str, float]]]] = {"points": [], "eigenvectors": [], "lighting": []}
    sweeps = {"points": (2000, 1000, 500, 250, 120), "eigenvectors": (8, 16, 32, 64), "lighting": (16, 32, 64, 96)}
    for axis, values in sweeps.items():
        for value in values:
            change: dict[str, Any] = {axis: value}
            model = ptt.cluster(transfer, replace(PAPER, **change))
            relighter = ptt.TransferRelighter(model)
            ours = relighter(light, materials, scene.camera)
            error = ptt.relative_rmse(ours[seen], truth[seen])
            clusters = sum(len(region.columns) for region in model.clustered)
            label = f"{clusters} clusters" if axis == "points" else f"{value} {axis}"
            how = "uffizi, moderate; against 100 points a cluster, 96 eigenvectors, 128 dimensions; else as paper"
            table.row(f"{name}, figure 9, {label}, error", error, "relative RMSE", how)
            table.row(f"{name}, figure 9, {label}, storage", model.bytes / 1e6, "MB", how)
            size = float(clusters if axis == "points" else value)
            compiled = ptt.TransferRelighter(model, compiled=True)
            times[axis].append((size, step_times(compiled, light, list(materials.values()), scene.camera)))
    for axis, found in times.items():
        exponents(table, name, "clusters" if axis == "points" else axis, found)


OTHERS = {"caustic": caustic, "growth": grown}

if __name__ == "__main__":
    main()
