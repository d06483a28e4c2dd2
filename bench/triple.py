"""Triple products in local frames: figures of it, as rows of bench/results/triple.csv.

    PTT_DATA=... python bench/triple.py             # a few minutes on two cores
    python bench/triple.py --quick                  # half a minute: a ball over a floor, written nowhere

Needs PTT_DATA with meshes and maps.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import ptt
from bench.table import Table, median_seconds, read_bandwidth, setting
from ptt import reference
from ptt.meshes import Part
from ptt.ops import geodesic, haar, local, mesh, rotation, triple
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import Octahedral

PAPER = {("texture", 1): "97 (25 K), 44 to 47 (50 K)", ("texture", 2): "38 (25 K), 17 to 18 (50 K)"}
PAPER |= {("vertices", 1): "21 (25 K), 15 (50 K)", ("vertices", 2): "8.5 (25 K), 7 (50 K)"}
GOALS = {("texture", 1): ">= 60", ("texture", 2): ">= 30"}
MATERIALS = {"dull": ptt.lambert(0.6), "glossy": ptt.blinn_phong(0.2, 0.6, 30.0)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="half a minute: a ball over a floor, written nowhere")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore")
    table, data = Table("triple_quick" if quick else "triple"), Path(os.environ.get("PTT_DATA", ""))
    if not quick and not data.name:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    body = mesh.sphere_mesh(3)
    scenes = {"ball": on_floor(*body, 20)}
    lights = {"area light": ptt.Environment.area_light((0.4, 0.8, 0.3), 12.0, 20.0)}
    if not quick:
        read = {"dragon": "dragon_vrip_res3.ply", "igea": "igea.ply"}
        loaded = {name: ptt.Scene.load(data / "meshes" / file) for name, file in read.items()}
        scenes = {name: on_floor(scene.vertices, scene.faces, 100) for name, scene in loaded.items()}
        lights["grace"] = ptt.Environment.load(data / "hdri" / "grace.hdr")
    table.row("read bandwidth", read_bandwidth() / 1e9, "GB/s", f"sum of 400 MB; {setting()}")
    name, scene = next(iter(scenes.items()))
    coefficients(table, name, scene, lights, 30 if quick else 200, 256 if quick else 2048, 3 if quick else 4)
    for name, scene in scenes.items():
        frames(table, name, scene, next(reversed(lights.values())), quick)
    storage(table)
    if not quick:
        table.write()


def on_floor(vertices: Tensor, faces: Tensor, cells: int) -> ptt.Scene:
    """A mesh on a floor, looked at from the front and above."""
    low, high = vertices.amin(0), vertices.amax(0)
    size, middle = float((high - low).max()), (low + high) / 2
    plane, squares = mesh.plane_mesh(3 * size, cells)
    below = torch.stack((middle[0], low[1], middle[2]))
    seen = ptt.Camera.framing(middle, 0.7 * size)
    return ptt.Scene.from_parts([Part("body", vertices, faces), Part("floor", plane + below, squares)], camera=seen)


def coefficients(
    table: Table, name: str, scene: ptt.Scene, lights: dict[str, ptt.Environment], some: int, samples: int, finest: int
) -> None:
    """Figures 7 and 8: error against the number of coefficients, top-only and adaptive, at vertices with shadows."""
    assert scene.camera is not None
    seen = ((scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.1).nonzero()[:, 0]
    index = seen[torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))[:some]]
    frames, points = scene.frames[index], reference.Points(*(x[index] for x in reference.vertex_points(scene)))
    toward = scene.camera.toward(points.position)
    wo = torch.einsum("vax,vx->va", frames, toward)
    grid = Geodesic(finest)
    visible = local.visibility(scene.surface, points.position, frames, grid, 2).float() / 255
    for light_name, light in lights.items():
        values = light.project(Octahedral(128)).reshape(-1, 3)
        s = rotation.resampling(Octahedral(128), grid, frames, 4)
        local_light = rotation.resample(values, s).reshape(some, grid.cells, 3).transpose(1, 2)
        for kind, material in MATERIALS.items():
            factor = material.diffuse[:, None] * local.cosine(grid)
            if material.shape is not None:
                table_ = torch.cat([local.brdf(material.shape.evaluate, grid, o[None], 2) for o in wo])
                factor = factor + material.specular[:, None] * table_[:, None]
            given = {region.name: material for region in scene.regions}
            truth = reference.radiance(scene, light, given, points, toward, samples=samples)
            noise = float(truth.standard_error.norm() / truth.mean.norm())
            three = [geodesic.analyse(x) for x in (local_light, visible[:, None], factor.expand(some, 3, -1))]
            for level in range(finest + 1):
                keep, what = 20 << 2 * level, f"figure 8, {light_name}, {kind}"
                top = triple.quadrature(*(triple.top_only(x, keep) for x in three))
                how = f"{name} on a floor, {some} vertices; noise of the reference {noise:.4f}"
                error = ptt.relative_rmse(top, truth.mean)
                table.row(f"{what}, {keep} coefficients, top-only", error, "relative RMSE", how)
                weights = geodesic.areas(finest).sqrt().float()
                cut = [haar.truncate(x.contiguous(), keep, weights) for x in three]
                error = ptt.relative_rmse(triple.adaptive(*cut, grid.cells), truth.mean)
                table.row(f"{what}, {keep} coefficients, adaptive", error, "relative RMSE", how)


def frames(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """Table 3: frames a second at 1024 x 768, the G-buffer cached; a change of light, of a BRDF, of the camera."""
    assert scene.camera is not None
    width, height = (96, 72) if quick else (1024, 768)
    camera = replace(scene.camera, width=width, height=height)
    took = median_seconds(lambda: ptt.GBuffer.of(scene, camera), 3)
    pixels = ptt.GBuffer.of(scene, camera)
    where = f"{len(scene.vertices)} vertices, {len(pixels.pixel)} pixels of {width} x {height}; {setting()}"
    table.row(f"table 3, {name}, G-buffer", 1e3 * took, "ms", where)
    start = time.perf_counter()
    atlas = ptt.Atlas.of(scene, 64 if quick else 1024)
    texels = len(atlas.triangle)
    table.row(f"table 3, {name}, atlas made in", time.perf_counter() - start, "s", f"{texels} texels; {where}")
    given = {"body": ptt.fitted("gold-metallic-paint"), "floor": ptt.blinn_phong(0.5, 0.2, 20.0)}
    for kind, held in {"texture": atlas, "vertices": None}.items():
        for level in (1, 2):
            if kind == "texture" and level == 2 and not quick:
                held = ptt.Atlas.of(scene, 512)
            start = time.perf_counter()
            relighter = ptt.TripleProductRelighter(scene, level, atlas=held)
            n = relighter.grid.cells
            what, how = f"table 3, {name}, {kind}, {n}", f"{len(relighter.visibility)} rows of visibility; {where}"
            table.row(f"{what}, built in", time.perf_counter() - start, "s", how)
            relighter(light, given, pixels)
            took = median_seconds(lambda: relighter(light, given, pixels))  # noqa: B023
            goal = GOALS.get((kind, level), "")
            table.row(f"{what}, frames", 1 / took, "1/s", how, goal, paper=PAPER[kind, level])
            turned: Iterator[ptt.Environment] = (light.rotated(y=k) for k in count(1))
            took = median_seconds(lambda: relighter.incident(next(turned)))  # noqa: B023
            rotated = f"{len(relighter.frames) * relighter.twists} frames"
            table.row(f"{what}, light rotated", 1e3 * took, "ms", f"{rotated}; {how}")
            start = time.perf_counter()
            relighter._table(ptt.BlinnPhong(17.0 + level))
            goal = "<= 0.2" if level == 1 else ""
            table.row(f"{what}, an edited BRDF", time.perf_counter() - start, "s", how, goal, paper="2 to 3 s")


def storage(table: Table) -> None:
    """Table 1: global against local frames by the paper's formulas, in its bytes (RGB light, 1 byte each)."""
    light, rotations, views, materials = 5120, 32 * 16 * 32, 128 * 64, 1
    normals = 32 * 16
    for name, n in (("5120", light), ("320", 320), ("80", 80)):
        local_frames = 3 * rotations * n + materials * views * n
        global_frames = 3 * n + materials * normals * views * n
        how = "without visibility; light in three channels, one material, one byte a number"
        table.row(f"table 1, {name} coefficients, local frames", local_frames / 1e6, "MB", how)
        table.row(f"table 1, {name} coefficients, global frames", global_frames / 1e6, "MB", how)


if __name__ == "__main__":
    main()
