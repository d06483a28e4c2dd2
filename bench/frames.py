"""Frames a second of relighting with clusters, their limits, and how their cost grows; for bench/transfer.py."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import torch
from torch import Tensor

import ptt
from bench.forms import BLOCKS, block, four_forms, made
from bench.table import Table, median_seconds, read_bandwidth, setting
from ptt.materials import shapes
from ptt.ops import mesh
from ptt.scene.parts import Part, join

STEPS = count(1)  # no two frames are alike
GOALS = {"view": 500, "view and BRDF": 200, "view, BRDF and light": 80}  # frames/s at 62 K vertices
LINE = 64  # bytes that memory gives at a time


def dressed(scene: ptt.Scene, material: ptt.Material) -> dict[str, ptt.Material]:
    """The scene's materials, those of editable regions replaced."""
    return {r.name: material if r.editable else scene.materials[r.name] for r in scene.regions}


def steps(
    relighter: ptt.TransferRelighter, scene: ptt.Scene, light: ptt.Environment, material: ptt.Material
) -> dict[str, Callable[[], Tensor]]:
    """A frame after a change of the view; of that, a colour and a shape; of those and of the light."""
    camera = scene.camera
    materials = dressed(scene, material)
    edited = next(r.name for r in scene.regions if r.editable)
    shape: Any = material.shape  # an analytic one
    assert shape is not None
    name, value = list(shapes.parameters(shape).items())[-1]

    def edit() -> dict[str, ptt.Material]:
        share = 1 - 1e-4 * (next(STEPS) % 1000)
        changed = replace(shape, **{name: float(value) * share})
        return materials | {edited: ptt.Material(material.diffuse * share, material.specular, changed)}

    def orbit() -> ptt.Camera:
        return camera.orbited(next(STEPS) * 0.37)

    return {
        "view": lambda: relighter(light, materials, orbit()),
        "view and BRDF": lambda: relighter(light, edit(), orbit()),
        "view, BRDF and light": lambda: relighter(light.rotated(y=next(STEPS) * 0.7), edit(), orbit()),
    }


def speed(
    table: Table,
    name: str,
    scene: ptt.Scene,
    material: ptt.Material,
    paper: tuple[str, tuple[float, float, float]],
    light: ptt.Environment,
    models: Mapping[str, ptt.TransferModel],
) -> None:
    """Table 1's three columns, beside the bytes that must be read at the measured bandwidth."""
    bandwidth = read_bandwidth()
    how = setting()
    table.row(f"{name}, read bandwidth", bandwidth / 1e9, "GB/s", f"sum of 400 MB; {how}")
    for key, model in models.items():
        for compiled in (False, True):
            relighter = ptt.TransferRelighter(model, compiled=compiled)
            form = "compiled" if compiled else "eager"
            tensor = model.highlights == "tensor"
            read = bytes_read(model, relighter, light, dressed(scene, material)) if tensor else {}
            frames = steps(relighter, scene, light, material)
            for (step, frame), said in zip(frames.items(), paper[1], strict=True):
                frame()
                seconds = median_seconds(frame, 40)
                goal = f">= {GOALS[step]}" if name == "engine" and key.startswith("paper") and compiled else ""
                limit = f"{bandwidth / read[step]:.0f} frames/s to read {read[step] / 1e6:.3g} MB" if tensor else ""
                note = f"{len(scene.vertices)} vertices, {key} settings, lobes included, {material.shape}; {how}"
                table.row(
                    f"{name}, {key}, {form}, {step}", 1 / seconds, "frames/s", note, goal,
                    paper=f"{said} ({paper[0]})", limit=limit,
                )  # fmt: skip


def fused(
    table: Table,
    name: str,
    scene: ptt.Scene,
    material: ptt.Material,
    light: ptt.Environment,
    model: ptt.TransferModel,
) -> None:
    """The four forms of the relighter, and what torch.compile alone spends on gathers."""
    own = dressed(scene, material)
    edited = next(r.name for r in scene.regions if r.editable)

    def edit(k: int) -> dict[str, ptt.Material]:
        share = 1 - 1e-4 * (k % 1000)
        return own | {edited: ptt.Material(material.diffuse * share, material.specular * share, material.shape)}

    four_forms(
        table,
        name,
        lambda compiled: ptt.TransferRelighter(model, compiled),
        light,
        edit,
        lambda k: scene.camera.orbited(0.37 * k),
        f"{len(scene.vertices)} vertices, paper settings, lobes included, {material.shape}",
    )
    gathers(table, name, scene.camera, light, own, model)


