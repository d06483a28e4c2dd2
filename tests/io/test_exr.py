"""OpenEXR images in the forms that others write."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from ptt.io import exr


def header(**more: Any) -> dict[str, Any]:
    """A new one each time: OpenEXR writes into it."""
    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **more}


def values(height: int = 6, width: int = 10) -> NDArray[np.float32]:
    return np.random.default_rng(1).random((height, width, 3), dtype=np.float32)


def window(left: int, top: int, width: int, height: int) -> Any:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


@pytest.mark.parametrize(("left", "top"), [(0, 0), (3, 2), (-4, -3), (12, 7), (-4, 5)])
def test_the_display_window_is_the_picture(tmp_path: Path, left: int, top: int) -> None:
    """What lies outside of the data is black, and data outside of the display are cut off."""
    windows = header(dataWindow=window(left, top, 10, 6), displayWindow=window(0, 0, 16, 9))
    OpenEXR.File(windows, {"RGB": values()}).write(str(tmp_path / "a.exr"))
    expected = np.zeros((40, 40, 3), np.float32)
    expected[10 + top : 16 + top, 10 + left : 20 + left] = values()
    assert np.array_equal(exr.read(tmp_path / "a.exr"), expected[10:19, 10:26])


def test_data_beside_the_display_are_refused(tmp_path: Path) -> None:
    windows = header(dataWindow=window(50, 0, 10, 6), displayWindow=window(0, 0, 16, 9))
    OpenEXR.File(windows, {"RGB": values()}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match="outside of its display window"):
        exr.read(tmp_path / "a.exr")


def test_chromaticities_are_converted(tmp_path: Path) -> None:
    """Rec. 2020's red, by ITU-R BT.2087, table 4; white stays white."""
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0] = 1
    pixels[1, :, 0] = 1
    OpenEXR.File(header(chromaticities=wide), {"RGB": pixels}).write(str(tmp_path / "a.exr"))
    read = exr.read(tmp_path / "a.exr")
    assert np.allclose(read[0], 1, atol=1e-4)
    assert np.allclose(read[1], (1.6605, -0.1246, -0.0182), atol=2e-4)


