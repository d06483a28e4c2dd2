"""Generated PLY files: text and bytes of either order, numbers of any type, polygons and strips, and damage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.generated_files import Array, Case, Forms, Region, Shapes, linear, polygons

WHOLE = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
         "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}  # fmt: skip
BROKEN = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
TYPES = WHOLE | BROKEN


class Column(NamedTuple):
    """A property: its name, the type of its numbers, the type of their count where it is a list, and a row of values
    for each element."""

    name: str
    kind: str
    counted_by: str
    rows: list[list[float]]


class Element(NamedTuple):
    """An element of the header and its properties."""

    name: str
    size: int
    columns: list[Column]


def valid(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A valid .ply file."""
    forms = Forms(random)
    shapes = polygons(forms, int(random.integers(1, 8)))
    positions = np.concatenate(shapes)
    kind = forms.one("float", "double", "float64", "short", "int", "char")
    if kind in WHOLE:
        shapes = [_lattice(random) for _ in shapes]
        positions = np.concatenate(shapes)
    stored = positions.astype(TYPES[kind]).astype(np.float64)
    columns = [Column(axis, kind, "", _rows(stored[:, k])) for k, axis in enumerate("xyz")]
    colours, more = _colours(forms, len(positions))
    uv, coordinates = _coordinates(forms, len(positions))
    columns += [*more, *coordinates]
    if forms.chance("normals", 0.2):
        columns += [Column(name, "float", "", [[1.0]] * len(positions)) for name in ("nx", "ny", "nz")]
    if forms.chance("other properties"):
        columns.insert(
            int(random.integers(len(columns) + 1)), Column("quality", "uint16", "", [[7.0]] * len(positions))
        )
    if forms.chance("a list at a vertex", 0.15):
        columns.append(Column("near", "int", "ushort", [[float(i)] * (i % 3) for i in range(len(positions))]))
    if forms.chance("another order of columns"):
        columns = [columns[k] for k in random.permutation(len(columns))]
    starts = np.cumsum([0, *map(len, shapes)])
    elements = [Element("vertex", len(positions), columns), _face_element(forms, shapes, starts)]
    if forms.chance("another element"):
        elements.insert(int(random.integers(3)), Element("camera", 2, [Column("fov", "double", "", [[1.0], [2.0]])]))
    if forms.chance("an empty element", 0.2):
        elements.append(Element("edge", 0, [Column("a", "int", "", []), Column("b", "int", "uchar", [])]))
    if forms.chance("faces before vertices", 0.15):
        elements.reverse()
    path = folder / f"valid {number}.ply"
    path.write_bytes(ply(elements, forms))
    rows = np.concatenate((stored, uv, colours), 1)
    return Case(path, Shapes([Region(_cut(elements, rows, shapes, starts))]), tuple(forms.drawn))


def _lattice(random: np.random.Generator) -> Array:
    """A triangle of whole numbers, of an area."""
    while True:
        corners = random.integers(-100, 100, (3, 3)).astype(np.float64)
        if np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) > 100:
            return corners


def _rows(values: Array) -> list[list[float]]:
    return [[x] for x in values.tolist()]


def _colours(forms: Forms, count: int) -> tuple[Array, list[Column]]:
    """Linear colours (count, 3), and their columns: sRGB in 0..255, or in 0..1 of floats; white without."""
    if not forms.chance("colours", 0.5):
        return np.ones((count, 3)), []
    names = {
        "red": ("red", "green", "blue"),
        "r": tuple("rgb"),
        "diffuse": ("diffuse_red", "diffuse_green", "diffuse_blue"),
    }
    kind = forms.one("uchar", "uint8", "ushort", "float", "double")
    whole = forms.random.integers(0, 256, (count, 3)).astype(np.float64)
    stored = (whole / 255).round(6) if kind in BROKEN else whole
    own = names[forms.one("red", "r", "diffuse")]
    alpha = [Column("alpha", kind, "", [[1.0]] * count)] if forms.chance("alpha") else []
    encoded = stored.astype(TYPES[kind]).astype(np.float64) / (1 if kind in BROKEN else 255)
    return linear(encoded), [*(Column(name, kind, "", _rows(stored[:, k])) for k, name in enumerate(own)), *alpha]


