"""PLY files: elements and their properties, in text or binary of either byte order.

Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import re
import struct
from itertools import accumulate, chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Lists(NamedTuple):
    """A property that is a list: how many numbers each element has, and all numbers, one after the other."""

    counts: NDArray[np.int64]
    values: NDArray[np.float64]


class Property(NamedTuple):
    """A property: its name, the type of its numbers, and of their count where it is a list."""

    name: str
    kind: str
    counted_by: str | None


class Element(NamedTuple):
    """A kind of element in the header."""

    name: str
    size: int
    properties: list[Property]


Elements = dict[str, dict[str, NDArray[np.float64] | Lists]]
"""Properties, by the names of element and property."""


class File(NamedTuple):
    """What a file holds.

    kinds: types of numbers, by the names of element and property
    left: what follows the last element, which means nothing: bytes, or words of text
    """

    elements: Elements
    kinds: dict[tuple[str, str], str]
    comments: list[str]
    left: int


def read(path: Path) -> File:
    """A PLY file.

    Raises:
        ValueError: the header is damaged, or the body is cut short.
    """
    data = path.read_bytes()
    order, elements, comments, body = _header(path, data)
    try:
        read_body = _from_text if order == "" else _from_binary
        kinds = {(element.name, prop.name): prop.kind for element in elements for prop in element.properties}
        found, left = read_body(data[body:], elements, order)
        return File(found, kinds, comments, left)
    except (ValueError, IndexError, struct.error) as error:
        raise ValueError(f"{path} is damaged, or cut short: {error}") from error


def _header(path: Path, data: bytes) -> tuple[str, list[Element], list[str], int]:
    """The byte order ("" for text), the elements, the comments, and where the body begins."""
    begin = re.match(rb"ply[ \t]*(\r\n|\r|\n)", data)
    end = begin and re.search(rb"[\r\n]end_header[ \t]*(" + begin[1] + rb"|\r?\n|$)", data)
    if end is None:
        raise ValueError(f"{path} must be a PLY file: it has no header")
    order = None
    elements: list[Element] = []
    comments = []
    for line in re.split("[\r\n]+", _text(data[: end.start()]))[1:]:
        words = line.split()
        try:
            match words:
                case ["format", form, _]:
                    order = FORMATS[form]
                case ["comment" | "obj_info", *rest]:
                    comments.append(" ".join(rest))
                case ["element", name, count]:
                    elements.append(Element(name, int(count), []))
                case ["property", "list", counted_by, kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind], TYPES[counted_by]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind], None))
                case [_, *_]:
                    raise ValueError("unknown keyword")
        except (KeyError, ValueError, IndexError) as error:
            raise ValueError(f"{path}: its header is damaged at {line!r}") from error
    if order is None:
        raise ValueError(f"{path}: its header names no format")
    return order, elements, comments, end.end()


def _text(data: bytes) -> str:
    """The text of a header, UTF-8 or else Latin-1."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _from_text(data: bytes, elements: list[Element], order: str) -> tuple[Elements, int]:
    words = data.split()
    found: Elements = {}
    at = 0
    for element in elements:
        if not any(prop.counted_by for prop in element.properties):
            width = len(element.properties)
            size = element.size * width
            if at + size > len(words):
                raise ValueError(f"{len(words)} of {at + size} numbers")
            table = np.array(words[at : at + size]).astype(np.float64).reshape(element.size, width)
            found[element.name] = {prop.name: table[:, k] for k, prop in enumerate(element.properties)}
            at += size
            continue
        columns: dict[str, tuple[list[int], list[bytes]]] = {prop.name: ([], []) for prop in element.properties}
        for _ in range(element.size):
            for prop in element.properties:
                count = 1
                if prop.counted_by:
                    count = int(words[at])
                    at += 1
                if count < 0 or at + count > len(words):
                    raise ValueError(f"{len(words)} of {at + count} numbers")
                counts, values = columns[prop.name]
                counts.append(count)
                values += words[at : at + count]
                at += count
        found[element.name] = {
            prop.name: _property(prop, np.array(columns[prop.name][0], np.int64), np.array(columns[prop.name][1]))
            for prop in element.properties
        }
    return found, len(words) - at


