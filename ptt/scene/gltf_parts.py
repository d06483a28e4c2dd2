"""The parts of a glTF file: its meshes in world space, each with its material.

Each mesh is a region (each primitive of one that has several), all its instances together. What a file asks for and ptt
has no counterpart of is left out with one warning that counts it; what it needs is refused (`ptt.io.gltf`).

Khronos, glTF 2.0 specification; numbers of sections are its own.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.io import gltf
from ptt.scene.gltf_materials import Look, Materials
from ptt.scene.parts import Part, join, transformed

Matrix = NDArray[np.float64]
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of primitives (3.7.2.1); those below are points and lines


def read_parts(path: Path) -> list[Part]:
    """The parts of a .gltf or .glb file, in world space.

    Raises:
        ValueError: as `gltf.open_file`; the file is damaged, or shows no triangles.
    """
    try:
        reader = _Reader(gltf.open_file(path))
        parts = reader.parts()
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged: {type(error).__name__}: {error}") from error
    if reader.losses:
        lost = ", ".join(f"{count} x {what}" for what, count in sorted(reader.losses.items()))
        warnings.warn(f"{path.name} was read without {lost}", UserWarning, stacklevel=4)
    if not parts:
        raise ValueError(f"path must hold triangles: {path} shows none")
    return parts


class _Reader:
    """A file, and what was left out of it."""

    def __init__(self, file: gltf.File) -> None:
        self.file = file
        self.losses = Counter[str]()
        self.materials = Materials(file, self.losses)
        self.world: dict[int, Matrix] = {}

    def parts(self) -> list[Part]:
        """A part for each primitive of each mesh that the scene shows, all instances of it together."""
        for name in self.file.tree.get("extensionsUsed", []):
            if name not in gltf.SUPPORTED and not name.startswith("KHR_materials_"):
                self.losses[name] += 1
        placed: dict[tuple[int, int], list[Part]] = {}
        for index, node in self._nodes():
            if "mesh" not in node:
                continue
            for number, primitive in enumerate(self.file.item("meshes", node["mesh"])["primitives"]):
                part = self._primitive(node, primitive)
                if part is not None:
                    placed.setdefault((node["mesh"], number), []).extend(self._instances(index, node, part, primitive))
        return [join(name, placed[key]) for key, name in _names(self.file).items() if placed.get(key)]

    def _nodes(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """The nodes of the scene that are visible, with their world matrices in `world` (3.5)."""
        scenes = self.file.items("scenes")
        if scenes:
            roots = self.file.item("scenes", self.file.tree.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in self.file.items("nodes") for child in node.get("children", [])}
            roots = [index for index in range(len(self.file.items("nodes"))) if index not in children]
        waiting = [(index, np.eye(4)) for index in reversed(roots)]
        while waiting:
            index, parent = waiting.pop()
            node = self.file.item("nodes", index)
            if index in self.world:
                raise ValueError(f"{self.file.path} is damaged: node {index} has two parents, or is its own")
            with np.errstate(all="ignore"):
                self.world[index] = parent @ _local(node)
            if not np.isfinite(self.world[index]).all():
                raise ValueError(f"{self.file.path} is damaged: node {index} has no finite place")
            extensions = node.get("extensions", {})
            if not extensions.get("KHR_node_visibility", {}).get("visible", True):
                continue
            if "KHR_lights_punctual" in extensions:
                self.losses["a lamp (KHR_lights_punctual)"] += 1
            waiting += [(child, self.world[index]) for child in reversed(node.get("children", []))]
        yield from ((index, self.file.item("nodes", index)) for index in list(self.world) if self._visible(index))

    def _visible(self, index: int) -> bool:
        extensions = self.file.item("nodes", index).get("extensions", {})
        return bool(extensions.get("KHR_node_visibility", {}).get("visible", True))

    def _instances(self, index: int, node: dict[str, Any], part: Part, primitive: dict[str, Any]) -> list[Part]:
        """A part where its node, its skin or its instances place it; none where that leaves no area."""
        if "skin" in node:
            return [self._posed(part, primitive["attributes"], self.file.item("skins", node["skin"]))]
        instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        matrices = [np.eye(4)] if instancing is None else self._instance_matrices(instancing["attributes"])
        world = [self.world[index] @ matrix for matrix in matrices]
        return [transformed(part, torch.from_numpy(m)) for m in world if np.linalg.matrix_rank(m[:3, :3]) > 1]

    def _instance_matrices(self, attributes: dict[str, int]) -> list[Matrix]:
        """The matrices of EXT_mesh_gpu_instancing."""
        keys = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
        arrays = {
            name: gltf.array(self.file, index, "VEC4" if name == "ROTATION" else "VEC3").astype(np.float64)
            for name, index in attributes.items()
            if name in keys
        }
        count = min(map(len, arrays.values()))
        return [_local({key: arrays[name][k] for name, key in keys.items() if name in arrays}) for k in range(count)]

    def _posed(self, part: Part, attributes: dict[str, int], skin: dict[str, Any]) -> Part:
        """A part in the pose that its joints have in the file (3.7.3.3)."""
        joints = skin["joints"]
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            inverse = gltf.array(self.file, skin["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)
        matrices = np.stack([self.world.get(j, np.eye(4)) @ m for j, m in zip(joints, inverse, strict=True)])
        blended = np.zeros((len(part.vertices), 4, 4))
        for k in range(len(attributes)):
            if f"JOINTS_{k}" in attributes:
                which = gltf.indices(self.file, attributes[f"JOINTS_{k}"], "VEC4")
                weights = gltf.array(self.file, attributes[f"WEIGHTS_{k}"], "VEC4").astype(np.float64)
                blended += np.einsum("vj,vjab->vab", weights, matrices[which])
        homogeneous = np.concatenate((part.vertices.double().numpy(), np.ones((len(blended), 1))), 1)
        vertices = torch.from_numpy(np.einsum("vab,vb->va", blended, homogeneous)[:, :3])
        normals = None
        if part.normals is not None:
            turned = np.linalg.pinv(blended[:, :3, :3]).swapaxes(1, 2)
            normals = torch.from_numpy(np.einsum("vab,vb->va", turned, part.normals.double().numpy()))
        return replace(part, vertices=vertices, normals=normals)

    def _primitive(self, node: dict[str, Any], primitive: dict[str, Any]) -> Part | None:
        """A primitive in its own space; None where it has no triangles."""
        mode = primitive.get("mode", TRIANGLES)
        attributes = primitive["attributes"]
        if mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in attributes:
            self.losses["points or lines"] += 1
            return None
        mesh = self.file.item("meshes", node["mesh"])
        weights = node.get("weights", mesh.get("weights", []))
        vertices = self._morphed("POSITION", primitive, weights, "VEC3")
        normals = self._morphed("NORMAL", primitive, weights, "VEC3") if "NORMAL" in attributes else None
        faces = self._faces(primitive, mode, len(vertices))
        look = self.materials.of(primitive.get("material"), "COLOR_0" in attributes)
        colours = None
        if "COLOR_0" in attributes:
            given = self._morphed("COLOR_0", primitive, weights, "VEC3", "VEC4")[:, :3]
            colours = torch.from_numpy(given.clip(0, 1).astype(np.float32))
        return Part(
            mesh.get("name", ""),
            torch.from_numpy(vertices),
            torch.from_numpy(faces),
            normals=torch.from_numpy(normals) if normals is not None else None,
            uv=self._uv(primitive, weights, look),
            colours=colours,
            texture=look.texture,
            material=look.material,
            bumps=look.bumps,
            glow=look.glow,
        )

    def _morphed(
        self, name: str, primitive: dict[str, Any], weights: Sequence[float], *types: str
    ) -> NDArray[np.float64]:
        """An attribute (v, numbers) with the morph targets by their weights (3.7.2.2)."""
        values = gltf.array(self.file, primitive["attributes"][name], *types).astype(np.float64)
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if weight and name in target:
                values = values + weight * gltf.array(self.file, target[name], *types)
        return values

    def _faces(self, primitive: dict[str, Any], mode: int, count: int) -> NDArray[np.int64]:
        """The triangles (f, 3) of a primitive."""
        corners = np.arange(count)
        if "indices" in primitive:
            corners = gltf.indices(self.file, primitive["indices"], "SCALAR")[:, 0]
            if corners.max() >= count:
                raise ValueError(f"{self.file.path} is damaged: an index of {int(corners.max())} for {count} vertices")
        if mode == TRIANGLES:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if mode == FAN:
            return np.stack((corners[1:-1], corners[2:], np.full(max(len(corners) - 2, 0), corners[0])), 1)
        faces = np.stack((corners[:-2], corners[1:-1], corners[2:]), 1)
        faces[1::2] = faces[1::2][:, [0, 2, 1]]
        return faces

    def _uv(self, primitive: dict[str, Any], weights: Sequence[float], look: Look) -> Tensor | None:
        """Texture coordinates (v, 2), v up, those of its textures."""
        name = f"TEXCOORD_{look.uv_set}"
        if name not in primitive["attributes"]:
            if look.textured:
                raise ValueError(f"{self.file.path}: a texture asks for {name}, which its mesh does not have")
            return None
        uv = self._morphed(name, primitive, weights, "VEC2")
        uv = uv @ look.uv_matrix[:, :2].T + look.uv_matrix[:, 2]
        return torch.from_numpy(np.stack((uv[:, 0], 1 - uv[:, 1]), 1))


def _local(node: dict[str, Any]) -> Matrix:
    """The matrix (4, 4) of a node's matrix, or of its scale, rotation and translation (3.5.3)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    length = x * x + y * y + z * z + w * w
    if length > 0:
        s = 2 / length
        matrix[:3, :3] = (
            (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
            (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
            (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
        )
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _names(file: gltf.File) -> dict[tuple[int, int], str]:
    """A name of its own for each primitive of each mesh: that of the mesh, or the next number where it is taken."""
    from trimesh.util import unique_name  # whose numbers scene files name parts by

    names: dict[tuple[int, int], str] = {}
    counts: dict[str | None, int] = {}
    for number, mesh in enumerate(file.items("meshes")):
        for k in range(len(mesh["primitives"])):
            names[number, k] = unique_name(mesh.get("name") or file.path.stem, set(names.values()), counts)
    return names
