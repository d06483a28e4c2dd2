"""Figure 6 of Sun et al. 2007: a sphere under a map, from the BRDF tensor and its lobes, beside the path tracer."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

import ptt
from ptt import reference
from ptt.light import prefiltered as light_maps
from ptt.ops import lobes, mesh, transfer
from ptt.ops.sphere import Cube
from ptt.ops.view import light_about
from ptt.scene.parts import Part

GRID = Cube(64)


class Sphere:
    """Points of a unit sphere, as an eye far along +z sees it through n x n pixels; light comes from everywhere."""

    def __init__(self, pixels: int) -> None:
        at = (2 * torch.arange(pixels) + 1) / pixels - 1
        y, x = torch.meshgrid(-at, at, indexing="ij")
        self.seen = x * x + y * y < 0.995
        x = x[self.seen]
        y = y[self.seen]
        normal = torch.stack((x, y, (1 - x * x - y * y).sqrt()), 1)
        self.view = torch.tensor([0.0, 0.0, 1.0]).expand_as(normal)
        tangent = normalize(self.view - normal[:, 2:] * normal + 1e-6, dim=1)
        tangent = normalize(tangent - (tangent * normal).sum(1, keepdim=True) * normal, dim=1)
        self.frames = torch.stack((tangent, torch.linalg.cross(normal, tangent), normal), 1)
        self.wo = torch.einsum("vij,vj->vi", self.frames, self.view)

    def truth(self, material: ptt.Material, light: ptt.Environment, samples: int) -> reference.Estimate:
        """Radiance (v, 3) by the path tracer."""
        speck, faces = mesh.sphere_mesh(1, 1e-3)
        away = Part("sphere", speck + torch.tensor([0.0, -1e3, 0.0]), faces, material=material)
        scene = ptt.Scene.from_parts([away])
        v = len(self.wo)
        points = reference.Points(self.frames[:, 2], self.frames, torch.zeros(v, dtype=torch.int64), torch.ones(v, 3))
        return reference.radiance(scene, light, {"sphere": material}, points, self.view, samples=samples)

    def incident(self, brdf: ptt.TensorBRDF, light: ptt.Environment) -> Tensor:
        """U (1 + i, v, 3): the light through the diffuse and every incident factor, by the texels of a cube map."""
        directions = GRID.directions().reshape(-1, 3).float()
        solid_angles = GRID.solid_angles().flatten().float()
        texels = light.project(GRID).reshape(-1, 3)
        parts = []
        for frames in self.frames.split(64):
            visible = torch.ones(len(frames), GRID.cells, dtype=torch.bool)
            parts.append(transfer.direct_transfer(visible, frames, directions, solid_angles, brdf.u_i) @ texels)
        return torch.cat(parts).transpose(0, 1)

    def mirrored(self, brdf: ptt.TensorBRDF, light: ptt.Environment) -> Tensor:
        """Mean light (v, k, 3) about the axes of the lobes, as the relighter has it."""
        axes = self._world(lobes.lean(brdf.axes, self.wo))
        if not brdf.angles:
            return torch.zeros_like(axes)
        return light_about(light_maps.light_maps(light.map, brdf.angles).whole.blurred, axes @ light.rotation.float())

    def relit(self, brdf: ptt.TensorBRDF, material: ptt.Material, incident: Tensor, mirrored: Tensor) -> Tensor:
        """Radiance (v, 3) as the relighting equation has it, plus the lobes."""
        assert material.shape is not None
        specular = torch.einsum("ov,oi,ivc->vc", brdf.outgoing(self.wo), brdf.matrix(material.shape), incident[1:])
        reflected = lobes.lookup(brdf.lobe_tables(material.shape), self.wo)
        specular = specular + torch.einsum("kv,vkc->vc", reflected, mirrored)
        return material.diffuse / math.pi * incident[0] + material.specular * specular

    def picture(self, values: Tensor) -> Tensor:
        """Values (v, 3) as an image (n, n, 3), 0 beside the sphere."""
        image = torch.zeros(*self.seen.shape, 3)
        image[self.seen] = values.float()
        return image

    def _world(self, local: Tensor) -> Tensor:
        return torch.einsum("vij,vki->vkj", self.frames, local)


def save_rows(path: Path, rows: list[list[Tensor]], gains: list[float]) -> None:
    """Images side by side, one row below the other, each times its own gain."""
    strips = [torch.cat(images, 1) * gain for images, gain in zip(rows, gains, strict=True)]
    ptt.Image(torch.cat(strips)).save(path)
