"""Judge a compressed model: its radiance at the vertices against path-traced ground truth.

    python scripts/evaluate.py                                      # runs/default
    python scripts/evaluate.py --model runs/bunny/model.safetensors --scene bunny.ply --environment uffizi.hdr

Writes evaluate.json beside the model: relative RMSE over all vertices that face the camera and by region, and the
reference's own noise, which sets how small an error can be seen.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import ptt
from ptt.cli import Layout, chosen_light, chosen_scene, configure, run


@dataclass
class Config:
    """Defaults; flags override them."""

    model: Path = Path("runs/default/model.safetensors")
    """The model that compress.py wrote."""
    scene: str = "default"
    """The scene that the model was made of."""
    environment: str = "scene"
    """An HDR map (.exr .hdr), "scene" for the scene's own, "sky" or "constant"."""
    layout: Layout = "auto"
    """Layout of the sphere in the map: latlong, cross, angular or octahedral; auto: by width and height."""
    rotate: float = 0.0
    """Turn of the light about the vertical axis, degrees."""
    bounces: int | None = None
    """Bounces of the reference; default: those that the model was made for."""
    samples: int = 1024
    """Light paths for each vertex of the reference."""


def main() -> None:
    config = configure(Config, __doc__ or "")
    model = ptt.TransferModel.load(config.model)
    scene = chosen_scene(config.scene)
    light = chosen_light(config.environment, scene, config.layout).rotated(y=config.rotate)
    relighter = ptt.TransferRelighter(model)

    start = time.perf_counter()
    radiance = relighter(light, scene.materials, scene.camera)
    relit = time.perf_counter()
    bounces = model.bounces if config.bounces is None else config.bounces
    truth = ptt.reference.at_vertices(
        scene, light, scene.materials, scene.camera, bounces=bounces, samples=config.samples, progress=True
    )
    traced = time.perf_counter()

    facing = (scene.camera.toward(scene.vertices) * scene.normals).sum(1) > 0
    rows = {"all": facing} | {r.name: facing & (scene.vertex_region == k) for k, r in enumerate(scene.regions)}
    errors = {}
    for name, at in rows.items():
        if at.any():
            noise = float(truth.standard_error[at].square().mean().sqrt() / truth.mean[at].square().mean().sqrt())
            errors[name] = {"relative_rmse": ptt.relative_rmse(radiance[at], truth.mean[at]), "noise": noise}
            print(f"{name:>12}: relative RMSE {errors[name]['relative_rmse']:.4f}, reference noise {noise:.4f}")
    print(f"relit in {relit - start:.3f} s, reference of {bounces} bounces in {traced - relit:.1f} s")
    result = {
        "config": asdict(config) | {"bounces": bounces},
        "errors": errors,
        "relight_s": relit - start,
        "reference_s": traced - relit,
    }
    path = config.model.with_name("evaluate.json")
    path.write_text(json.dumps(result, default=str, indent=2) + "\n")
    print(f"wrote {path}")


if __name__ == "__main__":
    run(main)
