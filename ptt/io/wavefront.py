"""Wavefront files: geometry in .obj, materials in .mtl; text of any encoding, indent and line end."""

from __future__ import annotations

import codecs
from collections import Counter
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
HARMLESS = ("g", "o", "s", "mg", "shadow_obj", "trace_obj", "bevel", "c_interp", "d_interp", "lod", "vp")
"""Keywords that change no triangle, or that only other ones read."""
NUMBERS = ("v", "vt", "vn")
MOST = 1 << 53
"""Beyond, float64 does not have every whole number."""
MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class Faces(NamedTuple):
    """The faces of one material, their corners one after the other.

    material: its name, "" for none
    counts (f,): corners of each face
    corners (c, 3): numbers of position, texture coordinates and normal from 0, -1 for none
    """

    material: str
    counts: Ints
    corners: Ints


class Geometry(NamedTuple):
    """An .obj file.

    positions (v, 3), colours (v, 3) or None, uv (t, 2), normals (n, 3)
    faces: by material, in the order of their first
    libraries: names of .mtl files
    ignored: keywords that are not supported, and how often they stand there
    """

    positions: Floats
    colours: Floats | None
    uv: Floats
    normals: Floats
    faces: list[Faces]
    libraries: list[str]
    ignored: Counter[str]


def read_text(path: Path) -> str:
    """The text of a file: UTF-8, UTF-16 or UTF-32 by its mark, else UTF-8, else Latin-1; tabs are spaces.

    Raises:
        ValueError: UTF-16 or UTF-32 that is cut short.
    """
    data = path.read_bytes()
    encoding = next((name for mark, name in MARKS if data.startswith(mark)), "utf-8")
    if encoding == "utf-8" and data[:200].count(b"\0") > len(data[:200]) / 3:
        encoding = "utf-16-le" if data[1:2] == b"\0" else "utf-16-be"  # without a mark
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        if not encoding.startswith("utf-8"):
            raise ValueError(f"{path} is damaged: {error}") from error
        text = data.decode("latin-1")
    text = text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    return text.replace("\\\n", " ").replace("\t", " ").replace("\0", " ")


def read_obj(path: Path) -> Geometry:
    """The geometry of an .obj file.

    Raises:
        ValueError: a row is no row of numbers, or a face has an index that is 0 or beyond what there is.
    """
    numbers: dict[str, list[str]] = {name: [] for name in NUMBERS}
    faces: dict[str, list[str]] = {"": []}
    current = faces[""]
    libraries: list[str] = []
    ignored = Counter[str]()
    for line in read_text(path).split("\n"):
        keyword, _, rest = line.strip().partition(" ")
        if keyword == "f":
            current.append(_absolute(rest, [len(numbers[name]) for name in NUMBERS]) if "-" in rest else rest)
        elif keyword in numbers:
            numbers[keyword].append(rest)
        elif keyword == "usemtl":
            current = faces.setdefault(without_comment(rest), [])
        elif keyword == "mtllib":
            libraries.append(without_comment(rest))
        elif keyword and not keyword.startswith("#") and keyword not in HARMLESS:
            ignored[keyword] += 1
    positions = _table(path, "v", numbers["v"], 3)
    sizes = [len(numbers[name]) for name in NUMBERS]
    return Geometry(
        positions[:, :3],
        _colours(positions),
        _table(path, "vt", numbers["vt"], 2)[:, :2],
        _table(path, "vn", numbers["vn"], 3)[:, :3],
        [_faces(path, name, rows, sizes) for name, rows in faces.items() if rows],
        libraries,
        ignored,
    )


def without_comment(text: str) -> str:
    """A name without what follows a # after a space."""
    return text.partition(" #")[0].strip()


def _table(path: Path, keyword: str, rows: list[str], least: int) -> Floats:
    """Rows of numbers (r, widest), NaN where a row is shorter."""
    words = [row.partition("#")[0].split() for row in rows]
    widths = np.fromiter(map(len, words), np.int64, len(words))
    if (short := np.nonzero(widths < least)[0]).size:
        if keyword != "vt" or (widths < 1).any():
            raise ValueError(f"{path.name}: {keyword} must have {least} numbers, got {rows[int(short[0])]!r}")
        words = [row if len(row) > 1 else [*row, "0"] for row in words]  # a texture of one axis
        widths = np.maximum(widths, 2)
    table = np.full((len(rows), int(widths.max(initial=least))), np.nan)
    try:
        table[np.arange(table.shape[1]) < widths[:, None]] = np.array(list(chain.from_iterable(words)), np.float64)
    except ValueError as error:
        raise ValueError(f"{path.name}: {keyword} must be numbers: {error}") from error
    return table


def _colours(positions: Floats) -> Floats | None:
    """The colours (v, 3) in 0..1 that stand after positions, None where some have none."""
    colours = positions[:, 3:6]
    if colours.shape[1] < 3 or not np.isfinite(colours).all():
        return None
    return colours / 255 if colours.max(initial=0) > 1 else colours


def _absolute(face: str, sizes: list[int]) -> str:
    """A face whose negative numbers count back from the end of what stands before it, as positive ones."""
    corners = []
    for corner in face.partition("#")[0].split():
        parts = corner.split("/")
        counted = [str(size + 1 + int(x)) if x.startswith("-") else x for x, size in zip(parts, sizes, strict=False)]
        corners.append("/".join(counted))
    return " ".join(corners)


def _faces(path: Path, material: str, rows: list[str], sizes: list[int]) -> Faces:
    words = [row.partition("#")[0].split() for row in rows]
    counts = np.fromiter(map(len, words), np.int64, len(words))
    flat = list(chain.from_iterable(words))
    try:
        corners = _corners(flat)
    except ValueError as error:
        raise ValueError(f"{path.name}: f must be indices such as 1/2/3: {error}") from error
    for axis, (name, size) in enumerate(zip(NUMBERS, sizes, strict=True)):
        given = corners[:, axis]
        for number in (int(given.min()), int(given.max())) if given.size else ():
            if number >= size or number < (0 if axis == 0 else -1):
                raise ValueError(f"{path.name}: a face asks for {name} {number + 1} of {size}")
    return Faces(material, counts, corners)


def _corners(words: list[str]) -> Ints:
    """Numbers (c, 3) from 0 of corners such as 1, 1/2, 1//3 or 1/2/3; -1 for what is not there."""
    slashes = np.fromiter((word.count("/") for word in words), np.int64, len(words))
    corners = np.full((len(words), 3), -1, dtype=np.int64)
    if not slashes.any():
        numbers = np.array(words, np.float64)
        if not (np.abs(numbers) < MOST).all() or (numbers % 1).any():
            raise ValueError(f"they must be whole numbers below {MOST}")
        corners[:, 0] = numbers.astype(np.int64) - 1
        return corners
    padded = [word + "//"[: 2 - int(count)] for word, count in zip(words, slashes.tolist(), strict=True)]
    parts = "/".join(padded).split("/")
    corners[:] = np.array([part or "0" for part in parts]).astype(np.int64).reshape(-1, 3) - 1
    return corners


def read_mtl(path: Path) -> dict[str, dict[str, str]]:
    """The materials of an .mtl file by name: what follows each keyword, in lower case."""
    found: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in read_text(path).split("\n"):
        keyword, _, rest = line.strip().partition(" ")
        if keyword.lower() == "newmtl":
            current = found.setdefault(without_comment(rest), {})
        elif keyword and not keyword.startswith("#"):
            current[keyword.lower()] = without_comment(rest)
    return found
