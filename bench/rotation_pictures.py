"""Pictures of rotated light, and of what is lit by it: Figures 7 and 1 of Wang et al. 2006."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

import ptt
from bench.table import ROOT
from ptt import reference

IMAGES = ROOT / "docs" / "images"
MATERIALS = ("yellow-plastic", "blue-metallic-paint", "nickel", "pickled-oak-260")


def maps(name: str, rows: list[list[Tensor]], size: int = 160) -> None:
    """Local maps side by side, one row below the other, each row at its own exposure."""
    strips = []
    for row in rows:
        image = ptt.Image(torch.cat(row, 1))
        enlarged = image.pixels.repeat_interleave(size // len(row[0]) or 1, 0).repeat_interleave(
            size // len(row[0]) or 1, 1
        )
        strips.append(enlarged * 2.0 ** ptt.Image(row[0]).exposure())
    ptt.Image(torch.cat(strips)).save(IMAGES / f"{name}.png")


def figure_1(scene: ptt.Scene, lights: dict[str, ptt.Environment]) -> None:
    """Four materials under two maps: relit per pixel, the reference without shadows, their difference times four."""
    assert scene.camera is not None
    camera = replace(scene.camera, width=320, height=240)
    pixels = ptt.GBuffer.of(scene, camera)
    rotate = ptt.LightRotation.build(128, 32)
    relighter = ptt.EnvMapRelighter(scene, rotate)
    shaded = ptt.EnvMapRelighter(scene, rotate, occlusion=ptt.ambient_occlusion(scene))
    region = scene.regions[0].name
    points = reference.Points(pixels.positions, pixels.frames, pixels.region, pixels.colours)
    wo = camera.toward(pixels.positions)
    columns = []
    for name in MATERIALS:
        given = {region: ptt.fitted(name)}
        strip = []
        for light in lights.values():
            relit = relighter(light, given, pixels)
            truth = reference.unshadowed(scene, light, given, points, wo, samples=256).mean.float()
            gain = 2.0 ** pixels.image(truth, light).exposure()
            strip += [pixels.image(x, light).pixels * gain for x in (shaded(light, given, pixels), relit, truth)]
            strip.append(pixels.image(4 * (relit - truth).abs()).pixels * gain)
        columns.append(torch.cat(strip))
    ptt.Image(torch.cat(columns, 1)).save(IMAGES / "rotation_figure1.png")
