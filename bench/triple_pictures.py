"""Pictures of Ma et al. 2006, Figures 5 to 13, each beside the path tracer and four times the difference."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import ptt
from bench.table import ROOT, Table
from ptt import reference
from ptt.ops import geodesic, haar, local, mesh, native, rotation, triple
from ptt.ops.geodesic import Geodesic
from ptt.ops.haar import Truncated
from ptt.ops.octahedral import Octahedral
from ptt.scene.parts import Part

IMAGES = ROOT / "docs" / "images"
SIZE: dict[str, Any] = {"width": 256, "height": 192}
SAMPLES = 384  # of the reference
DIMMED = 0.7  # stops, so that bright floors keep their shadows
SMALL = ptt.Environment.area_light((0.5, 0.7, 0.4), 8.0, 40.0)
Materials = Mapping[str, ptt.Material | ptt.Mixed]


def all_figures(table: Table, data: Path) -> None:
    """Every figure, and the error of each picture as a row."""
    maps = {name: ptt.Environment.load(data / "hdri" / f"{name}.hdr") for name in ("grace", "uffizi")}
    dragon = ptt.load_scene(data / "meshes" / "dragon_vrip_res3.ply")
    coarse = ptt.load_scene(data / "meshes" / "dragon_vrip_res4.ply")
    figure_5(table, on_table(coarse, 60), maps["grace"])
    figure_6(table)
    figure_7(table, maps["grace"])
    figure_9(table, on_table(dragon, 60), maps["grace"])
    figure_10(table, on_table(dragon, 60), maps["uffizi"])
    figure_11(table, maps["grace"])
    figure_12(table, on_table(dragon, 60), maps["grace"])
    figure_13(table, on_table(dragon, 100))


def on_table(scene: ptt.Scene, cells: int) -> ptt.Scene:
    """A mesh on a floor with texture coordinates."""
    low = scene.vertices.amin(0)
    high = scene.vertices.amax(0)
    size = float((high - low).max())
    middle = (low + high) / 2
    plane, squares = mesh.plane_mesh(2.4 * size, cells)
    uv = plane[:, [0, 2]] / (2.4 * size) * torch.tensor([1.0, -1.0]) + 0.5
    below = torch.stack((middle[0], low[1], middle[2]))
    parts = [Part("body", scene.vertices, scene.faces), Part("floor", plane + below, squares, uv=uv)]
    camera = replace(ptt.Camera.framing(middle, 0.56 * size), **SIZE)
    return ptt.Scene.from_parts(parts, camera=camera)


def truth(scene: ptt.Scene, light: ptt.Environment, given: Materials, pixels: ptt.GBuffer) -> Tensor:
    """Radiance of pixels by the path tracer; of mixed materials, that of each, mixed."""
    points = reference.Points(pixels.positions, pixels.frames, pixels.region, pixels.colours)
    wo = pixels.camera.toward(pixels.positions)
    parts = []
    for k in range(2):
        own = {name: (m.first, m.second)[k] if isinstance(m, ptt.Mixed) else m for name, m in given.items()}
        parts.append(reference.radiance(scene, light, own, points, wo, samples=SAMPLES).mean.float())
        if not any(isinstance(m, ptt.Mixed) for m in given.values()):
            return parts[0]
    share = torch.zeros(len(wo))
    for name, m in given.items():
        rows = (pixels.region == scene.region_index(name)).nonzero()[:, 0]
        if isinstance(m, ptt.Mixed):
            share[rows] = scene.map_values(m.maps, pixels.triangle[rows], pixels.barycentric[rows])[0]
    return parts[0] + share[:, None] * (parts[1] - parts[0])


def strip(
    table: Table, what: str, pixels: ptt.GBuffer, images: Mapping[str, Tensor], exact: Tensor, light: ptt.Environment
) -> Tensor:
    """Pictures, the reference, and four times the difference of the last, in a row; a row of each error."""
    gain: float = 2.0 ** (pixels.image(exact, light).exposure() - DIMMED)
    shown = [pixels.image(x, light).pixels for x in (*images.values(), exact)]
    last = list(images.values())[-1]
    for name, radiance in images.items():
        how = f"{len(exact)} pixels against {SAMPLES} samples each"
        table.row(f"{what}{', ' if name else ''}{name}", ptt.relative_rmse(radiance, exact), "relative RMSE", how)
    return torch.cat([*shown, pixels.image(4 * (last - exact).abs()).pixels], 1) * gain


def adaptive_product(three: Sequence[Truncated], n: int) -> Tensor:
    """Integrals (v, 3) of products of three functions, each (v * 3, k) of n coefficients."""
    f, g, h = three
    return native.adaptive(f, g, h, n).reshape(-1, 3)


def save(number: int, strips: list[Tensor]) -> None:
    widest = max(s.shape[1] for s in strips)
    padded = [torch.nn.functional.pad(s, (0, 0, 0, widest - s.shape[1])) for s in strips]
    ptt.Image(torch.cat(padded)).save(IMAGES / f"triple_figure{number}.png")


def under(
    table: Table,
    number: int,
    scene: ptt.Scene,
    pixels: ptt.GBuffer,
    given: Materials,
    lights: Mapping[str, ptt.Environment],
) -> None:
    """A figure of one scene under several lights, on 1280 triangles."""
    relighter = ptt.TripleProductRelighter(scene, 3, highlights="triangles")
    strips = []
    for name, light in lights.items():
        exact = truth(scene, light, given, pixels)
        images = {name: relighter(light, given, pixels)}
        strips.append(strip(table, f"figure {number}", pixels, images, exact, light))
    save(number, strips)


def turned(light: ptt.Environment, *degrees: int) -> dict[str, ptt.Environment]:
    return {f"turned by {angle}": light.rotated(y=angle) for angle in degrees}


def figure_5(table: Table, scene: ptt.Scene, light: ptt.Environment) -> None:
    """Per vertex and per pixel, on a coarse mesh."""
    given = {"body": ptt.blinn_phong((0.25, 0.2, 0.15), 0.6, 60.0), "floor": ptt.lambert(0.5)}
    relighter = ptt.TripleProductRelighter(scene, 3, highlights="triangles")
    pixels = ptt.GBuffer.of(scene, scene.camera)
    per_vertex = pixels.interpolated(scene, relighter(light, given, scene.camera))
    images = {"per vertex": per_vertex, "per pixel": relighter(light, given, pixels)}
    save(5, [strip(table, "figure 5", pixels, images, truth(scene, light, given, pixels), light)])


def figure_6(table: Table) -> None:
    """A box on a floor of two triangles: visibility of its vertices, of texels, and of a fine mesh."""
    light = ptt.Environment.area_light((0.5, 0.7, 0.4), 20.0, 8.0)
    images: dict[str, Tensor] = {}
    camera = ptt.Camera((1.2, 1.6, 2.4), (0.0, 0.2, 0.0), fov=40, **SIZE)
    body = mesh.sphere_mesh(3, 0.4)
    for name, cells in (("coarse, vertices", 1), ("fine, vertices", 120), ("coarse, texture", 1)):
        floor = Part("floor", *mesh.plane_mesh(3.0, cells), material=ptt.lambert(0.6))
        ball = Part("ball", body[0] + torch.tensor([0.0, 0.45, 0.0]), body[1], material=ptt.lambert(0.5))
        scene = ptt.Scene.from_parts([ball, floor], camera=camera)
        atlas = ptt.Atlas.of(scene, 512) if "texture" in name else None
        relighter = ptt.TripleProductRelighter(scene, 3, atlas=atlas, highlights="triangles")
        pixels = ptt.GBuffer.of(scene, camera)
        images[name] = relighter(light, {}, pixels)
    save(6, [strip(table, "figure 6", pixels, images, truth(scene, light, scene.materials, pixels), light)])


def local_light(light: ptt.Environment, grid: Geodesic, frames: Tensor) -> Tensor:
    """Light (p, 3, n) in the frames (p, 3, 3) of points themselves."""
    values = light.project(Octahedral(128)).reshape(-1, 3)
    s = rotation.resampling(Octahedral(128), grid, frames, 4)
    return rotation.resample(values, s).reshape(len(frames), grid.cells, 3).transpose(1, 2)


def local_brdf(material: ptt.Material, grid: Geodesic, wo: Tensor) -> Tensor:
    """BRDF times cosine (p, 3, n) for local directions of view (p, 3)."""
    factor = (material.diffuse[:, None] * local.cosine(grid)).expand(len(wo), 3, -1)
    if material.shape is None:
        return factor
    table = torch.cat([local.brdf(material.shape.evaluate, grid, o, 2) for o in wo.split(64)])
    return factor + material.specular[:, None] * table[:, None]


def weights(grid: Geodesic) -> Tensor:
    """Of coefficients, so that the largest are those of most energy."""
    return geodesic.areas(grid.level).sqrt().float()


def figure_7(table: Table, grace: ptt.Environment) -> None:
    """Figures 7 and 8: 20, 80 and 320 coefficients, top-only above adaptive: hard shadows, a glossy ball."""
    camera = ptt.Camera((1.2, 1.6, 2.4), (0.0, 0.3, 0.0), fov=40, width=128, height=96)
    ball, faces = mesh.sphere_mesh(4, 0.5)
    parts = [Part("ball", ball + torch.tensor([0.0, 0.5, 0.0]), faces), Part("floor", *mesh.plane_mesh(3.0, 4))]
    scene = ptt.Scene.from_parts(parts, camera=camera)
    grid = Geodesic(4)
    strips = []
    pixels = ptt.GBuffer.of(scene, camera)
    seen = local.visibility(scene.surface, pixels.positions, pixels.frames, grid, 1)
    wo = torch.einsum("pax,px->pa", pixels.frames, camera.toward(pixels.positions))
    cases = ("hard shadows", SMALL, ptt.lambert(0.6)), ("glossy", grace, ptt.blinn_phong(0.2, 0.6, 30.0))
    for kind, light, material in cases:
        given = {"ball": material, "floor": material}
        exact = truth(scene, light, given, pixels)
        top: dict[str, Tensor] = {}
        adaptive: dict[str, Tensor] = {}
        parts_of = zip(pixels.frames.split(256), seen.split(256), wo.split(256), strict=True)
        found: list[list[list[Tensor]]] = [[[], []] for _ in range(3)]
        for frames, visible, away in parts_of:
            functions = (local_light(light, grid, frames), (visible.float() / 255)[:, None].expand(-1, 3, -1))
            three = [geodesic.analyse(x) for x in (*functions, local_brdf(material, grid, away))]
            for level in range(3):
                keep = 20 << 2 * level
                cut = [haar.truncate(x.flatten(0, 1), keep, weights(grid)) for x in three]
                found[level][0].append(triple.quadrature(*(triple.top_only(x, keep) for x in three)))
                found[level][1].append(adaptive_product(cut, grid.cells))
        for level in range(3):
            top[f"{20 << 2 * level}"], adaptive[f"{20 << 2 * level}"] = map(torch.cat, found[level])
        for name, images in (("top-only", top), ("adaptive", adaptive)):
            strips.append(strip(table, f"figure 7, {kind}, {name}", pixels, images, exact, light))
    save(7, strips)


def figure_9(table: Table, scene: ptt.Scene, light: ptt.Environment) -> None:
    """Exponents of 10, 40 and 160, on 1280 triangles."""
    relighter = ptt.TripleProductRelighter(scene, 3, highlights="triangles")
    pixels = ptt.GBuffer.of(scene, scene.camera)
    strips = []
    for exponent in (10.0, 40.0, 160.0):
        given = {"body": ptt.blinn_phong((0.2, 0.15, 0.1), 0.6, exponent), "floor": ptt.lambert(0.4)}
        images = {f"exponent {exponent:g}": relighter(light, given, pixels)}
        strips.append(strip(table, "figure 9", pixels, images, truth(scene, light, given, pixels), light))
    save(9, strips)


def figure_10(table: Table, scene: ptt.Scene, light: ptt.Environment) -> None:
    """Mixed materials: bands on the dragon, a chequered floor, under two turns of the light."""
    x = torch.linspace(0, 16 * math.pi, 256)
    chequered = (torch.sin(x)[:, None] * torch.sin(x) > 0).float()
    bands = (20 * math.pi * scene.vertices[:, 1] / scene.bounds[1]).sin().mul(2).clamp(-1, 1) / 2 + 0.5
    given: Materials = {
        "body": ptt.Mixed(ptt.fitted("gold-metallic-paint"), ptt.blinn_phong((0.05, 0.1, 0.3), 0.2, 30.0), bands),
        "floor": ptt.Mixed(ptt.lambert((0.6, 0.55, 0.5)), ptt.blinn_phong(0.05, 0.5, 80.0), chequered),
    }
    under(table, 10, scene, ptt.GBuffer.of(scene, scene.camera), given, turned(light, 0, 120))


def figure_11(table: Table, grace: ptt.Environment) -> None:
    """A sphere of Ward's model with slopes 0.1 and 1.0, under an area light and grace."""
    camera = ptt.Camera((0.0, 0.8, 2.6), (0.0, 0.0, 0.0), fov=44, **SIZE)
    scene = ptt.Scene.from_mesh(*mesh.sphere_mesh(5), name="ball")
    lights = {"area light": ptt.Environment.area_light((0.4, 0.7, 0.8), 20.0, 8.0), "grace": grace}
    under(table, 11, scene, ptt.GBuffer.of(scene, camera), {"ball": ptt.ward(0.05, 0.5, 0.1, 1.0)}, lights)


