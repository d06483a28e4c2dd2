"""Relit scenes against the path tracer, in figures and in pictures; for bench/transfer.py."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import ptt
from bench.cases import OWN, Case
from bench.frames import dressed
from bench.table import ROOT, Table
from bench.uncompressed import Uncompressed
from ptt.models.clustered_transfer import WIDTH
from ptt.ops import mesh
from ptt.scene.parts import Part

IMAGES = ROOT / "docs" / "images"
GOALS = {
    "uncompressed": ("<= 0.03", "<= 0.1"),
    "own": ("<= 0.04", ""),
    "tensor": ("<= 0.04", ""),
    "paper": ("<= 0.06", ""),
    "paper-16": ("", ""),
}
"""Relative RMSE in total and of the indirect part.

own is the default, narrow lobes, in the clusters of `cases.OWN`, and tensor is the BRDF tensor in the same clusters;
paper has the paper's clusters, and paper-16 the eigenvectors of the paper's Watch scene.
"""


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
    vertices: int,
    samples: int,
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
        if kind in case.whole and light_name in list(lights)[: case.maps]:
            parts = exact.radiance(rows, light, materials, torch.tensor(scene.camera.eye))
            found["uncompressed"] = parts[0] + parts[1] + parts[2], parts[1] + parts[2]
        for key, relighter in relighters.items():
            ours = relighter(light, materials, scene.camera)[rows]
            found[key] = ours, ours - direct[key](light, materials, scene.camera)[rows]
        for key, (ours, bounced) in found.items():
            what = f"{name}, {light_name}, {kind}, {key}"
            goals = GOALS[key] if smooth else ("", "")
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
    model.bounces = min(model.bounces, most)
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
        light = lights[light_name]
        materials = dressed(scene, case.materials()[kind])
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
    brdf = ptt.TensorBRDF.fit(space, ranks=(8, 40, 40), separated=4)
    basis = ptt.BRDFBasis.fit(space)
    transfer = ptt.assemble(raw, brdf, basis, 96, progress=True)
    model = ptt.cluster(transfer, OWN, progress=True)
    seams(table, scene, light, model, ptt.cluster(transfer, replace(OWN, points=100, eigenvectors=96, columns=4096)))
    relighters = [ptt.TransferRelighter(without_bounces(model, most)) for most in range(3)]
    strips = []
    bounced = []
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
        bounces = radiance[1] - radiance[0], (points.mean - direct.mean).float()
        bounced += [ptt.render(scene, camera, bounce).pixels for bounce in bounces]
        ours, truly = (bounce[own] for bounce in bounces)
        how = "first bounce on the table, all its vertices; light of 12 degrees, lighting of the bounce 6 x 8 x 8"
        table.row(f"caustic, {kind} ring, error", ptt.relative_rmse(ours, truly), "relative RMSE", how)
        peak = float(ours.max()) / float(truly.quantile(0.999))
        table.row(f"caustic, {kind} ring, brightest over the reference's", peak, "", f"{how}; its 99.9 % quantile")
    exposure = ptt.Image(strips[0]).exposure() - 1.6
    ptt.Image(torch.cat(strips)).save(IMAGES / "transfer_caustic.png", exposure)
    ptt.Image(torch.cat(bounced, 1)).save(IMAGES / "transfer_caustic_bounce.png", exposure + 2)  # four times as bright
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
