"""Direct light: every figure of it, as rows of bench/results/direct.csv.

    PTT_DATA=... python -m bench.direct             # about 10 minutes on two cores
    PTT_DATA=... python -m bench.direct --quick     # under a minute: fewer vertices, rays and samples; written nowhere

Needs the extra `bench` (Mitsuba), and PTT_DATA with meshes/bunny.ply and hdri/uffizi.hdr. Pictures go to docs/images.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import ptt
from bench import mitsuba_check
from bench.table import ROOT, Table, median_seconds, read_bandwidth, setting
from ptt.ops import mesh
from ptt.ops.sphere import Cube
from ptt.scene.parts import Part

STEPS = count()  # no two frames are alike
IMAGES = ROOT / "docs" / "images"
FAR = torch.tensor([0.0, 50.0, 0.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute: fewer vertices; written nowhere")
    quick = parser.parse_args().quick
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with meshes/bunny.ply and hdri/uffizi.hdr")
    data = Path(os.environ["PTT_DATA"])
    IMAGES.mkdir(parents=True, exist_ok=True)
    table = Table("direct")
    furnace(table)
    against_mitsuba(table, rays=200 if quick else 2000, samples=64 if quick else 1024, pictures=not quick)
    bunny(table, data, vertices=200 if quick else 2000, samples=4096 if quick else 16384)
    speed(table, data, stride=64 if quick else 1)
    if not quick:
        whole_flow(table)
        table.write()


def furnace(table: Table) -> None:
    """Albedo 1 under 1 from everywhere: 1 on a convex body, never more where something is hidden."""
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((20.0,)), ranks=(1, 1, 1), separated=0)

    def radiance(scene: ptt.Scene, coefficients: int | None) -> Tensor:
        relighter = ptt.TransferRelighter(ptt.compress(ptt.precompute(scene), coefficients, brdf, clusters=None))
        relit: Tensor = relighter(ptt.Environment.constant(1.0), {}, FAR)
        return relit

    ball = ptt.Scene.from_mesh(*mesh.sphere_mesh(3, 1.0), material=ptt.lambert(1.0))
    error = float((radiance(ball, 96) - 1).abs().max())
    table.row("furnace, convex body, largest |B - 1|", error, "", "sphere, 642 vertices, 96 coefficients", "<= 0.005")
    body, faces = mesh.sphere_mesh(3, 0.5)
    floor = Part("floor", *mesh.plane_mesh(3.0, 24), material=ptt.lambert(1.0))
    over = Part("ball", body + torch.tensor([0.0, 0.51, 0.0]), faces, material=ptt.lambert(1.0))
    scene = ptt.Scene.from_parts([floor, over])
    for keep in (96, None):
        most = float(radiance(scene, keep).max())
        how = f"ball over a floor, 1267 vertices, {keep or 'all'} coefficients; 1 + float32 rounding"
        table.row(f"furnace, with occlusion, largest B, {keep or 'all'} coefficients", most, "", how, "<= 1.00001")


def against_mitsuba(table: Table, rays: int, samples: int, pictures: bool) -> None:
    """The reference and Mitsuba 3, both with a standard error, along the same rays."""
    scene = ptt.default_scene()
    lights = {"constant": ptt.Environment.constant((1.0, 2.0, 0.5)), "smooth": ptt.Environment.gradient_sky()}
    for name, light in lights.items():
        for bounces in (0, 1, 2):
            score = mitsuba_check.compare(scene, light, bounces, rays, samples)
            how = f"{rays} camera rays of the default scene, matt, {samples} samples, scalar_rgb"
            what = f"reference against Mitsuba, {name} map, {bounces} bounces"
            table.row(f"{what}: mean difference over its standard error", score["bias_z"], "", how, "<= 3")
            table.row(f"{what}: root mean square of z", score["z_rms"], "", how + "; 1 if both are right")
            table.row(f"{what}: share of z within 3", score["within_3"], "", how + "; 0.9973 if both are right")
            table.row(f"{what}: relative difference of the means", score["bias"], "", how)
    if pictures:
        small = replace(scene, camera=replace(scene.camera, width=160, height=120))
        for name, light in lights.items():
            for bounces in (0, 1, 2):
                path = IMAGES / f"mitsuba_{name}_{bounces}.png"
                mitsuba_check.side_by_side(path, small, light, bounces=bounces, samples=64)


def bunny(table: Table, data: Path, vertices: int, samples: int) -> None:
    """bunny.ply under uffizi.hdr, 6 x 64 x 64: against the reference, and truncated against untruncated."""
    scene = ptt.load_scene(data / "meshes" / "bunny.ply")
    light = ptt.Environment.load(data / "hdri" / "uffizi.hdr")
    seen = torch.nonzero((scene.camera.toward(scene.vertices) * scene.normals).sum(1) > 0)[:, 0]
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))
    index = seen[order[:vertices]].sort().values
    raw = ptt.precompute(scene, index=index)
    name = scene.regions[0].name
    materials = {
        "diffuse": {name: ptt.lambert(0.5)},
        "Blinn-Phong 20": {name: ptt.blinn_phong(0.0, 1.0, 20.0)},
    }
    brdf = moderate()
    radiance = {keep: relit(raw, keep, brdf, light, materials, scene.camera) for keep in (None, 256, 96, 32)}
    how = f"{vertices} random vertices that face the camera, uffizi.hdr, tensor (4, 24, 24) of exponents 1..64"
    for kind, goal in (("diffuse", 0.01), ("Blinn-Phong 20", 0.03)):
        points = ptt.reference.Points(
            scene.points[index], scene.frames[index], scene.vertex_region[index], scene.colours[index]
        )
        wo = scene.camera.toward(points.position)
        truth = ptt.reference.radiance(scene, light, materials[kind], points, wo, samples=samples)
        noise = truth.noise
        error = ptt.relative_rmse(radiance[None][kind], truth.mean)
        what = f"bunny, {kind}"
        note = f"{how}; {samples} samples, the reference's own noise is {noise:.4f} and is contained in the value"
        table.row(f"{what}, untruncated against the reference", error, "relative RMSE", note, f"<= {goal}")
        for keep, bound in ((32, ""), (96, "<= 0.03"), (256, "<= 0.01")):
            lost = ptt.relative_rmse(radiance[keep][kind], radiance[None][kind])
            trial = {32: "0.086", 96: "0.026", 256: "0.008"}[keep]
            note = f"{how}; a rough trial gave {trial} (diffuse)"
            table.row(f"{what}, {keep} coefficients against untruncated", lost, "relative RMSE", note, bound)


def moderate() -> ptt.TensorBRDF:
    """Exponents 1..64, without lobes: what every point's own T0 shows."""
    return ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong(ptt.materials.spaces.MODERATE), ranks=(4, 24, 24), separated=0)


