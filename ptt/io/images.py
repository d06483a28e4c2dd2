"""Images on disk; `ptt.io.saved` has the models.

In memory an image is linear, float32, (height, width, channels), row 0 on top. `.exr` and `.hdr` hold linear
values; `.png` holds eight bits with the sRGB transfer curve, clipped to [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TypeVar

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import torch
from numpy.typing import NDArray
from torch import Tensor

_F = TypeVar("_F", bound=Callable[..., object])
_CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}


def read_image(path: str | PathLike[str]) -> Tensor:
    """The linear image (height, width, channels) float32 of a file: 3 channels, 4 with alpha, 1 or 2 for grey.

    Raises:
        ValueError: the ending is unknown, or the file is missing, unreadable or cut short.
    """
    path = Path(path)
    pixels = _by_ending(path, {".exr": _read_exr, ".hdr": _read_oiio, ".png": _read_png})(path)
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))


def write_image(path: str | PathLike[str], image: Tensor) -> None:
    """Write a linear image (height, width, channels) of 1, 3 or 4 channels; PNG is clipped to [0, 1].

    Raises:
        ValueError: the ending is unknown, the shape is not that of an image, values are not finite (PNG and HDR), or
            the file cannot be written.
    """
    path = Path(path)
    write = _by_ending(path, {".exr": _write_exr, ".hdr": _write_hdr, ".png": _write_png})
    if image.ndim != 3 or image.shape[2] not in _CHANNELS or image.numel() == 0:
        raise ValueError(f"image must have shape (height, width, 1 | 3 | 4), got {tuple(image.shape)}")
    if path.suffix.lower() != ".exr" and not image.isfinite().all():
        bad = int((~image.isfinite()).sum())
        raise ValueError(f"image must be finite for {path.name}: {bad} of {image.numel()} values are not")
    write(path, np.ascontiguousarray(image.detach().cpu().numpy(), dtype=np.float32))


def to_srgb(linear: Tensor) -> Tensor:
    """sRGB-encoded values (IEC 61966-2-1) of linear ones, which are clipped to [0, 1]."""
    x = linear.clamp(0, 1)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Tensor) -> Tensor:
    """Linear values of sRGB-encoded ones in [0, 1]: the inverse of `to_srgb`."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _by_ending(path: Path, table: dict[str, _F]) -> _F:
    """The function of a table for the ending of a path."""
    if path.suffix.lower() not in table:
        raise ValueError(f"image file must end in one of {', '.join(table)}, got {path}")
    return table[path.suffix.lower()]


def _read_exr(path: Path) -> NDArray[np.float32]:
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    colours = "RGB" if {"R", "G", "B"} <= planes.keys() else "Y"
    if not set(colours) <= planes.keys():
        raise ValueError(f"{path} must have channels R, G, B or Y, got {', '.join(planes)}")
    names = [*colours, "A"] if "A" in planes else [*colours]
    return np.stack([planes[name].astype(np.float32) for name in names], axis=-1)


def _read_oiio(path: Path) -> NDArray[np.float32]:
    file = oiio.ImageInput.open(str(path), _straight_alpha(oiio.ImageSpec()))
    if file is None:
        raise ValueError(f"cannot read {path}: {oiio.geterror()}")
    pixels = file.read_image("float")
    error = file.geterror()
    file.close()
    if pixels is None:
        raise ValueError(f"cannot read {path}: {error}")
    return np.asarray(pixels, dtype=np.float32)


def _straight_alpha(spec: oiio.ImageSpec) -> oiio.ImageSpec:
    """The spec, changed so that OpenImageIO neither multiplies nor divides colours by alpha."""
    spec.attribute("oiio:UnassociatedAlpha", 1)
    return spec


def _read_png(path: Path) -> NDArray[np.float32]:
    pixels = torch.from_numpy(_read_oiio(path))
    channels = pixels.shape[-1]
    colours = channels - 1 if channels in (2, 4) else channels  # the last of an even number is alpha
    return torch.cat((from_srgb(pixels[..., :colours]), pixels[..., colours:]), dim=-1).numpy()


def _write_exr(path: Path, pixels: NDArray[np.float32]) -> None:
    name = _CHANNELS[pixels.shape[2]]
    planes = {name: pixels if len(name) > 1 else np.ascontiguousarray(pixels[..., 0])}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, planes).write(str(path))
    except RuntimeError as error:
        raise ValueError(f"cannot write {path}: {error}") from error


def _write_hdr(path: Path, pixels: NDArray[np.float32]) -> None:
    if pixels.shape[2] != 3 or pixels.min() < 0:
        raise ValueError(f".hdr needs 3 channels >= 0, got shape {pixels.shape}, minimum {pixels.min():g}")
    _write_oiio(path, pixels)


def _write_png(path: Path, pixels: NDArray[np.float32]) -> None:
    image = torch.from_numpy(pixels)
    encoded = torch.cat((to_srgb(image[..., :3]), image[..., 3:].clamp(0, 1)), dim=-1)
    _write_oiio(path, (encoded * 255).round().to(torch.uint8).numpy())


def _write_oiio(path: Path, pixels: NDArray[np.generic]) -> None:
    height, width, channels = pixels.shape
    file = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype).replace("float32", "float"))
    _straight_alpha(spec)
    written = file is not None and file.open(str(path), spec) and file.write_image(pixels) and file.close()
    if not written:
        raise ValueError(f"cannot write {path}: {oiio.geterror() if file is None else file.geterror()}")
