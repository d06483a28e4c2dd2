"""glTF files that are damaged in one way, in their tree, their buffer or their container."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench.generated_files import Case
from bench.generated_gltf import Tree, data_uri, glb


def broken(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A quad, damaged in one way."""
    tree, blob = _quad()
    damage = DAMAGES[number % len(DAMAGES)]
    path = folder / f"broken {number}.{'glb' if damage in FILES or number % 2 else 'gltf'}"
    if damage in TREES:
        blob = TREES[damage](tree, blob) or blob
    if path.suffix == ".glb":
        data = glb(json.dumps(tree).encode(), blob)
        path.write_bytes(FILES[damage](data, random) if damage in FILES else data)
    else:
        tree["buffers"][0]["uri"] = data_uri("application/gltf-buffer", blob)
        path.write_text(json.dumps(tree))
    return Case(path, None, damage=damage)


def _quad() -> tuple[Tree, bytes]:
    """A textured quad, which is valid, and its buffer."""
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], "<f4")
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
    indices = np.array([0, 1, 2, 0, 2, 3], "<u2")
    buffer = io.BytesIO()
    Image.new("RGB", (2, 2), (255, 0, 0)).save(buffer, "PNG")
    pieces = [corners.tobytes(), uv.tobytes(), indices.tobytes(), buffer.getvalue()]
    starts = np.cumsum([0, *map(len, pieces)]).tolist()
    views = [{"buffer": 0, "byteOffset": start, "byteLength": len(piece)}
             for start, piece in zip(starts, pieces, strict=False)]  # fmt: skip
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    tree: Tree = {
        "asset": {"version": "2.0"}, "bufferViews": views, "accessors": accessors, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}], "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}], "buffers": [{"byteLength": starts[-1]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    }  # fmt: skip
    return tree, b"".join(pieces)


def _set(*keys: Any, to: Any) -> Callable[[Tree, bytes], None]:
    """Damage: a value somewhere in the tree."""

    def change(tree: Any, _: bytes) -> None:
        for key in keys[:-1]:
            tree = tree.setdefault(key, {}) if isinstance(tree, dict) else tree[key]
        tree[keys[-1]] = to

    return change


def _without(*keys: Any) -> Callable[[Tree, bytes], None]:
    """Damage: a value that is missing."""

    def change(tree: Any, _: bytes) -> None:
        for key in keys[:-1]:
            tree = tree[key]
        del tree[keys[-1]]

    return change


def _number(value: float, at: int) -> Callable[[Tree, bytes], bytes]:
    """Damage: a number in the buffer."""
    return lambda _, blob: blob[:at] + struct.pack("<f", value) + blob[at + 4 :]


