"""One sky and one box with letters, through every format and Mitsuba: they come out alike, and a picture shows it.

python -m bench.conventions            # prints the largest differences, draws docs/images/conventions.png
python -m bench.conventions --quick    # without the picture
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import torch
from torch import Tensor

import ptt
from bench import lettered_box as box
from bench import lettered_sky as sky
from bench.lettered_sky import SAMPLES, reduced
from bench.mitsuba_check import mitsuba_light
from bench.table import ROOT
from ptt.light.layouts import Layout

PICTURE = ROOT / "docs" / "images" / "conventions.png"
FLAT = 0.64  # height of the sky's views, in widths of the chart's panels
DIRECTIONS = 2000  # in which skies are compared
SIZE = 188  # of the chart's panels, in pixels
COLUMNS = 8
GAP = 8  # pixels between panels
LEGEND = """right-handed, +y up,
a camera looks along -z

R  right   +x
L  left      -x
U  up        +y
D  down   -y
B  back    +z
F  front    -z"""
FILES: tuple[tuple[Layout, str], ...] = (
    ("latlong", "exr"),
    ("latlong", "hdr"),
    ("cross", "exr"),
    ("angular", "hdr"),
    ("octahedral", "exr"),
)
LINE = 0.15  # height of a line of text, in widths of a panel
STORED = (*(layout for layout, _ in FILES), "poles", "latlong")  # in the columns of the chart, but for the first


Pictures = Sequence[PIL.Image.Image | None]


class Column(NamedTuple):
    """What came out of one way in.

    title: of the way; views: pictures (h, w, 3), linear
    difference: the largest from what was drawn, which has none: of skies `errors`, of boxes `lettered_box.difference`
    """

    title: str
    views: list[Tensor]
    difference: float | None = None


# --- Skies


def sky_cameras(size: int) -> list[ptt.Camera]:
    """Views of the sky from its middle, each at a letter, half as wide as a panel."""
    shape: dict[str, Any] = {"fov": 100, "width": size // 2, "height": round(FLAT * size)}
    ways = zip(sky.AHEAD.tolist(), sky.UP.tolist(), strict=True)
    return [ptt.Camera((0, 0, 0), ahead, up, **shape) for ahead, up in ways]


def in_pairs(views: list[Tensor]) -> list[Tensor]:
    """The views of `sky_cameras` as pictures of two letters."""
    return [torch.cat(pair, 1) for pair in zip(views[::2], views[1::2], strict=True)]


def sky_column(
    title: str, radiance: Callable[[Tensor], Tensor], cameras: list[ptt.Camera], exact: bool = False
) -> Column:
    """Views of a sky whose radiance (..., 3) from directions (..., 3) is given."""
    views = [reduced(radiance(box.finer(camera).rays()[1].double()).double()) for camera in cameras]
    directions = sky.clear_directions(DIRECTIONS)
    largest = None if exact else float(sky.errors(radiance(directions), directions).max())
    return Column(title, in_pairs(views), largest)


def skies(folder: Path, size: int) -> list[Column]:
    """The sky itself, and as ptt reads it from each file."""
    cameras = sky_cameras(size)
    columns = [sky_column("the sky itself", sky.sky, cameras, exact=True)]
    for layout, ending in FILES:
        light = ptt.Environment.load(sky.write(folder, layout, ending), layout=layout)
        columns.append(sky_column(f"{layout} .{ending}", light.radiance, cameras))
    return columns


def mitsuba_skies(folder: Path, size: int) -> list[Column]:
    """Mitsuba's sky as ptt reads it, and ptt's as Mitsuba shows it."""
    cameras = sky_cameras(size)
    theirs = {"type": "envmap", "filename": str(sky.write(folder, "poles", "exr"))}
    read = ptt.from_mitsuba({"type": "scene", "light": theirs, "shape": {"type": "rectangle"}}).environment
    assert read is not None
    ours = mitsuba_light(ptt.Environment.load(sky.write(folder, "latlong", "exr")))
    views = [rendered({"light": ours}, camera, box.PATHS) for camera in cameras]
    directions = sky.clear_directions(DIRECTIONS)
    largest = max(float(sky.errors(mitsuba_sky(light, directions), directions).max()) for light in (ours, theirs))
    return [
        sky_column("Mitsuba's, in ptt", read.radiance, cameras),
        Column("ptt's, in Mitsuba", in_pairs(views), largest),
    ]


def mitsuba_sky(light: Mapping[str, Any], directions: Tensor) -> Tensor:
    """Radiance (n, 3) from directions (n, 3) by Mitsuba's own evaluation of a light."""
    emitter = mi.load_dict(dict(light))
    at = mi.SurfaceInteraction3f()
    values = []
    for x, y, z in directions.tolist():
        at.wi = mi.Vector3f(-x, -y, -z)
        values.append(np.array(emitter.eval(at)))
    return torch.from_numpy(np.array(values))


# --- Boxes


def box_cameras(size: int) -> list[ptt.Camera]:
    """Square views of the box."""
    return [replace(camera, width=size, height=size) for camera in box.VIEWS]


def box_column(title: str, scene: ptt.Scene, cameras: list[ptt.Camera]) -> Column:
    """The reference's views of a box."""
    return compared(title, [box.traced(scene, camera) for camera in cameras], cameras)


def compared(title: str, views: list[Tensor], cameras: list[ptt.Camera]) -> Column:
    """Views of a box with how far they are from what is painted on it."""
    return Column(title, views, max(map(box.difference, views, cameras)))


