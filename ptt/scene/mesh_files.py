"""Mesh files: .gltf and .glb (`gltf_parts`), .obj (`wavefront_parts`), .ply (`ply_parts`); .stl through trimesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ptt.ops import mesh
from ptt.scene import gltf_parts, ply_parts, wavefront_parts
from ptt.scene.parts import Part


def read_parts(path: Path) -> list[Part]:
    """The parts of a mesh file, in world space, each of which becomes a region.

    Raises:
        ValueError: the file is missing, of another kind, damaged, has no triangles, or asks for what is not supported.
    """
    if path.suffix.lower() not in READERS:
        raise ValueError(f"path must end in {', '.join(READERS)} or .toml, got {path}")
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    return READERS[path.suffix.lower()](path)


def _read_stl(path: Path) -> list[Part]:
    """One part; vertices at the same position are joined."""
    import trimesh

    try:
        loaded = trimesh.load_mesh(str(path), process=False)
        corners = torch.from_numpy(np.array(loaded.triangles, dtype=np.float64))
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise ValueError(f"path must be a readable mesh: {path}: {type(error).__name__}: {error}") from error
    if not len(corners):
        raise ValueError(f"path must hold triangles: {path} has no faces")
    vertices, faces, _ = mesh.weld(corners.reshape(-1, 3), torch.arange(3 * len(corners)).reshape(-1, 3))
    return [Part(path.stem, vertices, faces)]


READERS: dict[str, Callable[[Path], list[Part]]] = {
    ".ply": ply_parts.read_parts,
    ".obj": wavefront_parts.read_parts,
    ".stl": _read_stl,
    ".gltf": gltf_parts.read_parts,
    ".glb": gltf_parts.read_parts,
}
