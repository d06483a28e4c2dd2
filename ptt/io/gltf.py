"""glTF 2.0 files, .gltf and .glb: their tree, arrays and images. What a file asks for is checked before it is believed.

Khronos, glTF 2.0 specification; numbers of sections are its own. `ptt.scene.gltf_parts` makes regions of it.

Example:
    >>> file = gltf.open_file(Path("chair.glb"))
    >>> gltf.array(file, file.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"], "VEC3").shape
    (5210, 3)
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

SUPPORTED = frozenset({
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_variants",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
})  # fmt: skip
"""Extensions that are read, or that change neither geometry nor colour in a file's default state."""
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
"""Types of numbers, little-endian."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Numbers of an element; MAT2 and MAT3 are not used by what is read."""
JSON, BINARY = 0x4E4F534A, 0x004E4942


class File(NamedTuple):
    """A file, open: its path, its tree and its buffers."""

    path: Path
    tree: dict[str, Any]
    buffers: list[bytes]

    def items(self, kind: str) -> list[dict[str, Any]]:
        """The list of a kind at the top of the tree; empty where there is none."""
        found: list[dict[str, Any]] = self.tree.get(kind, [])
        return found

    def item(self, kind: str, index: int) -> dict[str, Any]:
        """One of them.

        Raises:
            ValueError: there is none of that number.
        """
        every = self.items(kind)
        if not (isinstance(index, int) and 0 <= index < len(every)):
            raise ValueError(f"{self.path.name} asks for {kind}[{index}] of {len(every)}")
        return every[index]


