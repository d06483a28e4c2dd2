"""Rotation of light: every figure of it, as rows of bench/results/rotation.csv.

    PTT_DATA=... python bench/rotation.py             # 9 minutes on two cores
    python bench/rotation.py --quick                  # half a minute: small maps and a ball, written nowhere

Needs the extra `peers` (pyshtools), and PTT_DATA with meshes and maps. Pictures go to docs/images.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import ptt
from bench import rotation_peers as peers
from bench import rotation_pictures as pictures
from bench.table import Table, median_seconds, read_bandwidth, setting
from ptt import reference
from ptt.ops import haar, mesh, native, rotation, slices
from ptt.ops.octahedral import HemiOctahedral, Octahedral

PAPER = {  # table 2: seconds, MB, non-zeros a row, light changes a second
    16: ("2", "11.8", "46.2", "23"),
    32: ("24", "58.4", "57.5", "7.5"),
    64: ("600", "266", "62.2", "1.8"),
    128: ("10800", "1100", "63.2", "0.4"),
}
TRUNCATED = {  # table 1: error, MB
    1: ("0.051", "266"),
    8: ("0.067", "242"),
    16: ("0.068", "219"),
    32: ("0.077", "189"),
    128: ("0.102", "105"),
}
NORMALS = {  # table 3: error, seconds, MB
    8: ("0.225", "38", "16.6"),
    16: ("0.087", "150", "66.5"),
    32: ("0.062", "600", "266"),
    64: ("0.051", "2400", "1000"),
}
OPTIONS: dict[str, dict[str, int]] = {
    "64 terms": {"terms": 64},
    "96 terms": {"terms": 96},
    "128 terms": {"terms": 128},
    "rank 32": {"rank": 32},
}
GLOSSY = {"nickel": "Cook-Torrance, m 0.042", "gold-metallic-paint": "Cook-Torrance, m 0.24"}
DULL = "red-fabric"


@dataclass
class Body:
    """A mesh, some of its vertices that face the camera, and their radiance without shadows."""

    name: str
    scene: ptt.Scene
    index: Tensor
    truth: dict[str, Tensor]
    noise: dict[str, float]

    @classmethod
    def of(cls, name: str, scene: ptt.Scene, light: ptt.Environment, count: int, samples: int) -> Body:
        assert scene.camera is not None
        seen = torch.nonzero((scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.05)[:, 0]
        index = seen[torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))[:count]]
        body = cls(name, scene, index, {}, {})
        points = reference.Points(*(x[index] for x in reference.vertex_points(scene)))
        for material in (*GLOSSY, DULL):
            given, wo = body.dressed(material), scene.camera.toward(points.position)
            estimate = reference.unshadowed(scene, light, given, points, wo, samples=samples)
            body.truth[material] = estimate.mean
            body.noise[material] = float(estimate.standard_error.norm() / estimate.mean.norm())
        return body

    def dressed(self, material: str) -> dict[str, ptt.Material]:
        return {region.name: ptt.fitted(material) for region in self.scene.regions}

    def error(self, relighter: ptt.EnvMapRelighter, light: ptt.Environment, material: str) -> float:
        assert self.scene.camera is not None
        radiance = relighter(light, self.dressed(material), self.scene.camera)
        return ptt.relative_rmse(radiance[self.index], self.truth[material])


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
        scenes["dragon"] = ptt.Scene.load(data / "meshes" / "dragon_vrip_res2.ply")
        scenes["igea"] = ptt.Scene.load(data / "meshes" / "igea.ply")
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


def coefficients(light: ptt.Environment, n: int) -> Tensor:
    """(3, n, n) in Haar."""
    return haar.analyse(light.project(Octahedral(n)).movedim(-1, 0))


def turns(light: ptt.Environment) -> Iterator[ptt.Environment]:
    """The light, turned a little further each time."""
    return (light.rotated(y=k) for k in count(1))


def table_2(table: Table, sizes: Sequence[int], light: ptt.Environment, normals: int) -> None:
    """Time to form, bytes, non-zeros a row and light changes a second against N; and the law of their growth."""
    times: dict[str, list[float]] = {"matrix": [], "factored": [], "resample": []}
    rows, bandwidth = [], read_bandwidth()
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
                per_row = len(rotate.reads) / (len(rotate.starts) - 1)
                table.row(f"{what}, non-zeros of S", per_row, "a row", "4 x 4 samples a cell")
            del rotate
    logs = np.log([n * n for n in sizes])
    for operator, took in times.items():
        power = np.polyfit(logs, np.log(took), 1)[0]
        paper = "1 (and 1.5 of spherical harmonics)" if operator == "matrix" else ""
        table.row(
            f"cost law, light change, {operator}", power, "", f"time as a power of N, {len(sizes)} sizes", paper=paper
        )
    power = np.polyfit(logs, np.log([r * n * n / 4 for r, n in zip(rows, sizes, strict=True)]), 1)[0]
    table.row("cost law, non-zeros of R", power, "", f"as a power of N, {len(sizes)} sizes", paper="1 as N grows")


def table_1(table: Table, bodies: Sequence[Body], light: ptt.Environment, n: int, normals: int) -> None:
    """Truncation of small elements of the matrices."""
    for threshold, (error, megabytes) in TRUNCATED.items():
        rotate = ptt.LightRotation.build(n, normals, operator="matrix", threshold=threshold)
        lit = torch.nn.functional.pad(coefficients(light, n), (0, 0, 0, 0, 0, 1))
        what, how = f"table 1, threshold {threshold}", f"N {n}^2, {normals} x {normals} normals; {setting()}"
        table.row(f"{what}, size", rotate.bytes / 1e6, "MB", how, paper=f"{megabytes} MB")
        table.row(f"{what}, light changes", 1 / median_seconds(lambda r=rotate, x=lit: r(x)), "1/s", how)  # type: ignore[misc]
        exact = ptt.LightRotation.build(n, normals)(lit)
        table.row(f"{what}, local light", ptt.relative_rmse(rotate(lit), exact), "relative RMSE", "against factored")
        for body in bodies:
            relighter = ptt.EnvMapRelighter(body.scene, rotate)
            for material in GLOSSY:
                noted = f"{how}; {GLOSSY[material]}, noise of the reference {body.noise[material]:.4f}"
                value = body.error(relighter, light, material)
                table.row(f"{what}, {body.name} {material}", value, "relative RMSE", noted, paper=error)


def table_3(table: Table, bodies: Sequence[Body], light: ptt.Environment, n: int, sampled: Sequence[int]) -> None:
    """Sampling of the normals; beside the paper's lookup in the frame of the point."""
    for normals in sampled:
        error, seconds, megabytes = NORMALS[normals]
        start = time.perf_counter()
        matrix = ptt.LightRotation.build(n, normals, operator="matrix")
        formed = time.perf_counter() - start
        what, how = f"table 3, {normals}^2 normals", f"N {n}^2; {setting()}"
        table.row(f"{what}, formed in", formed, "s", how, paper=f"{seconds} s")
        table.row(f"{what}, size", matrix.bytes / 1e6, "MB", how, paper=f"{megabytes} MB")
        del matrix
        rotate = ptt.LightRotation.build(n, normals)
        for body in bodies:
            relighter = ptt.EnvMapRelighter(body.scene, rotate)
            for material in GLOSSY:
                noted = f"{how}; {GLOSSY[material]}, noise of the reference {body.noise[material]:.4f}"
                value = body.error(relighter, light, material)
                table.row(f"{what}, {body.name} {material}", value, "relative RMSE", noted, paper=error)
                once = same_direction(relighter, body, light, material)
                once = ptt.relative_rmse(once, body.truth[material])
                table.row(
                    f"{what}, {body.name} {material} in one direction", once, "relative RMSE", f"the paper's; {noted}"
                )


