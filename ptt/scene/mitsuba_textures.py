"""The textures of a loaded Mitsuba scene: constant values, bitmaps, checkerboards and vertices' colours.

A loaded texture does not say whether its bytes follow the sRGB curve, nor how it goes on beyond its edges: both are
found by asking it for a few values. Rows of Mitsuba's bitmaps start at v = 0, those of ptt's at v = 1.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import product
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from ptt.io.colour import from_srgb
from ptt.materials.textures import Texture, Wrap
from ptt.scene.mitsuba_probes import Array, look_up, number, numbers

CHECKS = 512  # texels of a checkerboard's period, across which its edges are blurred by one
PROBES = 64  # lookups that tell how a bitmap is read
TOLERANCE = 2e-3  # of a bitmap's largest value: bytes and half floats are rounded to this


class Value(NamedTuple):
    """A value over a surface.

    mean (3,): linear RGB, over the texture or the same everywhere; what multiplies an attribute
    texture: over coordinates that are uv taken through the matrix, or None
    matrix (3, 3): takes Mitsuba's uv to those of the texture
    attribute: name of the vertices' colours that it is instead, or None
    """

    mean: Tensor
    texture: Texture | None = None
    matrix: Array = np.eye(3)
    attribute: str | None = None

    @property
    def varies(self) -> bool:
        """Tell whether it is not the same everywhere."""
        return self.texture is not None or self.attribute is not None


def read_value(texture: Any, losses: Counter[str]) -> Value:
    """The value of a loaded texture; one of another kind is its mean over the unit square, which counts as a loss."""
    name = texture.class_name()
    if name == "MeshAttribute":
        attribute = re.findall(r'name = "(.+)"', str(texture))[0]
        if attribute.startswith("vertex_"):
            return Value(torch.full((3,), number(texture, "scale")), attribute=attribute)
        losses[f"the colours of faces ({attribute})"] += 1
        return Value(torch.full((3,), 0.5))
    if not texture.is_spatially_varying():
        return Value(look_up(texture, np.zeros((1, 2)))[0])
    if not name.startswith(("BitmapTexture", "Checkerboard")):
        losses[f"a texture, whose mean it has ({name})"] += 1
        grid = np.stack(np.meshgrid(*[(np.arange(16) + 0.5) / 16] * 2), -1).reshape(-1, 2)
        return Value(look_up(texture, grid).mean(0))
    parameters = _parameters(texture)
    matrix = numbers(parameters["to_uv"].matrix).reshape(3, 3)
    found = _bitmap(texture, matrix, losses) if "data" in parameters else _checkerboard(texture, matrix)
    return Value(found.pixels.mean((0, 1)).expand(3), found, matrix)


def upwards(uv: Tensor) -> Tensor:
    """Coordinates (n, 2) with v down, as Mitsuba's bitmaps have it, as ptt's, with v up; and the other way around."""
    return torch.stack((uv[:, 0], 1 - uv[:, 1]), 1)


def transformed(uv: Tensor, matrix: Array) -> Tensor:
    """Coordinates (n, 2) taken through a matrix (3, 3)."""
    m = torch.from_numpy(matrix).to(uv)
    return uv @ m[:2, :2].T + m[:2, 2]


def _bitmap(texture: Any, matrix: Array, losses: Counter[str]) -> Texture:
    """The texture that gives what a bitmap gives at places inside and outside, of those that it may be."""
    data = np.array(_parameters(texture)["data"])
    pixels = torch.from_numpy(data / 255.0 if data.dtype == np.uint8 else data.astype(np.float64))
    decoded = [pixels, from_srgb(pixels)] if data.dtype == np.uint8 else [pixels]
    at = np.random.default_rng(0).uniform(-1, 2, (PROBES, 2))
    homogeneous = np.concatenate((at, np.ones((PROBES, 1))), 1)
    expected = look_up(texture, (homogeneous @ np.linalg.pinv(matrix).T)[:, :2])

    def error(candidate: Texture) -> float:
        return float((candidate.at(upwards(torch.from_numpy(at))) - expected).abs().mean())

    wraps: tuple[Wrap, ...] = get_args(Wrap)
    candidates = [Texture(values.float(), (wrap, wrap)) for values, wrap in product(decoded, wraps)]
    best = min(candidates, key=error)
    if error(best) > TOLERANCE * float(expected.abs().max()):
        losses["a bitmap's nearest texels (filter_type)"] += 1
    return best


def _checkerboard(texture: Any, matrix: Array) -> Texture:
    """One period of a checkerboard, as texels."""
    centres = np.array([[0.25, 0.25, 1], [0.75, 0.25, 1]]) @ np.linalg.pinv(matrix).T
    same, other = look_up(texture, centres[:, :2])
    half = torch.arange(CHECKS) >= CHECKS // 2
    return Texture(torch.where((half[:, None] == half)[..., None], same, other))


def _parameters(texture: Any) -> Any:
    import mitsuba as mi

    return mi.traverse(texture)
