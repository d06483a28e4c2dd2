"""Indirect light that follows every edit: every figure of it, as rows of bench/results/transfer.csv.

    PTT_DATA=... python bench/transfer.py                   # about 45 minutes on two cores
    PTT_DATA=... python bench/transfer.py --only engine     # or suzanne, dragon, caustic, growth
    python bench/transfer.py --quick                        # under a minute: a ball over a floor alone

Needs the extra `bench` (Mitsuba), and PTT_DATA with meshes and maps. Pictures go to docs/images. Every scene has a
process of its own, so that its peak memory is known.
"""

from __future__ import annotations

import argparse
import copy
import csv
import os
import resource
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import ptt
from bench.frames import against_mitsuba, dressed, exponents, growth, naive, speed, step_times
from bench.table import ROOT, Table, setting
from bench.uncompressed import Uncompressed
from ptt.meshes import Part
from ptt.models.clustered_transfer import WIDTH
from ptt.ops import mesh

IMAGES = ROOT / "docs" / "images"
CONFIGS = ROOT / "scripts" / "configs"
LIGHTS = {"uffizi": "uffizi.hdr", "grace": "grace_cross.hdr", "courtyard": "courtyard.exr"}
PAPER = ptt.Clusters(points=1000, eigenvectors=32, lighting=64)
OWN = ptt.Clusters(points=1000, eigenvectors=96, lighting=16)
# relative RMSE in total and of the indirect part; paper-16 has the eigenvectors of the paper's Watch scene
GOALS = {"uncompressed": ("<= 0.03", "<= 0.1"), "paper": ("<= 0.06", ""), "own": ("<= 0.04", ""), "paper-16": ("", "")}
SAMPLES = 4096


@dataclass(frozen=True)
class Case:
    """A scene of the bench: its space, tensor, materials to try, and its row of Table 1.

    table: name, vertices, megabytes, hours (precomputation, compression), frames/s (view, and BRDF, and light)
    seconds: goal of precomputation and compression together
    vertices, whole: how many are compared, and with which materials the uncompressed transfer is, under one map
    """

    space: Callable[[], ptt.BRDFSpace]
    ranks: tuple[int, int, int]
    lobes: int
    functions: int
    materials: Callable[[], dict[str, ptt.Material]]
    table: tuple[str, float, float, tuple[float, float], tuple[float, float, float]]
    seconds: float | None = None
    vertices: int = 600
    whole: tuple[str, ...] = ("rough", "moderate", "metallic", "mirror-like")


def blinn_phong_materials() -> dict[str, ptt.Material]:
    return {
        "rough": ptt.blinn_phong((0.45, 0.12, 0.1), 0.4, 8.0),
        "moderate": ptt.blinn_phong((0.3, 0.28, 0.24), 0.5, 24.0),
        "mirror-like": ptt.blinn_phong((0.1, 0.1, 0.12), 0.7, 150.0),
    }


def fitted_materials() -> dict[str, ptt.Material]:
    space = ptt.BRDFSpace.fitted()
    names = {
        "rough": "light-red-paint",
        "moderate": "violet-rubber",
        "metallic": "gold-metallic-paint",
        "mirror-like": "nickel",
    }
    return {kind: space.material(name) for kind, name in names.items()}


CASES = {
    "suzanne": Case(
        ptt.BRDFSpace.blinn_phong, (4, 40, 40), 3, 4, blinn_phong_materials,
        ("Airplane", 13100, 144, (2.5, 6.4), (139.5, 30.79, 5.91)), 300.0,
    ),
    "dragon": Case(
        ptt.BRDFSpace.fitted, (4, 16, 16), 4, 4, fitted_materials,
        ("Venus", 39700, 389, (5.0, 7.3), (57.09, 10.94, 2.62)), None, 300, ("rough", "moderate"),
    ),
    "engine": Case(
        ptt.BRDFSpace.fitted, (4, 8, 8), 4, 4, fitted_materials,
        ("Watch", 62100, 603, (15.7, 14.3), (43.06, 7.23, 1.53)), 1800.0, 300, ("moderate",),
    ),
}  # fmt: skip


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
            replace_rows(name, pool.submit(OTHERS.get(name, scene_rows), name).result())


def replace_rows(name: str, new: list[dict[str, str]]) -> None:
    """Write the rows of one scene; those of the others stay as they are in the file by now."""
    table = Table("transfer")
    old = list(csv.DictReader(table.path.open())) if table.path.exists() else []
    rows = {scene: [row for row in old if row["what"].startswith(scene)] for scene in (*CASES, *OTHERS)}
    table.rows = [row for scene in (rows | {name: new}).values() for row in scene]
    table.write()