def same_direction(relighter: ptt.EnvMapRelighter, body: Body, light: ptt.Environment, material: str) -> Tensor:
    """Radiance (v, 3) as the paper has it: the viewer's direction in the point's own frame, for all four normals.

    The frame is leaned over to each normal, so that there are no seams where frames jump.
    """
    given, camera, at = ptt.fitted(material), body.scene.camera, body.index
    assert camera is not None and given.shape is not None
    dull = relighter(light, {name: ptt.Material(given.diffuse) for name in body.scene.materials}, camera)[at]
    normal, frames = body.scene.normals[at], relighter.rotation.frames
    where = slices.located(body.scene.points[at], body.scene.frames[at], frames)
    cut = slices.tabulate(given.shape.evaluate, relighter.rotation.m, relighter.views, relighter.terms)
    around = frames[where.near.long()]  # shape: (4, v, 3, 3)
    leaned = slices._leaned(camera.toward(body.scene.points[at])[None], normal[None], around[:, :, 2])
    cell = HemiOctahedral(relighter.views).cell(torch.einsum("kvax,kvx->kva", around, leaned))
    values = cut.values[cell].float() * where.weights[..., None]
    picked = relighter.incident(light).local[where.near.long()[..., None], cut.terms[cell].long()]
    return dull + given.specular * torch.einsum("kvt,kvtc->vc", values, picked)[:, :3]


