"""Mesh files: .ply, .obj and .stl, read through trimesh; .gltf and .glb (`ptt.scene.gltf_parts`).

A region is named after what it comes from: each material of an OBJ is one, where there are several; other files are one
region, named by the stem.

Base colour: MTL's Kd is linear and becomes the material's diffuse. Textures and vertex colours are sRGB and are
decoded; a texture stands in place of vertex colours. MTL's Ks and Ns are taken as they are, Ns within 1..200.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ptt.io.colour import from_srgb
from ptt.materials.material import Material, blinn_phong
from ptt.ops import mesh
from ptt.scene import gltf_parts
from ptt.scene.parts import Part, join, transformed
from ptt.scene.textures import Texture, from_image

FORMATS = (".ply", ".obj", ".stl", ".gltf", ".glb")  # endings of files that are read
GLTF = (".gltf", ".glb")
EXPONENTS = (1.0, 200.0)  # the range of `BRDFSpace.blinn_phong`, in which exponents from files are kept


def read_parts(path: Path) -> list[Part]:
    """The parts of a mesh file, in world space.

    PLY keeps its vertices' order and number. STL vertices at the same position are joined. An OBJ without
    normals gets smooth ones across the seams of its texture coordinates.

    Raises:
        ValueError: the file is missing, of another kind, unreadable, or has no triangles.
    """
    suffix = path.suffix.lower()
    if suffix in GLTF and path.is_file():
        return gltf_parts.read_parts(path)
    scene = _open(path)
    sources = {
        name: _part(name, geometry)
        for name, geometry in scene.geometry.items()
        if hasattr(geometry, "faces") and len(geometry.faces)
    }
    placed: dict[str, list[Part]] = {name: [] for name in sources}
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name in sources:
            placed[name].append(transformed(sources[name], _tensor(matrix)))
    parts = [join(name, instances) for name, instances in placed.items() if instances]
    if not parts:
        raise ValueError(f"path must hold triangles: {path} has no faces")
    lost = _missing_files(path) if suffix == ".obj" else []
    lost += [f"{name} (no triangles)" for name in scene.geometry if name not in sources]
    if lost:
        warnings.warn(f"{path.name} was read without {', '.join(lost)}", UserWarning, stacklevel=2)
    if len(parts) == 1:
        parts = [replace(parts[0], name=path.stem)]
    return [_per_format(part, suffix) for part in parts]


def _open(path: Path) -> Any:
    """The file as a scene of trimesh."""
    import trimesh

    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"path must end in {', '.join(FORMATS)} or .toml, got {path}")
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    try:
        return trimesh.load_scene(str(path), process=False)
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise ValueError(f"path must be a readable mesh: {path}: {type(error).__name__}: {error}") from error


def _part(name: str, geometry: Any) -> Part:
    """A mesh of trimesh as ours."""
    normals = geometry.vertex_normals if "vertex_normals" in geometry._cache else None  # the file's own only
    material, image = _material(getattr(geometry.visual, "material", None))
    uv = getattr(geometry.visual, "uv", None)
    textured = image is not None and uv is not None
    return Part(
        name,
        _tensor(geometry.vertices),
        torch.from_numpy(np.array(geometry.faces, dtype=np.int64)),
        normals=None if normals is None else _tensor(normals),
        uv=None if uv is None else _tensor(uv),
        colours=None if textured else _vertex_colours(geometry.visual),
        texture=Texture(from_image(image)) if textured else None,
        material=material,
    )


def _vertex_colours(visual: Any) -> Tensor | None:
    """Linear colours (v, 3) of trimesh's visual, None where it has none."""
    if visual.kind in ("vertex", "face"):
        colours = visual.vertex_colors
    elif (colours := getattr(visual, "vertex_attributes", {}).get("color")) is None:
        return None
    scale = np.iinfo(colours.dtype).max if colours.dtype.kind in "ui" else 1.0
    return from_srgb(_tensor(colours[:, :3]) / scale).float()


def _material(material: Any) -> tuple[Material | None, Any]:
    """A trimesh material as ours, and its base colour image."""
    image = getattr(material, "image", None)
    mtl = getattr(material, "kwargs", {})
    if mtl or (image is not None and "file_path" in image.info):  # trimesh's stand-in has neither
        diffuse = torch.as_tensor(mtl.get("kd", 1.0)).clamp(0, 1)
        specular = torch.as_tensor(mtl.get("ks", 0.0)).clamp(min=0)
        return blinn_phong(diffuse, specular, _kept_exponent(float(mtl.get("ns", 20.0)))), image
    return None, None


def _kept_exponent(exponent: float) -> float:
    least, most = EXPONENTS
    return min(max(exponent, least), most)


def _per_format(part: Part, suffix: str) -> Part:
    """The part with the vertices and normals that its format leaves to the reader."""
    if suffix == ".stl":
        vertices, faces, _ = mesh.weld(part.vertices, part.faces)
        return replace(part, vertices=vertices, faces=faces, normals=None)
    if suffix == ".obj" and part.normals is None and int(part.faces.max()) < len(part.vertices):
        vertices, faces, index = mesh.weld(part.vertices, part.faces)
        return replace(part, normals=mesh.vertex_normals(vertices, faces)[index])
    return part


def _missing_files(path: Path) -> list[str]:
    """Material libraries and textures that an OBJ names and that do not exist: trimesh passes over them."""
    missing = []
    for library in _mentions(path, "mtllib"):
        if not (path.parent / library).is_file():
            missing.append(library)
        else:
            images = _mentions(path.parent / library, "map_Kd")
            missing += [image for image in images if not (path.parent / image).is_file()]
    return missing


def _mentions(path: Path, keyword: str) -> list[str]:
    """The text after a keyword at the start of a line, for each line that has it."""
    words = [line.split(None, 1) for line in path.read_text(errors="replace").splitlines()]
    return [w[1].strip() for w in words if len(w) == 2 and w[0].lower() == keyword.lower()]


def _tensor(array: Any) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float64))
