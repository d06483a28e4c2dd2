"""Textures: images over texture coordinates, and how they go on beyond their edges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ptt.io.colour import from_srgb
from ptt.ops import mesh

Wrap = Literal["repeat", "mirror", "clamp"]
EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's modes of at most 8 bits a channel


@dataclass(frozen=True, eq=False)
class Texture:
    """An image (h, w, c), linear, row 0 on top; wrap: how it goes on beyond its edges, along u and along v.

    Raises:
        ValueError: pixels have another shape, or are not finite.
    """

    pixels: Tensor
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def __post_init__(self) -> None:
        pixels = torch.as_tensor(self.pixels).float()
        if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.numel():
            raise ValueError(f"texture must be (h, w, 3) linear RGB, got {tuple(pixels.shape)}")
        if not bool(pixels.isfinite().all()):
            raise ValueError("texture must be finite")
        object.__setattr__(self, "pixels", pixels)

    def __repr__(self) -> str:
        height, width, _ = self.pixels.shape
        return f"Texture({width} x {height}, {' and '.join(self.wrap)})"

    def at(self, uv: Tensor) -> Tensor:
        """Bilinear values (n, c) at uv (n, 2), v = 1 on top."""
        return mesh.sample_texture(self.pixels, uv, self.wrap)


def read_texture(path: Path) -> Texture:
    """The texture of an 8-bit sRGB image.

    Raises:
        ValueError: the file is missing, not an image, or not of 8 bits.
    """
    try:
        return Texture(from_image(Image.open(path)))
    except (OSError, ValueError) as error:
        raise ValueError(f"texture must be a readable 8-bit image: {path}: {error}") from error


def from_image(image: Image.Image, srgb: bool = True) -> Tensor:
    """The linear RGB (h, w, 3) float32 of an 8-bit image; alpha is ignored.

    Raises:
        ValueError: it has more than 8 bits.
    """
    if image.mode not in EIGHT_BITS:
        raise ValueError(f"8-bit grey, palette or RGB expected, got mode {image.mode}")
    pixels = torch.from_numpy(np.asarray(image.convert("RGB")) / 255.0)
    return (from_srgb(pixels) if srgb else pixels).float()
