"""Triple products in local frames: every figure of it, as rows of bench/results/triple.csv.

    PTT_DATA=... python -m bench.triple             # about ten minutes on two cores, pictures and all
    python -m bench.triple --quick                  # over a minute: a ball over a floor, written nowhere

Needs PTT_DATA with meshes and maps. Pictures go to docs/images.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

import ptt
from bench import triple_pictures
from bench.forms import four_forms
from bench.table import Table, median_seconds, read_bandwidth, setting
from ptt import reference
from ptt.models.cache import Cache
from ptt.ops import geodesic, haar, local, mesh, native, triple
from ptt.ops.geodesic import Geodesic
from ptt.ops.shade import Functions, ShadedPoints
from ptt.relight.triple_relighter import Storage
from ptt.scene.parts import Part

PAPER = {("texture", 1): "97 (25 K), 44 to 47 (50 K)", ("texture", 2): "38 (25 K), 17 to 18 (50 K)"}
PAPER |= {("vertices", 1): "21 (25 K), 15 (50 K)", ("vertices", 2): "8.5 (25 K), 7 (50 K)"}
GOALS = {("texture", 1): ">= 60", ("texture", 2): ">= 30"}
MATERIALS = {"dull": ptt.lambert(0.6), "glossy": ptt.blinn_phong(0.2, 0.6, 30.0)}
GIVEN = {"body": ptt.fitted("gold-metallic-paint"), "floor": ptt.blinn_phong(0.5, 0.2, 20.0)}
PRODUCTS = 28  # multiplications and additions for a triangle of a pixel: 12 of light, 4 and 4, 2 products, 6 sums
COMPARED = 400  # pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="over a minute: a ball over a floor, written nowhere")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore")
    table = Table("triple_quick" if quick else "triple")
    data = Path(os.environ.get("PTT_DATA", ""))
    if not quick and not data.name:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    scenes = {"ball": on_floor(*mesh.sphere_mesh(3), 20)}
    lights = {"hard shadows": ptt.Environment.area_light((0.4, 0.8, 0.3), 8.0, 40.0)}
    if not quick:
        read = {"dragon": "dragon_vrip_res3.ply", "igea": "igea.ply"}
        loaded = {name: ptt.load_scene(data / "meshes" / file) for name, file in read.items()}
        scenes = {name: on_floor(scene.vertices, scene.faces, 100) for name, scene in loaded.items()}
        lights |= {name: ptt.Environment.load(data / "hdri" / f"{name}.hdr") for name in ("grace", "uffizi")}
    bandwidth = read_bandwidth()
    peak = products_per_second()
    table.row("read bandwidth", bandwidth / 1e9, "GB/s", f"sum of 400 MB; {setting()}")
    table.row("products", peak / 1e9, "1/ns", f"of a float32 matrix product; {setting()}")
    for name, scene in scenes.items():
        frames(table, name, scene, next(reversed(lights.values())), bandwidth, peak, quick)
    name, scene = next(iter(scenes.items()))
    light_change(table, name, scene, next(reversed(lights.values())), quick)
    kept(table, name, scene, next(reversed(lights.values())), quick)
    extremes(table, name, scene)
    coefficients(table, name, scene, lights, 30 if quick else 200, 256 if quick else 2048, 3 if quick else 4)
    forms(table, name, scene, next(reversed(lights.values())), quick)
    formulas(table)
    if not quick:
        triple_pictures.all_figures(table, data)
        table.write()


def on_floor(vertices: Tensor, faces: Tensor, cells: int) -> ptt.Scene:
    """A mesh on a floor, looked at from the front and above."""
    low = vertices.amin(0)
    high = vertices.amax(0)
    size = float((high - low).max())
    middle = (low + high) / 2
    plane, squares = mesh.plane_mesh(3 * size, cells)
    below = torch.stack((middle[0], low[1], middle[2]))
    seen = ptt.Camera.framing(middle, 0.7 * size)
    return ptt.Scene.from_parts([Part("body", vertices, faces), Part("floor", plane + below, squares)], camera=seen)


def products_per_second() -> float:
    """Multiplications with addition that a matrix product in float32 does in a second."""
    x = torch.rand(2048, 2048)
    return 2048**3 / median_seconds(lambda: x @ x, 5)


def frames(
    table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, bandwidth: float, peak: float, quick: bool
) -> None:
    """Table 3: frames a second at 1024 x 768 when the view, or everything, changes; a light, and a BRDF."""
    assert scene.camera is not None
    width, height = (96, 72) if quick else (1024, 768)
    camera = replace(scene.camera, width=width, height=height)
    took = median_seconds(lambda: ptt.GBuffer.of(scene, camera), 3)
    pixels = ptt.GBuffer.of(scene, camera)
    where = f"{len(scene.vertices)} vertices, {len(pixels.pixel)} pixels of {width} x {height}; {setting()}"
    table.row(f"table 3, {name}, G-buffer", 1e3 * took, "ms", where)
    for kind in ("texture", "vertices"):
        for level in (1, 2):
            start = time.perf_counter()
            atlas = ptt.Atlas.of(scene, 64 if quick else 1024 >> (level - 1)) if kind == "texture" else None
            relighter = ptt.TripleProductRelighter(scene, level, atlas=atlas, highlights="triangles")
            n = relighter.grid.cells
            what = f"table 3, {name}, {kind}, {n}"
            how = f"{len(relighter.visibility)} rows of visibility; {where}"
            table.row(f"{what}, built in", time.perf_counter() - start, "s", f"atlas and visibility; {how}")
            relighter(light, GIVEN, pixels)

            def another_view(relighter: ptt.TripleProductRelighter = relighter) -> None:
                relighter._viewed = Cache()
                relighter(light, GIVEN, pixels)

            def another_buffer(relighter: ptt.TripleProductRelighter = relighter) -> None:
                relighter._pixels = Cache()
                relighter(light, GIVEN, pixels)

            functions, coats, points = relighter.prepared(light, GIVEN, pixels)
            most = 2 * peak / (PRODUCTS * n * len(pixels.pixel))
            size = bytes_of(functions, points)
            limit = (
                f"{most:.0f} by its products, float16 being twice as fast as float32; {bandwidth / size:.0f} to read "
            )
            limit += f"{size / 1e6:.0f} MB once"
            others = {"goal": GOALS.get((kind, level), ""), "paper": PAPER[kind, level], "limit": limit}
            table.row(f"{what}, frames", 1 / median_seconds(another_view), "1/s", how, **others)
            aside = f"all lookups anew, as for another G-buffer of the same size; {how}"
            table.row(f"{what}, frames of new pixels", 1 / median_seconds(another_buffer), "1/s", aside, limit=limit)
            nearest = points._replace(light=points.light.one(), seen=points.seen.one(), view=points.view.one())
            both = [median_seconds(lambda p=p: native.shade(functions, coats, p)) for p in (points, nearest)]  # type: ignore[misc]  # noqa: B023
            aside = f"of {1e3 * both[0]:.1f} ms, over the nearest frame, texel and view alone; {how}"
            table.row(f"{what}, interpolation", 1e3 * (both[0] - both[1]), "ms", aside)
            for kind_of, shape in (("isotropic", ptt.BlinnPhong(17.0)), ("brushed", ptt.Ward(0.1, 0.5))):
                took = median_seconds(lambda r=relighter, s=shape: r._table(s), 3)  # type: ignore[misc]
                table.row(f"{what}, an edited BRDF, {kind_of}", took, "s", how, "<= 0.2", paper="2 to 3 s")


def forms(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """The four forms of the relighter, per pixel; the eye moves, the G-buffer stays."""
    camera = replace(scene.camera, width=96 if quick else 640, height=72 if quick else 480)
    pixels = ptt.GBuffer.of(scene, camera)
    body = GIVEN["body"]

    def edit(k: int) -> dict[str, ptt.Material]:
        return GIVEN | {"body": ptt.Material(body.diffuse, body.specular * (1 - 1e-4 * (k % 1000)), body.shape)}

    four_forms(
        table,
        f"forms, {name}, 320",
        lambda compiled: ptt.TripleProductRelighter(scene, 2, highlights="triangles", compiled=compiled),
        light,
        edit,
        lambda k: replace(pixels, camera=camera.orbited(0.01 * k)),
        f"{len(scene.vertices)} vertices, {len(pixels.pixel)} pixels of {camera.width} x {camera.height}",
        4,
    )


def bytes_of(functions: Functions, at: ShadedPoints) -> int:
    """What a frame reads and writes: each row of the tables once, and what it knows of every pixel."""
    light, visibility, _, glossy = functions
    tables = ((at.light, light.values), (at.seen, visibility), (at.view, glossy.values))
    rows = sum(len(near.rows.unique()) * values[0].numel() * values.element_size() for near, values in tables)
    pixels = sum(x.numel() * x.element_size() for x in (*at.light, *at.seen, *at.view, *at[3:], at.colour))
    return rows + pixels


def light_change(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """The rotation operator against tables that were rotated before: time, bytes, error against the path tracer."""
    assert scene.camera is not None
    camera = replace(scene.camera, width=160, height=120)
    pixels = ptt.GBuffer.of(scene, camera)
    index = torch.randperm(len(pixels.pixel), generator=torch.Generator().manual_seed(0))[:COMPARED]
    truth = traced(scene, light, GIVEN, pixels, index, 256 if quick else 2048)
    for level in (1, 2) if quick else (1, 2, 3):
        relighter = ptt.TripleProductRelighter(scene, level, highlights="triangles")
        what = f"light change, {name}, {relighter.grid.cells}"
        count_of = len(relighter.frames) * relighter.twists
        how = f"{count_of} frames; error: of {len(index)} pixels under the last map, with shadows; {setting()}"
        turned: Iterator[ptt.Environment] = (light.rotated(y=k) for k in count(1))
        took = median_seconds(lambda r=relighter: r.incident(next(turned)))  # type: ignore[misc]  # noqa: B023
        table.row(f"{what}, on the fly, time", took, "s", how)
        held = sum(x.numel() * x.element_size() for x in (relighter.starts, relighter.reads))
        table.row(f"{what}, on the fly, bytes of the operator", held / 1e6, "MB", how)
        start = time.perf_counter()
        before = relighter.prerotated(light)
        table.row(f"{what}, rotated before, time", time.perf_counter() - start, "s", how, paper="minutes")
        table.row(f"{what}, rotated before, bytes of a light", before.frames.bytes / 1e6, "MB", how)
        for kind, given in (("on the fly", light), ("rotated before", before)):
            error = ptt.relative_rmse(relighter(given, GIVEN, pixels)[index], truth)
            table.row(f"{what}, {kind}, error", error, "relative RMSE", how)


def traced(
    scene: ptt.Scene,
    light: ptt.Environment,
    given: Mapping[str, ptt.Material],
    pixels: ptt.GBuffer,
    index: Tensor,
    samples: int,
) -> Tensor:
    """Radiance of some pixels by the path tracer, direct light with shadows."""
    parts = (x[index] for x in (pixels.positions, pixels.frames, pixels.region, pixels.colours))
    points = reference.Points(*parts)
    return reference.radiance(
        scene, light, given, points, pixels.camera.toward(points.position), samples=samples
    ).mean.float()


def kept(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """Storage in 8 and 16 bits and in float: bytes, frames a second, error against float."""
    assert scene.camera is not None
    camera = replace(scene.camera, width=96, height=72) if quick else replace(scene.camera, width=1024, height=768)
    pixels = ptt.GBuffer.of(scene, camera)
    exact = None
    for storage in get_args(Storage):
        relighter = ptt.TripleProductRelighter(scene, 2, storage=storage, highlights="triangles")
        functions, coats, points = relighter.prepared(light, GIVEN, pixels)
        radiance = relighter(light, GIVEN, pixels)
        exact = radiance if exact is None else exact
        what = f"storage, {name}, 320, {storage}"
        how = f"{len(pixels.pixel)} pixels; {setting()}"
        table.row(f"{what}, light", functions.light.bytes / 1e6, "MB", how)
        table.row(f"{what}, BRDFs", functions.glossy.bytes / 1e6, "MB", f"two materials; {how}")
        table.row(f"{what}, visibility", functions.visibility.numel() / 1e6, "MB", f"8 bits, of vertices; {how}")
        table.row(f"{what}, error", ptt.relative_rmse(radiance, exact), "relative RMSE", f"against float; {how}")
        took = median_seconds(lambda p=(functions, coats, points): native.shade(*p))  # type: ignore[misc]
        table.row(f"{what}, frames", 1 / took, "1/s", f"products alone; {how}")


def extremes(table: Table, name: str, scene: ptt.Scene) -> None:
    """Dim and bright light, a sun of 1e9 in one texel."""
    relighter = ptt.TripleProductRelighter(scene, 1, highlights="triangles")
    sky = ptt.Environment.sun_sky(radius=10.0)
    whole = relighter(sky, GIVEN, scene.camera)
    for factor in (1e-6, 1e6):
        error = ptt.relative_rmse(relighter(sky.scaled(factor), GIVEN, scene.camera) / factor, whole)
        table.row(f"extremes, {name}, light times {factor:g}", error, "relative RMSE", "over the factor", "<= 1e-3")
    sun = sky.map.clone()
    sun[len(sun) // 4, 10] = 1e9
    finite = float(relighter(ptt.Environment(sun), GIVEN, scene.camera).isfinite().float().mean())
    table.row(f"extremes, {name}, a sun of 1e9 in one texel", finite, "share of finite values", "", ">= 1")


def coefficients(
    table: Table, name: str, scene: ptt.Scene, lights: dict[str, ptt.Environment], some: int, samples: int, finest: int
) -> None:
    """Figures 7 and 8: error against the number of coefficients, top-only and adaptive, at vertices with shadows."""
    assert scene.camera is not None
    seen = ((scene.camera.toward(scene.points) * scene.normals).sum(1) > 0.1).nonzero()[:, 0]
    index = seen[torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))[:some]]
    frames = scene.frames[index]
    points = reference.vertex_points(scene).take(index)
    toward = scene.camera.toward(points.position)
    grid = Geodesic(finest)
    visible = local.visibility(scene.surface, points.position, frames, grid, 2).float() / 255
    for light_name, light in lights.items():
        local_light = triple_pictures.local_light(light, grid, frames)
        for kind, material in MATERIALS.items():
            factor = triple_pictures.local_brdf(material, grid, torch.einsum("vax,vx->va", frames, toward))
            given = {region.name: material for region in scene.regions}
            truth = reference.radiance(scene, light, given, points, toward, samples=samples)
            noise = truth.noise
            three = [geodesic.analyse(x) for x in (local_light, visible[:, None].expand(-1, 3, -1), factor)]
            for level in range(finest + 1):
                keep = 20 << 2 * level
                what = f"figure 8, {light_name}, {kind}"
                how = f"{name} on a floor, {some} vertices; noise of the reference {noise:.4f}"
                cut = [haar.truncate(x.flatten(0, 1), keep, triple_pictures.weights(grid)) for x in three]
                top = [triple.top_only(x, keep) for x in three]
                for strategy, product in (
                    ("top-only", partial(triple.quadrature, *top)),
                    ("adaptive", partial(triple_pictures.adaptive_product, cut, grid.cells)),
                ):
                    error = ptt.relative_rmse(product(), truth.mean)
                    table.row(f"{what}, {strategy}, {keep}", error, "relative RMSE", how)
                    if light_name == next(iter(lights)):
                        took = median_seconds(product) / (3 * some)
                        aside = f"a product of three, compiled tree or torch's quadrature; {how}; {setting()}"
                        table.row(f"time of a product, {kind}, {strategy}, {keep}", 1e6 * took, "us", aside)


def formulas(table: Table) -> None:
    """Table 1: global against local frames by the paper's formulas, one byte a number, RGB light."""
    rotations = 32 * 16 * 32
    views = 128 * 64
    normals = 32 * 16
    for n in (5120, 320, 80):
        how = "without visibility; light in three channels, one material, one byte a number"
        own = 3 * rotations * n + views * n
        world = 3 * n + normals * views * n
        table.row(f"table 1, {n} coefficients, local frames", own / 1e6, "MB", how)
        table.row(f"table 1, {n} coefficients, global frames", world / 1e6, "MB", how)
        frames = 22 * 22 * 32
        own = 3 * frames * n + 90 * 90 * n
        table.row(f"table 1, {n} coefficients, local frames here", own / 1e6, "MB", f"22 x 22 x 32 frames; {how}")


if __name__ == "__main__":
    main()
