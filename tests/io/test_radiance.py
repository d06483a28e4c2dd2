"""Radiance pictures in every form that the format has; the oracle writes bytes by the format's own description."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ptt.io import colour, images, radiance

Array = NDArray[np.float64]


def values(height: int = 9, width: int = 14) -> Array:
    """Numbers that RGBE holds exactly: eight bits and an exponent that the channels share."""
    generator = np.random.default_rng(0)
    return generator.integers(128, 256, (height, width, 3)) * 2.0 ** generator.integers(-12, 4, (height, width, 1))


def rgbe(pixels: Array) -> NDArray[np.uint8]:
    largest = pixels.max(-1, keepdims=True)
    exponent = np.floor(np.log2(largest)) + 1
    return np.concatenate((pixels / 2 ** (exponent - 8), exponent + 128), -1).astype(np.uint8)


def new_runs(line: NDArray[np.uint8]) -> bytes:
    """A line by channels: a run of 4 where the first values are alike, then what is left as it is."""
    body = b"\2\2" + len(line).to_bytes(2, "big")
    for channel in line.T:
        alike = 4 if len(set(channel[:4].tolist())) == 1 else 0
        body += bytes([128 + alike, channel[0]]) if alike else b""
        body += bytes([len(channel) - alike]) + channel[alike:].tobytes()
    return body


def write(path: Path, stored: Array, size: str = "", extra: str = "", form: str = "rgbe", runs: str = "flat") -> Path:
    """Stored pixels (slow, fast, 3) under a header."""
    quads = rgbe(stored)
    body = quads.tobytes() if runs == "flat" else b"".join(new_runs(line) for line in quads)
    size = size or f"-Y {len(stored)} +X {stored.shape[1]}"
    path.write_bytes(f"#?RADIANCE\n{extra}FORMAT=32-bit_rle_{form}\n\n{size}\n".encode() + body)
    return path


@pytest.mark.parametrize("runs", ["flat", "new"])
@pytest.mark.parametrize(
    ("first", "second"), [*product(("-Y", "+Y"), ("-X", "+X")), *product(("-X", "+X"), ("-Y", "+Y"))]
)
def test_every_scan_order_is_upright(tmp_path: Path, first: str, second: str, runs: str) -> None:
    """-Y runs from the top to the bottom, +X from the left to the right; the slower axis comes first."""
    upright = values()
    stored = upright
    if "+Y" in (first, second):
        stored = stored[::-1]
    if "-X" in (first, second):
        stored = stored[:, ::-1]
    if first[1] == "X":
        stored = stored.swapaxes(0, 1)
    size = f"{first} {stored.shape[0]} {second} {stored.shape[1]}"
    read = radiance.read(write(tmp_path / "a.hdr", stored, size, runs=runs))
    assert np.array_equal(read, upright.astype(np.float32))


@pytest.mark.parametrize("size", ["+Y 1 -X 14", "-X 14 +Y 1"])
def test_one_line_turned_around_is_an_image(tmp_path: Path, size: str) -> None:
    """numpy takes one line with a negative stride for contiguous, torch refuses it."""
    upright = values(1)
    stored = upright[:, ::-1] if size.startswith("+Y") else upright[:, ::-1].swapaxes(0, 1)
    read = images.read_image(write(tmp_path / "a.hdr", stored, size))
    assert np.array_equal(read.numpy(), upright.astype(np.float32))


@pytest.mark.parametrize("runs", ["flat", "new"])
def test_exposure_and_colour_correction_are_divided_out(tmp_path: Path, runs: str) -> None:
    extra = "EXPOSURE=4\n# a note\nEXPOSURE= 0.5\nCOLORCORR= 1 2 4\n"
    read = radiance.read(write(tmp_path / "a.hdr", values(), extra=extra, runs=runs))
    assert np.allclose(read, values() / 2 / (1, 2, 4), rtol=1e-6)


@pytest.mark.parametrize("runs", ["flat", "new"])
def test_xyz_become_rgb_by_radiance_s_primaries(tmp_path: Path, runs: str) -> None:
    """Equal X, Y and Z are white; red has the chromaticity (0.64, 0.33)."""
    grey = np.repeat(values()[..., :1], 3, -1)
    assert np.allclose(radiance.read(write(tmp_path / "a.hdr", grey, form="xyze", runs=runs)), grey, rtol=1e-5)
    red = np.broadcast_to(np.array([0.64, 0.33, 0.03]), (3, 8, 3))
    read = radiance.read(write(tmp_path / "b.hdr", red, form="xyze", runs=runs))
    assert (read[..., 0] > 0.5).all() and (np.abs(read[..., 1:]) < 0.02 * read[..., :1]).all()


def test_other_primaries_are_converted(tmp_path: Path) -> None:
    """Rec. 2020's red has more red than Rec. 709's and less than no green; its white is white."""
    extra = "PRIMARIES= .708 .292 .17 .797 .131 .046 .3127 .329\n"
    pixels = np.array([[[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]]).repeat(8, 1)
    pixels = np.maximum(pixels, 2.0**-9)
    read = radiance.read(write(tmp_path / "a.hdr", pixels, extra=extra))
    assert np.allclose(read[0, 0], 1, atol=1e-3)
    assert np.allclose(read[0, -1], (1.6605, -0.1246, -0.0182), atol=5e-3)  # ITU-R BT.2087, table 4


def test_old_runs_repeat_the_pixel_before(tmp_path: Path) -> None:
    """1 1 1 n repeats n times, and 1 1 1 n 1 1 1 m  n + 256 m times, across lines."""
    a, b = rgbe(values(1, 2))[0]
    body = a.tobytes() + bytes([1, 1, 1, 3, 1, 1, 1, 2]) + b.tobytes() + bytes([1, 1, 1, 83])
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 3 +X 200\n" + body)
    read = radiance.read(tmp_path / "a.hdr").reshape(-1, 3)
    expected = values(1, 2)[0].astype(np.float32)
    assert np.array_equal(read, expected[[0] * (1 + 3 + 512) + [1] * 84])


def test_zero_and_the_least_exponent(tmp_path: Path) -> None:
    body = bytes([9, 9, 9, 0, 128, 0, 1, 1])
    (tmp_path / "a.hdr").write_bytes(b"#?RGBE\n\n-Y 1 +X 2\n" + body)
    assert radiance.read(tmp_path / "a.hdr").tolist() == [[[0, 0, 0], [2.0**-128, 0, 2.0**-135]]]


@pytest.mark.parametrize(("data", "reason"), [
    (b"RIFF", "begins with #?"),
    (b"#?RADIANCE\nFORMAT=32-bit_float\n\n-Y 1 +X 1\n", "FORMAT must be one of"),
    (b"#?RADIANCE\nEXPOSURE=bright\n\n-Y 1 +X 1\n", "header is damaged"),
    (b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\n1234", "must be positive"),
    (b"#?RADIANCE\nPRIMARIES=1 2\n\n-Y 1 +X 1\n", "must be 8 numbers"),
    (b"#?RADIANCE\nPRIMARIES=.1 .1 .2 .2 .3 .3 .3 .3\n\n-Y 1 +X 1\n1234", "must not lie on one line"),
    (b"#?RADIANCE\n\n-Y 1 -Y 1\n1234", "must be as -Y 512 [+]X 1024"),
    (b"#?RADIANCE\n\n-Y 0 +X 1\n", "is damaged"),
    (b"#?RADIANCE\n\n-Y 99999999 +X 99999999\n1234", "is damaged"),
    (b"#?RADIANCE\n\n-Y 1 +X", "header is damaged"),
    (b"#?RADIANCE\n\n-Y 2 +X 2\n12345678", "cut short"),
    (b"#?RADIANCE\n\n-Y 2 +X 2\n\1\1\1\4" + b"1234", "begins with a repetition"),
    (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 9\n\2\2\0\x09\x89", "scanline 0"),
    (b"", "begins with #?"),
])  # fmt: skip
def test_damage_is_refused_by_name(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=rf"a\.hdr: .*{reason}"):
        radiance.read(path)


def test_primaries_of_rec_709() -> None:
    """The luminance of Rec. 709's red, green and blue, and the identity."""
    assert np.allclose(colour.to_xyz(colour.REC_709)[1], (0.2126, 0.7152, 0.0722), atol=1e-4)
    assert np.allclose(colour.to_rec_709(colour.REC_709), np.eye(3), atol=1e-12)


def test_another_white_stays_white() -> None:
    """ACES 2065-1, whose white is D60."""
    aces = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    matrix = colour.to_rec_709(aces)
    assert np.allclose(matrix.sum(1), 1, atol=1e-9)
    assert np.allclose(matrix[0], (2.5216, -1.1341, -0.3876), atol=3e-3)  # with the adaptation of Bradford