def scene_rows(name: str) -> list[dict[str, str]]:
    """All rows of one scene."""
    warnings.simplefilter("ignore")
    table, case = Table("transfer"), CASES[name]
    scene = ptt.Scene.load(CONFIGS / f"{name}.toml")
    data = Path(os.environ["PTT_DATA"]) / "hdri"
    lights = {key: ptt.Environment.load(data / file) for key, file in LIGHTS.items()}
    raw, transfer, models = built(table, name, scene, case)
    right(table, name, scene, case, lights, raw, transfer, models, case.vertices)
    pictures(name, scene, case, lights, models["own"])
    material = case.materials()["moderate"]
    speed(table, name, scene, material, (case.table[0], case.table[4]), lights["uffizi"], models)
    stability(table, name, scene, case, lights["uffizi"], models["own"], transfer)
    if name == "suzanne":
        figure_9(table, name, scene, case, lights["uffizi"], transfer)
    if name == "engine":
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
    stability(table, "quick", scene, case, lights["sky"], models["own"], transfer)
    return table.rows


def built(
    table: Table, name: str, scene: ptt.Scene, case: Case
) -> tuple[ptt.RawTransfer, Any, dict[str, ptt.TransferModel]]:
    """Precomputation and compression: time, memory, storage."""
    paper, vertices, megabytes, hours, _ = case.table
    v = len(scene.vertices)
    start = time.perf_counter()
    raw = ptt.precompute(scene, 2, progress=True)
    traced = time.perf_counter()
    space = case.space()
    brdf = ptt.TensorBRDF.fit(space, ranks=case.ranks, separated=case.lobes)
    basis = ptt.BRDFBasis.fit(space, case.functions)
    fitted = time.perf_counter()
    transfer = ptt.assemble(raw, brdf, basis, 96, progress=True)
    assembled = time.perf_counter()
    own = ptt.cluster(transfer, OWN, progress=True)
    done = time.perf_counter()
    models = {"own": own, "paper": ptt.cluster(transfer, PAPER)}
    paper_seconds = time.perf_counter() - done
    if name == "engine":
        models["paper-16"] = ptt.cluster(transfer, replace(PAPER, eigenvectors=16))
    slots = len(own.slots)
    how = f"{v} vertices, {slots} slots, tensor {case.ranks}, {case.lobes} lobes; {setting()}"
    what = f"{name}, precomputation"
    table.row(f"{what}, rays", traced - start, "s", how)
    table.row(f"{what}, fits of tensor and basis", fitted - traced, "s", how)
    table.row(f"{what}, T0 T1 T2 of all points", assembled - fitted, "s", how)
    table.row(f"{what}, clusters", done - assembled, "s", f"own settings; {how}")
    table.row(f"{what}, clusters of 1000 points", paper_seconds, "s", how)
    goal = "" if case.seconds is None else f"<= {case.seconds:g}"
    said = f"{sum(hours) * 3600:g} s ({paper}, {vertices:g} vertices)"
    table.row(f"{what}, all", done - start, "s", f"own settings; {how}", goal, paper=said)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 2**30
    table.row(f"{what}, peak memory", peak, "GiB", how, "<= 12")
    for key, model in models.items():
        clusters = sum(len(region.columns) for region in model.clustered)
        eigenvectors = model.clustered[0].eigenvectors
        dimensions = model.clustered[0].lighting.shape[2]
        how = f"{clusters} clusters, {eigenvectors} eigenvectors, {dimensions} lighting dimensions, bfloat16"
        goal, said = f"<= {megabytes:g}", f"{megabytes:g} MB ({paper})"
        table.row(f"{name}, storage, {key}", model.bytes / 1e6, "MB", how, goal, paper=said)
        table.row(f"{name}, storage of lobes' visibility, {key}", _cuts(model) / 1e6, "MB", how)
    return raw, transfer, models


def _cuts(model: ptt.TransferModel) -> int:
    return sum(region.cuts.numel() * 4 for region in model.clustered)


def grown(name: str) -> list[dict[str, str]]:
    """Cost as vertices and regions grow."""
    table = Table("transfer")
    growth(table)
    return table.rows


def facing(scene: ptt.Scene, most: int) -> Tensor:
    """Some vertices that face the camera."""
    seen = torch.nonzero((scene.camera.toward(scene.vertices) * scene.normals).sum(1) > 0)[:, 0]
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))
    return seen[order[:most]].sort().values


