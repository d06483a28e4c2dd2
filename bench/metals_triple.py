"""The metals of bench/metals.py by `TripleProductRelighter` at its defaults: direct light beside the reference, at
vertices and in pixels, and what the paper's triangles make of it; frames a second of both."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import get_args

import torch

import ptt
from bench.metals_seen import Seen
from bench.metals_speed import GOLD
from bench.table import ROOT, Table, median_seconds, setting
from ptt import reference
from ptt.models.cache import Cache
from ptt.relight.triple_relighter import Highlights

GOALS = {"gold, roughness 0.1": "<= 0.08"}  # the others have 0.05
MATT = ptt.lambert(0.5)
NUMBERS = count(1)  # no two frames are alike


def direct(
    table: Table, materials: Mapping[str, ptt.Material], maps: Sequence[str], vertices: int, samples: int
) -> None:
    """Rows of one statue under some maps."""
    scene = ptt.load_scene(ROOT / "scripts" / "configs" / "suzanne.toml")
    relighters = {kind: ptt.TripleProductRelighter(scene, highlights=kind) for kind in get_args(Highlights)}
    seen = Seen(scene, vertices)
    region = scene.regions[0].name
    for file in maps:
        light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / file)
        for key, material in {**materials, "matt": MATT}.items():
            given = {region: material}
            truth = seen.truth(light, given, 0, samples)
            what = f"triple, {Path(file).stem}, {key}"
            seen.errors(table, what, relighters["lobes"](light, given, seen.eye), truth, GOALS.get(key, "<= 0.05"))
        _brightness(table, f"triple, {Path(file).stem}, matt, pixels", relighters, light, samples // 8)
    _frames(table, relighters)
    if samples > 64:
        _picture(relighters)


def _picture(relighters: Mapping[str, ptt.TripleProductRelighter]) -> None:
    """Gold on a matt table under grace: the reference, lobes, triangles."""
    scene = relighters["lobes"].scene
    light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / "grace.hdr")
    given = {scene.regions[0].name: ptt.ggx(0.0, 1.0, GOLD, 0.25), scene.regions[1].name: MATT}
    pixels = ptt.GBuffer.of(scene, replace(scene.camera, width=400, height=360))
    exact = reference.image(scene, light, given, pixels.camera, bounces=0, samples=512).mean.float()
    shown = [pixels.image(relighter(light, given, pixels), light).pixels for relighter in relighters.values()]
    picture = torch.cat([exact, *shown], 1)
    ptt.Image((picture / exact.flatten().quantile(0.97)).clamp(0, 1)).save(
        ROOT / "docs" / "images" / "metals_triple.png"
    )


def _brightness(
    table: Table,
    what: str,
    relighters: Mapping[str, ptt.TripleProductRelighter],
    light: ptt.Environment,
    samples: int,
) -> None:
    """How much brighter a matt picture is than the reference's, in all."""
    scene = relighters["lobes"].scene
    camera = replace(scene.camera, width=160, height=120)
    given = {region.name: MATT for region in scene.regions}
    pixels = ptt.GBuffer.of(scene, camera)
    truth = reference.image(scene, light, given, camera, bounces=0, samples=samples).mean.flatten(0, 1)[pixels.pixel]
    for kind, relighter in relighters.items():
        brighter = float(relighter(light, given, pixels).mean() / truth.mean()) - 1
        how = f"{len(pixels.pixel)} pixels, {samples} samples each"
        table.row(f"{what}, {kind}, brighter by", brighter, "of the mean", how, "<= 0.02" if kind == "lobes" else "")


def _frames(table: Table, relighters: Mapping[str, ptt.TripleProductRelighter]) -> None:
    """Frames a second at 1024 x 768: the eye moves, the G-buffer stays; a light that turns; a material."""
    scene = relighters["lobes"].scene
    light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / "grace.hdr")
    region = scene.regions[0].name
    pixels = ptt.GBuffer.of(scene, replace(scene.camera, width=1024, height=768))
    for kind, relighter in relighters.items():

        def frame(turn: float, shift: float, relighter: ptt.TripleProductRelighter = relighter) -> None:
            relighter._viewed = Cache()  # another eye
            relighter(light.rotated(y=turn), {region: ptt.ggx(0.0, 1.0, GOLD, 0.3 + shift)}, pixels)

        frames: dict[str, Callable[[], None]] = {
            "view": partial(frame, 0, 0),
            "view and light": lambda: frame(next(NUMBERS), 0),
            "view and BRDF": lambda: frame(0, 1e-4 * (next(NUMBERS) % 100)),
        }
        for step, function in frames.items():
            how = f"{len(pixels.pixel)} pixels of 1024 x 768 in gold of roughness 0.3 and on a floor; {setting()}"
            table.row(f"triple, frames, {kind}, {step}", 1 / median_seconds(function, 5), "frames/s", how)
