"""Images, and pictures of radiance at vertices: rays by embree, radiance interpolated in each triangle."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from os import PathLike

import torch
from torch import Tensor

from ptt.io.images import png, write_image
from ptt.light.environment import Environment
from ptt.ops import kinds
from ptt.scene.camera import Camera
from ptt.scene.scene import Scene

RAYS_AT_ONCE = 1 << 20  # 24 MB of origins and directions in float32


@dataclass(frozen=True, eq=False)
class Image:
    """A picture in linear RGB: pixels (height, width, 3), row 0 on top."""

    pixels: Tensor

    def __repr__(self) -> str:
        height, width, _ = self.pixels.shape
        low, high = (float(end) for end in self.pixels.detach().aminmax())
        return f"Image({width} x {height} pixels of {low:.3g} to {high:.3g})"

    def _repr_png_(self) -> bytes:
        """The picture as a notebook shows it, exposed by `exposure`."""
        return png(self.pixels * 2.0 ** self.exposure())

    def exposure(self) -> float:
        """The stops for `save` that bring the brightest twentieth of the picture to white; 0 for a black picture."""
        luminance = self.pixels.reshape(-1, 3) @ self.pixels.new_tensor([0.2126, 0.7152, 0.0722])
        rank = max(1, int(0.95 * len(luminance)))
        bright = float(luminance.kthvalue(rank).values)
        return -math.log2(bright) if bright > 0 else 0.0

    def save(self, path: str | PathLike[str], exposure: float = 0.0) -> None:
        """Write .exr or .hdr (linear) or .png (sRGB, clipped), brightened by `exposure` stops.

        Raises:
            ValueError: the ending is another, or the file cannot be written.
        """
        write_image(path, self.pixels * 2.0**exposure)


def render(
    scene: Scene, camera: Camera, radiance: Tensor, environment: Environment | None = None, antialias: int = 2
) -> Image:
    """The picture that a camera sees of vertex radiance (v, 3).

    environment: the background; black without one
    antialias: rays along each side of a pixel; 1 for its centre alone

    Back faces are black: surfaces are one-sided.

    Raises:
        ValueError: radiance is not (v, 3) for the scene's vertices or not finite, antialias < 1, or another
            argument is of another kind.
    """
    kinds.check("scene", scene, Scene)
    kinds.check("camera", camera, Camera)
    kinds.check("environment", environment, (Environment, type(None)))
    if radiance.shape != scene.vertices.shape or not bool(torch.isfinite(radiance).all()):
        raise ValueError(f"radiance must be finite, {tuple(scene.vertices.shape)}, got {tuple(radiance.shape)}")
    if antialias < 1:
        raise ValueError(f"antialias must be at least 1, got {antialias}")
    width = camera.width
    eye, directions = replace(camera, width=width * antialias, height=camera.height * antialias).rays()
    rows_at_once = max(1, RAYS_AT_ONCE // (width * antialias**2))
    rows = []
    for part in directions.split(antialias * rows_at_once):
        seen = _radiance_along(scene, eye, part.flatten(0, 1), radiance, environment)
        rows.append(seen.reshape(-1, antialias, width, antialias, 3))
    return Image(torch.cat(rows).mean((1, 3)))


def _radiance_along(
    scene: Scene, eye: Tensor, directions: Tensor, radiance: Tensor, environment: Environment | None
) -> Tensor:
    """Radiance (n, 3) along rays from the eye, interpolated from the vertices (v, 3); the environment beyond."""
    hits = scene.surface.first_hit(eye.expand_as(directions), directions)
    corners = scene.faces[hits.triangle.clamp(min=0)]
    surface = torch.einsum("nkc,nk->nc", radiance.cpu()[corners], hits.barycentric * hits.front[:, None])
    if environment is None:
        return surface
    missed = (hits.triangle < 0)[:, None]
    return torch.where(missed, environment.radiance(directions), surface)
