"""Generated EXR maps: types, compressions, windows, parts, layers, chromaticities, and damage."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from bench.generated_files import REC_709, WIDE, Array, Case, Forms, Sky, rgb, xyz

EXACT = ("ZIP", "NO", "RLE", "ZIPS", "PIZ", "HTJ2K32", "HTJ2K256")
LOSSY = {"PXR24": 1e-4, "B44": 0.02, "B44A": 0.02, "DWAA": 0.03, "DWAB": 0.03}
"""Compressions of OpenEXR, and the share of the largest value that they may be wrong by."""
HALVES = ("PXR24", "B44", "B44A", "DWAA", "DWAB")


def valid(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A valid .exr file."""
    forms = Forms(random)
    height = int(random.integers(1, 40))
    width = 2 * int(random.integers(1, 40))
    compression = forms.one(*EXACT, *LOSSY)
    pixels = _smooth(random, height, width)
    header: dict[str, Any] = {
        "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
        "type": OpenEXR.scanlineimage,
    }
    if forms.chance("tiles", 0.2):
        tile = OpenEXR.TileDescription()
        tile.xSize, tile.ySize = 16, 8
        header |= {"type": OpenEXR.tiledimage, "tiles": tile}
    elif forms.chance("lines from below", 0.15):
        header["lineOrder"] = OpenEXR.DECREASING_Y
    channels, shown = _channels(forms, pixels, compression)
    if "R" in channels and forms.chance("chromaticities", 0.2):
        header["chromaticities"] = WIDE
        shown = shown @ (rgb(REC_709) @ xyz(WIDE)).T
    shown = _windows(forms, header, shown)
    negative = bool((shown < 0).any())
    path = folder / f"valid {number}.exr"
    layer = _written(forms, path, header, channels)
    close = LOSSY.get(compression, 2e-6)
    return Case(path, Sky(np.clip(shown, 0, None), layer, close), tuple(forms.drawn), warns="were negative" * negative)


def _smooth(random: np.random.Generator, height: int, width: int) -> Array:
    """Values (height, width, 3) that grow along both axes."""
    y, x = np.mgrid[0:height, 0:width]
    slope, start = random.uniform(0, 0.05, (2, 3)), random.uniform(1, 2, 3)
    pixels: Array = start + y[..., None] * slope[0] + x[..., None] * slope[1]
    return pixels


def _channels(forms: Forms, pixels: Array, compression: str) -> tuple[dict[str, NDArray[Any]], Array]:
    """Channels by name, of types of their own, and the values (height, width, 3) that they stand for."""
    kinds = ["f2", "f4", "f2"] if compression in HALVES else ["f4", "f2", "u4"]
    kind = forms.one(*kinds)
    if kind == "u4":
        pixels = np.floor(pixels * 100)
    elif forms.chance("negative values", 0.1) and compression in EXACT:
        pixels = pixels - 1.5
    names = ["R", "G", "B"]
    if forms.chance("luminance", 0.15):
        names = ["Y"]
    elif kind != "u4" and compression in EXACT and pixels.min() > 0 and forms.chance("luminance and chroma", 0.1):
        return _chroma(pixels)
    types = [kind] * 3
    if compression in EXACT and forms.chance("types of their own", 0.2):
        types = [str(forms.random.choice(["f2", "f4"])) for _ in range(3)] if kind != "u4" else types
    channels = {name: np.ascontiguousarray(pixels[..., k]).astype(types[k]) for k, name in enumerate(names)}
    shown = np.stack([channels[name].astype(np.float64) for name in names], -1)
    shown = shown if len(names) == 3 else shown.repeat(3, 2)
    more = {"A": "f2", "Z": "f4", "id": "u4"}
    channels |= {
        name: np.full(pixels.shape[:2], 1, more[name]) for name in more if forms.chance(f"channel {name}", 0.2)
    }
    return channels, shown


