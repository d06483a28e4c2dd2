"""Brushed metals on the statue of bench/metals.py: narrow lobes and the paper's tensor beside the reference."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import ptt
from bench.against import without_bounces
from bench.metals_seen import Seen
from bench.table import ROOT, Table
from ptt.models.transfer_model import Highlights

BRUSHED = {
    "brushed, slopes 0.3 and 0.1": ptt.ward(0.02, 0.7, 0.3, 0.1),
    "brushed, slopes 0.5 and 0.15": ptt.ward(0.02, 0.7, 0.5, 0.15),
}


def brushed(table: Table, maps: Sequence[str], vertices: int, samples: int) -> None:
    """Rows of direct light and of all of it."""
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "suzanne.toml")
    raw = ptt.precompute(scene, 2, progress=True)
    seen = Seen(scene, vertices)
    region = scene.regions[0].name
    models = {
        kind: ptt.compress(raw, highlights=kind, editable=list(BRUSHED.values())) for kind in get_args(Highlights)
    }
    relighters = {
        kind: [ptt.TransferRelighter(which) for which in (without_bounces(model), model)]
        for kind, model in models.items()
    }
    for file in maps:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        for key, material in BRUSHED.items():
            given = {region: material}
            truth = [seen.truth(light, given, bounces, samples) for bounces in (0, 2)]
            for kind, both in relighters.items():
                what = f"brushed, {Path(file).stem}, {key.removeprefix('brushed, ')}, {kind}"
                goals = ("<= 0.04", "<= 0.06") if kind == "lobes" else ("", "")
                for part, relighter, exact, goal in zip(("direct", "total"), both, truth, goals, strict=True):
                    radiance = relighter(light, given, seen.eye)
                    seen.errors(table, f"{what}, {part}", radiance, exact, goal)
                seen.negative(table, what, both[1](light, given, seen.everywhere), goals[1])