def gathers(
    table: Table,
    name: str,
    camera: ptt.Camera,
    light: ptt.Environment,
    materials: Mapping[str, ptt.Material],
    model: ptt.TransferModel,
) -> None:
    """The share of a change of view that torch.compile alone waits for what it gathers.

    Over the same arithmetic where all points stand and look alike, so that all gather from the same cells.
    """
    alike = ptt.TransferRelighter(model, compiled=False)
    for region in alike.steps.points:
        for name_of in ("position", "frame"):
            values = region.get_buffer(name_of)
            region.register_buffer(name_of, values[..., :1].expand_as(values).contiguous(), persistent=False)
    both = {"all": made(ptt.TransferRelighter(model, compiled=False), True), "alike": made(alike, True)}
    seconds: dict[str, list[float]] = {which: [] for which in both}
    for _ in range(BLOCKS):
        for which, relighter in both.items():
            seconds[which] += block(relighter, lambda k: (light, materials, camera.orbited(0.37 * k)), 8)
    waits = 1 - statistics.median(seconds["alike"]) / statistics.median(seconds["all"])
    how = (
        f"1 - the time of points that all gather from the same cells, over that of {len(model.positions)}; {setting()}"
    )
    table.row(f"{name}, view changes, torch.compile alone, share of gathers", waits, "", how)


def bytes_read(
    model: ptt.TransferModel,
    relighter: ptt.TransferRelighter,
    light: ptt.Environment,
    materials: Mapping[str, ptt.Material],
) -> dict[str, float]:
    """What a frame must read at least, step by step: tensors once each, and of the cuts a cache line a point."""
    exitant = relighter.exitant(light, relighter.chosen(materials))
    points = sum(len(region.place) for region in model.clustered)
    view = sum(sent.values.nbytes for layers in exitant.layers for sent, *_ in layers) + points * (12 * 4 + LINE)
    brdf = sum(region.weights.nbytes for region in model.clustered)
    lighting = sum(t.nbytes for r in model.clustered for t in (r.direct, r.one, r.two, r.lighting))
    return {"view": view, "view and BRDF": view + brdf, "view, BRDF and light": view + brdf + lighting}


def step_times(
    relighter: ptt.TransferRelighter,
    light: ptt.Environment,
    materials: Sequence[ptt.Material],
    camera: ptt.Camera,
) -> dict[str, float]:
    """Seconds of each step alone; the BRDF step with a material that changes every time."""
    steps: Any = relighter.steps  # of either kind: each takes what it gave
    eye = torch.tensor(camera.eye)
    lit = steps.incident(light)
    sent = steps.exitant(lit, materials)

    def edited() -> Any:
        share = 1 - 1e-4 * (next(STEPS) % 1000)
        changed = [ptt.Material(m.diffuse * share, m.specular, m.shape) for m in materials]
        return steps.exitant(lit, changed)

    return {
        "light": median_seconds(lambda: steps.incident(light), 20),
        "BRDF": median_seconds(edited, 20),
        "view": median_seconds(lambda: steps.radiance(sent, eye), 20),
    }


