"""Points among the sampled normals of environment maps, by regions and by the layers of their materials."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial
from ptt.ops import slices
from ptt.ops.compiling import in_python
from ptt.ops.octahedral import Octahedral
from ptt.ops.slices import ALIGNED, NormalLookup
from ptt.relight.surface_points import SurfacePoints
from ptt.scene.scene import Scene


@in_python
class SortedPoints(nn.Module):
    """The points of one region, sorted by the normal that is nearest, so that the local light stays in the cache.

    rows (v,): which they are; beyond the count of points the last one again, until v is a multiple of `ALIGNED`
    colour (v, 3), occlusion (v, 1), frames (3, 3, v): of the surface
    """

    rows: Tensor
    colour: Tensor
    occlusion: Tensor
    frames: Tensor

    def __init__(
        self, count: int, rows: Tensor, lookup: NormalLookup, colour: Tensor, occlusion: Tensor, frames: Tensor
    ) -> None:
        super().__init__()
        self.count = count
        own = {"rows": rows, "colour": colour, "occlusion": occlusion, "frames": frames}
        for name, tensor in (own | lookup._asdict()).items():
            self.register_buffer(name, tensor, persistent=False)

    @classmethod
    def of(cls, rows: Tensor, surface: SurfacePoints, occlusion: Tensor, sampled: Tensor) -> SortedPoints:
        """The points in those rows of a surface, with its occlusion (v,), among sampled frames (f, 3, 3)."""
        nearest = Octahedral(math.isqrt(len(sampled))).cell(surface.frames[rows, 2])
        count = len(rows)
        rows = rows[nearest.argsort(stable=True)]
        rows = torch.cat((rows, rows[-1:].expand(-count % ALIGNED)))
        positions, frames = surface.positions[rows], surface.frames[rows]
        lookup = slices.located(positions, frames, sampled, surface.dips[rows])
        own = surface.colour[rows], occlusion[rows, None], frames.movedim(0, 2).contiguous()
        return cls(count, rows, lookup, *own)

    @property
    def lookup(self) -> NormalLookup:
        """The points among the sampled normals."""
        return NormalLookup(*(self.get_buffer(name) for name in NormalLookup._fields))


class LayeredPoints(NamedTuple):
    """The points of a region that have the same layers: those of its material by their numbers, and how much of each
    (m, v, 3), None for all of every layer; the base colour (v, 3)."""

    points: SortedPoints
    layers: tuple[int, ...]
    shares: Tensor | None
    colour: Tensor


def whole(points: SortedPoints, material: Material) -> LayeredPoints:
    """Points of a material that is the same everywhere."""
    return LayeredPoints(points, material.groups[0], None, points.colour)


def by_layers(
    points: SortedPoints,
    material: SurfaceMaterial,
    scene: Scene,
    surface: SurfacePoints,
    occlusion: Tensor,
    sampled: Tensor,
) -> list[LayeredPoints]:
    """The points of a region, group by group of its material's layers; those of a surface, as for `SortedPoints.of`."""
    if isinstance(material, Material):
        return [whole(points, material)]
    device = points.rows.device
    rows = points.rows[: points.count].cpu()
    at = surface.layers_at(scene, material, rows)
    found = []
    for number, layers in enumerate(material.groups):
        some = (at.group == number).nonzero()[:, 0]
        if len(some):
            own = SortedPoints.of(rows[some], surface, occlusion, sampled).to(device)
            some = torch.cat((some, some[-1:].expand(len(own.rows) - len(some))))  # as the rows are padded
            shares, colour = (x.to(device) for x in (at.shares[:, some], at.colour[some]))
            found.append(LayeredPoints(own, layers, shares, colour))
    return found
