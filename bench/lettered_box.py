"""A box with a letter on each of six sides, by one texture, as files of each format; and what rays see of it.

The letters and colours are those of `bench.lettered_sky`, by axis. Each is upright as seen from outside with +y up; U
is upright as seen from above by who stands at +z, D as seen from below.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray
from torch import Tensor

import ptt
from bench.lettered_sky import AHEAD, COLOURS, SAMPLES, glyphs, looked_up, reduced
from ptt import Camera

NORMALS = AHEAD
UP = torch.tensor([(0, 1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1), (0, 1, 0), (0, 1, 0)], dtype=torch.float64)
RIGHT = torch.linalg.cross(UP, NORMALS)
CENTRE = torch.tensor([0.2, 0.3, -0.1], dtype=torch.float64)
HALF = torch.tensor([0.6, 0.5, 0.4], dtype=torch.float64)  # half the lengths of the edges along x, y and z
LETTER = 0.9  # albedo of the letters
CELL = 128  # texels along the edge of a side in the atlas, which has three columns and two rows of them
CELLS = tuple((column, row) for row in (0, 1) for column in (0, 1, 2))  # columns and rows of the sides R to F
PATHS = 16  # of a ray, of which a pixel has SAMPLES x SAMPLES
VIEWS = tuple(Camera((0.2 + s * 1.5, 0.3 + s * 1.3, -0.1 + s * 2.0), tuple(CENTRE.tolist()), fov=36) for s in (1, -1))
"""Cameras that see R, U, B and L, D, F."""


def to_bytes(linear: Tensor) -> NDArray[np.uint8]:
    """Linear values as sRGB bytes (IEC 61966-2-1)."""
    curve = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (curve * 255).round().to(torch.uint8).numpy()


def to_linear(values: NDArray[np.uint8]) -> Tensor:
    """sRGB bytes as linear values."""
    curve = torch.from_numpy(values).double() / 255
    return torch.where(curve <= 0.04045, curve / 12.92, ((curve + 0.055) / 1.055) ** 2.4)


PAINT = to_linear(to_bytes(torch.cat((COLOURS, torch.full((1, 3), LETTER, dtype=torch.float64)))))
"""Albedos (7, 3) of the six sides and of the letters, as bytes hold them."""


def atlas() -> NDArray[np.uint8]:
    """The texture, sRGB, row 0 on top."""
    y, x = torch.meshgrid(-_middles(CELL), _middles(CELL), indexing="ij")
    cells = []
    for side in range(6):
        letter = looked_up(glyphs(CELL), torch.full_like(x, side, dtype=torch.int64), x, y)
        cells.append(PAINT[torch.where(letter, 6, side)])
    rows = [torch.cat(cells[:3], 1), torch.cat(cells[3:], 1)]
    return to_bytes(torch.cat(rows))


def _middles(count: int) -> Tensor:
    """Middles (count,) of equal steps from -1 to 1."""
    return (torch.arange(count, dtype=torch.float64) + 0.5) * (2 / count) - 1


def corners() -> tuple[Tensor, Tensor, Tensor]:
    """Positions and normals (24, 3) of the sides' corners, and uv (24, 2) with v down; the lower left first, around."""
    x = torch.tensor([-1.0, 1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    y = torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64)[:, None]
    positions = torch.cat([NORMALS[side] + x * RIGHT[side] + y * UP[side] for side in range(6)]) * HALF + CENTRE
    cells = [torch.cat((column + (x + 1) / 2, row + (1 - y) / 2), 1) for column, row in CELLS]
    uv = torch.cat(cells) / torch.tensor([3.0, 2.0], dtype=torch.float64)
    return positions, NORMALS.repeat_interleave(4, 0), uv


FACES = [(4 * side + a, 4 * side + b, 4 * side + c) for side in range(6) for a, b, c in ((0, 1, 2), (0, 2, 3))]
"""Triangles, counter-clockwise as seen from outside."""


# --- Files


def write_png(folder: Path) -> Path:
    """The atlas as an image of its own."""
    path = folder / "atlas.png"
    PIL.Image.fromarray(atlas()).save(path)
    return path


def write_glb(folder: Path) -> Path:
    """glTF in one file: v runs down from the image's top."""
    positions, normals, uv = (values.float().numpy() for values in corners())
    blobs = [positions, normals, uv, np.array(FACES, np.uint16)]
    data = b"".join(blob.tobytes() for blob in blobs)
    starts = np.cumsum([0, *(blob.nbytes for blob in blobs)]).tolist()
    picture = write_png(folder).read_bytes()
    views = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(starts)]
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)})
    data += picture + bytes(-len(picture) % 4)
    accessors = [
        {"bufferView": number, "componentType": 5126, "count": 24, "type": kind}
        for number, kind in enumerate(("VEC3", "VEC3", "VEC2"))
    ]
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    accessors.append({"bufferView": 3, "componentType": 5123, "count": 3 * len(FACES), "type": "SCALAR"})
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"name": "box", "primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    path = folder / "box.glb"
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(header + chunks)
    return path


