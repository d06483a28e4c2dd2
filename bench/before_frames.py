"""Frames of one relighter by the code of one checkout: a process of `bench.before`, which runs this file by its path.

It says "ready", then answers each number with the medians of so many frames after a change of the view, of a material
and of the light, in milliseconds. It calls only what both checkouts have.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any

import torch

import ptt
from bench.frames import balls
from bench.table import median_seconds

CHANGES = ("view", "material", "light")
Viewed = tuple[Any, Callable[[ptt.Camera], Any]]
"""A relighter, and what it is given to see by a camera."""


def transfer(scene: ptt.Scene) -> Viewed:
    """Clusters of 24 eigenvectors, for the paper's 32, with the BRDF tensor and its lobes."""
    space = ptt.BRDFSpace.blinn_phong()
    brdf = ptt.TensorBRDF.fit(space, ranks=(4, 16, 16), separated=3)
    clusters = ptt.Clusters(points=1000, eigenvectors=24, lighting=64)
    raw = ptt.precompute(scene, 2, resolution=32, rays=64)
    model = ptt.compress(raw, 96, brdf, ptt.BRDFBasis.fit(space), clusters)
    return ptt.TransferRelighter(model, compiled=True), lambda camera: camera


def rotation(scene: ptt.Scene) -> Viewed:
    """Light turned in the wavelet domain, per vertex."""
    return ptt.EnvMapRelighter(scene, ptt.LightRotation.build(64, 32), terms=96), lambda camera: camera


def triple(scene: ptt.Scene) -> Viewed:
    """Triple products per pixel, highlights by triangles; the eye moves, the G-buffer stays."""
    newer = "highlights" in inspect.signature(ptt.TripleProductRelighter).parameters
    options: dict[str, Any] = {"highlights": "triangles"} if newer else {}
    assert scene.camera is not None
    pixels = ptt.GBuffer.of(scene, replace(scene.camera, width=640, height=480))
    return ptt.TripleProductRelighter(scene, 2, **options), lambda camera: replace(pixels, camera=camera)


def frames(scene: ptt.Scene, relighter: Any, seen: Callable[[ptt.Camera], Any]) -> list[Callable[[], object]]:
    """A frame after a change of the view, of a material's colour and shape, and of the light; no two are alike."""
    light = ptt.Environment(torch.rand(128, 256, 3, generator=torch.Generator().manual_seed(0)))
    steps: Iterator[int] = count(1)
    camera = scene.camera
    assert camera is not None

    def edited() -> dict[str, ptt.Material]:
        share = 1 - 1e-4 * (next(steps) % 1000)
        material = ptt.blinn_phong(0.3 * share, 0.4, 24.0 * share)
        return {region.name: material for region in scene.regions if region.editable}

    given = edited()
    viewed = seen(camera)
    return [
        lambda: relighter(light, given, seen(camera.orbited(0.01 * next(steps)))),
        lambda: relighter(light, edited(), viewed),
        lambda: relighter(light.rotated(y=0.7 * next(steps)), given, viewed),
    ]


RELIGHTERS: dict[str, Callable[[ptt.Scene], Viewed]] = {"transfer": transfer, "rotation": rotation, "triple": triple}

if __name__ == "__main__":
    balls_on_floor = balls(5, 2, ptt.blinn_phong(0.3, 0.4, 24.0))
    changes = frames(balls_on_floor, *RELIGHTERS[sys.argv[1]](balls_on_floor))
    for change in changes:
        median_seconds(change, 3)
    print("ready", flush=True)
    for line in sys.stdin:
        print(*(1e3 * median_seconds(change, int(line)) for change in changes), flush=True)