def accuracy(table: Table, bodies: Sequence[Body], light: ptt.Environment, sizes: Sequence[int]) -> None:
    """Error against N, samples of a cell, and coefficients of the light."""
    for body in bodies:
        for material in GLOSSY:
            for n in sizes:
                relighter = ptt.EnvMapRelighter(body.scene, ptt.LightRotation.build(n, 32))
                value = body.error(relighter, light, material)
                table.row(f"accuracy, N {n}^2, {body.name} {material}", value, "relative RMSE", "32 x 32 normals")
    body, n = bodies[0], sizes[-2]
    for samples in (1, 2, 4, 8):
        relighter = ptt.EnvMapRelighter(body.scene, ptt.LightRotation.build(n, 32, samples=samples))
        value = body.error(relighter, light, "nickel")
        table.row(f"accuracy, {samples} x {samples} samples, {body.name} nickel", value, "relative RMSE", f"N {n}^2")
    for keep in (64, 128, 256, 512, 1024):
        relighter = ptt.EnvMapRelighter(body.scene, ptt.LightRotation.build(n, 32), keep=keep if keep < n * n else None)
        for material in GLOSSY:
            value = body.error(relighter, light, material)
            table.row(f"accuracy, light of {keep} terms, {body.name} {material}", value, "relative RMSE", f"of {n}^2")


def small_lamps(table: Table, ball: ptt.Scene, light: ptt.Environment, counts: int, samples: int) -> None:
    """Under a map whose lamps are smaller than a cell: where N ends."""
    body = Body.of("sphere", ball, light, counts, samples)
    for n in (64, 128):
        relighter = ptt.EnvMapRelighter(ball, ptt.LightRotation.build(n, 32))
        for material in (*GLOSSY, DULL):
            value, noise = body.error(relighter, light, material), f"noise of the reference {body.noise[material]:.4f}"
            table.row(f"grace, N {n}^2, sphere {material}", value, "relative RMSE", f"32 x 32 normals; {noise}")


def figure_7(table: Table, lights: dict[str, ptt.Environment], n: int) -> None:
    """Rotated light from 128, 256, 2048 coefficients beside the rotation in space, and 128 of the result's own."""
    frames = rotation.frames_of(torch.randn(8, 3, generator=torch.Generator().manual_seed(7)))
    rotate, m = ptt.LightRotation.build(n, frames=frames, operator="matrix"), n // 2
    rows = []
    for name, light in lights.items():
        values = light.project(Octahedral(n))
        truth = torch.stack([rotation.rotate(values, frame, HemiOctahedral(m)) for frame in frames])
        lit = haar.analyse(values.movedim(-1, 0))
        own = haar.analyse(truth.movedim(-1, 1)).flatten(2)
        shown = {"reference": truth}
        kept = min(128, m * m)
        shown["reference 128"] = texels(haar.truncate(own, kept).to_dense(m * m).transpose(1, 2), m)
        for keep in (128, 256, 2048):
            few = haar.truncate(lit.flatten(1), min(keep, n * n)).to_dense(n * n).reshape(lit.shape)
            shown[str(keep)] = texels(rotate(few), m)
        for kind, maps in list(shown.items())[1:]:
            value = sum(ptt.relative_rmse(a, b) for a, b in zip(maps, truth, strict=True)) / len(frames)
            table.row(f"figure 7, {name}, {kind}", value, "relative RMSE", f"N {n}^2, mean of {len(frames)} frames")
        rows += [[maps[k] for maps in shown.values()] for k in (0, 1)]
    if n >= 128:
        pictures.maps("rotation_figure7", rows)


def texels(local: Tensor, m: int) -> Tensor:
    """Maps (f, m, m, c) of coefficients (f, M, c)."""
    return haar.synthesise(local.transpose(1, 2).reshape(len(local), -1, m, m)).movedim(1, -1)


