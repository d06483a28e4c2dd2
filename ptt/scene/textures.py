"""Textures from image files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ptt.io.colour import from_srgb
from ptt.materials.textures import Texture

EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's modes of at most 8 bits a channel


def read_texture(path: Path, srgb: bool = True) -> Texture:
    """The texture of an 8-bit image, linear RGB; srgb: says whether the file follows the sRGB curve.

    Raises:
        ValueError: the file is missing, not an image, or not of 8 bits.
    """
    try:
        return Texture(from_image(Image.open(path), srgb))
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
