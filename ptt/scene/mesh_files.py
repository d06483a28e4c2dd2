"""Mesh files: .gltf and .glb (`gltf_parts`), .obj (`wavefront_parts`), .ply (`ply_parts`); .stl through trimesh."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ptt.ops import mesh
from ptt.scene import gltf_parts, ply_parts, wavefront_parts
from ptt.scene.parts import Part

LARGEST = 1e18
"""Of positions, and of one over their size: squares must stay within float32."""


def read_parts(path: Path) -> list[Part]:
    """The parts of a mesh file, in world space, each of which becomes a region.

    Raises:
        ValueError: the file is missing, of another kind, damaged, has no triangles, or asks for what is not supported.
            The message names the file.
    """
    if path.suffix.lower() not in READERS:
        raise ValueError(f"path must end in {', '.join(READERS)} or .toml, got {path}")
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    try:
        parts = READERS[path.suffix.lower()](path)
        for part in parts:
            _check(part)
    except ValueError as error:
        if path.name in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error
    return parts


def _check(part: Part) -> None:
    """Refuse what the scene would, while the file's name is known."""
    vertices = part.vertices.double()
    mesh.check_mesh(vertices.float(), part.faces)
    if not any(bool(mesh.sound_faces(vertices, some).any()) for some in part.faces.split(4096)):
        raise ValueError(f"region {part.name!r} has no triangle with an area")
    largest = float(vertices.abs().max())
    size = float((vertices.amax(0) - vertices.amin(0)).max())
    if largest > LARGEST or size < 1 / LARGEST:
        raise ValueError(f"positions must lie within {LARGEST:g} and {1 / LARGEST:g}: {largest:g}, over {size:g}")
    for name, values in (("texture coordinates", part.uv), ("colours", part.colours)):
        if values is not None and (len(values) != len(vertices) or not bool(values.isfinite().all())):
            raise ValueError(f"{name} of region {part.name!r} must be finite, one row a vertex")


def _read_stl(path: Path) -> list[Part]:
    """One part; vertices at the same position are joined."""
    import trimesh

    _check_whole_stl(path)
    try:
        loaded = trimesh.load_mesh(str(path), process=False)
        corners = torch.from_numpy(np.array(loaded.triangles, dtype=np.float64))
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise ValueError(f"path must be a readable mesh: {path}: {type(error).__name__}: {error}") from error
    if not len(corners):
        raise ValueError(f"path must hold triangles: {path} has no faces")
    vertices, faces, _ = mesh.weld(corners.reshape(-1, 3), torch.arange(3 * len(corners)).reshape(-1, 3))
    return [Part(path.stem, vertices, faces)]


def _check_whole_stl(path: Path) -> None:
    """Refuse an .stl that is cut short, of which trimesh returns nothing: 84 bytes and 50 a triangle, or a text."""
    with path.open("rb") as file:
        head = file.read(84)
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 1024))
        tail = file.read()
    whole = 84 + 50 * int.from_bytes(head[80:], "little")
    if size >= whole:
        return
    if head.lstrip()[:5].lower() != b"solid":
        raise ValueError(f"{path} is cut short: {size} of {whole} bytes")
    if b"endsolid" not in tail.lower():
        raise ValueError(f"{path} is cut short: its last line is no endsolid")


READERS: dict[str, Callable[[Path], list[Part]]] = {
    ".ply": ply_parts.read_parts,
    ".obj": wavefront_parts.read_parts,
    ".stl": _read_stl,
    ".gltf": gltf_parts.read_parts,
    ".glb": gltf_parts.read_parts,
}