def cuts(table: Table, bodies: Sequence[Body], light: ptt.Environment, n: int) -> None:
    """Sparse slices against low-rank ones: error, bytes, and the time to make them."""
    rotate = ptt.LightRotation.build(n, 32)
    for material in (*GLOSSY, DULL):
        shape = ptt.fitted(material).shape
        assert shape is not None
        for kind, values in (("terms", (16, 32, 64, 96, 128, 256)), ("rank", (8, 16, 32, 64, 128))):
            for value in values:
                start = time.perf_counter()
                if kind == "terms":
                    relighter = ptt.EnvMapRelighter(bodies[0].scene, rotate, terms=value)
                else:
                    relighter = ptt.EnvMapRelighter(bodies[0].scene, rotate, rank=value)
                cut = relighter._cut(shape, torch.device("cpu"))
                seconds, what = time.perf_counter() - start, f"slices, {material}, {kind} {value}"
                table.row(f"{what}, size", cut.bytes / 1e6, "MB", f"128 x 128 views; made in {seconds:.2f} s")
                error = bodies[0].error(relighter, light, material)
                table.row(f"{what}, error", error, "relative RMSE", f"{bodies[0].name}, N {n}^2")


def anisotropic(table: Table, ball: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """A brushed sphere: the twists of a tangent that are sampled."""
    assert ball.camera is not None
    at = torch.nonzero((ball.camera.toward(ball.points) * ball.normals).sum(1) > 0.05)[:200, 0]
    points, material = reference.Points(*(x[at] for x in reference.vertex_points(ball))), ptt.ward(0.0, 1.0, 0.1, 0.4)
    given, wo = {"sphere": material}, ball.camera.toward(points.position)
    truth = reference.unshadowed(ball, light, given, points, wo, samples=256 if quick else 4096).mean
    rotate = ptt.LightRotation.build(32 if quick else 64, 32)
    for twists in (8, 16, 32, 64):
        relighter = ptt.EnvMapRelighter(ball, rotate, views=16 if quick else 64, twists=twists)
        start = time.perf_counter()
        error = ptt.relative_rmse(relighter(light, given, ball.camera)[at], truth)
        how = f"Ward 0.1 x 0.4, 64 x 64 views; made in {time.perf_counter() - start:.1f} s"
        table.row(f"anisotropic, {twists} twists", error, "relative RMSE", how)


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
            relighter = ptt.EnvMapRelighter(scene, rotate, **options)  # type: ignore[arg-type]
            camera, lit = iter(cameras), turns(light)
            took = median_seconds(lambda: relighter(light, given, next(camera)), 15)  # noqa: B023
            kept = next(iter(options.values()))
            read = v * (4 * kept * 4 + 100)
            how = f"{v} vertices, {kind}, N {n}^2, 32 x 32 normals, gold metallic paint; {setting()}"
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
    relighter, shape = (
        ptt.EnvMapRelighter(scene, ptt.LightRotation.build(n, 32)),
        ptt.fitted("gold-metallic-paint").shape,
    )
    assert shape is not None and scene.camera is not None
    at, cut = relighter.placed[0].at, relighter._slices(shape)
    args = relighter.incident(light).local, cut, slices.first_slice(cut, at.twist), relighter.rotation.frames, at

    def whole(
        local: Tensor, cut: slices.Slices, first: Tensor, frames: Tensor, at: slices.Located, eye: Tensor
    ) -> Tensor:
        which = first + slices._view_cell(cut.views, frames, at, eye)
        values = cut.values[which].float() * at.weights[..., None]
        return (values[..., None] * local[at.near[..., None].long(), cut.terms[which].long()]).sum((0, 2))

    eye, how = torch.tensor(scene.camera.eye), f"{len(scene.vertices)} vertices, {relighter.terms} terms; {setting()}"
    exact = native.reflected(*args, eye)
    for name, step in {
        "eager": slices.reflected,
        "torch.compile": torch.compile(whole),
        "kernel": native.reflected,
    }.items():
        took = median_seconds(lambda f=step: f(*args, eye), 5)  # type: ignore[misc]
        off = ptt.relative_rmse(step(*args, eye), exact)
        table.row(f"view step, {name}", 1e3 * took, "ms", f"off the kernel by {off:.1e}; {how}")


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