def write_obj(folder: Path) -> Path:
    """Wavefront, with a library and an image: v runs up from the image's foot, numbers start at 1."""
    positions, normals, uv = corners()
    lines = ["mtllib box.mtl", "usemtl box"]
    lines += [f"v {x} {y} {z}" for x, y, z in positions.tolist()]
    lines += [f"vn {x} {y} {z}" for x, y, z in normals.tolist()]
    lines += [f"vt {u} {1 - v}" for u, v in uv.tolist()]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}/{k + 1}" for k in face) for face in FACES]
    (folder / "box.mtl").write_text(f"newmtl box\nKd 1 1 1\nKs 0 0 0\nmap_Kd {write_png(folder).name}\n")
    path = folder / "box.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_ply(folder: Path) -> Path:
    """PLY as text, with an image that a comment names and no normals: v runs up from the image's foot."""
    positions, _, uv = corners()
    lines = ["ply", "format ascii 1.0", f"comment TextureFile {write_png(folder).name}", "element vertex 24"]
    lines += [f"property float {name}" for name in "xyzst"]
    lines += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows = zip(positions.tolist(), uv.tolist(), strict=True)
    lines += [f"{x} {y} {z} {u} {1 - v}" for (x, y, z), (u, v) in rows]
    lines += [f"3 {a} {b} {c}" for a, b, c in FACES]
    path = folder / "box.ply"
    path.write_text("\n".join(lines) + "\n")
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {"glb": write_glb, "obj": write_obj, "ply": write_ply}


# --- What is seen


def seen(camera: Camera) -> Tensor:
    """The albedo (height, width) that a camera's pixels' centres see, as a row of PAINT; -1 beside the box."""
    eye, directions = (values.double() for values in camera.rays())
    start = (eye - CENTRE) / HALF
    step = directions / HALF
    enter = (-step.sign() - start) / step  # distances to the planes of the sides that face the eye
    axis = enter.argmax(-1)
    place = start + step * enter.amax(-1, keepdim=True)
    side = 2 * axis + (step.gather(-1, axis[..., None])[..., 0] > 0)
    letter = looked_up(glyphs(CELL), side, (place * RIGHT[side]).sum(-1), (place * UP[side]).sum(-1))
    paint = torch.where(letter, 6, side)
    return torch.where((place.abs() <= 1 + 1e-9).all(-1), paint, -1)


def painted(camera: Camera) -> Tensor:
    """The picture (height, width, 3) under a constant light of 1: a matt convex box sends out its albedo."""
    return torch.cat((PAINT, torch.ones(1, 3, dtype=torch.float64)))[seen(camera)]


def difference(view: Tensor, camera: Camera) -> float:
    """The largest error of a paint's mean in a picture (height, width, 3) under that light; 1 for a wrong picture.

    Pixels count that see one paint, those around them too; the picture is wrong where one is nearer to another paint.
    """
    fine = seen(finer(camera)).double()
    around = torch.nn.functional.pad(fine[None], [SAMPLES] * 4, value=-1)
    highest = torch.nn.functional.max_pool2d(around, 3 * SAMPLES, SAMPLES)[0]
    lowest = -torch.nn.functional.max_pool2d(-around, 3 * SAMPLES, SAMPLES)[0]
    one = (highest == lowest) & (highest >= 0)
    pixels = view[one].double()
    paint = highest[one].long()
    if not torch.equal(torch.cdist(pixels, PAINT).argmin(1), paint):
        return 1.0
    return max(float((pixels[paint == k].mean(0) - PAINT[k]).abs().max()) for k in paint.unique().tolist())


def finer(camera: Camera) -> Camera:
    """A camera with SAMPLES rays along each side of a pixel."""
    return replace(camera, width=camera.width * SAMPLES, height=camera.height * SAMPLES)


def traced(scene: ptt.Scene, camera: Camera, paths: int = PATHS) -> Tensor:
    """The reference's picture (height, width, 3) of a box that is matt, under that light."""
    matt = {region.name: ptt.lambert(1.0) for region in scene.regions}
    light = ptt.Environment.constant(1.0)
    return reduced(ptt.reference.image(scene, light, matt, finer(camera), samples=paths).mean)
