"""The error of rotated light against truncation, normals, N, terms of light and of slices, and twists."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import ptt
from bench import rotation_pictures as pictures
from bench.table import Table, median_seconds, setting
from ptt import reference
from ptt.ops import haar, rotation, slices
from ptt.ops.octahedral import HemiOctahedral, Octahedral

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
        points = reference.vertex_points(scene).take(index)
        for material in (*GLOSSY, DULL):
            given = body.dressed(material)
            wo = scene.camera.toward(points.position)
            estimate = reference.unshadowed(scene, light, given, points, wo, samples=samples)
            body.truth[material] = estimate.mean
            body.noise[material] = estimate.noise
        return body

    def dressed(self, material: str) -> dict[str, ptt.Material]:
        return {region.name: ptt.fitted(material) for region in self.scene.regions}

    def error(self, relighter: ptt.EnvMapRelighter, light: ptt.Environment, material: str) -> float:
        assert self.scene.camera is not None
        radiance = relighter(light, self.dressed(material), self.scene.camera)
        return ptt.relative_rmse(radiance[self.index], self.truth[material])


def coefficients(light: ptt.Environment, n: int) -> Tensor:
    """(3, n, n) in Haar."""
    return haar.analyse(light.project(Octahedral(n)).movedim(-1, 0))


def errors(
    table: Table,
    what: str,
    bodies: Sequence[Body],
    rotate: ptt.LightRotation,
    light: ptt.Environment,
    how: str,
    paper: str,
) -> Iterator[tuple[ptt.EnvMapRelighter, Body, str, str]]:
    """A row for every body and glossy material; what made it, and its note."""
    for body in bodies:
        relighter = ptt.EnvMapRelighter(body.scene, rotate, lamps=False)
        for material in GLOSSY:
            noted = f"{how}; {GLOSSY[material]}, noise of the reference {body.noise[material]:.4f}"
            value = body.error(relighter, light, material)
            table.row(f"{what}, {body.name} {material}", value, "relative RMSE", noted, paper=paper)
            yield relighter, body, material, noted


def table_1(table: Table, bodies: Sequence[Body], light: ptt.Environment, n: int, normals: int) -> None:
    """Truncation of small elements of the matrices."""
    for threshold, (error, megabytes) in TRUNCATED.items():
        rotate = ptt.LightRotation.build(n, normals, operator="matrix", threshold=threshold)
        lit = torch.nn.functional.pad(coefficients(light, n), (0, 0, 0, 0, 0, 1))
        what = f"table 1, threshold {threshold}"
        how = f"N {n}^2, {normals} x {normals} normals; {setting()}"
        table.row(f"{what}, size", rotate.bytes / 1e6, "MB", how, paper=f"{megabytes} MB")
        table.row(f"{what}, light changes", 1 / median_seconds(lambda r=rotate, x=lit: r(x)), "1/s", how)  # type: ignore[misc]
        exact = ptt.LightRotation.build(n, normals)(lit)
        table.row(f"{what}, local light", ptt.relative_rmse(rotate(lit), exact), "relative RMSE", "against factored")
        for _ in errors(table, what, bodies, rotate, light, how, error):
            pass


def table_3(table: Table, bodies: Sequence[Body], light: ptt.Environment, n: int, sampled: Sequence[int]) -> None:
    """Sampling of the normals; beside the paper's lookup in the frame of the point."""
    for normals in sampled:
        error, seconds, megabytes = NORMALS[normals]
        start = time.perf_counter()
        matrix = ptt.LightRotation.build(n, normals, operator="matrix")
        formed = time.perf_counter() - start
        what = f"table 3, {normals}^2 normals"
        how = f"N {n}^2; {setting()}"
        table.row(f"{what}, formed in", formed, "s", how, paper=f"{seconds} s")
        table.row(f"{what}, size", matrix.bytes / 1e6, "MB", how, paper=f"{megabytes} MB")
        del matrix
        rotate = ptt.LightRotation.build(n, normals)
        for relighter, body, material, noted in errors(table, what, bodies, rotate, light, how, error):
            once = ptt.relative_rmse(same_direction(relighter, body, light, material), body.truth[material])
            which = f"{what}, {body.name} {material} in one direction"
            table.row(which, once, "relative RMSE", f"the paper's; {noted}")