PRIMITIVE = ("meshes", 0, "primitives", 0)
SPARSE = {"count": 2, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 0}}
BEYOND = {"bufferView": 1, "componentType": 5125}
FRACTIONS = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "SCALAR"}
TREES: dict[str, Callable[[Tree, bytes], bytes | None]] = {
    "a count too high": _set("accessors", 0, "count", to=5),
    "an endless count": _set("accessors", 0, "count", to=10**12),
    "a count below one": _set("accessors", 2, "count", to=0),
    "a count that is a word": _set("accessors", 0, "count", to="4"),
    "a count that is no whole number": _set("accessors", 0, "count", to=3.5),
    "an unknown type of numbers": _set("accessors", 0, "componentType", to=5127),
    "an unknown width": _set("accessors", 0, "type", to="VEC5"),
    "a width that is not a position's": _set("accessors", 0, "type", to="VEC2"),
    "a width that is not a coordinate's": _set("accessors", 1, "type", to="SCALAR"),
    "indices that are fractions": _set("accessors", 2, to=FRACTIONS),
    "an offset beyond the view": _set("accessors", 0, "byteOffset", to=4),
    "an offset below zero": _set("accessors", 0, "byteOffset", to=-4),
    "a view beyond the buffer": _set("bufferViews", 0, "byteOffset", to=10**6),
    "a view below zero": _set("bufferViews", 0, "byteOffset", to=-12),
    "a stride below the width": _set("bufferViews", 0, "byteStride", to=4),
    "a stride beyond the view": _set("bufferViews", 0, "byteStride", to=100),
    "a view of no buffer": _set("bufferViews", 0, "buffer", to=7),
    "an accessor of no view": _set("accessors", 0, "bufferView", to=9),
    "a primitive of no accessor": _set(*PRIMITIVE, "attributes", "POSITION", to=12),
    "an attribute below zero": _set(*PRIMITIVE, "attributes", "POSITION", to=-1),
    "a node of no mesh": _set("nodes", 0, "mesh", to=3),
    "a scene of no node": _set("scenes", 0, "nodes", to=[4]),
    "no scene of that number": _set("scene", to=2),
    "a node that is its own child": _set("nodes", 0, "children", to=[0]),
    "two parents": _set("scenes", 0, "nodes", to=[0, 0]),
    "a rotation of three numbers": _set("nodes", 0, "rotation", to=[0, 0, 1]),
    "a matrix of nine numbers": _set("nodes", 0, "matrix", to=[1] * 9),
    "a scale that is a word": _set("nodes", 0, "scale", to="large"),
    "a translation that is no number": _set("nodes", 0, "translation", to=[float("nan"), 0, 0]),
    "a texture of no image": _set("textures", 0, "source", to=5),
    "a material of no texture": _set("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index", to=3),
    "no material of that number": _set(*PRIMITIVE, "material", to=8),
    "an image that is none": _set("images", 0, "bufferView", to=0),
    "an image without data": _without("images", 0, "bufferView"),
    "coordinates that are missing": _without(*PRIMITIVE, "attributes", "TEXCOORD_0"),
    "fewer coordinates than vertices": _set("accessors", 1, "count", to=3),
    "a sampler that is none": _set("textures", 0, "sampler", to=0),
    "a mode of no kind": _set(*PRIMITIVE, "mode", to=9),
    "a sparse row beyond the end": _set("accessors", 0, "sparse", to=SPARSE | {"indices": BEYOND}),
    "a sparse accessor without values": _set("accessors", 0, "sparse", to={"count": 2, "indices": SPARSE["indices"]}),
    "a sparse count below zero": _set("accessors", 0, "sparse", to=SPARSE | {"count": -1}),
    "no version": _without("asset"),
    "version 1": _set("asset", "version", to="1.0"),
    "an extension that is needed": _set("extensionsRequired", to=["KHR_draco_mesh_compression"]),
    "a buffer that is missing": lambda tree, _: tree["buffers"].append({"byteLength": 8, "uri": "nowhere.bin"}),
    "a buffer elsewhere": lambda tree, _: tree["buffers"].append({"byteLength": 8, "uri": "https://example.org/a.bin"}),
    "a buffer that is too short": _set("buffers", 0, "byteLength", to=10**6),
    "a data URI that is damaged": lambda tree, _: tree["buffers"].append({"byteLength": 1, "uri": "data:;base64,%%%"}),
    "meshes that are a word": _set("meshes", to="many"),
    "nodes that are numbers": _set("nodes", to=[1, 2]),
    "no primitives": _without("meshes", 0, "primitives"),
    "an index beyond the vertices": lambda _, blob: blob[:80] + struct.pack("<H", 9) + blob[82:],
    "a position that is no number": _number(float("nan"), 0),
    "a position without end": _number(float("inf"), 4),
    "a coordinate that is no number": _number(float("nan"), 48),
    "triangles without area": lambda _, blob: bytes(48) + blob[48:],
}  # fmt: skip
"""Changes of the quad's tree or buffer, each of which makes it invalid."""
FILES: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "cut short": lambda data, random: data[: int(random.integers(0, len(data)))],
    "cut by a byte": lambda data, _: data[:-1],
    "another magic": lambda data, _: b"GLTF" + data[4:],
    "version 3": lambda data, _: data[:4] + struct.pack("<I", 3) + data[8:],
    "a length beyond the file": lambda data, _: data[:8] + struct.pack("<I", 2 * len(data)) + data[12:],
    "a length below the chunks": lambda data, _: data[:8] + struct.pack("<I", len(data) - 8) + data[12:],
    "a chunk beyond the file": lambda data, _: data[:12] + struct.pack("<I", 1 << 31) + data[16:],
    "no tree": lambda data, _: data[:16] + b"JUNK" + data[20:],
    "a tree that is no text": lambda data, _: data[:20] + b"\xff\xfe" + data[22:],
    "a tree that is cut": lambda data, _: data.replace(b"}", b" ", 1),
    "no bytes": lambda data, _: b"",
}
"""Changes of the bytes of the quad's .glb."""
DAMAGES = (*TREES, *FILES)
