"""Generated glTF files: every form of accessor, primitive, node, material and container."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bench.generated_files import Array, Case, Forms, Region, Shapes, linear

Tree = dict[str, Any]
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
REFLECTED = 0.04  # straight on by what is no metal (glTF 2.0, 3.9.6)


class Corners(NamedTuple):
    """What a primitive has at its corners: triangles (f, 3) of positions (v, 3), uv (v, 2) and colours (v, 3)."""

    triangles: NDArray[np.int64]
    positions: Array
    uv: Array
    colours: Array
    diffuse: tuple[float, ...] | None


class Writer(Forms):
    """A glTF file that grows."""

    def __init__(self, random: np.random.Generator) -> None:
        super().__init__(random)
        self.blobs = [b""] * int(random.integers(1, 3))
        self.quantised = bool(random.random() < 0.3)
        self.tree: Tree = {"asset": {"version": "2.0", "generator": "bench"}, "bufferViews": [], "accessors": []}
        if self.quantised:
            self.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
            self.chance("quantised", 1)

    def add(self, kind: str, item: Any) -> int:
        """The number of a new item at the top of the tree."""
        self.tree.setdefault(kind, []).append(item)
        return len(self.tree[kind]) - 1

    def view(self, data: bytes, **more: Any) -> int:
        """A view of bytes, in one of the buffers."""
        number = int(self.random.integers(len(self.blobs)))
        blob = self.blobs[number]
        blob += b"\0" * (-len(blob) % 4)
        self.blobs[number] = blob + data
        return self.add("bufferViews", {"buffer": number, "byteOffset": len(blob), "byteLength": len(data), **more})

    def array(self, values: NDArray[Any], loose: bool = True, **more: Any) -> int:
        """An accessor of rows: sparse, offset, and, where it is `loose`, strided, as drawn."""
        rows = np.ascontiguousarray(values.reshape(len(values), -1))
        accessor = {
            "componentType": KINDS[rows.dtype.str[1:]],
            "count": len(rows),
            "type": TYPES[rows.shape[1]],
            **more,
        }
        if self.chance("sparse", 0.15):
            accessor["sparse"], rows = self._sparse(rows)
        if not rows.any() and self.chance("without data", 0.5):
            return self.add("accessors", accessor)
        size = rows.itemsize * rows.shape[1]
        stride = size
        view = {}
        if loose and (size % 4 or self.chance("strided")):
            stride = -(-size // 4) * 4 + 4 * int(self.random.integers(3))
            view = {"byteStride": stride}
        offset = 4 * int(self.random.integers(1, 3)) if self.chance("offset") else 0
        packed = np.zeros((len(rows), stride), np.uint8)
        packed[:, :size] = rows.view(np.uint8)
        data = bytes(offset) + packed.tobytes()[: stride * (len(rows) - 1) + size]
        accessor |= {"bufferView": self.view(data, **view)} | ({"byteOffset": offset} if offset else {})
        return self.add("accessors", accessor)

    def _sparse(self, rows: NDArray[Any]) -> tuple[Tree, NDArray[Any]]:
        """What a sparse accessor lists, and the rows that it replaces: other ones, or zeros."""
        random = self.random
        every = bool(random.random() < 0.5)
        listed = (
            np.arange(len(rows)) if every else np.sort(random.permutation(len(rows))[: random.integers(1, len(rows))])
        )
        stored = rows.copy()
        stored[listed] = 0 if every else rows[random.integers(0, len(rows), len(listed))]
        kind = str(random.choice(["u1", "u2", "u4"]))
        indices = {"bufferView": self.view(listed.astype("<" + kind).tobytes()), "componentType": KINDS[kind]}
        values = {"bufferView": self.view(rows[listed].tobytes())}
        return {"count": len(listed), "indices": indices, "values": values}, stored

    def numbers(self, shape: tuple[int, ...], quantised: bool, least: float = 0.0) -> tuple[int, Array]:
        """An accessor of numbers in least..1, fractions of integers as drawn, and the numbers."""
        signed = ["i1", "i2"] if quantised and least < 0 else []
        kind = str(self.random.choice(["f4", "f4", *signed, *(["u1", "u2"] if quantised else [])]))
        if kind == "f4":
            drawn = self.random.uniform(least, 1, shape).astype("<f4")
            return self.array(drawn), drawn.astype(np.float64)
        bounds = np.iinfo(kind)
        whole = self.random.integers(bounds.min, bounds.max, shape, endpoint=True).astype("<" + kind)
        self.chance(f"{kind} fractions", 1)
        return self.array(whole, normalized=True), np.maximum(whole / bounds.max, -1.0)


def valid(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A valid file."""
    writer = Writer(random)
    regions = _scene(writer)
    path = _saved(writer, folder, f"valid {number}")
    return Case(path, Shapes(regions), tuple(writer.drawn))


