"""Metals and plastics on the object alone, beside the reference: narrow lobes and the paper's tensor.

    PTT_DATA=... python -m bench.metals [--quick] [--only SCENE ...]      # about 20 minutes a scene on two cores

Rows of bench/results/metals.csv: relative RMSE at vertices that face the eye, the noise of the reference taken out and
named, of direct light, of light that bounced twice at most, and of both ("total"); those seen at less than 20 degrees
to the surface apart ("grazing").
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch
from torch import Tensor

import ptt
from bench.table import ROOT, Table, median_seconds, setting

GOLD = (1.0, 0.78, 0.34)
METALS = {
    "gold, roughness 0.1": ptt.ggx(0.0, 1.0, GOLD, 0.1),
    "gold, roughness 0.2": ptt.ggx(0.0, 1.0, GOLD, 0.2),
    "gold, roughness 0.3": ptt.ggx(0.0, 1.0, GOLD, 0.3),
    "gold, roughness 0.5": ptt.ggx(0.0, 1.0, GOLD, 0.5),
    "gold, roughness 0.7": ptt.ggx(0.0, 1.0, GOLD, 0.7),
    "gold-metallic-paint": ptt.fitted("gold-metallic-paint"),
}
PLASTICS = {
    "plastic, roughness 0.2": ptt.ggx((0.3, 0.08, 0.05), 1.0, 0.04, 0.2),
    "plastic, roughness 0.4": ptt.ggx((0.3, 0.08, 0.05), 1.0, 0.04, 0.4),
}
SCENES = ("suzanne", "dragon")
MAPS = ("uffizi.hdr", "grace.hdr", "interior.exr")
FORMS = {"tensor": ("tensor", 16), "lobes, 16": ("lobes", 16), "lobes, 48": ("lobes", 48)}
GRAZING = 0.34  # cosine of 70 degrees
NEGATIVE = -1e-3  # of the mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few vertices of one scene, nothing written")
    parser.add_argument("--only", nargs="+", choices=SCENES, default=SCENES, help="scenes whose rows are made anew")
    options = parser.parse_args()
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    for name in options.only[: 1 if options.quick else None]:
        table = Table("metals")
        _rows(table, name, *((100, 64) if options.quick else (500, 512)))
        if not options.quick:
            table.replace(name, SCENES)


def _rows(table: Table, name: str, vertices: int, samples: int) -> None:
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / f"{name}.toml")
    materials = METALS | PLASTICS
    relighters: dict[tuple[str, int], ptt.TransferRelighter] = {}
    for bounces in (0, 2):
        raw = ptt.precompute(scene, bounces, progress=True)
        models = {
            kind: ptt.compress(raw, highlights=kind, editable=list(materials.values()), progress=True)
            for kind in ("tensor", "lobes")
        }
        for form, (kind, count) in FORMS.items():
            relighters[form, bounces] = ptt.TransferRelighter(models[kind], lobes=count)
    for form in FORMS:
        size = relighters[form, 2].model.bytes / 1e6
        table.row(f"{name}, {form}, size", size, "MB", f"{len(scene.vertices)} vertices, two bounces")
    region = scene.regions[0].name
    seen = _Seen(scene, vertices)
    for file in MAPS:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        for key, material in materials.items():
            given = {region: material}
            direct, total = (seen.truth(light, given, bounces, samples) for bounces in (0, 2))
            for form in FORMS:
                what = f"{name}, {Path(file).stem}, {key}, {form}"
                first, whole = (relighters[form, bounces](light, given, seen.eye) for bounces in (0, 2))
                goals = _goals(key, form)
                seen.errors(table, f"{what}, total", whole, total, goals["total"])
                seen.errors(table, f"{what}, direct", first, direct, goals["direct"])
                seen.errors(table, f"{what}, indirect", whole - first, _less(total, direct), goals["indirect"])
                seen.negative(table, what, whole, goals["total"])
    for form in FORMS:
        _speed(table, f"{name}, {form}", relighters[form, 2], scene, light, region)


def _goals(key: str, form: str) -> dict[str, str]:
    """The goals of a material by a form; those of the default one, and of more lobes."""
    if form == "tensor":
        return dict.fromkeys(("total", "direct", "indirect"), "")
    if key in PLASTICS:
        return {"total": "<= 0.03", "direct": "<= 0.03", "indirect": "<= 0.1"}
    total = 0.08 if key.endswith("0.1") else 0.06 if form == "lobes, 16" else 0.04
    return {"total": f"<= {total}", "direct": "<= 0.04", "indirect": "<= 0.2"}


def _less(total: ptt.reference.Estimate, part: ptt.reference.Estimate) -> ptt.reference.Estimate:
    """The difference of two estimates that know nothing of each other."""
    noise = (total.standard_error.square() + part.standard_error.square()).sqrt()
    return ptt.reference.Estimate(total.mean - part.mean, noise)


class _Seen:
    """Some vertices of a scene's first region that face its eye."""

    def __init__(self, scene: ptt.Scene, count: int) -> None:
        self.scene = scene
        self.eye = torch.as_tensor(scene.camera.eye, dtype=torch.float32)
        self.own = scene.vertex_region == 0
        toward = scene.camera.toward(scene.points)
        cosine = (toward * scene.frames[:, 2]).sum(1)
        facing = torch.nonzero(self.own & (cosine > 0.05))[:, 0]
        some = torch.randperm(len(facing), generator=torch.Generator().manual_seed(0))[:count]
        self.rows = facing[some].sort().values
        self.toward = toward[self.rows]
        self.steep = cosine[self.rows] > GRAZING

    def truth(
        self, light: ptt.Environment, materials: dict[str, ptt.Material], bounces: int, samples: int
    ) -> ptt.reference.Estimate:
        """Light at the vertices."""
        points = ptt.reference.vertex_points(self.scene).take(self.rows)
        every = self.scene.materials | materials
        return ptt.reference.radiance(self.scene, light, every, points, self.toward, bounces=bounces, samples=samples)

    def errors(self, table: Table, what: str, radiance: Tensor, truth: ptt.reference.Estimate, goal: str) -> None:
        """Rows of one picture: steep and grazing views."""
        for name, rows, bound in (("steep", self.steep, goal), ("grazing", ~self.steep, goal and "<= 0.1")):
            size = truth.mean[rows].square().mean().sqrt()
            noise = truth.standard_error[rows].square().mean()
            excess = (radiance[self.rows][rows] - truth.mean[rows]).square().mean() - noise
            how = f"{int(rows.sum())} vertices, noise of the reference {float(noise.sqrt() / size):.3f}, taken out"
            table.row(f"{what}, {name}", float(excess.clamp(min=0).sqrt() / size), "relative RMSE", how, bound)

    def negative(self, table: Table, what: str, radiance: Tensor, goal: str) -> None:
        """The share of vertices of the whole object with a negative value."""
        own = radiance[self.own]
        below = float((own < NEGATIVE * own.mean()).any(1).double().mean())
        table.row(f"{what}, negative", below, "of the vertices", f"below {NEGATIVE} of the mean", goal and "<= 0.001")


def _speed(
    table: Table, what: str, relighter: ptt.TransferRelighter, scene: ptt.Scene, light: ptt.Environment, region: str
) -> None:
    """Frames a second after a change of the view, and of the material."""
    material = {region: METALS["gold, roughness 0.3"]}
    turns = iter(range(1, 10**6))
    frames = {
        "view": lambda: relighter(light, material, scene.camera.orbited(0.37 * next(turns))),
        "view and BRDF": lambda: relighter(
            light, {region: ptt.ggx(0.0, 1.0, GOLD, 0.3 + 1e-4 * (next(turns) % 1000))}, scene.camera
        ),
    }
    for step, frame in frames.items():
        table.row(f"{what}, {step}", 1 / median_seconds(frame, 15), "frames/s", f"gold metal; {setting()}")


if __name__ == "__main__":
    main()
