"""Metals and plastics on the object alone, beside the reference: narrow lobes and the paper's tensor.

    PTT_DATA=... python -m bench.metals [--quick] [--only PART ...]      # about 20 minutes a scene on two cores

Rows of bench/results/metals.csv: relative RMSE at vertices that face the eye, the noise of the reference taken out and
named, of direct light, of light that bounced twice at most, and of both ("total"); those seen at less than 20 degrees
to the surface apart ("grazing").
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import ptt
from bench.against import without_bounces
from bench.machine import SETS, printed
from bench.metals_brushed import brushed
from bench.metals_measured import measured
from bench.metals_seen import Seen
from bench.metals_speed import COUNTS, GOLD
from bench.metals_triple import direct
from bench.metals_unshadowed import unshadowed
from bench.table import ROOT, Table
from ptt.materials.shapes import GGX
from ptt.ops.cells import gloss_of
from ptt.ops.gloss import rows_of

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
TRADED = ("gold, roughness 0.3", "gold, roughness 0.5", "plastic, roughness 0.2")
PARTS = ("furnace", "measured", "unshadowed", "triple", "brushed", "suzanne", "dragon", "engine")
MAPS = ("uffizi.hdr", "grace.hdr", "interior.exr")
FORMS = {"tensor": ("tensor", None), "lobes": ("lobes", None), "lobes, 48": ("lobes", 48)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few vertices of one scene, nothing written")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts whose rows are made anew")
    options = parser.parse_args()
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    for name in options.only[: 6 if options.quick else None]:
        table = Table("metals")
        if name == "furnace":
            _furnace(table)
        elif name == "measured":
            measured(table, 2 if options.quick else None)
        elif name == "unshadowed":
            unshadowed(table, METALS | PLASTICS, MAPS, *((100, 64) if options.quick else (500, 1024)))
        elif name == "brushed":
            brushed(table, MAPS, *((100, 64) if options.quick else (500, 512)))
        elif name == "triple":
            direct(table, METALS | PLASTICS, MAPS, *((100, 64) if options.quick else (500, 1024)))
        else:
            _rows(table, name, *((100, 64) if options.quick else (500, 512)))
        if not options.quick:
            table.replace(name, PARTS)


def _rows(table: Table, name: str, vertices: int, samples: int) -> None:
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / f"{name}.toml")
    raw = ptt.precompute(scene, 2, progress=True)
    editable = list((METALS | PLASTICS).values())
    models = {
        kind: ptt.compress(raw, highlights=kind, editable=editable, progress=True) for kind in ("tensor", "lobes")
    }
    for kind, model in models.items():
        how = f"{len(scene.vertices)} vertices, two bounces"
        table.row(f"{name}, {kind}, size", model.bytes / 1e6, "MB", how)
    _speed(table, name, models)
    _errors(table, scene, name, models, Seen(scene, vertices), samples)


def _speed(table: Table, name: str, models: dict[str, ptt.TransferModel]) -> None:
    """Frames a second with both sets of instructions, in processes of their own."""
    with tempfile.TemporaryDirectory() as folder:
        for kind, model in models.items():
            model.save(Path(folder) / f"{kind}.safetensors")
        for variables in SETS.values():
            for row in printed("bench.metals_speed", folder, name, **variables):
                table.row(**row)  # type: ignore[arg-type]


def _errors(
    table: Table, scene: ptt.Scene, name: str, models: dict[str, ptt.TransferModel], seen: Seen, samples: int
) -> None:
    region = scene.regions[0].name
    direct = {kind: without_bounces(model) for kind, model in models.items()}
    relighters = {
        form: [ptt.TransferRelighter(which[kind], lobes=count) for which in (direct, models)]
        for form, (kind, count) in FORMS.items()
    }
    for file in MAPS:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        for key, material in (METALS | PLASTICS).items():
            given = {region: material}
            alone, total = (seen.truth(light, given, bounces, samples) for bounces in (0, 2))
            for form, both in relighters.items():
                what = f"{name}, {Path(file).stem}, {key}, {form}"
                first, whole = (relighter(light, given, seen.eye) for relighter in both)
                goals = _goals(key, form)
                seen.errors(table, f"{what}, total", whole, total, goals["total"])
                seen.errors(table, f"{what}, direct", first, alone, goals["direct"])
                seen.errors(table, f"{what}, indirect", whole - first, _less(total, alone), goals["indirect"])
                seen.negative(table, what, both[1](light, given, seen.everywhere), goals["total"])
            if file == MAPS[0] and key in TRADED:
                _trade(table, f"{name}, trade, {key}", models["lobes"], light, given, seen, total)


def _trade(
    table: Table,
    what: str,
    model: ptt.TransferModel,
    light: ptt.Environment,
    given: dict[str, ptt.Material],
    seen: Seen,
    truth: ptt.reference.Estimate,
) -> None:
    """Errors by the number of lobes; their speed is `bench.metals_speed`'s."""
    for n in COUNTS:
        radiance = ptt.TransferRelighter(model, lobes=n)(light, given, seen.eye)
        seen.errors(table, f"{what}, {n} lobes", radiance, truth, "")