def right(
    table: Table,
    name: str,
    scene: ptt.Scene,
    case: Case,
    lights: Mapping[str, ptt.Environment],
    raw: ptt.RawTransfer,
    transfer: Any,
    models: Mapping[str, ptt.TransferModel],
    vertices: int = 600,
    samples: int = SAMPLES,
) -> None:
    """Against the path tracer with the same two bounces; every material after the first is an edit of the model."""
    rows = facing(scene, vertices)
    points = ptt.reference.Points(
        scene.points[rows], scene.frames[rows], scene.vertex_region[rows], scene.colours[rows]
    )
    wo = scene.camera.toward(points.position)
    relighters = {key: ptt.TransferRelighter(model) for key, model in models.items()}
    direct = {key: ptt.TransferRelighter(without_bounces(model)) for key, model in models.items()}
    exact = Uncompressed(raw, transfer.brdf, transfer.basis, transfer.direct.coarse, transfer.cuts)
    for (light_name, light), (kind, material) in ((a, b) for a in lights.items() for b in case.materials().items()):
        materials = dressed(scene, material)
        whole, indirect, noise = truth(scene, light, materials, points, wo, samples)
        how = f"{len(rows)} vertices, {samples} samples, noise of the reference {noise[0]:.4f} in total "
        how += f"and {noise[1]:.3f} in its indirect part, "
        how += f"which is {float(indirect.norm() / whole.norm()):.3f} of it; {material.shape}"
        smooth = kind != "mirror-like"

        found = {}
        if name == "suzanne" or (light_name == next(iter(lights)) and kind in case.whole):
            parts = exact.radiance(rows, light, materials, torch.tensor(scene.camera.eye))
            found["uncompressed"] = parts[0] + parts[1] + parts[2], parts[1] + parts[2]
        for key, relighter in relighters.items():
            ours = relighter(light, materials, scene.camera)[rows]
            found[key] = ours, ours - direct[key](light, materials, scene.camera)[rows]
        for key, (ours, bounced) in found.items():
            what, goals = f"{name}, {light_name}, {kind}, {key}", GOALS[key] if smooth else ("", "")
            table.row(f"{what}, total", ptt.relative_rmse(ours, whole), "relative RMSE", how, goals[0])
            table.row(f"{what}, indirect", ptt.relative_rmse(bounced, indirect), "relative RMSE", how, goals[1])


def truth(
    scene: ptt.Scene,
    light: ptt.Environment,
    materials: Mapping[str, ptt.Material],
    points: ptt.reference.Points,
    wo: Tensor,
    samples: int,
) -> tuple[Tensor, Tensor, tuple[float, float]]:
    """Radiance (v, 3) with two bounces, its indirect part, and the relative noise of both, from two halves.

    The same seed with and without bounces: the same direct light is in both and leaves nothing in their difference.
    """

    def half(bounces: int, seed: int) -> Tensor:
        return ptt.reference.radiance(
            scene, light, materials, points, wo, samples=samples // 2, bounces=bounces, seed=seed
        ).mean

    wholes = torch.stack([half(2, seed) for seed in (0, 1)])
    indirect = wholes - torch.stack([half(0, seed) for seed in (0, 1)])
    spread, several = ((x[0] - x[1]).norm() / 2 / x.mean(0).norm() for x in (wholes, indirect))
    return wholes.mean(0), indirect.mean(0), (float(spread), float(several))


def without_bounces(model: ptt.TransferModel, most: int = 0) -> ptt.TransferModel:
    """The same model with at most so many bounces."""
    model = copy.deepcopy(model)
    for region in model.clustered:
        if most < 2:
            region.two.zero_()
        if most < 1:
            region.one.zero_()
    return model


def pictures(
    name: str, scene: ptt.Scene, case: Case, lights: Mapping[str, ptt.Environment], model: ptt.TransferModel
) -> None:
    """Figures 11 and 12: direct light, with one bounce, with two, the reference, the difference; a row a state."""
    camera = replace(scene.camera, width=320, height=240)
    relighters = [ptt.TransferRelighter(without_bounces(model, most)) for most in range(3)]
    states = {"rough": ("uffizi", "rough"), "moderate": ("grace", "moderate"), "sun": ("courtyard", "moderate")}
    strips = []
    for light_name, kind in states.values():
        light, materials = lights[light_name], dressed(scene, case.materials()[kind])
        images = [ptt.render(scene, camera, r(light, materials, camera), light).pixels for r in relighters]
        truth = ptt.reference.image(scene, light, materials, camera, samples=128, bounces=2).mean.float()
        gain = 2.0 ** ptt.Image(images[-1]).exposure()
        strips.append(torch.cat([*images, truth, 4 * (images[-1] - truth).abs()], 1) * gain)
    ptt.Image(torch.cat(strips)).save(IMAGES / f"transfer_{name}.png")