def _chroma(pixels: Array) -> tuple[dict[str, NDArray[Any]], Array]:
    """Y, (R - Y) / Y and (B - Y) / Y as channels, and the values (height, width, 3) that they stand for."""
    y = pixels @ xyz(REC_709)[1]
    chroma = {"RY": pixels[..., 0] / y - 1, "BY": pixels[..., 2] / y - 1}
    return {name: values.astype("f4") for name, values in {"Y": y, **chroma}.items()}, pixels


def _windows(forms: Forms, header: dict[str, Any], shown: Array) -> Array:
    """The picture of a display window that is not the data window: black outside of the data."""
    if not forms.chance("windows", 0.3):
        return shown
    height, width, _ = shown.shape
    left, top = (int(x) for x in forms.random.integers(-6, 7, 2))
    x, y = (int(v) for v in forms.random.integers(-3, 4, 2))
    across = 2 * int(forms.random.integers(6, 30))
    down = int(forms.random.integers(12, 40))
    header["dataWindow"] = _window(left, top, width, height)
    header["displayWindow"] = _window(x, y, across, down)
    canvas = np.zeros((200, 200, 3))
    canvas[50 + top : 50 + top + height, 50 + left : 50 + left + width] = shown
    picture = canvas[50 + y : 50 + y + down, 50 + x : 50 + x + across]
    if picture.any():
        return picture
    del header["dataWindow"], header["displayWindow"]
    return shown


def _window(left: int, top: int, width: int, height: int) -> Any:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


def _written(forms: Forms, path: Path, header: dict[str, Any], channels: dict[str, NDArray[Any]]) -> str | None:
    """Write the file: in one part, in a layer, or as one of several parts or layers; the layer to ask for."""
    other = {name: np.ones_like(values) for name, values in channels.items()}
    form = forms.one("one part", "several parts", "several layers", "one layer")
    if form == "several parts":
        parts = [
            OpenEXR.Part(dict(header), dict(planes), name) for name, planes in (("left", other), ("right", channels))
        ]
        OpenEXR.File(parts).write(str(path))
        return "right"
    layered = {f"sky.{name}": values for name, values in channels.items()}
    if form == "several layers":
        OpenEXR.File(header, {**layered, **{f"sun.{name}": values for name, values in other.items()}}).write(str(path))
        return "sky"
    OpenEXR.File(header, layered if form == "one layer" else channels).write(str(path))
    return None


