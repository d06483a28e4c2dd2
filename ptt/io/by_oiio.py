"""Pixels as OpenImageIO reads and writes them: row 0 on top, alpha neither multiplied into colours nor divided out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray


def read(path: Path, name: Path | None = None) -> NDArray[np.float32]:
    """Values (height, width, channels) of a file, in 0..1 where it has 8 or 16 bits; name: for messages.

    Raises:
        ValueError: the file is missing, unreadable or cut short.
    """
    file = oiio.ImageInput.open(str(path), _straight_alpha(oiio.ImageSpec()))
    if file is None:
        raise ValueError(f"cannot read {name or path}: {oiio.geterror()}")
    pixels = file.read_image("float")
    error = file.geterror()
    file.close()
    if pixels is None:
        raise ValueError(f"cannot read {name or path}: {error}")
    return np.asarray(pixels, dtype=np.float32)


def write(path: Path, pixels: NDArray[np.generic]) -> None:
    """Write (height, width, channels) in the type of the pixels.

    Raises:
        ValueError: the file cannot be written.
    """
    height, width, channels = pixels.shape
    file = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype).replace("float32", "float"))
    _straight_alpha(spec)
    written = file is not None and file.open(str(path), spec) and file.write_image(pixels) and file.close()
    if not written:
        raise ValueError(f"cannot write {path}: {oiio.geterror() if file is None else file.geterror()}")


def _straight_alpha(spec: oiio.ImageSpec) -> oiio.ImageSpec:
    """The spec, changed so that OpenImageIO neither multiplies nor divides colours by alpha."""
    spec.attribute("oiio:UnassociatedAlpha", 1)
    return spec