def boxes(folder: Path, size: int) -> list[Column]:
    """The box itself, and as ptt reads it from each file."""
    cameras = box_cameras(size)
    columns = [Column("the box itself", [reduced(box.painted(box.finer(camera))) for camera in cameras])]
    for ending, write_box in box.WRITERS.items():
        columns.append(box_column(f".{ending}", ptt.load_scene(write_box(folder)), cameras))
    return columns


def mitsuba_boxes(folder: Path, size: int) -> list[Column]:
    """Mitsuba's box as ptt reads it, and as Mitsuba shows it."""
    cameras = box_cameras(size)
    columns = []
    for ending, shape in mitsuba_shapes(folder).items():
        scene = ptt.from_mitsuba({"type": "scene", "box": shape})
        columns.append(box_column(f"Mitsuba's .{ending}, in ptt", scene, cameras))
    for ending, shape in mitsuba_shapes(folder).items():
        lit = {"box": shape, "light": {"type": "constant", "radiance": 1.0}}
        views = [rendered(lit, camera, box.PATHS * SAMPLES**2) for camera in cameras]
        columns.append(compared(f".{ending}, in Mitsuba", views, cameras))
    return columns


def mitsuba_shapes(folder: Path) -> dict[str, dict[str, Any]]:
    """The box for Mitsuba: of an .obj file it turns v over, of a .ply file where it is asked to."""
    box.write_obj(folder)
    box.write_ply(folder)
    look = {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": str(folder / "atlas.png")}}
    return {
        "obj": {"type": "obj", "filename": str(folder / "box.obj"), "bsdf": look},
        "ply": {"type": "ply", "filename": str(folder / "box.ply"), "flip_tex_coords": True, "bsdf": look},
    }


# --- Both


def sensor(camera: ptt.Camera) -> dict[str, Any]:
    """ptt's camera as one of Mitsuba's."""
    look = mi.ScalarTransform4f().look_at(camera.eye, camera.target, camera.up)
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    return {"type": "perspective", "to_world": look, "fov": camera.fov, "fov_axis": "y", "film": film}


def rendered(scene: Mapping[str, Any], camera: ptt.Camera, paths: int) -> Tensor:
    """Mitsuba's picture (h, w, 3) of a scene through ptt's camera."""
    path = {"type": "path", "max_depth": 2}
    loaded = mi.load_dict({"type": "scene", "integrator": path, "sensor": sensor(camera), **scene})
    return torch.from_numpy(np.array(mi.render(loaded, spp=paths))[..., :3]).double()


# --- The chart


def chart(of_skies: list[Column], of_boxes: list[Column], size: int) -> PIL.Image.Image:
    """The picture: the files of the sky, views of each sky, two views of each box."""
    stored = [None, *(stored_image(layout, size) for layout in STORED)]
    page = PIL.Image.new("RGB", (COLUMNS * (size + GAP) + GAP, 8 * size), "white")
    write(page, LEGEND, (GAP, round(LINE * size)), size)
    top = block(page, 0, of_skies, [stored], size)
    top = block(page, top, of_boxes, [], size)
    return page.crop((0, 0, page.width, top))


def block(page: PIL.Image.Image, top: int, columns: list[Column], rows: list[Pictures], size: int) -> int:
    """Draw the titles of columns, then rows of pictures and those of their views; where the next block begins."""
    for k, column in enumerate(columns):
        write(page, column.title, (GAP + k * (size + GAP), top + GAP // 2), size)
    top += round(LINE * size)
    for row in [*rows, *zip(*[map(shown, column.views) for column in columns], strict=True)]:
        height = max(picture.height for picture in row if picture is not None)
        for k, picture in enumerate(row):
            if picture is not None:
                page.paste(picture, (GAP + k * (size + GAP), top + (height - picture.height) // 2))
        top += height + GAP
    return top


def write(page: PIL.Image.Image, text: str, place: tuple[int, int], size: int) -> None:
    """Write lines of text below and to the right of a place."""
    font = PIL.ImageFont.load_default(size * 0.082)
    PIL.ImageDraw.Draw(page).multiline_text(place, text, "black", font, spacing=size * 0.02)


def shown(linear: Tensor) -> PIL.Image.Image:
    """A linear picture (h, w, 3), clipped to 1."""
    return PIL.Image.fromarray(box.to_bytes(linear.double().clamp(0, 1)))


def stored_image(layout: str, size: int) -> PIL.Image.Image:
    """The sky's image in a layout, within a square."""
    picture = shown(sky.image(layout))
    scale = size / max(picture.size)
    width, height = (round(scale * x) for x in picture.size)
    centred = PIL.Image.new("RGB", (size, height), "white")
    centred.paste(picture.resize((width, height), PIL.Image.Resampling.BOX), ((size - width) // 2, 0))
    return centred


def differences(columns: list[Column]) -> dict[str, float]:
    """The largest difference of each way in."""
    return {column.title: column.difference for column in columns if column.difference is not None}


def main(quick: bool = False) -> dict[str, dict[str, float]]:
    """Compare everything, and draw the picture unless it is to be quick; the largest differences."""
    mi.set_variant("scalar_rgb")
    size = 48 if quick else SIZE
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        of_skies = skies(place, size) + mitsuba_skies(place, size)
        of_boxes = boxes(place, size) + mitsuba_boxes(place, size)
    if not quick:
        chart(of_skies, of_boxes, size).quantize(256, dither=PIL.Image.Dither.NONE).save(PICTURE, optimize=True)
    found = {"sky": differences(of_skies), "box": differences(of_boxes)}
    for what, rows in found.items():
        for title, value in rows.items():
            print(f"{what}, {title}: {value:.2g}")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="compare smaller pictures, and draw none")
    main(**vars(parser.parse_args()))