def exponents(table: Table, name: str, axis: str, found: Sequence[tuple[float, dict[str, float]]]) -> None:
    """Of the time of each step as a power of the number of something, and the times at its ends."""
    for step in ("light", "BRDF", "view"):
        points = [(size, spent[step]) for size, spent in found]
        ends = " to ".join(f"{1e3 * t:.3g} ms at {size:g}" for size, t in (points[0], points[-1]))
        how = f"time of the step as a power of the number of {axis}, {len(found)} sizes, compiled, {ends}; {setting()}"
        table.row(f"{name}, exponent, {step} step, {axis}", slope(points), "", how)


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Of log y over log x, by least squares."""
    x, y = ([math.log(p[k]) for p in points] for k in (0, 1))
    return statistics.linear_regression(x, y).slope


def growth(table: Table) -> None:
    """Eight balls on a floor: cost as their vertices grow in number, and as they are cut into more regions."""
    light = ptt.Environment.sun_sky(radius=10.0)
    material = ptt.blinn_phong(0.3, 0.4, 24.0)
    space = ptt.BRDFSpace.blinn_phong()
    brdf = ptt.TensorBRDF.fit(space, ranks=(4, 16, 16), separated=3)
    basis = ptt.BRDFBasis.fit(space)
    clusters = ptt.Clusters(points=250, eigenvectors=32, lighting=64)

    def times(scene: ptt.Scene) -> dict[str, float]:
        raw = ptt.precompute(scene, 2, resolution=32, rays=64, progress=True)
        model = ptt.compress(raw, 96, brdf, basis, clusters, progress=True)
        relighter = ptt.TransferRelighter(model, compiled=True)
        return step_times(relighter, light, list(dressed(scene, material).values()), scene.camera)

    scenes = [balls(fineness, 2, material) for fineness in (2, 3, 4)]
    exponents(table, "growth", "vertices", [(len(scene.vertices), times(scene)) for scene in scenes])
    exponents(table, "growth", "regions", [(regions, times(balls(3, regions, material))) for regions in (1, 2, 4, 8)])


def balls(fineness: int, regions: int, material: ptt.Material) -> ptt.Scene:
    """Eight balls on a fixed floor, in so many editable regions."""
    body, faces = mesh.sphere_mesh(fineness, 0.3)
    places = [torch.tensor([x, 0.35, z]) for x in (-1.2, -0.4, 0.4, 1.2) for z in (-0.4, 0.4)]
    ball = [Part(str(k), body + place, faces, material=material) for k, place in enumerate(places)]
    each = len(ball) // regions
    joined = [join(f"balls {k}", ball[k : k + each]) for k in range(0, len(ball), each)]
    floor = Part("floor", *mesh.plane_mesh(4.0, 20), material=ptt.lambert(0.5), editable=False)
    return ptt.Scene.from_parts([*joined, floor], camera=ptt.Camera((1.5, 2.0, 3.0), (0.0, 0.2, 0.0)))


def naive(table: Table, name: str, transfer: Any, points: int = 500) -> None:
    """The same frame as dense einsums, point by point, without clusters: a sample of points, scaled up."""
    one = transfer.indirect.one
    two = transfer.indirect.two
    t1 = one[:points].float()
    t2 = two[:points].float()
    t0 = transfer.direct.coarse[:points]
    light, twice, fine = (torch.rand(n, 3) for n in (t1.shape[3], t2.shape[3], t0.shape[2]))
    h = torch.rand(t1.shape[1], 3)
    m = torch.rand(3, t0.shape[1], t0.shape[1])
    c = torch.rand(t1.shape[2], t0.shape[1])
    outgoing = torch.rand(points, t0.shape[1])

    def frame() -> Tensor:
        arriving = torch.einsum("vqsl,lc,qc->vsc", t1, light, h)
        arriving[:, 0] += torch.einsum("vpql,lc,pc,qc->vc", t2, twice, h, h)
        incident = torch.einsum("vil,lc->vic", t0, fine) + torch.einsum("vsc,si->vic", arriving, c)
        return torch.einsum("vo,coi,vic->vc", outgoing, m, incident)

    seconds = median_seconds(frame) * len(one) / points
    how = f"{points} points, times {len(one) / points:.0f}; T0 of 6 x 8 x 8 light alone; {setting()}"
    table.row(f"{name}, naive dense einsum, view, BRDF and light", 1 / seconds, "frames/s", how)


def against_mitsuba(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment) -> None:
    """Mitsuba on the same scene, matt, as many pixels as the scene has vertices: time to 4 % of noise."""
    import mitsuba as mi

    from bench.mitsuba_check import matt, mitsuba_scene

    width = round(math.sqrt(len(scene.vertices) * 4 / 3))
    camera = replace(scene.camera, width=width, height=round(width * 0.75))
    dull = replace(scene, materials=matt(scene), camera=camera)
    theirs = mitsuba_scene(dull, light)
    to_world = mi.ScalarTransform4f().look_at(list(camera.eye), list(camera.target), list(camera.up))
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    sensor = mi.load_dict(
        {"type": "perspective", "fov": camera.fov, "fov_axis": "y", "to_world": to_world, "film": film}
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 4})

    def image(samples: int, seed: int) -> Tensor:
        pixels = mi.render(theirs, sensor=sensor, integrator=integrator, spp=samples, seed=mi.UInt32(seed))
        return torch.tensor(pixels).clone()

    samples = 16
    start = time.perf_counter()
    pair = [image(samples, seed) for seed in (1, 2)]
    seconds = (time.perf_counter() - start) / 2
    noise = float((pair[0] - pair[1]).norm() / math.sqrt(2) / pair[0].norm())
    needed = seconds * (noise / 0.04) ** 2
    how = f"{camera.width} x {camera.height} pixels, path of 4 vertices, matt, scalar_rgb on all threads; "
    how += f"{samples} samples took {seconds:.2f} s and left {noise:.3f}"
    table.row(f"{name}, Mitsuba 3 to 4 % of noise", needed, "s", how)