def _coordinates(forms: Forms, count: int) -> tuple[Array, list[Column]]:
    """Texture coordinates (count, 2), and their columns."""
    if not forms.chance("coordinates"):
        return np.full((count, 2), np.nan), []
    uv = forms.random.uniform(-1, 2, (count, 2)).astype("f4").astype(np.float64)
    pairs = {
        "s": ("s", "t"),
        "u": ("u", "v"),
        "texture_u": ("texture_u", "texture_v"),
        "texture_s": ("texture_s", "texture_t"),
    }
    names = pairs[forms.one("s", "u", "texture_u", "texture_s")]
    return uv, [Column(name, "float", "", _rows(uv[:, k])) for k, name in enumerate(names)]


def _face_element(forms: Forms, shapes: list[Array], starts: Any) -> Element:
    """Faces, with numbers before and after their list; or strips, in which -1 ends one."""
    rows = [[float(start + k) for k in range(len(shape))] for start, shape in zip(starts, shapes, strict=False)]
    if forms.chance("strips", 0.2):
        joined = [x for row in rows for x in (*row, -1.0)]
        return Element("tristrips", 1, [Column("vertex_indices", "int", "int", [joined])])
    counted_by = forms.one("uchar", "uint8", "ushort", "int", "uint", "char", "int16")
    kind = forms.one("int", "uint", "ushort", "short", "uchar", "float", "double")
    list_ = Column(forms.one("vertex_indices", "vertex_index"), kind, counted_by, rows)
    before = [Column("flags", "uchar", "", [[3.0]] * len(rows))] if forms.chance("numbers before a list") else []
    after = [Column("quality", "float", "", [[0.5]] * len(rows))] if forms.chance("numbers after a list") else []
    return Element("face", len(rows), [*before, list_, *after])


def _cut(elements: list[Element], rows: Array, shapes: list[Array], starts: Any) -> list[Array]:
    """The polygons of faces; the triangles of strips, every second of which is turned."""
    faces = [rows[start : start + len(shape)] for start, shape in zip(starts, shapes, strict=False)]
    if all(element.name != "tristrips" for element in elements):
        return faces
    return [face[[k, k + 1 + k % 2, k + 2 - k % 2]] for face in faces for k in range(len(face) - 2)]


def ply(elements: list[Element], forms: Forms) -> bytes:
    """A file, in text or binary of either byte order as drawn."""
    form = forms.one("binary_little_endian", "binary_big_endian", "ascii")
    lines = ["ply", f"format {form} 1.0"]
    lines += ["comment the header ends at end_header"] * forms.chance("comment that names the end", 0.2)
    lines += ["comment \u00c5 \u2026 \u4e2d"] * forms.chance("comment in UTF-8", 0.2)
    lines += ["obj_info num_cols 512"] * forms.chance("obj_info", 0.2)
    for element in elements:
        lines.append(f"element {element.name} {element.size}")
        for column in element.columns:
            listed = f"list {column.counted_by} " if column.counted_by else ""
            lines.append(f"property {listed}{column.kind} {column.name}")
    end = forms.one("\n", "\r\n") if form != "ascii" else forms.one("\n", "\r\n", "\r")
    head = end.join([*lines, "end_header", ""]).encode()
    rows = [(column, column.rows[k]) for element in elements for k in range(element.size) for column in element.columns]
    if form == "ascii":
        breaks = " " if forms.chance("all numbers in a line", 0.2) else end
        return head + breaks.join(_in_text(column, row) for column, row in rows).encode() + end.encode()
    order = ">" if form == "binary_big_endian" else "<"
    return head + b"".join(_in_bytes(column, row, order) for column, row in rows)


def _in_text(column: Column, row: list[float]) -> str:
    words = [str(int(x)) if column.kind in WHOLE else repr(x) for x in row]
    return " ".join([str(len(row)), *words] if column.counted_by else words)


def _in_bytes(column: Column, row: list[float], order: str) -> bytes:
    count = np.array(len(row), order + TYPES[column.counted_by]).tobytes() if column.counted_by else b""
    return count + np.array(row, order + TYPES[column.kind]).tobytes()