def caustic(name: str) -> list[dict[str, str]]:
    """Figure 13: a ring on a table, shiny and dull, under a small light; and how much light is in the caustic."""
    warnings.simplefilter("ignore")
    table = Table("transfer")
    ring, faces = mesh.torus_mesh(0.8, 0.18)
    parts = [
        Part("ring", ring + torch.tensor([0.0, 0.18, 0.0]), faces, material=ptt.blinn_phong(0.1, 0.8, 60.0)),
        Part("table", *mesh.plane_mesh(4.0, 90), material=ptt.lambert(0.6), editable=False),
    ]
    camera = ptt.Camera((0.3, 3.2, 2.6), (0.0, 0.0, 0.0), fov=36, width=320, height=240)
    scene = ptt.Scene.from_parts(parts, camera=camera)
    light = ptt.Environment.area_light((-0.8, 0.75, -0.2), 12.0, 30.0)
    raw = ptt.precompute(scene, 2, progress=True)
    space = ptt.BRDFSpace.blinn_phong()
    brdf, basis = ptt.TensorBRDF.fit(space, ranks=(4, 24, 24), separated=2), ptt.BRDFBasis.fit(space)
    transfer = ptt.assemble(raw, brdf, basis, 96, progress=True)
    model = ptt.cluster(transfer, OWN, progress=True)
    seams(table, scene, light, model, ptt.cluster(transfer, replace(OWN, points=100, eigenvectors=96, columns=4096)))
    relighters = [ptt.TransferRelighter(without_bounces(model, most)) for most in range(3)]
    strips = []
    for kind, material in (("shiny", ptt.blinn_phong(0.1, 0.8, 60.0)), ("dull", ptt.blinn_phong(0.5, 0.1, 4.0))):
        materials = dressed(scene, material)
        radiance = [r(light, materials, camera) for r in relighters]
        images = [ptt.render(scene, camera, b).pixels for b in radiance]
        truth = ptt.reference.image(scene, light, materials, camera, samples=256, bounces=2).mean.float()
        truth = truth * (ptt.render(scene, camera, torch.ones_like(scene.vertices)).pixels > 0)
        strips.append(torch.cat([*images, truth, 4 * (images[-1] - truth).abs()], 1))
        points = ptt.reference.at_vertices(scene, light, materials, camera, samples=2048, bounces=1)
        direct = ptt.reference.at_vertices(scene, light, materials, camera, samples=2048)
        own = scene.vertex_region == 1
        truly, ours = (points.mean - direct.mean)[own], (radiance[1] - radiance[0])[own]
        how = "first bounce on the table, all its vertices; light of 12 degrees, lighting of the bounce 6 x 8 x 8"
        table.row(f"caustic, {kind} ring, error", ptt.relative_rmse(ours, truly), "relative RMSE", how)
        peak = float(ours.max()) / float(truly.quantile(0.999))
        table.row(f"caustic, {kind} ring, brightest over the reference's", peak, "", f"{how}; its 99.9 % quantile")
    ptt.Image(torch.cat(strips)).save(IMAGES / "transfer_caustic.png", ptt.Image(strips[0]).exposure() - 1.6)
    return table.rows


def seams(
    table: Table, scene: ptt.Scene, light: ptt.Environment, model: ptt.TransferModel, finer: ptt.TransferModel
) -> None:
    """How far the error jumps along the ring's edges where they cross from one cluster to the next, and elsewhere."""
    rough = dressed(scene, ptt.blinn_phong(0.4, 0.3, 12.0))
    ours, truth = (ptt.TransferRelighter(m)(light, rough, scene.camera) for m in (model, finer))
    region = model.clustered[0]
    cluster = region.cluster[region.place // WIDTH]
    first, end = model.receivers.spans[0]
    faces = scene.faces[(scene.faces < end).all(1)]
    a, b = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]])).T
    error = ours - truth
    step = (error[a] - error[b]).norm(dim=1).square()
    crossing = cluster[a] != cluster[b]
    size = truth[first:end].norm(dim=1).square().mean().sqrt()
    how = "root mean square of the difference of errors along an edge over that of the radiance; ring, exponent 12"
    table.row("caustic, seams, edges between clusters", float(step[crossing].mean().sqrt() / size), "", how)
    table.row("caustic, seams, edges within clusters", float(step[~crossing].mean().sqrt() / size), "", how)


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
    relighter, materials = ptt.TransferRelighter(model), dressed(scene, case.materials()["moderate"])

    def of(environment: ptt.Environment) -> Tensor:
        return relighter(environment, materials, scene.camera)

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
            model = ptt.cluster(transfer, replace(PAPER, **{axis: value}))
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
