"""A sheet of 24 materials from dull to mirror on a sphere and a teapot: relit, by the reference, and the difference.

    PTT_DATA=... python -m bench.metals_sheet --out FOLDER [--maps uffizi.hdr ...]      # 5 minutes a map

Each picture of a material has 512 x 256 pixels, and there are two materials a row. Differences are four times as
bright. The maps have terms of their own: pictures are for looking at.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch
from torch import Tensor

import ptt
from bench.metals_speed import GOLD
from bench.table import ROOT

STEEL, COPPER = (0.56, 0.57, 0.58), (0.95, 0.64, 0.54)
RED = (0.3, 0.08, 0.05)
MATERIALS = {
    "matt": ptt.lambert(RED),
    **{f"gold {r}": ptt.ggx(0.0, 1.0, GOLD, r) for r in (1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05)},
    **{f"steel {r}": ptt.ggx(0.0, 1.0, STEEL, r) for r in (0.4, 0.15, 0.03)},
    "copper 0.25": ptt.ggx(0.0, 1.0, COPPER, 0.25),
    **{f"plastic {r}": ptt.ggx(RED, 1.0, 0.04, r) for r in (0.8, 0.4, 0.2, 0.1)},
    **{f"Blinn-Phong {n:g}": ptt.blinn_phong(RED, 0.5, n) for n in (8.0, 40.0, 150.0)},
    **{name: ptt.fitted(name) for name in ("gold-metallic-paint", "nickel", "violet-rubber", "cherry-235", "teflon")},
}
MAPS = ("uffizi.hdr", "grace.hdr", "interior.exr", "courtyard.exr")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--maps", nargs="+", default=MAPS, help="files of $PTT_DATA/hdri")
    parser.add_argument("--samples", type=int, default=64, help="of the reference, a pixel")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "teapot.toml")
    raw = ptt.precompute(scene, 2, progress=True)
    relighter = ptt.TransferRelighter(ptt.compress(raw, editable=list(MATERIALS.values()), progress=True))
    for file in options.maps:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        cells = [_cell(scene, relighter, light, material, options.samples) for material in MATERIALS.values()]
        rows = [torch.cat(cells[k : k + 2], 1) for k in range(0, len(cells), 2)]
        ptt.Image(torch.cat(rows)).save(options.out / f"metals_{Path(file).stem}.png")
    print("\n".join(f"{k // 2}, {k % 2}: {name}" for k, name in enumerate(MATERIALS)))


def _cell(
    scene: ptt.Scene, relighter: ptt.TransferRelighter, light: ptt.Environment, material: ptt.Material, samples: int
) -> Tensor:
    """Relit, by the reference, and the difference, side by side, at an exposure of their own."""
    given = {region.name: material for region in scene.regions}
    relit = ptt.render(scene, scene.camera, relighter(light, given, scene.camera), light).pixels
    truth = ptt.reference.image(scene, light, given, scene.camera, samples=samples, bounces=2).mean.float()
    gain = 2.0 ** ptt.Image(truth).exposure()
    sheet: Tensor = torch.cat((relit, truth, 4 * (relit - truth).abs()), 1) * gain
    return sheet


if __name__ == "__main__":
    main()