def figure_12(table: Table, scene: ptt.Scene, light: ptt.Environment) -> None:
    """Waves on the floor, under two turns of grace."""
    t = (torch.arange(512) + 0.5) / 512 * 2 * math.pi
    waves = torch.sin(12 * t)[None] + torch.sin(9 * t + 2 * torch.sin(2 * t))[:, None]
    given = {"body": ptt.blinn_phong(0.3, 0.4, 30.0), "floor": ptt.blinn_phong((0.1, 0.15, 0.2), 0.6, 60.0)}
    pixels = ptt.GBuffer.of(scene, scene.camera, {"floor": ptt.BumpMap.of_heights(waves, 0.004)})
    under(table, 12, scene, pixels, given, turned(light, 0, 120))


def figure_13(table: Table, scene: ptt.Scene) -> None:
    """Three area lights of different colours, from three orientations."""
    area: Callable[..., ptt.Environment] = ptt.Environment.area_light
    light = area((0.7, 0.6, 0.2), 9.0, (30.0, 18.0, 8.0)) + area((-0.6, 0.7, 0.5), 9.0, (8.0, 16.0, 30.0))
    light = light + area((0.1, 0.8, -0.7), 12.0, (12.0, 14.0, 10.0))
    given = {"body": ptt.blinn_phong(0.4, 0.3, 20.0), "floor": ptt.lambert(0.6)}
    under(table, 13, scene, ptt.GBuffer.of(scene, scene.camera), given, turned(light, 0, 60, 200))
