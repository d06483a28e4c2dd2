"""Trace a scene: which light every vertex sees, and which other vertices. This is slow, and done once per geometry.

Nothing here depends on materials.

    python scripts/precompute.py                                   # the default scene
    python scripts/precompute.py --scene bunny.ply --bounces 0 --out runs/bunny
    python scripts/precompute.py --scene scripts/configs/bunny.toml --resolution 32

Writes OUT/raw.safetensors and OUT/precompute.json. Next: compress.py.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import ptt
from ptt.cli import chosen_scene, configure, make_folder, run, save_config


@dataclass
class Config:
    """Defaults; flags override them."""

    scene: str = "default"
    """A mesh (.ply .obj .stl .gltf .glb), a scene file (.toml), or "default", which is made in code."""
    resolution: int = 64
    """Cells along an edge of the cube map that holds the light; a power of two up to 128."""
    bounces: int = 2
    """Reflections before the last one that the models show: 0 for direct light, 1 or 2."""
    rays: int = 512
    """Number of rays over the hemisphere of each vertex, for light that bounces."""
    out: Path = Path("runs/default")
    """Folder for the result."""


def main() -> None:
    config = configure(Config, __doc__ or "")
    scene = chosen_scene(config.scene)
    make_folder(config.out)
    counts = region_counts(scene)
    print(f"{len(scene.vertices)} vertices, {len(scene.faces)} triangles; {counts}")

    start = time.perf_counter()
    raw = ptt.precompute(scene, config.bounces, resolution=config.resolution, rays=config.rays, progress=True)
    seconds = time.perf_counter() - start

    raw.save(config.out / "raw.safetensors")
    save_config(config, config.out / "precompute.json")
    size = (config.out / "raw.safetensors").stat().st_size
    print(f"traced in {seconds:.1f} s; {config.out / 'raw.safetensors'}: {size / 1e6:.1f} MB")


def region_counts(scene: ptt.Scene) -> str:
    """Vertices of each region, as text."""
    counts = scene.vertex_region.bincount(minlength=len(scene.regions)).tolist()
    return ", ".join(f"{region.name} {count}" for region, count in zip(scene.regions, counts, strict=True))


if __name__ == "__main__":
    run(main)