def same_direction(relighter: ptt.EnvMapRelighter, body: Body, light: ptt.Environment, material: str) -> Tensor:
    """Radiance (v, 3) as the paper has it: the viewer's direction in the point's own frame, for all four normals.

    The frame is leaned over to each normal, so that there are no seams where frames jump.
    """
    given = ptt.fitted(material)
    camera = body.scene.camera
    at = body.index
    assert camera is not None and given.shape is not None
    dull = relighter(light, {name: ptt.Material(given.diffuse) for name in body.scene.materials}, camera)[at]
    normal = body.scene.normals[at]
    frames = relighter.rotation.frames
    where = slices.located(body.scene.points[at], body.scene.frames[at], frames)
    cut = slices.tabulate(given.shape.evaluate, relighter.rotation.m, relighter.views, relighter.terms)
    around = frames[where.near.long()]  # shape: (4, v, 3, 3)
    leaned = slices._leaned(camera.toward(body.scene.points[at])[None], normal[None], around[:, :, 2])
    cell = HemiOctahedral(relighter.views).cell(torch.einsum("kvax,kvx->kva", around, leaned))
    values = cut.values[cell].float() * where.weights[..., None]
    picked = relighter.incident(light).local[where.near.long()[..., None], cut.terms[cell].long()]
    relit: Tensor = dull + given.specular * torch.einsum("kvt,kvtc->vc", values, picked)[:, :3]
    return relit


def accuracy(table: Table, bodies: Sequence[Body], light: ptt.Environment, sizes: Sequence[int]) -> None:
    """Error against N, samples of a cell, and coefficients of the light."""
    for body in bodies:
        for material in GLOSSY:
            for n in sizes:
                relighter = ptt.EnvMapRelighter(body.scene, ptt.LightRotation.build(n, 32), lamps=False)
                value = body.error(relighter, light, material)
                table.row(f"accuracy, N {n}^2, {body.name} {material}", value, "relative RMSE", "32 x 32 normals")
    body = bodies[0]
    n = sizes[-2]
    for samples in (1, 2, 4, 8):
        rotate = ptt.LightRotation.build(n, 32, samples=samples)
        relighter = ptt.EnvMapRelighter(body.scene, rotate, lamps=False)
        value = body.error(relighter, light, "nickel")
        table.row(f"accuracy, {samples} x {samples} samples, {body.name} nickel", value, "relative RMSE", f"N {n}^2")
    for keep in (64, 128, 256, 512, 1024):
        few = keep if keep < n * n else None
        relighter = ptt.EnvMapRelighter(body.scene, ptt.LightRotation.build(n, 32), keep=few, lamps=False)
        for material in GLOSSY:
            value = body.error(relighter, light, material)
            table.row(f"accuracy, light of {keep} terms, {body.name} {material}", value, "relative RMSE", f"of {n}^2")


def small_lamps(table: Table, ball: ptt.Scene, light: ptt.Environment, counts: int, samples: int) -> None:
    """Under a map whose lamps are smaller than a cell: where N ends."""
    body = Body.of("sphere", ball, light, counts, samples)
    for n, lamps in itertools.product((64, 128), (False, True)):
        relighter = ptt.EnvMapRelighter(ball, ptt.LightRotation.build(n, 32), lamps=lamps)
        for material in (*GLOSSY, DULL):
            value = body.error(relighter, light, material)
            noise = f"noise of the reference {body.noise[material]:.4f}"
            what = f"grace, N {n}^2{', lamps apart' if lamps else ''}, sphere {material}"
            table.row(what, value, "relative RMSE", f"32 x 32 normals; {noise}")


def figure_7(table: Table, lights: dict[str, ptt.Environment], n: int) -> None:
    """Rotated light from 128, 256, 2048 coefficients beside the rotation in space, and 128 of the result's own."""
    frames = rotation.frames_of(torch.randn(8, 3, generator=torch.Generator().manual_seed(7)))
    rotate = ptt.LightRotation.build(n, frames=frames, operator="matrix")
    m = n // 2
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
                cut = relighter.slices_of(shape)
                seconds = time.perf_counter() - start
                assert cut is not None
                what = f"slices, {material}, {kind} {value}"
                table.row(f"{what}, size", cut.bytes / 1e6, "MB", f"128 x 128 views; made in {seconds:.2f} s")
                error = bodies[0].error(relighter, light, material)
                table.row(f"{what}, error", error, "relative RMSE", f"{bodies[0].name}, N {n}^2")


def anisotropic(table: Table, ball: ptt.Scene, light: ptt.Environment, quick: bool) -> None:
    """A brushed sphere: the twists of a tangent that are sampled."""
    assert ball.camera is not None
    at = torch.nonzero((ball.camera.toward(ball.points) * ball.normals).sum(1) > 0.05)[:200, 0]
    points = reference.vertex_points(ball).take(at)
    material = ptt.ward(0.0, 1.0, 0.1, 0.4)
    given = {"sphere": material}
    wo = ball.camera.toward(points.position)
    truth = reference.unshadowed(ball, light, given, points, wo, samples=256 if quick else 4096).mean
    rotate = ptt.LightRotation.build(32 if quick else 64, 32)
    for twists in (8, 16, 32, 64):
        relighter = ptt.EnvMapRelighter(ball, rotate, views=16 if quick else 64, twists=twists)
        start = time.perf_counter()
        error = ptt.relative_rmse(relighter(light, given, ball.camera)[at], truth)
        how = f"Ward 0.1 x 0.4, 64 x 64 views; made in {time.perf_counter() - start:.1f} s"
        table.row(f"anisotropic, {twists} twists", error, "relative RMSE", how)
