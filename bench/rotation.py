"""Rotation of light: every figure of it, as rows of bench/results/rotation.csv.

    PTT_DATA=... python -m bench.rotation             # 9 minutes on two cores
    python -m bench.rotation --quick                  # half a minute: small maps and a ball, written nowhere

Needs the extra `peers` (pyshtools), and PTT_DATA with meshes and maps. Pictures go to docs/images.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import ptt
from bench import rotation_peers as peers
from bench import rotation_pictures as pictures
from bench.forms import four_forms
from bench.rotation_errors import (
    Body,
    accuracy,
    anisotropic,
    coefficients,
    cuts,
    figure_7,
    small_lamps,
    table_1,
    table_3,
)
from bench.table import Table, median_seconds, read_bandwidth, setting
from ptt.ops import mesh, native, slices
from ptt.ops.directions import toward

PAPER = {  # table 2: seconds, MB, non-zeros a row, light changes a second
    16: ("2", "11.8", "46.2", "23"),
    32: ("24", "58.4", "57.5", "7.5"),
    64: ("600", "266", "62.2", "1.8"),
    128: ("10800", "1100", "63.2", "0.4"),
}
OPTIONS: dict[str, dict[str, int]] = {
    "64 terms": {"terms": 64},
    "96 terms": {"terms": 96},
    "128 terms": {"terms": 128},
    "default": {},
    "rank 32": {"rank": 32},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="half a minute: small maps and a ball, written nowhere")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore")
    table = Table("rotation_quick" if quick else "rotation")
    data = Path(os.environ.get("PTT_DATA", ""))
    if not quick and not data.name:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    ball = ptt.Scene.from_mesh(*mesh.sphere_mesh(3 if quick else 5), name="sphere")
    lights = {"sky": ptt.Environment.sun_sky(radius=10.0)}
    scenes = {"sphere": ball}
    if not quick:
        lights = {name: ptt.Environment.load(data / "hdri" / f"{name}.hdr") for name in ("uffizi", "grace")}
        scenes["dragon"] = ptt.load_scene(data / "meshes" / "dragon_vrip_res2.ply")
        scenes["igea"] = ptt.load_scene(data / "meshes" / "igea.ply")
    light = next(iter(lights.values()))
    table.row("read bandwidth", read_bandwidth() / 1e9, "GB/s", f"sum of 400 MB; {setting()}")
    sizes = (16, 32) if quick else (16, 32, 64, 128)
    counts, samples = (50, 256) if quick else (1000, 4096)
    bodies = [Body.of(name, scene, light, counts, samples) for name, scene in scenes.items() if name != "igea"]
    table_2(table, sizes, light, 8 if quick else 32)
    table_1(table, bodies, light, 32 if quick else 64, 8 if quick else 32)
    table_3(table, bodies, light, 32 if quick else 64, (8, 16) if quick else (8, 16, 32, 64))
    accuracy(table, bodies, light, (16, 32) if quick else (16, 32, 64, 128))
    if "grace" in lights:
        small_lamps(table, ball, lights["grace"], counts, samples)
    figure_7(table, lights, 32 if quick else 128)
    cuts(table, bodies, light, 32 if quick else 64)
    anisotropic(table, ball, light, quick)
    views(table, scenes, light, 32 if quick else 64)
    forms(table, scenes.get("dragon", ball), light, 32 if quick else 64)
    peers.compare(table, bodies[0], light, 16 if quick else 64, 8 if quick else 32)
    extremes(table, ball)
    if not quick:
        pictures.figure_1(scenes["dragon"], lights)
        table.write()


def turns(light: ptt.Environment) -> Iterator[ptt.Environment]:
    """The light, turned a little further each time."""
    return (light.rotated(y=k) for k in count(1))


def table_2(table: Table, sizes: Sequence[int], light: ptt.Environment, normals: int) -> None:
    """Time to form, bytes, non-zeros a row and light changes a second against N; and the law of their growth."""
    times: dict[str, list[float]] = {"matrix": [], "factored": [], "resample": []}
    rows = []
    bandwidth = read_bandwidth()
    how = f"{normals} x {normals} normals, three channels; {setting()}"
    for n in sizes:
        seconds, megabytes, nonzeros, rate = PAPER[n]
        lit = torch.nn.functional.pad(coefficients(light, n), (0, 0, 0, 0, 0, 1))
        for operator in times:
            start = time.perf_counter()
            rotate = ptt.LightRotation.build(n, normals, operator=operator)  # type: ignore[arg-type]
            formed = time.perf_counter() - start
            what = f"table 2, N {n}^2, {operator}"
            took = median_seconds(lambda r=rotate, x=lit: r(x))  # type: ignore[misc]
            times[operator].append(took)
            paper = operator == "matrix"
            goal = {64: "<= 10", 128: "<= 90"}.get(n, "") if paper else ""
            table.row(f"{what}, formed in", formed, "s", how, goal, paper=f"{seconds} s" if paper else "")
            table.row(f"{what}, size", rotate.bytes / 1e6, "MB", how, paper=f"{megabytes} MB" if paper else "")
            out = 16 * len(rotate.frames) * rotate.m**2
            limit = f"{bandwidth / (rotate.bytes + out):.4g} to read the tables and write the answer"
            fastest = {64: ">= 60", 128: ">= 10"}.get(n, "") if operator == "factored" else ""
            table.row(f"{what}, light changes", 1 / took, "1/s", how, fastest, paper=rate if paper else "", limit=limit)
            if paper:
                per_row = len(rotate.numbers) / (len(rotate.starts) - 1)
                rows.append(per_row)
                table.row(f"{what}, non-zeros", per_row, "a row", how, paper=nonzeros)
                table.row(f"{what}, sparsity", 100 * per_row / n**2, "%", how)
            if operator == "factored":
                reads = len(rotate.reads) / (len(rotate.starts) - 1)
                table.row(f"{what}, non-zeros of S", reads, "a row", "4 x 4 samples a cell")
            del rotate
    logs = np.log([n * n for n in sizes])
    for operator, seconds_of in times.items():
        power = np.polyfit(logs, np.log(seconds_of), 1)[0]
        theirs = "1 (and 1.5 of spherical harmonics)" if operator == "matrix" else ""
        table.row(
            f"cost law, light change, {operator}", power, "", f"time as a power of N, {len(sizes)} sizes", paper=theirs
        )
    power = np.polyfit(logs, np.log([r * n * n / 4 for r, n in zip(rows, sizes, strict=True)]), 1)[0]
    table.row("cost law, non-zeros of R", power, "", f"as a power of N, {len(sizes)} sizes", paper="1 as N grows")


def views(table: Table, scenes: dict[str, ptt.Scene], light: ptt.Environment, n: int) -> None:
    """Frames a second as the view changes, and as the light does, on whole meshes."""
    bandwidth = read_bandwidth()
    paper = {"dragon": "4 to 5 at 120 K", "igea": "4 to 5 at 120 K"}
    for name, scene in scenes.items():
        if name == "sphere" and len(scenes) > 1:
            continue
        assert scene.camera is not None
        cameras = [scene.camera.orbited(k) for k in range(1, 200)]
        given = {region.name: ptt.fitted("gold-metallic-paint") for region in scene.regions}
        rotate = ptt.LightRotation.build(n, 32)
        v = len(scene.vertices)
        for kind, options in OPTIONS.items():
            relighter = ptt.EnvMapRelighter(scene, rotate if options else None, **options)  # type: ignore[arg-type]
            own = relighter.rotation
            camera = iter(cameras)
            lit = turns(light)
            took = median_seconds(lambda: relighter(light, given, next(camera)), 15)  # noqa: B023
            kept = relighter.rank or relighter.terms
            read = v * (4 * kept * 4 + 100)
            sampled = f"{own.normals} x {own.normals} normals"
            how = f"{v} vertices, {kept} terms, N {own.n}^2, {sampled}, gold metallic paint; {setting()}"
            limit = f"{bandwidth / read:.4g} to read four slices and the geometry of every vertex"
            table.row(
                f"view change, {name}, {kind}",
                1 / took,
                "frames/s",
                how,
                ">= 30",
                paper=paper.get(name, ""),
                limit=limit,
            )
            took = median_seconds(lambda: relighter(next(lit), given, scene.camera))  # noqa: B023
            table.row(f"light and view change, {name}, {kind}", 1 / took, "frames/s", how)
        took = median_seconds(lambda: relighter.incident(next(lit)))  # noqa: B023
        table.row(
            f"light step, {name}", 1 / took, "1/s", f"map, rotation and irradiance; N {n}^2; {setting()}", ">= 60"
        )
        pixels = ptt.GBuffer.of(scene, scene.camera)
        relighter(light, given, pixels)
        took = median_seconds(lambda: relighter(next(lit), given, pixels))  # noqa: B023
        table.row(
            f"light change per pixel, {name}", 1 / took, "frames/s", f"{len(pixels.pixel)} pixels of 640 x 480, rank 32"
        )


def forms(table: Table, scene: ptt.Scene, light: ptt.Environment, n: int) -> None:
    """The view step as plain torch, by torch.compile with its blocks opened, and as a kernel."""
    relighter = ptt.EnvMapRelighter(scene, ptt.LightRotation.build(n, 32))
    shape = ptt.fitted("gold-metallic-paint").shape
    assert shape is not None and scene.camera is not None
    at = relighter.points(scene.camera, torch.zeros(3), relighter.chosen({}))[0][0].points.lookup
    cut = relighter.slices_of(shape)
    assert cut is not None
    args = relighter.incident(light).local, cut, slices.first_slice(cut, at.twist), relighter.rotation.frames, at

    def whole(
        local: Tensor, cut: slices.Slices, first: Tensor, frames: Tensor, at: slices.NormalLookup, eye: Tensor
    ) -> Tensor:
        which = first + slices._view_cell(cut.views, frames, at, toward(eye, at.position, 0))
        values = cut.values[which].float() * at.weights[..., None]
        return (values[..., None] * local[at.near[..., None].long(), cut.terms[which].long()]).sum((0, 2))

    eye = torch.tensor(scene.camera.eye)
    how = f"{len(scene.vertices)} vertices, {relighter.terms} terms; {setting()}"
    exact = native.reflected(*args, eye)
    for name, step in {
        "eager": slices.reflected,
        "torch.compile": torch.compile(whole),
        "kernel": native.reflected,
    }.items():
        took = median_seconds(lambda f=step: f(*args, eye), 5)  # type: ignore[misc]
        off = ptt.relative_rmse(step(*args, eye), exact)
        table.row(f"view step, {name}", 1e3 * took, "ms", f"off the kernel by {off:.1e}; {how}")
    material = ptt.fitted("gold-metallic-paint")
    region = scene.regions[0].name

    def relighter_of(compiled: bool) -> ptt.EnvMapRelighter:
        rotation = ptt.LightRotation.build(n, 32, compiled=compiled)
        return ptt.EnvMapRelighter(scene, rotation, compiled=compiled)

    four_forms(
        table,
        "forms",
        relighter_of,
        light,
        lambda k: {region: ptt.Material(material.diffuse, material.specular * (1 - 1e-4 * (k % 1000)), material.shape)},
        lambda k: scene.camera.orbited(0.37 * k),
        how,
    )


def extremes(table: Table, ball: ptt.Scene) -> None:
    """What must stay finite, and exact."""
    sun = torch.ones(256, 512, 3)
    sun[60, 100] = 1e9
    relighter = ptt.EnvMapRelighter(ball, ptt.LightRotation.build(32, 16))
    for what, light in {
        "a sun of 1e9 in one texel": ptt.Environment(sun),
        "no light": ptt.Environment.constant(0.0),
    }.items():
        finite = relighter(light, {}, ball.camera).isfinite().float().mean()
        table.row(f"extremes, {what}", float(finite), "share of finite values", "", ">= 1")
    sky = ptt.Environment.sun_sky(radius=10.0)
    one = relighter(sky, {}, ball.camera)
    for factor in (1e-6, 1e6):
        off = ptt.relative_rmse(relighter(sky.scaled(factor), {}, ball.camera) / factor, one)
        table.row(f"extremes, light times {factor:g}", off, "relative RMSE", "of the answer over the factor", "<= 1e-5")
    lit = coefficients(sky, 64)
    rotate = ptt.LightRotation.build(64, 8)
    for kind in (torch.float16, torch.bfloat16):
        off = ptt.relative_rmse(rotate(lit.to(kind)), rotate(lit))
        table.row(f"extremes, {str(kind).removeprefix('torch.')} light", off, "relative RMSE", "of local light")


if __name__ == "__main__":
    main()
