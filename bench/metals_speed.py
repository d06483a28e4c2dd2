"""Frames a second of narrow lobes and of the paper's tensor, as JSON, one row a line; for bench/metals.py.

PTT_DATA=... python -m bench.metals_speed FOLDER SCENE      # FOLDER holds tensor.safetensors and lobes.safetensors
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path

from torch import Tensor

import ptt
from bench.machine_parts import instructions, row
from bench.table import ROOT, median_seconds

GOLD = (1.0, 0.78, 0.34)
COUNTS = (4, 8, 16, 32, 48, 64)
GOALS = {16: ">= 0.7", 32: ">= 0.7", 48: ">= 0.35"}  # of the tensor's frames; 16 and 32 are defaults
NUMBERS = count(1)  # no two frames are alike


def main() -> None:
    folder, name = Path(sys.argv[1]), sys.argv[2]
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / f"{name}.toml")
    light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / "uffizi.hdr")
    tensor, lobes = (ptt.TransferModel.load(folder / f"{kind}.safetensors") for kind in ("tensor", "lobes"))
    how = f"{len(scene.vertices)} vertices, two bounces, gold metal; {instructions()}"
    before = rates(ptt.TransferRelighter(tensor), scene, light)
    for step, rate in before.items():
        row(f"{name}, {instructions()}, tensor, {step}", rate, "frames/s", how)
    for n in COUNTS:
        for step, rate in rates(ptt.TransferRelighter(lobes, lobes=n), scene, light).items():
            what = f"{name}, {instructions()}, {n} lobes, {step}"
            row(what, rate, "frames/s", how)
            row(f"{what}, of the tensor's", rate / before[step], "", f"same run; {how}", GOALS.get(n, ""))


def rates(relighter: ptt.TransferRelighter, scene: ptt.Scene, light: ptt.Environment) -> dict[str, float]:
    """Frames a second after a change of the view; of that and a material; of those and the light."""
    region = scene.regions[0].name
    given = {region: ptt.ggx(0.0, 1.0, GOLD, 0.3)}

    def edit() -> dict[str, ptt.Material]:
        return {region: ptt.ggx(0.0, 1.0, GOLD, 0.3 + 1e-4 * (next(NUMBERS) % 1000))}

    def orbit() -> ptt.Camera:
        return scene.camera.orbited(0.37 * next(NUMBERS))

    frames: dict[str, Callable[[], Tensor]] = {
        "view": lambda: relighter(light, given, orbit()),
        "view and BRDF": lambda: relighter(light, edit(), orbit()),
        "view, BRDF and light": lambda: relighter(light.rotated(y=0.7 * next(NUMBERS)), edit(), orbit()),
    }
    return {step: 1 / median_seconds(frame, 15) for step, frame in frames.items()}


if __name__ == "__main__":
    main()