def relit(
    raw: ptt.RawTransfer,
    keep: int | None,
    brdf: ptt.TensorBRDF,
    light: ptt.Environment,
    materials: dict[str, dict[str, ptt.Material]],
    camera: ptt.Camera,
) -> dict[str, Tensor]:
    """Radiance of all receivers for each set of materials, in blocks: untruncated, 100 receivers weigh 0.6 GB."""
    parts: dict[str, list[Tensor]] = {kind: [] for kind in materials}
    for first in range(0, len(raw.receivers), 100):
        some = raw.part(slice(first, first + 100))
        relighter = ptt.TransferRelighter(ptt.compress(some, keep, brdf, clusters=None))
        for kind, chosen in materials.items():
            parts[kind].append(relighter(light, chosen, camera))
    return {kind: torch.cat(part) for kind, part in parts.items()}


def speed(table: Table, data: Path, stride: int) -> None:
    """What each step costs on the bunny, beside the bytes it reads at the measured bandwidth."""
    scene = ptt.load_scene(data / "meshes" / "bunny.ply")
    light = ptt.Environment.load(data / "hdri" / "uffizi.hdr")
    bandwidth = read_bandwidth()
    how = setting()
    table.row("read bandwidth", bandwidth / 1e9, "GB/s", f"sum of 400 MB; {how}")
    index = torch.arange(0, len(scene.vertices), stride)
    start = time.perf_counter()
    raw = ptt.precompute(scene, index=index)
    traced = time.perf_counter()
    model = ptt.compress(raw, 96, moderate(), clusters=None)
    done = time.perf_counter()
    v = len(index)
    rays = v * Cube(64).cells / 2
    table.row("visibility", rays / (traced - start) / 1e6, "million rays/s", how, limit="7.6 (bare embree, design)")
    table.row("visibility of the bunny", traced - start, "s", f"{v} vertices, 6 x 64 x 64; {how}")
    table.row("T0 and its compression", (done - traced) / v * 1e3, "ms/vertex", f"25 factors, 96 coefficients; {how}")
    table.row("model", model.bytes / v, "bytes/vertex", "25 factors, 96 coefficients")

    camera = scene.camera
    name = scene.regions[0].name
    glossy = ptt.blinn_phong(0.3, 0.4, 20.0)
    for form in ("eager", "torch.compile"):
        relighter: Any = ptt.TransferRelighter(model)
        if form == "torch.compile":
            relighter = torch.compile(relighter)
        relighter(light, {name: glossy}, camera)
        eyes = iter([camera.orbited(k) for k in range(1, 200)])

        def view(r: Any = relighter, eyes: Iterator[ptt.Camera] = eyes) -> object:
            return r(light, {name: glossy}, next(eyes))

        def brdf(r: Any = relighter, steps: Iterator[int] = STEPS) -> object:
            return r(light, {name: ptt.blinn_phong(0.3, 0.4, 20 + next(steps) / 100)}, camera)

        def lighting(r: Any = relighter, steps: Iterator[int] = STEPS) -> object:
            return r(light.rotated(y=next(steps)), {name: glossy}, camera)

        o = 25
        i = 25
        for what, function, read in (
            ("view", view, 4 * v * (3 * o + 12 + o)),
            ("BRDF", brdf, 4 * v * (3 * i + 3 * o)),
            ("light", lighting, 8 * v * i * 96),
        ):
            seconds = median_seconds(function)
            limit = f"{1e3 * read / bandwidth:.3g} ms to read {read / 1e6:.3g} MB"
            table.row(
                f"relit after a change of {what}, {form}", 1e3 * seconds, "ms", f"{v} vertices; {how}", limit=limit
            )


def whole_flow(table: Table) -> None:
    """scripts/relight.py without arguments, and what it reports."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        command = [sys.executable, str(ROOT / "scripts" / "relight.py"), "--out", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
        states = json.loads((Path(folder) / "relight.json").read_text())["states"]
        (IMAGES / "relight.png").write_bytes((Path(folder) / "relight.png").read_bytes())
    table.row("scripts/relight.py, the whole flow", seconds, "s", f"default scene, 7873 vertices; {setting()}", "<= 90")
    for state, report in states.items():
        how = f"96 coefficients; the reference's own noise is {report['noise']:.4f}"
        table.row(f"default scene, {state}", report["relative_rmse"], "relative RMSE", how)


if __name__ == "__main__":
    main()