def uncompressed(path: Path, planes: dict[str, tuple[NDArray[np.float32], int]]) -> None:
    """Channels of 32 bits at every or every other pixel, by the format's own description: none of ours writes these."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    names = sorted(planes)
    height, width = next(plane.shape for plane, step in planes.values() if step == 1)
    listed = b""
    for name in names:
        listed += name.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, planes[name][1], planes[name][1])
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = struct.pack("<ii", 20000630, 2) + attribute("channels", "chlist", listed + b"\0")
    head += attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
    head += attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
    head += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    head += attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0))
    head += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    lines = []
    for y in range(height):
        row = b"".join(plane[y // step].tobytes() for plane, step in map(planes.get, names) if y % step == 0)  # type: ignore[misc]
        lines.append(struct.pack("<ii", y, len(row)) + row)
    first = len(head) + 8 * height
    starts = [first + sum(map(len, lines[:y])) for y in range(height)]
    path.write_bytes(head + struct.pack(f"<{height}q", *starts) + b"".join(lines))


def test_luminance_and_chroma_become_colours(tmp_path: Path) -> None:
    """R = (RY + 1) Y, B = (BY + 1) Y, and G what is left of Y; chroma at every other pixel is linear between."""
    y = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)
    chroma = np.linspace(-0.5, 0.5, 4, dtype=np.float32)[None].repeat(3, 0)
    uncompressed(tmp_path / "a.exr", {"Y": (y, 1), "RY": (chroma, 2), "BY": (-chroma, 2)})
    read = exr.read(tmp_path / "a.exr")
    at = np.minimum(np.arange(8) / 2, 3)
    between = (-0.5 + at / 3).astype(np.float32)
    assert np.allclose(read[..., 0], (between + 1) * y, atol=1e-6)
    assert np.allclose(read[..., 2], (1 - between) * y, atol=1e-6)
    assert np.allclose(read @ np.array([0.2126, 0.7152, 0.0722]), y, atol=1e-3)


def test_a_layer_is_chosen_by_name(tmp_path: Path) -> None:
    planes = {f"{layer}{c}": np.full((2, 4), k + 3 * n, np.float32)
              for n, layer in enumerate(("", "sun.", "sky.left.")) for k, c in enumerate("RGB")}  # fmt: skip
    OpenEXR.File(header(), {**planes, "depth.Z": planes["R"]}).write(str(tmp_path / "a.exr"))
    with pytest.warns(UserWarning, match=r"a\.exr: layer '' was read; layer= chooses 'sky\.left', 'sun'"):
        assert exr.read(tmp_path / "a.exr")[0, 0].tolist() == [0, 1, 2]
    assert exr.read(tmp_path / "a.exr", "sun")[0, 0].tolist() == [3, 4, 5]
    assert exr.read(tmp_path / "a.exr", "sky.left")[0, 0].tolist() == [6, 7, 8]
    with pytest.raises(ValueError, match=r"no layer 'depth'; its layers are '', 'sky.left', 'sun'"):
        exr.read(tmp_path / "a.exr", "depth")


def test_the_only_layer_is_read_without_a_question(tmp_path: Path) -> None:
    planes = {f"sky.{c}": np.full((2, 4), k, np.float32) for k, c in enumerate("RGB")}
    OpenEXR.File(header(), planes).write(str(tmp_path / "a.exr"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert exr.read(tmp_path / "a.exr")[0, 0].tolist() == [0, 1, 2]


def test_a_part_is_chosen_by_name(tmp_path: Path) -> None:
    planes = {"depth": {"Z": values()[..., 0].copy()}, "left": {"RGB": values()}, "right": {"RGB": 2 * values()}}
    parts = [OpenEXR.Part(header(), pixels, name) for name, pixels in planes.items()]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.warns(UserWarning, match="layer 'left' was read; layer= chooses 'right'"):
        assert np.array_equal(exr.read(tmp_path / "a.exr"), values())
    assert np.array_equal(exr.read(tmp_path / "a.exr", "right"), 2 * values())


def test_a_cube_map_is_refused(tmp_path: Path) -> None:
    OpenEXR.File(header(envmap=OpenEXR.ENVMAP_CUBE), {"RGB": values()}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match="exrenvmap -latlong"):
        exr.read(tmp_path / "a.exr")


def test_alpha_stands_beside_colours_and_chromaticities(tmp_path: Path) -> None:
    """Chromaticities change colours alone: white stays white, and alpha what it was."""
    pixels = {name: np.full((2, 4), value, np.float16) for name, value in zip("RGBA", (1, 1, 1, 0.25), strict=True)}
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    OpenEXR.File(header(chromaticities=wide), pixels).write(str(tmp_path / "a.exr"))
    read = exr.read(tmp_path / "a.exr")
    assert read.dtype == np.float32 and np.allclose(read, (1, 1, 1, 0.25), atol=1e-4)


def changed(path: Path, attribute: bytes, data: bytes, kind: bytes | None = None) -> None:
    """Write other data, or another type, into an attribute of a file's header."""
    file = path.read_bytes()
    at = file.index(attribute + b"\0") + len(attribute) + 1
    end = file.index(b"\0", at)
    file = file[:at] + (kind or file[at:end]) + file[end : end + 5] + data + file[end + 5 + len(data) :]
    path.write_bytes(file)


@pytest.mark.parametrize("name", [b"dataWindow", b"displayWindow"])
def test_a_window_that_no_pixels_would_fill_is_refused(tmp_path: Path, name: bytes) -> None:
    """One that is four million pixels wide takes a minute to read, and gigabytes."""
    OpenEXR.File(header(), {"RGB": values()}).write(str(tmp_path / "a.exr"))
    changed(tmp_path / "a.exr", name, struct.pack("<4i", 0, 0, 1 << 22, 5))
    with pytest.raises(ValueError, match=r"a\.exr: .*of 4194305 x 6 pixels is damaged"):
        exr.read(tmp_path / "a.exr")


def test_an_attribute_of_another_type_is_refused(tmp_path: Path) -> None:
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    OpenEXR.File(header(chromaticities=wide), {"RGB": values()}).write(str(tmp_path / "a.exr"))
    changed(tmp_path / "a.exr", b"chromaticities", b"", b"chromaticitiez")
    with pytest.raises(ValueError, match=r"cannot read .*a\.exr"):
        exr.read(tmp_path / "a.exr")


def test_pixels_that_are_cut_short_are_refused_as_such(tmp_path: Path) -> None:
    OpenEXR.File(header(), {"RGB": values()}).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:-9])
    with pytest.raises(ValueError, match="its pixels are damaged, or cut short"):
        exr.read(tmp_path / "a.exr")