HEAD = (
    "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
)
TEXT = HEAD.format("ascii") + "0 0 0\n10 0 0\n0 10 0\n10 10 0\n3 0 1 2\n3 1 3 2\n"
BYTES = HEAD.format("binary_little_endian").encode() + b"".join((
    np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0]], "<f4").tobytes(),
    b"\3", np.array([0, 1, 2], "<i4").tobytes(), b"\3", np.array([1, 3, 2], "<i4").tobytes(),
))  # fmt: skip
WRITTEN: dict[str, tuple[str, str]] = {
    "another magic": ("ply", "plY"),
    "no end of the header": ("end_header", "end"),
    "an unknown format": ("format ascii", "format utf8"),
    "no format": ("format ascii 1.0\n", ""),
    "an unknown type": ("float x", "half x"),
    "an unknown type of a count": ("list uchar int", "list half int"),
    "an unknown keyword": ("property float y", "propery float y"),
    "a property of nothing": ("format ascii 1.0", "format ascii 1.0\nproperty float a"),
    "a count that is a word": ("vertex 4", "vertex four"),
    "a count below zero": ("vertex 4", "vertex -4"),
    "too many vertices": ("vertex 4", "vertex 5"),
    "too few vertices": ("vertex 4", "vertex 3"),
    "too many faces": ("face 2", "face 3"),
    "endless faces": ("face 2", "face 999999999999"),
    "no faces": ("face 2", "face 0"),
    "no z": ("float z", "float w"),
    "positions that are lists": ("float z", "list uchar float z"),
    "an index beyond the end": ("3 1 3 2", "3 1 4 2"),
    "an index below zero": ("3 1 3 2", "3 1 -3 2"),
    "an index that is a fraction": ("3 1 3 2", "3 1 2.5 2"),
    "a length below zero": ("3 1 3 2", "-3 1 3 2"),
    "a length that is too long": ("3 1 3 2", "9 1 3 2"),
    "a length that is a word": ("3 1 3 2", "three 1 3 2"),
    "a position that is a word": ("10 10 0", "ten 10 0"),
    "a position that is no number": ("10 10 0", "nan 10 0"),
    "a position without end": ("10 10 0", "inf 10 0"),
    "no area": ("10", "0"),
    "a missing number": ("3 1 3 2", "3 1 3"),
    "faces that are no lists": ("list uchar int vertex_indices", "int vertex_indices"),
    "a property twice": ("float y", "float x"),
}  # fmt: skip
CUTS: dict[str, Callable[[np.random.Generator], bytes]] = {
    "a body that is cut short": lambda random: BYTES[: -int(random.integers(1, 70))],
    "a header that is cut short": lambda random: BYTES[: int(random.integers(0, 100))],
    "an index of bytes beyond the end": lambda _: BYTES[:-4] + b"\0\0\1\0",
    "a length of bytes that is too long": lambda _: BYTES[:-13] + b"\xff" + BYTES[-12:],
    "the other byte order": lambda _: BYTES.replace(b"little", b"big"),
    "bytes called text": lambda _: BYTES.replace(b"binary_little_endian", b"ascii"),
    "endless vertices": lambda _: BYTES.replace(b"vertex 4", b"vertex 4000000000000"),
}
DAMAGES = (*WRITTEN, *CUTS, "too few faces", "too few faces of bytes")


def broken(folder: Path, number: int, random: np.random.Generator) -> Case:
    """Two triangles, damaged in one way; what is left over after the last element is named in a warning."""
    damage = DAMAGES[number % len(DAMAGES)]
    path = folder / f"broken {number}.ply"
    data = TEXT.replace(*WRITTEN[damage]).encode() if damage in WRITTEN else TEXT.encode()
    case = Case(path, None, damage=damage)
    if damage in CUTS:
        data = CUTS[damage](random)
    if damage.startswith("too few faces"):
        data = (BYTES if damage.endswith("bytes") else data).replace(b"face 2", b"face 1")
        rows = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], np.float64)
        rows = np.concatenate((rows, np.full((3, 2), np.nan), np.ones((3, 3))), 1)
        case = case._replace(answer=Shapes([Region([rows])]), warns="after its last element")
    path.write_bytes(data)
    return case
