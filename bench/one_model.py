"""Plastic, brushed metal, fitted paint and a textured glTF asset in one model, relit and edited: rows of inputs.csv.

`python -m bench.inputs "one model"`: radiance with two bounces at the vertices that face the eye, against the path
tracer with as many. A picture goes to runs/one_model, not to the docs: the asset has terms of its own.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import ptt
from bench.table import ROOT, Table, setting
from ptt import reference
from ptt.materials.varying import SurfaceMaterial
from ptt.ops import mesh
from ptt.scene.hidden import only
from ptt.scene.parts import Part

IMAGES = ROOT / "runs" / "one_model"
BOUNCES = 2
VISOR = 0.25  # how far in front of its middle it begins
VERTICES, SAMPLES = 150, 2048  # of a region that are compared, and paths of each
PIXELS = 64  # paths of a pixel

Materials = Mapping[str, SurfaceMaterial]


def rows(table: Table, options: argparse.Namespace) -> None:
    """Relative RMSE of every region, as it was traced and with all materials edited."""
    if not options.quick and "PTT_DATA" not in os.environ:
        raise SystemExit("one model: set PTT_DATA to the folder with meshes, gltf and hdri")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*was read without|.*lie below the surface|mesh repaired")
        scene, light = small() if options.quick else large()
    edited = edits(scene)
    start = time.process_time()
    model = ptt.compress(ptt.precompute(scene, BOUNCES), editable=list(edited.values()))
    seconds = time.process_time() - start
    relighter = ptt.TransferRelighter(model)
    how = f"{len(scene.vertices)} vertices, {BOUNCES} bounces, {len(model.brdf.space.samples)} BRDFs; {setting()}"
    what = "one model, precomputation"
    table.row(what, seconds, "s of all cores", f"without the fits of the space, if they were kept; {how}")
    for state, materials in {"as traced": {}, "edited": edited}.items():
        relit = relighter(light, materials, scene.camera)
        compare(table, f"one model, {state}", scene, light, scene.materials | materials, relit, options.quick)
        if not options.quick:
            picture(IMAGES / f"{state.replace(' ', '_')}.png", scene, light, scene.materials | materials, relit)


def large() -> tuple[ptt.Scene, ptt.Environment]:
    """The scene of scripts/configs/materials.toml; of the asset its visor, in front, without glow and normal map."""
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "materials.toml")
    light = scene.environment
    assert light is not None
    helmet = scene.region_index("helmet")
    middle = scene.vertices[scene.vertex_region == helmet].mean(0)
    visor = (scene.vertices[scene.faces][..., 2] > middle[2] + VISOR).all(1)
    scene = only(scene, visor | (scene.face_region != helmet))
    return replace(scene, regions=tuple(replace(r, glow=None, bumps=None) for r in scene.regions)), light


def small() -> tuple[ptt.Scene, ptt.Environment]:
    """Balls of the same materials, one of them with a texture of two roughnesses and two colours, on a floor."""
    ball, faces = mesh.sphere_mesh(2, 0.35)
    uv = torch.stack((ball[:, 0], ball[:, 1]), 1) / 0.7 + 0.5
    rough = ptt.Texture(torch.tensor([[[0.3], [0.6]]]))
    own: dict[str, SurfaceMaterial] = {
        "plastic": ptt.ggx((0.05, 0.25, 0.5), 1.0, 0.04, 0.3),
        "brushed metal": ptt.ward(0.02, (0.65, 0.6, 0.55), 0.35, 0.1),
        "paint": ptt.fitted("gold-metallic-paint"),
        "helmet": ptt.MetalRough(metallic=0.5, roughness_map=rough),
    }
    colour = ptt.Texture(torch.tensor([[[0.9, 0.6, 0.3], [0.3, 0.3, 0.8]]]))
    parts = [
        Part(name, ball + torch.tensor([0.8 * (k % 2), 0.36, 0.8 * (k // 2)]), faces, uv=uv, material=material)
        for k, (name, material) in enumerate(own.items())
    ]
    parts[-1] = replace(parts[-1], texture=colour)
    floor = Part("floor", *mesh.plane_mesh(3.0, 12), material=ptt.lambert(0.5), editable=False)
    return ptt.Scene.from_parts([*parts, floor]), ptt.Environment.sun_sky(radius=10.0)


def edits(scene: ptt.Scene) -> dict[str, SurfaceMaterial]:
    """Another material for every region that may have one."""
    helmet = scene.materials["helmet"]
    return {
        "plastic": ptt.ggx((0.5, 0.08, 0.05), 1.0, 0.04, 0.5),
        "brushed metal": ptt.ward(0.02, (0.65, 0.45, 0.3), 0.1, 0.35),
        "paint": ptt.fitted("blue-metallic-paint"),
        "helmet": replace(helmet, base=torch.tensor([0.5, 0.9, 0.6]), roughness=0.6),
    }


def compare(
    table: Table,
    what: str,
    scene: ptt.Scene,
    light: ptt.Environment,
    materials: Materials,
    relit: Tensor,
    quick: bool,
) -> None:
    """Rows of the error of each region at some of its vertices that face the eye, and of all of them."""
    at = _facing(scene, 40 if quick else VERTICES)
    wo = scene.camera.toward(scene.points[at])
    points = reference.vertex_points(scene).take(at)
    samples = 256 if quick else SAMPLES
    truth = reference.radiance(scene, light, materials, points, wo, bounces=BOUNCES, samples=samples)
    region = scene.vertex_region[at]
    for number, own in enumerate([*scene.regions, None]):
        some = torch.ones_like(region, dtype=torch.bool) if own is None else region == number
        mean = truth.mean[some]
        noise = float((truth.standard_error[some].square().mean() / mean.square().mean()).sqrt())
        bias = float((relit[at][some].double().mean() / mean.mean()) - 1)
        how = f"{len(mean)} vertices, {samples} paths each; the reference's noise {noise:.3f}; on average {bias:+.1%}"
        name = "all" if own is None else own.name
        table.row(f"{what}, {name}", ptt.relative_rmse(relit[at][some], mean), "relative RMSE", how)


def _facing(scene: ptt.Scene, most: int) -> Tensor:
    """Up to so many vertices (n,) of each region that face the eye."""
    faces = (scene.camera.toward(scene.points) * scene.normals).sum(1) > 0
    random = torch.Generator().manual_seed(0)
    found = []
    for number in range(len(scene.regions)):
        own = (faces & (scene.vertex_region == number)).nonzero()[:, 0]
        found.append(own[torch.randperm(len(own), generator=random)[:most]])
    return torch.cat(found)


def picture(path: Path, scene: ptt.Scene, light: ptt.Environment, materials: Materials, relit: Tensor) -> None:
    """The reference, what was relit, and their difference times two."""
    camera = replace(scene.camera, width=640, height=480)
    path.parent.mkdir(parents=True, exist_ok=True)
    truth = reference.image(scene, light, materials, camera, bounces=BOUNCES, samples=PIXELS).mean.float()
    shown = ptt.render(scene, camera, relit, light).pixels
    white = float(truth.flatten().quantile(0.98))
    difference = (0.5 + (shown - truth) / white).clamp(0, 1) ** 2.2
    ptt.Image(torch.cat([(truth / white).clamp(0, 1), (shown / white).clamp(0, 1), difference], 1)).save(path)
