"""Radiance pictures (.hdr, .pic): every scan order, exposure, primaries, XYZE, and run lengths old and new.

The header is read here, and so are flat pixels and old run lengths; OpenImageIO decodes the run lengths of today.

Ward, "Radiance File Formats" (filefmts.pdf), pictures.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ptt.io import by_oiio, colour

PRIMARIES = (0.64, 0.33, 0.29, 0.6, 0.15, 0.06, 1 / 3, 1 / 3)
"""Radiance's own, in which RGB are taken for ours; XYZ become RGB by them."""
FORMATS = ("32-bit_rle_rgbe", "32-bit_rle_xyze")
MOST_BYTES = 1 << 16
"""Of a line of the header."""
MOST_PIXELS = 1 << 28
"""More are taken for damage."""


class Header(NamedTuple):
    """What a picture says of itself.

    form: one of FORMATS, or "" where it does not say, which is the first
    exposure (3): what pixels were multiplied by
    matrix (3, 3): from pixels to RGB by our primaries
    order: signs and axes of both directions in which pixels follow each other, the slower first, as "-Y", "+X"
    counts: pixels along both
    """

    form: str
    exposure: NDArray[np.float64]
    matrix: NDArray[np.float64]
    order: tuple[str, str]
    counts: tuple[int, int]

    @property
    def plain(self) -> bool:
        """Tell whether OpenImageIO takes the file as it is."""
        return self.form == FORMATS[0] and self.order == ("-Y", "+X")


def read(path: Path) -> NDArray[np.float32]:
    """Linear RGB (height, width, 3) of a picture, row 0 on top: radiance, as it was before exposure.

    Raises:
        ValueError: the file is missing, no Radiance picture, or cut short.
    """
    try:
        with path.open("rb") as file:
            header = _header(file, path)
            start = file.tell()
            new = _is_new(file.read(4), header.counts[1])
            file.seek(start)
            pixels = _decoded(path, header, b"" if new and header.plain else file.read(), new)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    return _upright(_radiance(pixels, header), header.order)


def _header(file: BinaryIO, path: Path) -> Header:
    if not file.readline(MOST_BYTES).startswith(b"#?"):
        raise ValueError(f"cannot read {path}: it is no Radiance picture, which begins with #?")
    exposure = np.ones(3)
    form = ""
    matrix: NDArray[np.float64] = np.eye(3)
    try:
        while line := file.readline(MOST_BYTES).decode("latin-1").strip():
            name, _, value = line.partition("=")
            if name == "FORMAT":
                form = value.strip()
            elif name in ("EXPOSURE", "COLORCORR"):
                exposure = exposure * _numbers(name, value, 1 if name == "EXPOSURE" else 3)
            elif name == "PRIMARIES":
                matrix = _from(_numbers(name, value, 8))
        words = file.readline(MOST_BYTES).decode("latin-1").split()
        order, counts = (words[0], words[2]), (int(words[1]), int(words[3]))
    except (ValueError, IndexError) as error:
        raise ValueError(f"cannot read {path}: its header is damaged: {error}") from error
    if form not in ("", *FORMATS):
        raise ValueError(f"cannot read {path}: FORMAT must be one of {', '.join(FORMATS)}, got {form!r}")
    if {name[1:] for name in order} != {"X", "Y"} or any(name[0] not in "+-" for name in order):
        raise ValueError(f"cannot read {path}: its size must be as -Y 512 +X 1024, got {' '.join(words)!r}")
    if min(counts) < 1 or counts[0] * counts[1] > MOST_PIXELS:
        raise ValueError(f"cannot read {path}: its size of {counts[0]} x {counts[1]} pixels is damaged")
    if not (np.isfinite(exposure).all() and (exposure > 0).all()):
        raise ValueError(f"cannot read {path}: EXPOSURE and COLORCORR must be positive, got {exposure.tolist()}")
    if form == FORMATS[1]:
        matrix = np.linalg.inv(colour.to_xyz(PRIMARIES)).astype(np.float64)
    return Header(form, exposure, matrix, order, counts)


def _numbers(name: str, value: str, count: int) -> NDArray[np.float64]:
    numbers = np.array([float(word) for word in value.split()])
    if len(numbers) != count:
        raise ValueError(f"{name} must be {count} numbers, got {value!r}")
    return numbers


def _from(primaries: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix (3, 3) from RGB of some primaries to ours; Radiance's own are taken for ours."""
    return np.eye(3) if np.allclose(primaries, PRIMARIES, atol=1e-3) else colour.to_rec_709(primaries.tolist())


def _is_new(begin: bytes, width: int) -> bool:
    """Tell whether the first line has run lengths channel by channel, those of today."""
    return len(begin) == 4 and begin[:2] == b"\2\2" and begin[2] < 128 and 8 <= width < 1 << 15


def _decoded(path: Path, header: Header, data: bytes, new: bool) -> NDArray[np.float32]:
    """Pixels (slow, fast, 3) as they are stored."""
    slow, fast = header.counts
    if not new:
        quads = _old_runs(np.frombuffer(data, np.uint8, len(data) // 4 * 4).reshape(-1, 4), slow * fast, path)
        scale = np.ldexp(np.float32(1), quads[:, 3].astype(np.int32) - 136) * (quads[:, 3] > 0)
        pixels: NDArray[np.float32] = (quads[:, :3] * scale[:, None]).astype(np.float32)
        return pixels.reshape(slow, fast, 3)
    if header.plain:
        return by_oiio.read(path)
    with tempfile.NamedTemporaryFile(suffix=".hdr") as plain:
        plain.write(f"#?RADIANCE\nFORMAT={FORMATS[0]}\n\n-Y {slow} +X {fast}\n".encode() + data)
        plain.flush()
        return by_oiio.read(Path(plain.name), path)


def _old_runs(quads: NDArray[np.uint8], count: int, path: Path) -> NDArray[np.uint8]:
    """Pixels (count, 4) of quads: 1 1 1 n repeats the pixel before n times, such a quad right after it 256 n times."""
    marker = (quads[:, :3] == 1).all(1)
    numbers = np.arange(len(quads))
    source = np.maximum.accumulate(np.where(marker, -1, numbers))
    if len(source) and source[0] < 0:
        raise ValueError(f"cannot read {path}: it begins with a repetition")
    after = np.minimum(numbers - source - 1, 4)  # of markers that follow each other; more than four are damage
    times = np.where(marker, quads[:, 3].astype(np.int64) << 8 * after, 1)
    end = int(np.searchsorted(np.minimum(times, count).cumsum(), count))
    if end == len(quads):
        raise ValueError(f"cannot read {path}: it is cut short")
    rows = np.repeat(source[: end + 1], np.minimum(times[: end + 1], count))[:count]
    return quads.take(rows, 0)


def _radiance(pixels: NDArray[np.float32], header: Header) -> NDArray[np.float32]:
    """RGB before exposure, by our primaries."""
    if np.array_equal(header.matrix, np.eye(3)) and (header.exposure == 1).all():
        return pixels
    return pixels @ (header.matrix / header.exposure).T.astype(np.float32)


def _upright(pixels: NDArray[np.float32], order: tuple[str, str]) -> NDArray[np.float32]:
    """Rows from the top, columns from the left, in a copy: numpy takes one line, turned around, for contiguous."""
    if order == ("-Y", "+X"):
        return pixels
    if order[0][1] == "X":
        pixels = pixels.swapaxes(0, 1)
    if "+Y" in order:
        pixels = pixels[::-1]
    return (pixels[:, ::-1] if "-X" in order else pixels).copy()
