"""Textures: images over texture coordinates, and how they go on beyond their edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ptt.ops import mesh

Wrap = Literal["repeat", "mirror", "clamp"]


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
        if pixels.ndim != 3 or not pixels.numel():
            raise ValueError(f"texture must be linear (h, w, c), got {tuple(pixels.shape)}")
        if not bool(pixels.isfinite().all()):
            raise ValueError("texture must be finite")
        object.__setattr__(self, "pixels", pixels)

    def __repr__(self) -> str:
        height, width, channels = self.pixels.shape
        return f"Texture({width} x {height}, {channels} channels, {' and '.join(self.wrap)})"

    def at(self, uv: Tensor) -> Tensor:
        """Bilinear values (n, c) at uv (n, 2), v = 1 on top."""
        return mesh.sample_texture(self.pixels, uv, self.wrap)

    def channel(self, number: int) -> Texture:
        """The texture of one of its channels, (h, w, 1)."""
        return Texture(self.pixels[..., number : number + 1].contiguous(), self.wrap)