def broken(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A small map, damaged in one way."""
    damage = DAMAGES[number % len(DAMAGES)]
    path = folder / f"broken {number}.exr"
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = _smooth(random, 40, 40).astype(np.float32)
    planes = {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate("RGB")}
    if damage in WRITTEN:
        WRITTEN[damage](header, planes)
    OpenEXR.File(header, planes).write(str(path))
    if damage in CHANGED:
        path.write_bytes(CHANGED[damage](path.read_bytes(), random))
    return Case(path, Sky(pixels.astype(np.float64)) if damage in HARMLESS else None, damage=damage)


def _value(value: float) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    """Damage: a value of a pixel."""

    def change(_: dict[str, Any], planes: dict[str, Any]) -> None:
        planes["G"][3, 4] = value

    return change


def _attribute(name: bytes, data: bytes, offset: int = 0) -> Callable[[bytes, np.random.Generator], bytes]:
    """Damage: bytes of an attribute of the header."""

    def change(file: bytes, _: np.random.Generator) -> bytes:
        at = file.index(name + b"\0")
        at = file.index(b"\0", at + len(name) + 1) + 5 + offset
        return file[:at] + data + file[at + len(data) :]

    return change


def _chunk(at: int, data: bytes) -> Callable[[bytes, np.random.Generator], bytes]:
    """Damage: bytes of the first chunk: its line, the size of its data, and they."""

    def change(file: bytes, _: np.random.Generator) -> bytes:
        start = _first_chunk(file) + at
        return file[:start] + data + file[start + len(data) :]

    return change


def _first_chunk(file: bytes) -> int:
    """Where the first chunk begins, by the table of offsets after the header."""
    table = file.index(b"screenWindowWidth\0float\0\4\0\0\0") + 17 + 1 + 6 + 4 + 4
    while file[table] != 0:  # attributes after it
        name = file.index(b"\0", table) + 1
        kind = file.index(b"\0", name) + 1
        table = kind + 4 + struct.unpack_from("<i", file, kind)[0]
    first: int = struct.unpack_from("<q", file, table + 1)[0]
    return first


WRITTEN: dict[str, Callable[[dict[str, Any], dict[str, Any]], None]] = {
    "a value that is no number": _value(float("nan")),
    "a value without end": _value(float("inf")),
    "a value below without end": _value(float("-inf")),
    "a value that is too large": _value(3e38),
    "no colours": lambda _, planes: planes.update(Z=planes.pop("R"), N=planes.pop("G"), W=planes.pop("B")),
    "two colours": lambda _, planes: planes.update(X=planes.pop("B")),
    "a cube map": lambda header, _: header.update(envmap=OpenEXR.ENVMAP_CUBE),
    "data beside the display": lambda header, _: header.update(
        dataWindow=_window(50, 0, 40, 40), displayWindow=_window(0, 0, 40, 40)
    ),
}  # fmt: skip
CHANGED: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "no bytes": lambda _, random: b"",
    "another magic": lambda file, _: b"v/1\2" + file[4:],
    "another version": lambda file, _: file[:4] + b"\x09" + file[5:],
    "deep data without any": lambda file, _: file[:5] + b"\x08" + file[6:],
    "an unknown compression": _attribute(b"compression", b"\x63"),
    "another compression": _attribute(b"compression", b"\x04"),
    "an unknown type of channels": _attribute(b"channels", b"\x63", 2),
    "windows inside out": _attribute(b"dataWindow", struct.pack("<4i", 39, 39, 0, 0)),
    "an endless window": _attribute(b"dataWindow", struct.pack("<4i", 0, 0, 1 << 30, 1 << 30)),
    "an endless display": _attribute(b"displayWindow", struct.pack("<4i", 0, 0, 1 << 30, 1 << 30)),
    "more lines than there are": _attribute(b"dataWindow", struct.pack("<4i", 0, 0, 39, 99)),
    "a header that is cut short": lambda file, random: file[: int(random.integers(1, 250))],
    "a table that is cut short": lambda file, _: file[: _first_chunk(file) - 5],
    "chunks that are cut short": lambda file, random: file[: int(random.integers(_first_chunk(file), len(file)))],
    "a last byte that is missing": lambda file, _: file[:-1],
    "a chunk of another line": _chunk(0, struct.pack("<i", 12345)),
    "a chunk that is too long": _chunk(4, struct.pack("<i", 1 << 30)),
    "a chunk of a length below zero": _chunk(4, struct.pack("<i", -5)),
    "a chunk that is damaged": _chunk(8, b"\xff\xff\xff\xff\xff\xff"),
    "a chunk that is damaged later": _chunk(500, b"\xff\0\xff\0\xff\0\xff\0"),
    "an offset beyond the file": _chunk(-8, struct.pack("<q", 1 << 40)),
    "a window that is too wide": _attribute(b"dataWindow", struct.pack("<4i", 0, 0, 49, 39)),
    "a window that is too narrow": _attribute(b"dataWindow", struct.pack("<4i", 0, 0, 19, 39)),
    "an attribute of another type": lambda file, _: file.replace(b"box2i", b"box2j"),
}  # fmt: skip
"""Changes of the bytes of a compressed file."""
HARMLESS = ("deep data without any", "an unknown compression", "an offset beyond the file")
"""Damage that leaves all pixels in the file, where they are found: it may be read."""
DAMAGES = (*WRITTEN, *CHANGED)
