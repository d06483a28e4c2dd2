"""Images on disk; `ptt.io.saved` has the models.

In memory an image is linear, float32, (height, width, channels), row 0 on top. `.exr` and `.hdr` hold linear
values; `.png` holds eight bits with the sRGB transfer curve, clipped to [0, 1].
"""

from __future__ import annotations

import io
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TypeVar

import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.io import by_oiio, exr, radiance
from ptt.io.colour import from_srgb, to_srgb
from ptt.io.saved import check_folder

_F = TypeVar("_F", bound=Callable[..., object])
CHANNELS = (1, 3, 4)


def read_image(path: str | PathLike[str], layer: str | None = None) -> Tensor:
    """The linear image (height, width, channels) float32 of a file: 3 channels, 4 with alpha, 1 or 2 for grey.

    layer: of an .exr with several parts or layers, the one to read; default: the first, with a warning

    Raises:
        ValueError: the ending is unknown, the file is missing, unreadable or cut short, or has no such layer.
    """
    path = Path(path)
    read = _by_ending(path, {".exr": exr.read, ".hdr": radiance.read, ".pic": radiance.read, ".png": _read_png})
    if layer is not None and path.suffix.lower() != ".exr":
        raise ValueError(f"layer is for .exr files, got {path}")
    pixels = exr.read(path, layer) if layer is not None else read(path)
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))


def write_image(path: str | PathLike[str], image: Tensor) -> None:
    """Write a linear image (height, width, channels) of 1, 3 or 4 channels; PNG is clipped to [0, 1].

    Raises:
        ValueError: the ending is unknown, the shape is not that of an image, values are not finite (PNG and HDR), or
            the file cannot be written.
    """
    path = Path(path)
    check_folder(path)
    write = _by_ending(path, {".exr": exr.write, ".hdr": _write_hdr, ".png": _write_png})
    if image.ndim != 3 or image.shape[2] not in CHANNELS or image.numel() == 0:
        raise ValueError(f"image must have shape (height, width, 1 | 3 | 4), got {tuple(image.shape)}")
    if path.suffix.lower() != ".exr" and not image.isfinite().all():
        bad = int((~image.isfinite()).sum())
        raise ValueError(f"image must be finite for {path.name}: {bad} of {image.numel()} values are not")
    write(path, np.ascontiguousarray(image.detach().cpu().numpy(), dtype=np.float32))


def png(image: Tensor) -> bytes:
    """A linear image (height, width, 3) as the bytes of a .png, sRGB, clipped to [0, 1]."""
    buffer = io.BytesIO()
    encoded = (to_srgb(image.detach().cpu()) * 255).round().to(torch.uint8)
    PIL.Image.fromarray(encoded.numpy()).save(buffer, "PNG")
    return buffer.getvalue()


def _by_ending(path: Path, table: dict[str, _F]) -> _F:
    """The function of a table for the ending of a path."""
    if path.suffix.lower() not in table:
        raise ValueError(f"image file must end in one of {', '.join(table)}, got {path}")
    return table[path.suffix.lower()]


def _read_png(path: Path) -> NDArray[np.float32]:
    pixels = torch.from_numpy(by_oiio.read(path))
    channels = pixels.shape[-1]
    colours = channels - 1 if channels in (2, 4) else channels  # the last of an even number is alpha
    return torch.cat((from_srgb(pixels[..., :colours]), pixels[..., colours:]), dim=-1).numpy()


def _write_hdr(path: Path, pixels: NDArray[np.float32]) -> None:
    if pixels.shape[2] != 3 or pixels.min() < 0:
        raise ValueError(f".hdr needs 3 channels >= 0, got shape {pixels.shape}, minimum {pixels.min():g}")
    by_oiio.write(path, pixels)


def _write_png(path: Path, pixels: NDArray[np.float32]) -> None:
    image = torch.from_numpy(pixels)
    encoded = torch.cat((to_srgb(image[..., :3]), image[..., 3:].clamp(0, 1)), dim=-1)
    by_oiio.write(path, (encoded * 255).round().to(torch.uint8).numpy())
