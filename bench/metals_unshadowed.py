"""The metals of bench/metals.py by `EnvMapRelighter` at its defaults, beside the reference without shadows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import ptt
from bench.metals_seen import Seen
from bench.table import ROOT, Table

GOALS = {"gold, roughness 0.1": "<= 0.08"}  # the others have 0.05


def unshadowed(
    table: Table, materials: Mapping[str, ptt.Material], maps: Sequence[str], vertices: int, samples: int
) -> None:
    """Rows of one statue under some maps."""
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "suzanne.toml")
    relighter = ptt.EnvMapRelighter(scene)
    seen = Seen(scene, vertices)
    region = scene.regions[0].name
    for file in maps:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        for key, material in materials.items():
            given = {region: material}
            truth = seen.unshadowed(light, given, samples)
            what = f"unshadowed, {Path(file).stem}, {key}"
            seen.errors(table, what, relighter(light, given, seen.eye), truth, GOALS.get(key, "<= 0.05"))