def _property(prop: Property, counts: NDArray[np.int64], values: NDArray[np.bytes_]) -> NDArray[np.float64] | Lists:
    numbers = values.astype(np.float64)
    return Lists(counts, numbers) if prop.counted_by else numbers


def _from_binary(data: bytes, elements: list[Element], order: str) -> tuple[Elements, int]:
    found: Elements = {}
    at = 0
    for element in elements:
        lengths = _first_lengths(data, at, element, order)
        dtype = _row(element, lengths, order)
        if at + element.size * dtype.itemsize <= len(data):
            rows = np.frombuffer(data, dtype, element.size, at)
            if all((rows[f"{k} count"] == lengths[k]).all() for k, p in enumerate(element.properties) if p.counted_by):
                found[element.name] = _columns(element, rows, lengths)
                at += element.size * dtype.itemsize
                continue
        found[element.name], at = _row_by_row(data, at, element, order)
    return found, len(data[at:].strip(b"\0\r\n"))


def _first_lengths(data: bytes, at: int, element: Element, order: str) -> list[int]:
    """The lengths of the lists of an element's first row, 1 for other properties."""
    lengths = []
    for prop in element.properties if element.size else ():
        length = 1
        if prop.counted_by:
            kind = np.dtype(order + prop.counted_by)
            length = int(np.frombuffer(data, kind, 1, at)[0])
            at += kind.itemsize
        lengths.append(length)
        at += np.dtype(prop.kind).itemsize * length
    return lengths or [1] * len(element.properties)


def _row(element: Element, lengths: list[int], order: str) -> np.dtype[np.void]:
    """The type of rows whose lists all have these lengths."""
    fields: list[tuple[str, str, int]] = []
    for k, (prop, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if prop.counted_by:
            fields.append((f"{k} count", order + prop.counted_by, 1))
        fields.append((f"{k}", order + prop.kind, length))
    return np.dtype([(name, kind, (size,)) for name, kind, size in fields])


def _columns(element: Element, rows: NDArray[np.void], lengths: list[int]) -> dict[str, NDArray[np.float64] | Lists]:
    columns: dict[str, NDArray[np.float64] | Lists] = {}
    for k, (prop, length) in enumerate(zip(element.properties, lengths, strict=True)):
        values = rows[f"{k}"].astype(np.float64).reshape(-1)
        columns[prop.name] = Lists(np.full(len(rows), length), values) if prop.counted_by else values
    return columns


def _row_by_row(
    data: bytes, at: int, element: Element, order: str
) -> tuple[dict[str, NDArray[np.float64] | Lists], int]:
    """The properties of an element whose lists have lengths of their own, and where the next one begins."""
    readers = [
        (prop.name, prop.kind, prop.counted_by and struct.Struct((order or "<") + np.dtype(prop.counted_by).char))
        for prop in element.properties
    ]
    counts: dict[str, list[int]] = {prop.name: [] for prop in element.properties}
    pieces: dict[str, list[bytes]] = {prop.name: [] for prop in element.properties}
    for _ in range(element.size):
        for name, kind, counter in readers:
            count = 1
            if counter:
                count = counter.unpack_from(data, at)[0]
                at += counter.size
            size = count * int(kind[1])
            if count < 0 or at + size > len(data):
                raise ValueError(f"{len(data)} of {at + size} bytes")
            counts[name].append(count)
            pieces[name].append(data[at : at + size])
            at += size
    columns: dict[str, NDArray[np.float64] | Lists] = {}
    for prop in element.properties:
        values = np.frombuffer(b"".join(pieces[prop.name]), order + prop.kind).astype(np.float64)
        listed = prop.counted_by is not None
        columns[prop.name] = Lists(np.array(counts[prop.name], np.int64), values) if listed else values
    return columns, at


def strips(lists: Lists) -> list[NDArray[np.int64]]:
    """Strips of vertices, from lists in which -1 ends a strip, as files of laser scans have them."""
    ends = list(accumulate(lists.counts.tolist()))
    rows = [lists.values[end - count : end].astype(np.int64) for end, count in zip(ends, lists.counts, strict=True)]
    cut = [np.split(row, np.nonzero(row < 0)[0]) for row in rows]
    return [part[part >= 0] for part in chain.from_iterable(cut)]
