"""Where the functions of triple products are found for vertices and pixels, and what these are coated with."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.imaging.atlas import Atlas
from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial
from ptt.ops.near import Near
from ptt.ops.shade import ShadedPoints
from ptt.relight.shining_points import ShiningPoints
from ptt.relight.surface_points import SurfacePoints
from ptt.scene.scene import Scene


class PointLookups(NamedTuple):
    """Points that are shaded: where their light and visibility are found, rows of the tables, and their surface."""

    light: Near
    seen: Near
    surface: SurfacePoints


class CoatedPoints(NamedTuple):
    """What points are coated with: the group of layers (p,) int32, those of all regions one after the other; how much
    of each of its layers (i, p, 3); the base colour (p, 3)."""

    group: Tensor
    shares: Tensor
    colour: Tensor


class RelitPoints(NamedTuple):
    """Points as they are shaded, their normals (p, 3), and how they shine by lobes."""

    shaded: ShadedPoints
    normals: Tensor
    shining: list[ShiningPoints]


def located(
    scene: Scene,
    atlas: Atlas | None,
    surface: SurfacePoints,
    frames: Tensor,
    twists: int,
    brushed: bool,
    operations: Any,
) -> PointLookups:
    """Where the light of points is found, among frames (f, 3, 3) with so many turns, and their visibility: between the
    vertices, or the texels of an atlas.

    brushed: says whether light is interpolated between turns

    Raises:
        ValueError: pixels of another scene.
    """
    if len(surface.triangle) and int(surface.triangle.max()) >= len(scene.faces):
        raise ValueError("view must be a GBuffer of this relighter's scene: GBuffer.of(scene, camera)")
    light = operations.of_frames(surface.frames, frames.cpu(), twists, brushed)
    if atlas is not None:
        seen = operations.of_texels(atlas.corner_uv, surface.triangle, surface.barycentric, atlas.rows)
    else:
        seen = Near(scene.faces[surface.triangle].int(), surface.barycentric)
    light, seen = (Near(*(x.to(frames.device) for x in found)) for found in (light, seen))
    return PointLookups(light, seen, SurfacePoints(*(x.to(frames.device) for x in surface)))


def coated(scene: Scene, surface: SurfacePoints, materials: Sequence[SurfaceMaterial]) -> CoatedPoints:
    """What points are coated with, by the materials of all regions.

    Of a material that is the same everywhere that is all of each of its layers, in one group.
    """
    here = SurfacePoints(*(x.cpu() for x in surface))
    region = here.region.long()
    first = torch.tensor([0, *accumulate(len(material.groups) for material in materials)], dtype=torch.int32)
    layers = torch.tensor([max(map(len, material.groups)) for material in materials])
    groups = first[region]
    own = torch.arange(int(layers.max()))[:, None] < layers[region]
    shares = own[..., None].expand(-1, -1, 3).float()
    colours = here.colour.clone()
    for number, material in enumerate(materials):
        if isinstance(material, Material):
            continue
        rows = (region == number).nonzero()[:, 0]
        found = here.layers_at(scene, material, rows)
        groups[rows] += found.group.int()
        shares[: len(found.shares), rows] = found.shares
        colours[rows] = found.colour
    return CoatedPoints(*(x.to(surface.positions.device) for x in (groups, shares, colours)))