def _scene(writer: Writer) -> list[Region]:
    """Meshes, and the nodes that show them."""
    regions = []
    waiting: list[int] = []
    for name in ("first", "second")[: writer.random.integers(1, 3)]:
        primitives, corners = [], []
        weights = [0.25, -0.5] if writer.chance("morph targets", 0.2) else []
        skinned = not weights and writer.chance("skin", 0.15)
        for _ in range(2 if writer.chance("two primitives", 0.2) else 1):
            primitive, own = _primitive(writer, weights, skinned)
            primitives.append(primitive)
            corners.append(own)
        if writer.chance("points beside triangles", 0.1):
            primitives.append({"attributes": primitives[0]["attributes"], "mode": int(writer.random.integers(4))})
        mesh = writer.add(
            "meshes", {"name": name, "primitives": primitives, **({"weights": weights} if weights else {})}
        )
        matrices = _placed(writer, mesh, waiting) if not skinned else _skinned(writer, mesh, waiting)
        regions += [_shown(own, matrices) for own in corners]
    if writer.chance("no scene", 0.1):
        return regions
    other = writer.chance("two scenes", 0.15)
    writer.tree["scenes"] = [{"nodes": []}] * other + [{"nodes": waiting}]
    writer.tree |= {"scene": 1} if other else {}
    return regions


def _primitive(writer: Writer, weights: list[float], skinned: bool) -> tuple[Tree, Corners]:
    random = writer.random
    count = int(random.integers(4, 12))
    accessor, positions = writer.numbers((count, 3), writer.quantised, -1.0)
    primitive: Tree = {"attributes": {"POSITION": accessor}}
    for weight in weights:
        moved = random.uniform(-1, 1, (count, 3)).astype("<f4")
        primitive.setdefault("targets", []).append({"POSITION": writer.array(moved)})
        positions = positions + weight * moved
    colours = np.ones((count, 3))
    if writer.chance("colours of vertices"):
        accessor, colours = writer.numbers((count, int(random.integers(3, 5))), True)
        primitive["attributes"]["COLOR_0"] = accessor
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            moved = random.uniform(-1, 1, colours.shape).astype("<f4")
            target["COLOR_0"] = writer.array(moved)
            colours = colours + weight * moved
        colours = colours[:, :3].clip(0, 1)
    triangles = _faces(writer, primitive, count)
    uv, texels, diffuse = _look(writer, primitive, count)
    if skinned:
        primitive["attributes"]["JOINTS_0"] = writer.array(np.zeros((count, 4), "<u1") + np.array([0, 1, 0, 0], "<u1"))
        primitive["attributes"]["WEIGHTS_0"] = writer.array(np.array([[0.25, 0.75, 0, 0]] * count, "<f4"))
    return primitive, Corners(triangles, positions, uv, colours * texels, diffuse)


