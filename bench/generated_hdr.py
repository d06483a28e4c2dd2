"""Generated HDR maps: every scan order and run length, exposure, primaries, XYZ, and damage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.generated_files import REC_709, WIDE, Array, Case, Forms, Sky, rgb, xyz

Bytes = NDArray[np.uint8]
PRIMARIES = (0.64, 0.33, 0.29, 0.6, 0.15, 0.06, 1 / 3, 1 / 3)
"""Radiance's."""


def valid(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A valid .hdr file."""
    forms = Forms(random)
    height = int(random.integers(1, 14))
    width = 2 * int(random.integers(1, 24))
    quads = _quads(forms, height, width)
    upright = np.ldexp(quads[..., :3].astype(np.float64), quads[..., 3:].astype(np.int64) - 136)
    upright *= quads[..., 3:] > 0
    lines, matrix = _header(forms)
    order = forms.one("-Y +X", "-Y -X", "+Y +X", "+Y -X", "+X -Y", "-X -Y", "+X +Y", "-X +Y").split()
    stored = quads[::-1] if "+Y" in order else quads
    stored = stored[:, ::-1] if "-X" in order else stored
    stored = stored.swapaxes(0, 1) if order[0][1] == "X" else stored
    size = f"{order[0]} {stored.shape[0]} {order[1]} {stored.shape[1]}"
    body = _runs(forms, np.ascontiguousarray(stored))
    path = folder / f"valid {number}.hdr"
    path.write_bytes(
        "\n".join([*lines, "", size, ""]).encode() + body + b"more" * forms.chance("bytes after the end", 0.1)
    )
    pixels = np.clip(upright @ matrix.T, 0, None)
    return Case(path, Sky(pixels), tuple(forms.drawn), warns="were negative" if (upright @ matrix.T < 0).any() else "")


def _quads(forms: Forms, height: int, width: int) -> Bytes:
    """Pixels (height, width, 4) with runs of equal ones, of exponents that are near each other, and some black."""
    random = forms.random
    quads = random.integers(0, 256, (height, width, 4))
    largest = random.integers(0, 3, (height, width))
    np.put_along_axis(quads, largest[..., None], random.integers(128, 256, (height, width, 1)), 2)
    quads[..., 3] = random.integers(120, 136) + random.integers(0, 6, (height, width))
    if forms.chance("runs of equal pixels", 0.6):
        quads = quads[:, np.sort(random.integers(0, width, width))]
    if forms.chance("black pixels", 0.3):
        quads[random.random((height, width)) < 0.2] = 0
    return quads.astype(np.uint8)


def _header(forms: Forms) -> tuple[list[str], Array]:
    """Lines before the size, and the matrix (3, 3) from stored values to radiance."""
    lines = [forms.one("#?RADIANCE", "#?RGBE"), "# made by bench", "VIEW= -vtv -vp 0 0 0"]
    exposure = np.ones(3)
    for _ in range(2):
        if forms.chance("exposure"):
            exposure *= (own := round(float(forms.random.uniform(0.1, 9)), 3))
            lines.append(f"EXPOSURE={' ' * forms.chance('blanks in the header', 0.5)}{own}")
    if forms.chance("colour correction", 0.2):
        own_colours = forms.random.uniform(0.5, 2, 3).round(3)
        exposure *= own_colours
        lines.append(f"COLORCORR= {' '.join(map(str, own_colours))}")
    matrix: Array = np.eye(3)
    if forms.chance("XYZE", 0.2):
        matrix = rgb(PRIMARIES)
        lines.append("FORMAT=32-bit_rle_xyze")
    elif not forms.chance("no format", 0.2):
        lines.append("FORMAT=32-bit_rle_rgbe")
    if "XYZE" not in forms.drawn and forms.chance("primaries", 0.2):
        matrix = rgb(REC_709) @ xyz(WIDE)
        lines.append(f"PRIMARIES= {' '.join(map(str, WIDE))}")
    lines += ["PIXASPECT=1", "a line of another program"] * forms.chance("unknown lines")
    return lines, matrix / exposure


def _runs(forms: Forms, stored: Bytes) -> bytes:
    """Lines as they are, with old run lengths or with new ones."""
    kinds = ["new", "old", "flat"] if 8 <= stored.shape[1] < 32768 else ["old", "flat"]
    kind = forms.one(*(f"{kind} run lengths" for kind in kinds))
    if kind.startswith("flat"):
        return stored.tobytes()
    encode = _new_runs if kind.startswith("new") else _old_runs
    return b"".join(encode(line, forms) for line in stored)


def _old_runs(line: Bytes, forms: Forms) -> bytes:
    """A line in which 1 1 1 n repeats the pixel before n times, the next such quad 256 n times."""
    body = b""
    at = 0
    while at < len(line):
        same = int(np.argmin((line[at:] == line[at]).all(1))) or len(line) - at
        body += line[at].tobytes()
        left = same - 1
        while left:
            body += bytes((1, 1, 1, left % 256))
            left //= 256
        at += same
    return body


def _new_runs(line: Bytes, forms: Forms) -> bytes:
    """A line channel by channel: runs of equal bytes where there are any, and pieces of any length."""
    body = b"\2\2" + len(line).to_bytes(2, "big")
    for channel in line.T:
        at = 0
        while at < len(channel):
            same = min(int(np.argmin(channel[at:] == channel[at])) or len(channel) - at, 127)
            if same > 1:
                body += bytes((128 + same, channel[at]))
                at += same
                continue
            size = min(int(forms.random.integers(1, 129)), len(channel) - at)
            body += bytes((size,)) + channel[at : at + size].tobytes()
            at += size
    return body


HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n" + bytes((200, 100, 50, 129)) * 16
LINE = b"\2\2\0\x08" + b"".join(bytes((0x88, x)) for x in (200, 100, 50, 129))
NEW = HDR[: -4 * 16] + LINE + LINE
WRITTEN: dict[str, Callable[[np.random.Generator], bytes]] = {
    "another magic": lambda _: HDR.replace(b"#?", b"%!"),
    "no bytes": lambda _: b"",
    "an unknown format": lambda _: HDR.replace(b"rle_rgbe", b"rle_yuv"),
    "no size": lambda _: HDR.replace(b"-Y 2 +X 8\n", b""),
    "a size of words": lambda _: HDR.replace(b"2 +X 8", b"two +X eight"),
    "a size of nothing": lambda _: HDR.replace(b"-Y 2", b"-Y 0"),
    "a size below zero": lambda _: HDR.replace(b"-Y 2", b"-Y -2"),
    "an endless size": lambda _: HDR.replace(b"-Y 2 +X 8", b"-Y 999999999 +X 999999999"),
    "one axis twice": lambda _: HDR.replace(b"+X", b"+Y"),
    "a third axis": lambda _: HDR.replace(b"+X", b"+Z"),
    "more lines than there are": lambda _: HDR.replace(b"-Y 2", b"-Y 3"),
    "more columns than there are": lambda _: HDR.replace(b"+X 8", b"+X 20"),
    "an exposure of words": lambda _: HDR.replace(b"FORMAT", b"EXPOSURE=bright\nFORMAT"),
    "an exposure of nothing": lambda _: HDR.replace(b"FORMAT", b"EXPOSURE=0\nFORMAT"),
    "an exposure below zero": lambda _: HDR.replace(b"FORMAT", b"EXPOSURE=-2\nFORMAT"),
    "an exposure that is no number": lambda _: HDR.replace(b"FORMAT", b"EXPOSURE=nan\nFORMAT"),
    "an exposure next to nothing": lambda _: HDR.replace(b"FORMAT", b"EXPOSURE=1e-40\nFORMAT"),
    "two numbers for a colour": lambda _: HDR.replace(b"FORMAT", b"COLORCORR=1 2\nFORMAT"),
    "primaries on a line": lambda _: HDR.replace(b"FORMAT", b"PRIMARIES=.1 .1 .2 .2 .3 .3 .3 .3\nFORMAT"),
    "primaries that are no numbers": lambda _: HDR.replace(b"FORMAT", b"PRIMARIES=nan .1 .2 .2 .3 .3 .3 .3\nFORMAT"),
    "a header that is cut short": lambda random: HDR[: int(random.integers(0, 46))],
    "pixels that are cut short": lambda random: HDR[: -int(random.integers(1, 64))],
    "a repetition of nothing": lambda _: HDR[: -4 * 16] + b"\1\1\1\4" + HDR[-4 * 15 :],
    "runs that are cut short": lambda random: NEW[: -int(random.integers(1, 20))],
    "a run that is too long": lambda _: NEW[: -len(LINE)] + LINE.replace(b"\x88", b"\x89", 1),
    "a run of nothing": lambda _: NEW[: -len(LINE)] + LINE.replace(b"\x88", b"\0", 1),
    "a line of another length": lambda _: NEW[: -len(LINE)] + LINE.replace(b"\0\x08", b"\0\x09", 1),
    "a first line of another length": lambda _: NEW[: -2 * len(LINE)] + LINE.replace(b"\0\x08", b"\0\x09", 1) + LINE,
    "a second line that is missing": lambda _: NEW[: -len(LINE)],
    "an exponent beyond float32": lambda _: HDR[:-1] + b"\xff",
}
DAMAGES = tuple(WRITTEN)


def broken(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A map of one colour, damaged in one way."""
    damage = DAMAGES[number % len(DAMAGES)]
    path = folder / f"broken {number}.hdr"
    path.write_bytes(WRITTEN[damage](random))
    return Case(path, None, damage=damage)