def open_file(path: Path) -> File:
    """A file whose container, version, required extensions and buffers are sound.

    Raises:
        ValueError: it is no glTF 2.0, is cut short, lacks a buffer, or needs an extension that is not supported.
    """
    data = path.read_bytes()
    binary: bytes | None = None
    text = data
    if path.suffix.lower() == ".glb" or data[:4] == b"glTF":
        text, binary = _chunks(path, data)
    try:
        tree = json.loads(text.decode("utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} must hold JSON: {error}") from error
    if not isinstance(tree, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(tree).__name__}")
    _check_version(path, tree)
    _check_extensions(path, tree)
    buffers = [_buffer(path, i, buffer, binary) for i, buffer in enumerate(tree.get("buffers", []))]
    return File(path, tree, buffers)


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a .glb (4.4)."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError(f"{path} must be a .glb of at least 20 bytes that begins with glTF")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ValueError(f"{path} must be glTF 2, got version {version}")
    if length > len(data):
        raise ValueError(f"{path} is cut short: {len(data)} of {length} bytes")
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise ValueError(f"{path} is damaged: a chunk ends {at + 8 + size - length} bytes beyond the file")
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if JSON not in found:
        raise ValueError(f"{path} is damaged: it has no JSON chunk")
    return found[JSON], found.get(BINARY)


def _check_version(path: Path, tree: dict[str, Any]) -> None:
    asset = tree.get("asset") or {}
    version = str(asset.get("minVersion", asset.get("version", "none")))
    if version.partition(".")[0] != "2" or version.partition(".")[2] not in ("0", ""):
        raise ValueError(f"{path} must be glTF 2.0, got version {version}")


def _check_extensions(path: Path, tree: dict[str, Any]) -> None:
    """Refuse a file that needs what is not supported (3.12)."""
    if missing := [name for name in tree.get("extensionsRequired", []) if name not in SUPPORTED]:
        raise ValueError(
            f"{path} needs {', '.join(missing)}, which ptt does not read: convert the file to core glTF, e.g. by "
            "`gltf-transform copy in.glb out.glb`, which decodes compression"
        )


def _buffer(path: Path, index: int, buffer: dict[str, Any], binary: bytes | None) -> bytes:
    uri = buffer.get("uri")
    data = binary if uri is None and index == 0 else _at_uri(path, uri)
    length = buffer.get("byteLength", 0)
    if data is None or len(data) < length:
        raise ValueError(f"{path} is cut short: buffer {index} has {len(data or b'')} of {length} bytes")
    return data


def _at_uri(path: Path, uri: str | None) -> bytes | None:
    """What a URI holds: data of its own, or a file beside the path."""
    if uri is None:
        return None
    if uri.startswith("data:"):
        head, _, body = uri.partition(",")
        try:
            return (
                base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote(body).encode("latin-1")
            )
        except (binascii.Error, UnicodeEncodeError) as error:
            raise ValueError(f"{path} has a damaged data URI: {error}") from error
    if "://" in uri:
        raise ValueError(f"{path} names {uri}: nothing is fetched from elsewhere, put the file beside it")
    file = path.parent / unquote(uri)
    if not file.is_file():
        raise ValueError(f"{path} names {uri}, which is not beside it")
    return file.read_bytes()


def array(file: File, index: int, *types: str) -> NDArray[Any]:
    """An accessor (count, numbers) (3.6.2): float32 where it is or is normalised to fractions, else its integers.

    types: those of WIDTHS that it may have

    Raises:
        ValueError: it is damaged, of another type, or reads beyond its buffer.
    """
    accessor = file.item("accessors", index)
    count = accessor.get("count")
    kind = COMPONENTS.get(accessor.get("componentType", -1))
    width = WIDTHS.get(accessor.get("type", ""))
    if not isinstance(count, int) or count < 1 or kind is None or width is None:
        raise ValueError(f"{file.path.name}: accessors[{index}] is damaged: {accessor}")
    what = f"accessors[{index}]"
    if accessor["type"] not in types:
        raise ValueError(f"{file.path.name}: {what} must be {' or '.join(types)}, got {accessor['type']}")
    if "bufferView" in accessor:
        values = _view(file, accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width, what)
    elif count > _BLANK:
        raise ValueError(f"{file.path.name}: {what} has no data for its {count} elements")
    else:
        values = np.zeros((count, width), "<" + kind)
    if "sparse" in accessor:
        _replace(file, values, accessor["sparse"], kind, what)
    if accessor.get("normalized") and kind[0] in "iu":
        return np.maximum(values / np.iinfo(kind).max, -1).astype(np.float32)
    return values


_BLANK = 1 << 24  # elements of zeros that an accessor without data may have


def indices(file: File, index: int, kind: str) -> NDArray[np.int64]:
    """An accessor of unsigned integers (count, numbers), which number vertices or joints.

    Raises:
        ValueError: as `array`; it has other numbers.
    """
    values = array(file, index, kind)
    if values.dtype.kind != "u":
        raise ValueError(f"{file.path.name}: accessors[{index}] must hold unsigned integers, got {values.dtype}")
    return values.astype(np.int64)


def _replace(file: File, values: NDArray[Any], sparse: dict[str, Any], kind: str, what: str) -> None:
    """Overwrite the elements that a sparse accessor lists."""
    count, listed, new = sparse["count"], sparse["indices"], sparse["values"]
    index_kind = COMPONENTS[listed["componentType"]]
    rows = _view(file, listed["bufferView"], listed.get("byteOffset", 0), index_kind, count, 1, what)[:, 0]
    if rows.dtype.kind != "u" or int(rows.max()) >= len(values):
        raise ValueError(f"{file.path.name}: {what} replaces element {int(rows.max())} of {len(values)}")
    values[rows] = _view(file, new["bufferView"], new.get("byteOffset", 0), kind, count, values.shape[1], what)


def _view(file: File, index: int, offset: int, kind: str, count: int, width: int, what: str) -> NDArray[Any]:
    """A copy (count, width) of numbers in a buffer view, which may be strided."""
    view = file.item("bufferViews", index)
    number = view.get("buffer", -1)
    if not 0 <= number < len(file.buffers):
        raise ValueError(f"{file.path.name} asks for buffers[{number}] of {len(file.buffers)}")
    start, length = view.get("byteOffset", 0), view.get("byteLength", 0)
    size = np.dtype(kind).itemsize
    stride = view.get("byteStride") or size * width
    end = offset + stride * (count - 1) + size * width
    if (
        min(start, offset) < 0
        or count < 1
        or stride < size * width
        or end > length
        or start + end > len(file.buffers[number])
    ):
        raise ValueError(f"{file.path.name}: {what} reads {end} bytes of a view that has {length}")
    shown: NDArray[Any] = np.ndarray((count, width), "<" + kind, file.buffers[number], start + offset, (stride, size))
    return shown.copy()


def image(file: File, index: int) -> Image.Image:
    """An image (3.9.2).

    Raises:
        ValueError: it is missing, or in a format that Pillow does not read.
    """
    entry = file.item("images", index)
    name = entry.get("name") or entry.get("uri", "")[:40] or f"images[{index}]"
    if "bufferView" in entry:
        view = file.item("bufferViews", entry["bufferView"])
        data = _view(file, entry["bufferView"], 0, "u1", view["byteLength"], 1, name).tobytes()
    else:
        found = _at_uri(file.path, entry.get("uri"))
        if found is None:
            raise ValueError(f"{file.path.name}: image {name} has neither a uri nor a view")
        data = found
    try:
        opened = Image.open(io.BytesIO(data))
        opened.load()
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise ValueError(
            f"{file.path.name}: image {name} ({entry.get('mimeType', 'no type')}) cannot be read: {error}"
        ) from error
    return opened