def _faces(writer: Writer, primitive: Tree, count: int) -> NDArray[np.int64]:
    """Triangles, a strip or a fan, with indices or without; a strip's with two corners alike have no area."""
    random = writer.random
    mode = int(random.choice([4, 4, 5, 6]))
    order = np.arange(count)
    if writer.chance("no indices", 0.2):
        order = order[: len(order) // 3 * 3] if mode == 4 else order
    else:
        triples = [random.permutation(count)[:3] for _ in range(random.integers(2, 9))]
        order = np.concatenate(triples) if mode == 4 else random.permutation(count)
        if mode == 5 and writer.chance("strip with a stop"):
            order = np.insert(order, 2, order[2])
        kind = str(random.choice(["u1", "u2", "u4"]))
        primitive["indices"] = writer.array(order.astype("<" + kind), loose=False)
    if mode != 4 or writer.chance("mode in words", 0.5):
        primitive["mode"] = mode
    if mode == 4:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    writer.chance({5: "strip", 6: "fan"}[mode], 1)
    ahead = range(len(order) - 2)
    strip = [(order[k], order[k + 1 + k % 2], order[k + 2 - k % 2]) for k in ahead]
    fan = [(order[k + 1], order[k + 2], order[0]) for k in ahead]
    return np.array([t for t in (strip if mode == 5 else fan) if len(set(t)) == 3])


def _look(writer: Writer, primitive: Tree, count: int) -> tuple[Array, Array, tuple[float, ...] | None]:
    """Texture coordinates (count, 2) with v up, colours (count, 3) of a texture, and the diffuse colour."""
    random = writer.random
    unknown = np.full((count, 2), np.nan)
    white = np.ones((count, 3))
    if writer.chance("no material", 0.2):
        return unknown, white, None
    base = random.uniform(0, 1, 4).round(3)
    pbr: Tree = {"baseColorFactor": base.tolist(), "metallicFactor": 0, "roughnessFactor": 0.5}
    primitive["material"] = writer.add("materials", {"pbrMetallicRoughness": pbr})
    diffuse = tuple((1 - REFLECTED) * base[:3])
    if not writer.chance("texture", 0.5):
        return unknown, white, diffuse
    wraps = tuple(str(w) for w in random.choice(list(WRAPS), 2))
    quadrants, image = _image(writer)
    sampler = writer.add("samplers", {"wrapS": WRAPS[wraps[0]], "wrapT": WRAPS[wraps[1]]})
    info: Tree = {"index": writer.add("textures", {"source": image, "sampler": sampler})}
    pbr["baseColorTexture"] = info
    at = random.integers(-3, 4, (count, 2)) + random.choice([0.25, 0.75], (count, 2))
    stored = _transformed(writer, info, at)
    number = 1 if writer.chance("second set of coordinates") else 0
    info.update({"texCoord": number} if number else {})
    primitive["attributes"][f"TEXCOORD_{number}"] = writer.array(stored.astype("<f4"))
    column, row = (_wrapped(at[:, k], wraps[k]) for k in (0, 1))
    return np.stack((at[:, 0], 1 - at[:, 1]), 1), quadrants[row, column], diffuse


def _image(writer: Writer) -> tuple[Array, int]:
    """Linear colours (2, 2, 3) of quadrants, and an image of them."""
    kind = str(writer.random.choice(["RGB", "RGBA", "P", "L"]))
    values = writer.random.integers(0, 256, (2, 2, 3))
    if kind == "L":
        values = values[..., :1].repeat(3, 2)
    large = values.repeat(4, 0).repeat(4, 1).astype(np.uint8)
    picture = Image.fromarray(large).convert(kind if kind != "P" else "RGB")
    if kind == "P":
        picture = Image.fromarray(np.arange(4, dtype=np.uint8).reshape(2, 2).repeat(4, 0).repeat(4, 1), "P")
        picture.putpalette(values.astype(np.uint8).tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    writer.chance(f"{kind} image", 1)
    colours = linear(values / 255)
    if writer.chance("image in the tree"):
        return colours, writer.add("images", {"uri": data_uri("image/png", buffer.getvalue())})
    return colours, writer.add("images", {"bufferView": writer.view(buffer.getvalue()), "mimeType": "image/png"})


def _transformed(writer: Writer, info: Tree, at: Array) -> Array:
    """Coordinates that KHR_texture_transform, where it is drawn, takes to `at`."""
    if not writer.chance("texture transform"):
        return at
    random = writer.random
    offset, scale, angle = random.uniform(-1, 1, 2), random.uniform(0.5, 2, 2), float(random.uniform(-3, 3))
    transform = {"offset": offset.tolist(), "scale": scale.tolist(), "rotation": angle}
    info["extensions"] = {"KHR_texture_transform": transform}
    writer.tree.setdefault("extensionsUsed", []).append("KHR_texture_transform")
    turned = (at - offset) @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    stored: Array = turned / scale
    return stored


def _wrapped(at: Array, wrap: str) -> NDArray[np.int64]:
    """Which half of a texture, 0 or 1, stands at a coordinate."""
    if wrap == "clamp":
        return (np.clip(at, 0, 0.999) >= 0.5).astype(np.int64)
    inside = at - np.floor(at)
    if wrap == "mirror":
        inside = np.where(np.floor(at) % 2, 1 - inside, inside)
    return (inside >= 0.5).astype(np.int64)


def _placed(writer: Writer, mesh: int, roots: list[int]) -> list[Array]:
    """Matrices (4, 4) of nodes that show a mesh, one or two, each under parents of its own."""
    matrices = []
    for _ in range(int(writer.random.integers(1, 3))):
        transform, matrix = _transform(writer, True)
        node: Tree = {"mesh": mesh, **transform}
        own = [matrix]
        if writer.chance("instances", 0.15):
            own = _instances(writer, node, matrix)
        if writer.chance("hidden", 0.1):
            node.setdefault("extensions", {})["KHR_node_visibility"] = {"visible": False}
            own = []
        index = writer.add("nodes", node)
        while writer.chance("parents", 0.4):
            transform, matrix = _transform(writer, False)
            index = writer.add("nodes", {"children": [index], **transform})
            own = [matrix @ m for m in own]
        roots.append(index)
        matrices += own
    if not matrices:
        roots.append(writer.add("nodes", {"mesh": mesh}))
        matrices.append(np.eye(4))
    return matrices


def _transform(writer: Writer, leaf: bool) -> tuple[Tree, Array]:
    """The keys of a node, and its matrix (4, 4): any of translation, rotation and scale, or a matrix."""
    random = writer.random
    move, turn, scale = random.uniform(-3, 3, 3).round(3), random.normal(size=4), random.uniform(0.5, 2, 3).round(3)
    turn /= np.linalg.norm(turn)
    if leaf and writer.chance("far away", 0.05):
        move[0] += 1e5
    if writer.chance("mirrored"):
        scale *= random.choice([-1, 1], 3)
    if leaf and writer.chance("flattened", 0.1):
        scale[int(random.integers(3))] = 0
    given = {"translation": move, "rotation": turn, "scale": scale}
    given = {key: value for key, value in given.items() if random.random() < 0.6}
    matrix = np.eye(4)
    matrix[:3, :3] = _turned(given.get("rotation", np.array([0, 0, 0, 1.0]))) * given.get("scale", np.ones(3))
    matrix[:3, 3] = given.get("translation", np.zeros(3))
    if writer.chance("matrix"):
        return {"matrix": matrix.T.ravel().tolist()}, matrix
    return {key: value.tolist() for key, value in given.items()}, matrix


def _turned(quaternion: Array) -> Array:
    """The matrix of a unit quaternion x, y, z, w: v + 2 w (q x v) + 2 q x (q x v) of each axis."""
    axis, w = quaternion[:3], quaternion[3]
    eye = np.eye(3)
    once = np.cross(axis, eye)
    columns: Array = (eye + 2 * w * once + 2 * np.cross(axis, once)).T
    return columns


def _instances(writer: Writer, node: Tree, matrix: Array) -> list[Array]:
    """Two instances of a node."""
    moves = writer.random.uniform(-5, 5, (2, 3)).astype("<f4")
    scales = writer.random.uniform(0.5, 2, (2, 3)).astype("<f4")
    attributes = {"TRANSLATION": writer.array(moves, False), "SCALE": writer.array(scales, False)}
    node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    writer.tree.setdefault("extensionsUsed", []).append("EXT_mesh_gpu_instancing")
    own = [np.diag([*scale, 1.0]) for scale in scales.astype(np.float64)]
    for instance, move in zip(own, moves, strict=True):
        instance[:3, 3] = move
    return [matrix @ instance for instance in own]


def _skinned(writer: Writer, mesh: int, roots: list[int]) -> list[Array]:
    """The matrix of a skin of two joints, a quarter of the first; where its node is does not matter."""
    moves = writer.random.uniform(-2, 2, (2, 3)).round(3)
    joints = [writer.add("nodes", {"translation": move.tolist()}) for move in moves]
    bind = np.stack([np.eye(4), np.diag([0.5, 0.5, 2, 1])])
    skin = writer.add("skins", {"joints": joints, "inverseBindMatrices": writer.array(bind.astype("<f4"), False)})
    roots += [*joints, writer.add("nodes", {"mesh": mesh, "skin": skin, "translation": [9, 9, 9]})]
    placed = np.eye(4)[None].repeat(2, 0)
    placed[:, :3, 3] = moves
    return [np.einsum("j,jab->ab", (0.25, 0.75), placed @ bind)]


def _shown(own: Corners, matrices: list[Array]) -> Region:
    """The region of a primitive under each matrix; one that mirrors turns its triangles over."""
    polygons = []
    for matrix in matrices:
        positions = own.positions @ matrix[:3, :3].T + matrix[:3, 3]
        rows = np.concatenate((positions, own.uv, own.colours), 1)
        mirrored = np.linalg.det(matrix[:3, :3]) < 0
        polygons += [rows[t[::-1] if mirrored else t] for t in own.triangles]
    return Region(polygons, own.diffuse)


def data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _saved(writer: Writer, folder: Path, name: str) -> Path:
    """The file: .glb, or .gltf with its buffers within or beside it."""
    buffers: list[Tree] = [{"byteLength": len(blob)} for blob in writer.blobs]
    binary = writer.chance("glb", 0.5)
    for number, blob in enumerate(writer.blobs):
        if binary and number == 0:
            continue
        if writer.chance("buffer beside", 0.5):
            (folder / f"{name} {number}.bin").write_bytes(blob + b"more")
            buffers[number]["uri"] = f"{name} {number}.bin".replace(" ", "%20")
        else:
            buffers[number]["uri"] = data_uri("application/octet-stream", blob)
    tree = writer.tree | {"buffers": buffers}
    path = folder / f"{name}.{'glb' if binary else 'gltf'}"
    mark = b"\xef\xbb\xbf" if writer.chance("byte order mark", 0.1) and not binary else b""
    text = json.dumps(tree, ensure_ascii=False).encode()
    path.write_bytes(glb(text, writer.blobs[0], writer.chance("unknown chunk", 0.2)) if binary else mark + text)
    return path


def glb(text: bytes, blob: bytes, more: bool = False) -> bytes:
    """The container of a tree and its first buffer; more: an unknown chunk at the end."""
    chunks = [(text + b" " * (-len(text) % 4), 0x4E4F534A), (blob + b"\0" * (-len(blob) % 4), 0x004E4942)]
    chunks += [(b"abcd", 0x12345678)] * more
    body = b"".join(struct.pack("<II", len(data), kind) + data for data, kind in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
