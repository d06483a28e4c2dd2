"""Bump maps: normals in the frame of the surface, by its texture coordinates, for shading per pixel."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from os import PathLike

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.io.colour import to_srgb
from ptt.io.images import read_image
from ptt.materials.textures import Wrap
from ptt.ops import mesh

LOWEST = 0.05  # least height of a unit normal above the surface, 3 degrees: lower ones are raised to it


@dataclass(frozen=True, eq=False)
class BumpMap:
    """A tangent-space normal map (Ma et al. 2006, section 4.2).

    normals (h, w, 3): x along increasing u, y along increasing v, z out of the surface; any length but 0; row 0 on top
    wrap: how it goes on beyond its edges, as a `Texture`

    Normals lower than 3 degrees above the surface are raised to that; a warning counts them.

    Raises:
        ValueError: normals have another shape, are zero or not finite.
    """

    normals: Tensor
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def __post_init__(self) -> None:
        n = torch.as_tensor(self.normals, dtype=torch.float32)
        if n.ndim != 3 or n.shape[2] != 3 or not n.numel():
            raise ValueError(f"normals must be (h, w, 3), got {tuple(n.shape)}")
        length = n.norm(dim=2)
        if bad := int((~(length > 0) | ~length.isfinite()).sum()):
            raise ValueError(f"normals must be finite and not zero: {bad} of {length.numel()} are not")
        n = normalize(n, dim=2)
        below = n[..., 2:] < LOWEST
        if count := int(below.sum()):
            warnings.warn(f"{count} of {below.numel()} normals lie below the surface, and are raised", stacklevel=3)
            level = normalize(n[..., :2], dim=2) * math.sqrt(1 - LOWEST**2)
            n = torch.where(below, torch.cat((level, torch.full_like(n[..., 2:], LOWEST)), 2), n)
            n[(n[..., :2] == 0).all(2)] = n.new_tensor([0.0, 0.0, 1.0])
        object.__setattr__(self, "normals", n)

    @classmethod
    def of_heights(cls, heights: Tensor, depth: float = 1.0) -> BumpMap:
        """The normals of a height field (h, w) that repeats, row 0 on top.

        depth: the height of 1, in widths of the texture
        """
        if heights.ndim != 2 or not heights.numel():
            raise ValueError(f"heights must be (h, w), got {tuple(heights.shape)}")
        rows, columns = heights.shape
        du = (heights.roll(-1, 1) - heights.roll(1, 1)) * (depth * columns / 2)
        dv = (heights.roll(1, 0) - heights.roll(-1, 0)) * (depth * rows / 2)
        return cls(torch.stack((-du, -dv, torch.ones_like(heights)), 2))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> BumpMap:
        """The bump map of a .png with normals = 2 rgb - 1, y up (OpenGL's convention)."""
        return cls(2 * to_srgb(read_image(path)) - 1)

    def bend(self, frames: Tensor, uv: Tensor, mirrored: Tensor) -> Tensor:
        """Frames (p, 3, 3) of points at uv (p, 2), turned to the map's normals.

        mirrored (p,) bool: where uv run the other way around than the surface, and v against the bitangent
        """
        local = mesh.sample_texture(self.normals, uv, self.wrap).to(frames)
        local = torch.where(mirrored[:, None], local * local.new_tensor([1.0, -1.0, 1.0]), local)
        normal = torch.einsum("pa,pax->px", local, frames)
        return mesh.frames(normal, frames[:, 0], lambda rows: frames[rows, 2])[0]