def _furnace(table: Table) -> None:
    """What 16 lobes reflect of even light, over what the shape does: the worst of whole spaces."""
    ggx: list[Any] = [GGX(f0, r) for f0 in (0.02, 0.04, 1.0) for r in (0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)]
    spaces = {"GGX": ggx, "Blinn-Phong": ptt.BRDFSpace.blinn_phong().samples, "fitted": ptt.BRDFSpace.fitted().samples}
    for name, shapes in spaces.items():
        for angles, goal in (((0, 20, 40, 60, 70, 80), 0.01), ((82, 85, 87), 0.03)):
            worst = max(_furnace_error(shape, angles) for shape in shapes)
            what = f"furnace, {name}, {angles[0]} to {angles[-1]} degrees"
            table.row(what, worst, "of what is reflected", f"the worst of {len(shapes)} shapes", f"<= {goal}")


def _furnace_error(shape: Any, angles: Sequence[float]) -> float:
    """The largest relative error at some angles of view [degrees]."""
    made, turns = gloss_of(lambda wi, wo: shape.evaluate(wi, wo)[..., None], shape.isotropic, 16).lobes
    t = torch.deg2rad(torch.tensor(angles, dtype=torch.float64))
    wo = torch.stack((t.sin(), 0 * t, t.cos()), 1)
    index, weights = rows_of(wo.float(), turns)
    got = (made[index][..., 4].sum(2) * weights).sum(1)
    return max(abs(float(x) / _albedo(shape, towards) - 1) for x, towards in zip(got, wo, strict=True))


def _albedo(shape: Any, wo: Tensor) -> float:
    """The integral of f cos by 216,000 half vectors, 50 times as many as lobes are made of."""
    u = torch.linspace(-36, 14, 1201, dtype=torch.float64)
    square, step = torch.exp2((u[1:] + u[:-1]) / 2), u[1] - u[0]
    phi = (torch.arange(180, dtype=torch.float64) + 0.5) * (math.pi / 90)
    z = (1 + square).rsqrt()[:, None]
    s = square.sqrt()[:, None] * z
    h = torch.stack((s * phi.cos(), s * phi.sin(), z.expand(-1, 180)), -1).flatten(0, 1)
    solid = (square * math.log(2) * step / 2)[:, None] * z**3 * (math.pi / 90)
    along = h @ wo
    wi = 2 * along[:, None] * h - wo
    above = (wi[:, 2] > 0) & (along > 0)
    measure = (4 * along * solid.expand(-1, 180).flatten() * wi[:, 2])[above]
    value = shape.evaluate(wi[above], wo.expand(len(measure), 3))
    return float((value * measure).sum())


def _goals(key: str, form: str) -> dict[str, str]:
    """The goals of a material by a form; those of the default one, and of more lobes."""
    if form == "tensor":
        return dict.fromkeys(("total", "direct", "indirect"), "")
    if key in PLASTICS:
        return {"total": "<= 0.03", "direct": "<= 0.03", "indirect": "<= 0.1"}
    total = 0.08 if key.endswith("0.1") else 0.06 if form == "lobes" else 0.04
    return {"total": f"<= {total}", "direct": "<= 0.04", "indirect": "<= 0.2"}


def _less(total: ptt.reference.Estimate, part: ptt.reference.Estimate) -> ptt.reference.Estimate:
    """The difference of two estimates that know nothing of each other."""
    noise = (total.standard_error.square() + part.standard_error.square()).sqrt()
    return ptt.reference.Estimate(total.mean - part.mean, noise)


if __name__ == "__main__":
    main()
