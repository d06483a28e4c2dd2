"""The part of a PLY file: one region, named by the stem, with its vertices in their order.

Colours and textures are sRGB. Polygons are cut into triangles, strips too; a texture that a comment names (TextureFile,
as MeshLab writes it) lies over the coordinates of vertices, or over those of the corners of faces.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.io import ply
from ptt.io.colour import from_srgb
from ptt.materials.textures import Texture
from ptt.ops import polygons
from ptt.scene.parts import Part
from ptt.scene.textures import read_texture

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
INDICES = ("vertex_indices", "vertex_index")


def read_parts(path: Path) -> list[Part]:
    """The part of a .ply file.

    Raises:
        ValueError: the file is damaged, has no positions, or no faces.
    """
    file = ply.read(path)
    vertex = _numbers(file.elements.get("vertex", {}))
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError(f"{path} must have vertices with x, y and z")
    positions = np.stack([vertex[axis] for axis in "xyz"], 1)
    face = file.elements.get("face", {})
    if file.left:
        message = f"{path.name} was read without {file.left} bytes or words after its last element"
        warnings.warn(message, UserWarning, stacklevel=4)
    triangles, corners = _faces(path, file, positions)
    if not len(triangles):
        raise ValueError(f"path must hold triangles: {path} has no faces")
    uv = _columns(vertex, UV)
    colours = _columns(vertex, COLOURS)
    normals = _columns(vertex, (("nx", "ny", "nz"),))
    texture = _texture(path, file.comments)
    wedges = face.get("texcoord")
    if isinstance(wedges, ply.Lists) and texture is not None and len(wedges.values) == 2 * int(corners.max() + 1):
        rows, triangles, uv = _unshared(triangles, wedges.values.reshape(-1, 2)[corners])
        positions = positions[rows]
        colours, normals = (None if x is None else x[rows] for x in (colours, normals))
    textured = texture is not None and uv is not None
    return [
        Part(
            path.stem,
            torch.from_numpy(positions),
            torch.from_numpy(triangles),
            normals=None if normals is None else torch.from_numpy(normals),
            uv=None if uv is None else torch.from_numpy(uv),
            colours=None if colours is None or textured else _linear(colours, _whole(file)),
            texture=texture if textured else None,
        )
    ]


def _faces(path: Path, file: ply.File, positions: Floats) -> tuple[Ints, Ints]:
    """Triangles (f, 3), and which of the corners of all faces (f, 3) theirs are."""
    face = file.elements.get("face", {})
    lists = next((face[name] for name in INDICES if name in face), None)
    if isinstance(lists, ply.Lists) and len(lists.counts):
        indices = _checked(path, lists.values, len(positions))
        if bool((lists.counts == 3).all()):
            corners = np.arange(indices.size).reshape(-1, 3)
        else:
            corners, _ = polygons.triangulate(positions[indices], lists.counts)
        return indices[corners], corners
    strip = file.elements.get("tristrips", {}).get("vertex_indices")
    found = [np.zeros((0, 3), np.int64)]
    for indices in ply.strips(strip) if isinstance(strip, ply.Lists) else ():
        triangles = np.stack((indices[:-2], indices[1:-1], indices[2:]), 1)
        triangles[1::2] = triangles[1::2][:, [0, 2, 1]]
        found.append(triangles)
    every = _checked(path, np.concatenate(found), len(positions))
    return every, np.arange(every.size).reshape(-1, 3)


def _checked(path: Path, indices: Floats | Ints, count: int) -> Ints:
    if indices.size and not (indices.min() >= 0 and indices.max() < count):
        raise ValueError(f"{path}: faces must index {count} vertices, got {indices.min():.0f}..{indices.max():.0f}")
    whole = indices.astype(np.int64)
    if not np.array_equal(whole, indices):
        raise ValueError(f"{path}: faces must index vertices by whole numbers")
    return whole


def _numbers(element: dict[str, Floats | ply.Lists]) -> dict[str, Floats]:
    return {name: values for name, values in element.items() if isinstance(values, np.ndarray)}


def _columns(vertex: dict[str, Floats], names: tuple[tuple[str, ...], ...]) -> Floats | None:
    """The columns of the first set of names that are there."""
    found = next((own for own in names if vertex.keys() >= set(own)), None)
    return None if found is None else np.stack([vertex[name] for name in found], 1)


def _whole(file: ply.File) -> bool:
    """Tell whether the colours of vertices are whole numbers."""
    first = next(name for own in COLOURS for name in own if ("vertex", name) in file.kinds)
    return file.kinds["vertex", first][0] in "iu"


def _linear(colours: Floats, whole: bool) -> Tensor:
    """Linear colours (v, 3) of sRGB ones in 0..255, or in 0..1 where they are no whole numbers."""
    return from_srgb(torch.from_numpy(colours / 255 if whole else colours).clamp(0, 1)).float()


def _texture(path: Path, comments: list[str]) -> Texture | None:
    """The texture that a comment names, None for none."""
    names = [words[1].strip() for words in (comment.split(None, 1) for comment in comments)
             if len(words) == 2 and words[0].lower() == "texturefile"]  # fmt: skip
    if not names:
        return None
    image = path.parent / names[0].replace("\\", "/")
    if len(names) > 1 or not image.is_file():
        lost = ", ".join(names[1:] if image.is_file() else names)
        warnings.warn(f"{path.name} was read without {lost}", UserWarning, stacklevel=5)
    return read_texture(image) if image.is_file() else None


def _unshared(triangles: Ints, wedges: Floats) -> tuple[Ints, Ints, Floats]:
    """Vertices whose corners have coordinates of their own: the rows (v,) that they come from, faces, and uv (v, 2)."""
    keyed = np.concatenate((triangles.reshape(-1, 1), wedges.reshape(-1, 2)), 1)
    distinct, index = np.unique(keyed, axis=0, return_inverse=True)
    return distinct[:, 0].astype(np.int64), index.astype(np.int64).reshape(-1, 3), distinct[:, 1:].astype(np.float64)
