"""What triple products trace and turn once: what places see, and the frames that light is rotated into."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from ptt import threads
from ptt.imaging.atlas import Atlas
from ptt.ops import local, transfer
from ptt.ops.geodesic import Geodesic
from ptt.ops.hemispheres import SHARES, words_of
from ptt.scene.scene import Scene

BLOCK = 2048  # places whose visibility is traced at once
BITS_OF_VERTICES, BITS_OF_TEXELS = 128, 64
"""Cells along an edge of the map of bits of what a place sees: in a trial on a statue under a map with five lamps, GGX
of roughness 0.5 and 0.7 erred by 2.8 and 3.7 % with 128, 8.4 and 8.9 with 64, 2.9 and 3.4 with rays all over the lamps.
"""
MEMORY = 8e9  # bytes that all tables together may take
OPERATOR = 32  # of the rotation operator, for a triangle of a frame


def turned(frames: Tensor, twists: int) -> Tensor:
    """Frames (f * twists, 3, 3) of frames (f, 3, 3): their tangents turned about the normal, evenly all around."""
    angle = torch.arange(twists, dtype=torch.float64) * (2 * math.pi / twists)
    c = angle.cos()
    s = angle.sin()
    o = torch.zeros_like(angle)
    turns = torch.stack((c, s, o, -s, c, o, o, o, o + 1), -1).reshape(-1, 3, 3).to(frames)
    return torch.einsum("tab,fbx->ftax", turns, frames).reshape(-1, 3, 3)


def places_of(scene: Scene, atlas: Atlas | None) -> tuple[Tensor, Tensor]:
    """Positions (v, 3) and frames (v, 3, 3) of every vertex, or of every texel in use."""
    if atlas is None:
        return scene.points, scene.frames
    return atlas.interpolated(scene, scene.vertices), scene.frames_at(atlas.triangle, atlas.barycentric)


def triangles(scene: Scene, places: tuple[Tensor, Tensor], grid: Geodesic, rays: int, progress: bool) -> Tensor:
    """The share of each triangle that places see (v, n) uint8."""

    def traced(points: Tensor, frames: Tensor) -> Tensor:
        return local.visibility(scene.surface, points, frames, grid, rays)

    return _traced("visibility", places, progress, traced)


def hemispheres(scene: Scene, places: tuple[Tensor, Tensor], bits: int, progress: bool) -> Tensor:
    """What places see of their hemispheres (v, words) int32, for lobes."""

    def traced(points: Tensor, frames: Tensor) -> Tensor:
        return transfer.traced_hemispheres(scene.surface, points, frames, bits, SHARES)

    return _traced("hemispheres", places, progress, traced)


def _traced(
    what: str, places: tuple[Tensor, Tensor], progress: bool, trace: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    parts = []
    with tqdm(total=len(places[0]), desc=what, unit=" points", disable=not progress) as bar:
        for some in zip(*(x.split(BLOCK) for x in places), strict=True):
            threads.share()
            parts.append(trace(*some))
            bar.update(len(some[0]))
    return torch.cat(parts)


def check_memory(triangles: int, frames: int, views: int, points: int, bits: int) -> None:
    """Refuse tables that are too large; bits: of the hemispheres of places, 0 where triangles have the highlights."""
    seen = 4 * words_of(bits) * points if bits else 2 * triangles * views
    need = triangles * ((6 + OPERATOR) * frames + points) + seen
    if need > MEMORY:
        raise ValueError(
            f"{triangles} triangles take {need / 1e9:.1f} GB, of {MEMORY / 1e9:g}: {frames} frames of light, {views} "
            f"directions of view, {points} points; make level, normals, twists or views smaller, or the mesh or atlas"
        )
