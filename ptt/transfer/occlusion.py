"""Ambient occlusion: the share of the sky that a vertex sees, by the cosine."""

from __future__ import annotations

import torch
from torch import Tensor
from tqdm import tqdm

from ptt import threads
from ptt.ops import kinds
from ptt.ops.transfer import gather_directions
from ptt.scene.scene import Scene

RAYS_AT_ONCE = 1 << 20  # 24 MB of origins and directions in float32


def ambient_occlusion(scene: Scene, rays: int = 256, progress: bool = False) -> Tensor:
    """The share (v,) of the cosine-weighted hemisphere that each vertex sees: 1 where nothing is in the way.

    rays: number of rays from each vertex, with a density proportional to the cosine, in the same local directions

    Raises:
        ValueError: rays < 1.
    """
    kinds.check("scene", scene, Scene)
    if rays < 1:
        raise ValueError(f"rays must be at least 1, got {rays}")
    local = gather_directions(rays).float()
    origins = scene.surface.offset(scene.points, scene.normals)
    step = max(1, RAYS_AT_ONCE // rays)
    parts = []
    with tqdm(total=len(origins), desc="occlusion", unit=" vertices", disable=not progress) as bar:
        for start, frames in zip(origins.split(step), scene.frames.split(step), strict=True):
            threads.share()
            directions = (local @ frames).flatten(0, 1)
            hidden = scene.surface.occluded(start.repeat_interleave(rays, 0), directions)
            parts.append(1 - hidden.reshape(-1, rays).float().mean(1))
            bar.update(len(start))
    return torch.cat(parts)
