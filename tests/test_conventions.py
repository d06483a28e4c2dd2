"""A sky and a box with letters come out of every format as they were drawn (`bench.conventions` draws the picture)."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

import ptt
from bench import lettered_box as box
from bench import lettered_sky as sky
from ptt.light.layouts import Layout

MOST = 2e-3  # that interpolation may change of the sky's shade, where texels of a layout meet its edge
MIDDLE = 3e-5  # the same, at half of all directions: a map that lies half a texel off changes 30 times as much
BYTES = 2**-7  # what the eight bits of .hdr cut off, of the brightest channel
NOISE = 1e-2  # of a paint's mean over some 20 pixels of 144 paths, three standard errors
SIZE = 64
LAYOUTS = [layout for layout in get_args(Layout) if layout != "auto"]


@pytest.mark.parametrize("ending", ["exr", "hdr"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_skies_are_alike(tmp_path: Path, layout: Layout, ending: str) -> None:
    light = ptt.Environment.load(sky.write(tmp_path, layout, ending), layout=layout)
    directions = sky.clear_directions(4000)
    errors = sky.errors(light.radiance(directions), directions)
    cut = BYTES if ending == "hdr" else 0
    assert float(errors.max()) < MOST + cut
    assert float(errors.median()) < MIDDLE + cut / 2


def test_every_letter_is_compared() -> None:
    """Each of the six letters, and the ground of each."""
    face, x, y = sky.flattened(sky.clear_directions(4000))
    letter = sky.looked_up(sky.glyphs(sky.FINE), face, x, y)
    assert int(torch.bincount(face + 6 * letter, minlength=12).min()) > 20


def test_another_sky_is_seen() -> None:
    """A mirror image, another half turn, rows from below, and a shift by half a texel."""
    stored = sky.image("latlong")
    directions = sky.clear_directions(4000)
    shifted = (stored + stored.roll(1, 1)) / 2
    for other in (stored.flip(1), stored.roll(256, 1), stored.flip(0)):
        assert float(sky.errors(ptt.Environment(other).radiance(directions), directions).max()) > 0.5
    assert float(sky.errors(ptt.Environment(shifted).radiance(directions), directions).median()) > 10 * MIDDLE


def cameras() -> list[ptt.Camera]:
    return [replace(camera, width=SIZE, height=SIZE) for camera in box.VIEWS]


@pytest.mark.parametrize("ending", box.WRITERS)
def test_boxes_are_alike(tmp_path: Path, ending: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = ptt.load_scene(box.WRITERS[ending](tmp_path))
    for camera in cameras():
        assert box.difference(box.traced(scene, camera), camera) < NOISE


def test_another_box_is_seen(tmp_path: Path) -> None:
    """Texture coordinates whose v runs down, a mirror image, and sides that change places."""
    scene = ptt.load_scene(box.write_obj(tmp_path))
    assert scene.uv is not None
    x, y, z = (scene.vertices - box.CENTRE.float()).unbind(1)
    others = [
        replace(scene, uv=torch.stack((scene.uv[:, 0], 1 - scene.uv[:, 1]), 1)),
        replace(scene, vertices=torch.stack((-x, y, z), 1) + box.CENTRE.float(), faces=scene.faces.flip(1)),
        replace(scene, vertices=torch.stack((z, y, -x), 1) + box.CENTRE.float()),
    ]
    for other in others:
        assert max(box.difference(box.traced(other, camera, 4), camera) for camera in cameras()) > 0.1


def test_mitsuba_agrees(tmp_path: Path) -> None:
    """Its sky and boxes read by ptt, ptt's sky and the same boxes shown by Mitsuba, and ptt's camera there and back."""
    mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install mitsuba")
    from bench import conventions

    mi.set_variant("scalar_rgb")
    for column in conventions.mitsuba_skies(tmp_path, 8):
        assert column.difference is not None and column.difference < MOST, column.title
    for column in conventions.mitsuba_boxes(tmp_path, SIZE):
        assert column.difference is not None and column.difference < NOISE, column.title
    camera = replace(box.VIEWS[0], width=40, height=30)
    read = ptt.from_mitsuba({"type": "scene", "box": {"type": "cube"}, "sensor": conventions.sensor(camera)}).camera
    for ours, theirs in zip(camera.rays(), read.rays(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6)
