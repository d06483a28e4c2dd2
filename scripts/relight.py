"""Relight a scene: one picture before, and one after an edit of the material, of the light and of the view.

    python scripts/relight.py                                       # all of it, on the default scene
    python scripts/relight.py --model runs/bunny/model.safetensors --scene bunny.ply --environment uffizi.hdr
    python scripts/relight.py --region ball --exponent 40 --specular 0.8 0.6 0.3

Without --model the scene is traced and compressed first (a minute on two cores for the default one), and what was made
is kept in ~/.cache/ptt: other flags find it again. Writes to OUT:
before, material, light and view as .exr and .png, relight.png (all four over their path-traced references and the
differences, brightened), and relight.json (the config, times, and errors against the reference).
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import ptt  # before torch: it says how threads wait (ptt.threads)

# isort: split
import torch
from torch import Tensor

from ptt.cli import Layout, chosen_light, chosen_scene, chosen_space, configure, kept_model, make_folder, run

JUDGED = 128  # vertices, at most, each by PATHS light paths for every one of a pixel: noise stays below the error
PATHS = 512


@dataclass
class Config:
    """Defaults; flags override them."""

    scene: str = "default"
    """A mesh (.ply .obj .stl .gltf .glb), a scene file (.toml), or "default", which is made in code."""
    model: Path | None = None
    """The model that compress.py wrote for this scene; without it, the scene is traced and compressed first."""
    environment: str = "scene"
    """An HDR map (.exr .hdr), "scene" for the scene's own, "sky" or "constant"."""
    layout: Layout = "auto"
    """Layout of the sphere in the map: latlong, cross, angular or octahedral; auto: by width and height."""
    region: str = ""
    """Region whose material is edited; default: the second one, or the only one."""
    diffuse: tuple[float, float, float] = (0.03, 0.1, 0.05)
    """Albedo of the edited material."""
    specular: tuple[float, float, float] = (0.5, 0.6, 0.5)
    """Weight of its highlight."""
    exponent: float = 16.0
    """Sharpness of its highlight, 0..1e6; a shape other than Blinn-Phong stays as it is in the scene."""
    turn: float = 110.0
    """Turn of the light about the vertical axis, degrees."""
    orbit: float = -50.0
    """Turn of the camera about its target, degrees."""
    bounces: int = 2
    """Reflections before the last one, where the scene is traced here; with --model, those that it was made for."""
    rays: int = 128
    """Number of rays over the hemisphere of each vertex, for light that bounces, where the scene is traced here."""
    functions: int = 2
    """Specular functions by which light is reflected on its way, where the scene is compressed here."""
    coefficients: int = 96
    """Haar coefficients kept for each vertex and incident factor, where the scene is compressed here."""
    samples: int = 16
    """Light paths of the reference for each pixel, 512 times as many for each judged vertex; 0 leaves it out."""
    exposure: float | None = None
    """Stops that brighten the PNGs; default: those that bring the brightest twentieth of "before" to white."""
    width: int = 480
    height: int = 360
    out: Path = Path("runs/relight")
    """Folder for the pictures."""


def main() -> None:
    config = configure(Config, __doc__ or "")
    scene = chosen_scene(config.scene)
    light = chosen_light(config.environment, scene, config.layout)
    camera = replace(scene.camera, width=config.width, height=config.height)
    make_folder(config.out)

    # choose the edit
    names = [region.name for region in scene.regions]
    region = config.region or names[min(1, len(names) - 1)]
    scene.region_index(region)  # refuses an unknown name early, as `coordinates` below a shape that no model shows
    own = scene.materials[region].shape
    shape = ptt.BlinnPhong(config.exponent) if own is None or isinstance(own, ptt.BlinnPhong) else own
    edited = ptt.Material(config.diffuse, config.specular, shape)

    # trace and compress, or load
    if config.model is None:
        space = chosen_space("auto", scene.materials | {region: edited})
        space.coordinates(shape)
        settings = {name: getattr(config, name) for name in ("bounces", "rays", "functions", "coefficients")}
        model = kept_model(scene, settings | {"space": space.to_config()}, lambda: traced(scene, space, config))
    else:
        model = ptt.TransferModel.load(config.model)
        model.brdf.space.coordinates(shape)
    relighter = ptt.TransferRelighter(model)

    states = {
        "before": (light, scene.materials, camera),
        "material": (light, scene.materials | {region: edited}, camera),
        "light": (light.rotated(y=config.turn), scene.materials, camera),
        "view": (light, scene.materials, camera.orbited(config.orbit)),
    }

    # relight, render, and judge
    columns = []
    report = {}
    exposure = config.exposure
    for name, (environment, materials, view) in states.items():
        start = time.perf_counter()
        radiance = relighter(environment, materials, view)
        seconds = time.perf_counter() - start
        picture = ptt.render(scene, view, radiance, environment)
        picture.save(config.out / f"{name}.exr")
        exposure = picture.exposure() if exposure is None else exposure
        picture.save(config.out / f"{name}.png", exposure)
        report[name] = {"relight_ms": 1e3 * seconds}
        line = f"{name:>9}: relit in {1e3 * seconds:6.1f} ms"
        if config.samples:
            column, errors = judge(
                scene, environment, materials, view, radiance, picture, model.bounces, config.samples
            )
            columns.append(column)
            report[name] |= errors
            line += ", relative RMSE {relative_rmse:.4f} (reference noise {noise:.4f})".format(**errors)
        print(line)
    if columns and exposure is not None:
        ptt.Image(torch.cat(columns, 1)).save(config.out / "relight.png", exposure)
    (config.out / "relight.json").write_text(
        json.dumps({"config": asdict(config), "states": report}, default=str, indent=2) + "\n"
    )
    print(f"pictures are in {config.out}")


def traced(scene: ptt.Scene, space: ptt.BRDFSpace, config: Config) -> ptt.TransferModel:
    """The scene, traced and compressed for the materials of a space."""
    raw = ptt.precompute(scene, config.bounces, rays=config.rays, progress=True)
    brdf = ptt.TensorBRDF.fit(space, ptt.usual_ranks(space), separated=3)
    basis = ptt.BRDFBasis.fit(space, config.functions)
    return ptt.compress(raw, config.coefficients, brdf, basis, highlights="lobes", progress=True)


def judge(
    scene: ptt.Scene,
    environment: ptt.Environment,
    materials: Mapping[str, ptt.Material],
    view: ptt.Camera,
    radiance: Tensor,
    picture: ptt.Image,
    bounces: int,
    samples: int,
) -> tuple[Tensor, dict[str, float]]:
    """A column of pictures (relit, reference, difference x 4), and the errors at vertices that face the eye.

    bounces, samples: those of the reference. Some vertices, drawn by chance, with many paths each: the errors of all
        with few would be the reference's noise
    """
    every = scene, environment, materials
    facing = torch.nonzero((view.toward(scene.vertices) * scene.normals).sum(1) > 0)[:, 0]
    judged = facing[torch.randperm(len(facing), generator=torch.Generator().manual_seed(0))[:JUDGED]]
    points = ptt.reference.vertex_points(scene).take(judged)
    wo = view.toward(points.position)
    truth = ptt.reference.radiance(*every, points, wo, bounces=bounces, samples=PATHS * samples)
    image = ptt.reference.image(*every, view, bounces=bounces, samples=samples).mean.float()
    difference = 4 * (picture.pixels - image).abs()
    noise = truth.noise
    error = ptt.relative_rmse(radiance[judged], truth.mean)
    return torch.cat((picture.pixels, image, difference)), {"relative_rmse": error, "noise": noise}


if __name__ == "__main__":
    run(main)
