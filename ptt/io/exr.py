"""OpenEXR images: windows, chromaticities, luminance and chroma, several parts and named layers."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ptt.io import colour

MOST_PIXELS = 1 << 28
LONGEST = 1 << 17
"""Of a window, and along its sides: more is taken for damage."""
COLOURS = (("R", "G", "B"), ("Y", "RY", "BY"), ("Y",))
"""Sets of channels that are a picture, the best first."""


class Layer(NamedTuple):
    """A picture of a file.

    name: of the part, or what stands before the last dot of its channels; "" for the only one that has neither
    part: as OpenEXR gives it
    channels: by what stands after the last dot
    """

    name: str
    part: Any
    channels: dict[str, Any]

    @property
    def colours(self) -> tuple[str, ...]:
        """The channels that hold its colours; none where it is no picture."""
        return next((names for names in COLOURS if self.channels.keys() >= set(names)), ())


def read(path: Path, layer: str | None = None) -> NDArray[np.float32]:
    """Linear values (height, width, 1..4) of the display window, by Rec. 709's primaries; black outside of the data.

    layer: the part or layer to read; default: the first, with a warning that names the others

    Raises:
        ValueError: the file is missing, damaged or deep, or has no such layer; it is a cube map.
    """
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            for part in file.parts:
                _check(part)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return _displayed(_chosen(file.parts, layer, path.name))
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:  # attributes of strange types too
        raise ValueError(f"cannot read {path}: {error}") from error


def _check(part: Any) -> None:
    """Refuse what is not supported, and windows that no pixels would fill, before pixels are read."""
    if part.type() in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise ValueError(f"deep images are not supported: {part.name() or 'its only part'}")
    for name in ("dataWindow", "displayWindow"):
        _, _, width, height = _window(part, name)
        if min(width, height) < 1 or max(width, height) > LONGEST or width * height > MOST_PIXELS:
            raise ValueError(f"its {name} of {width} x {height} pixels is damaged")


def _window(part: Any, name: str) -> tuple[int, int, int, int]:
    """The left, top, width and height of a window."""
    (left, top), (right, bottom) = part.header[name]
    return int(left), int(top), int(right) - int(left) + 1, int(bottom) - int(top) + 1


def _chosen(parts: Iterable[Any], wanted: str | None, name: str) -> Layer:
    """The layer to read."""
    every = [layer for part in parts for layer in _layers(part)]
    if not every:
        raise ValueError("its pixels are damaged, or cut short")
    pictures = [layer for layer in every if layer.colours]
    names = [layer.name for layer in pictures]
    if not pictures:
        found = sorted({f"{layer.name}.{channel}".strip(".") for layer in every for channel in layer.channels})
        raise ValueError(f"it must have channels R, G, B or Y, got {', '.join(found)}")
    if wanted is not None:
        if wanted not in names:
            raise ValueError(f"it has no layer {wanted!r}; its layers are {', '.join(map(repr, names))}")
        return pictures[names.index(wanted)]
    if len(pictures) > 1:
        others = ", ".join(map(repr, names[1:]))
        warnings.warn(f"{name}: layer {names[0]!r} was read; layer= chooses {others}", UserWarning, stacklevel=5)
    return pictures[0]


def _layers(part: Any) -> list[Layer]:
    """The layers of a part; its plain channels first."""
    found: dict[str, dict[str, Any]] = {}
    for name, channel in part.channels.items():
        prefix, _, last = name.rpartition(".")
        found.setdefault(prefix, {})[last] = channel
    of_part = part.name()
    names = {prefix: ".".join(dict.fromkeys(filter(None, (of_part, prefix)))) for prefix in sorted(found)}
    return [Layer(name, part, found[prefix]) for prefix, name in names.items()]


def _displayed(layer: Layer) -> NDArray[np.float32]:
    """The pixels of the display window."""
    if layer.part.header.get("envmap") == OpenEXR.ENVMAP_CUBE:
        raise ValueError("it is a cube map in OpenEXR's own layout: convert it to lat-long (exrenvmap -latlong)")
    left, top, across, down = _window(layer.part, "dataWindow")
    x, y, width, height = _window(layer.part, "displayWindow")
    data = _pixels(layer, down, across)
    if (x, y, width, height) == (left, top, across, down):
        return data
    inside = data[max(0, y - top) : max(0, y + height - top), max(0, x - left) : max(0, x + width - left)]
    if not inside.size:
        raise ValueError("its data window lies outside of its display window")
    shown = np.zeros((height, width, data.shape[2]), np.float32)
    row, column = max(0, top - y), max(0, left - x)
    shown[row : row + inside.shape[0], column : column + inside.shape[1]] = inside
    return shown


def _pixels(layer: Layer, height: int, width: int) -> NDArray[np.float32]:
    """Linear values (height, width, channels) of the data window, alpha last."""
    names = layer.colours
    own = [*names, *(["A"] if "A" in layer.channels else [])]
    values = np.empty((height, width, len(own)), np.float32)
    for number, name in enumerate(own):  # np.stack takes five times as long
        values[..., number] = _full(layer.channels[name], height, width)
    primaries = layer.part.header.get("chromaticities", colour.REC_709)
    colours = values[..., : len(names)]
    if names == COLOURS[1]:
        colours[:] = _from_chroma(colours, primaries)
    if len(names) == 3 and not np.allclose(primaries, colour.REC_709, atol=1e-3):
        colours[:] = colours @ colour.to_rec_709(primaries).T.astype(np.float32)
    return values


def _full(channel: Any, height: int, width: int) -> NDArray[np.float32]:
    """A channel at every pixel; between those that it has, linear."""
    plane: NDArray[np.float32] = channel.pixels.astype(np.float32, copy=False)
    for axis, step, count in ((0, channel.ySampling, height), (1, channel.xSampling, width)):
        if step > 1:
            at = np.minimum(np.arange(count) / step, plane.shape[axis] - 1)
            below = at.astype(np.int64)
            above = np.minimum(below + 1, plane.shape[axis] - 1)
            share = (at - below).astype(np.float32).reshape((-1, 1) if axis == 0 else (1, -1))
            plane = plane.take(below, axis) * (1 - share) + plane.take(above, axis) * share
    return plane


def _from_chroma(values: NDArray[np.float32], primaries: Any) -> NDArray[np.float32]:
    """RGB of luminance and chroma (..., 3): Y, (R - Y) / Y and (B - Y) / Y."""
    y, ry, by = np.moveaxis(values, -1, 0)
    weights = colour.to_xyz(primaries)[1]
    red = (ry + 1) * y
    blue = (by + 1) * y
    green = (y - weights[0] * red - weights[2] * blue) / weights[1]
    colours: NDArray[np.float32] = np.stack((red, green, blue), -1).astype(np.float32)
    return colours


def write(path: Path, pixels: NDArray[np.float32]) -> None:
    """Write linear values (height, width, 1 | 3 | 4), in 32 bits.

    Raises:
        ValueError: the file cannot be written.
    """
    name = {1: "Y", 3: "RGB", 4: "RGBA"}[pixels.shape[2]]
    planes = {name: pixels if len(name) > 1 else np.ascontiguousarray(pixels[..., 0])}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, planes).write(str(path))
    except RuntimeError as error:
        raise ValueError(f"cannot write {path}: {error}") from error
