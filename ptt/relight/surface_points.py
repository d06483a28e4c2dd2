"""Vertices or pixels, as relighters take them that need no model of the scene."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ptt.imaging.gbuffer import GBuffer
from ptt.materials.material import LayersAt
from ptt.materials.varying import SurfaceMaterial
from ptt.ops.mesh import SEEN
from ptt.scene.scene import Scene


class SurfacePoints(NamedTuple):
    """Points of a mesh: positions (p, 3), frames (p, 3, 3), dips (p,) (`ops.mesh.dips`), region (p,) int32, colour
    (p, 3); where on it: triangle (p,), barycentric (p, 3)."""

    positions: Tensor
    frames: Tensor
    dips: Tensor
    region: Tensor
    colour: Tensor
    triangle: Tensor
    barycentric: Tensor

    @classmethod
    def of_vertices(cls, scene: Scene) -> SurfacePoints:
        """The vertices of a scene."""
        own = scene.points, scene.frames, scene.dips
        return cls(*own, scene.vertex_region.int(), scene.colours, *scene.vertex_places)

    @classmethod
    def of_pixels(cls, view: GBuffer) -> SurfacePoints:
        """The pixels of a G-buffer, which are seen."""
        own = view.positions, view.frames, torch.full_like(view.positions[:, 0], SEEN)
        return cls(*own, view.region.int(), view.colours, view.triangle, view.barycentric)

    def layers_at(self, scene: Scene, material: SurfaceMaterial, rows: Tensor) -> LayersAt:
        """What the points in some rows have of a material that is over them."""
        values = scene.map_values(material.maps, self.triangle[rows], self.barycentric[rows])
        return material.at(values, self.colour[rows])
