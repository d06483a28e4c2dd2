"""Radiance from raw transfer, nothing truncated or clustered: light and materials are contracted as T1 and T2 arise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

import ptt
from ptt.light import prefiltered as light_maps
from ptt.models import slots
from ptt.models.indirect import COARSE, responses
from ptt.ops import haar, lobes, transfer
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.sphere import Cube
from ptt.ops.view import light_about
from ptt.transfer import bounces


@dataclass(eq=False)
class Uncompressed:
    """What does not depend on light and materials; t0 (v, 1 + i, l): direct transfer, the coarse coefficients."""

    raw: ptt.RawTransfer
    brdf: ptt.TensorBRDF
    basis: ptt.BRDFBasis
    t0: Tensor
    cuts: Tensor

    def radiance(
        self, rows: Tensor, light: ptt.Environment, materials: Mapping[str, ptt.Material], eye: Tensor
    ) -> list[Tensor]:
        """Direct light, first and second bounce (v, 3) each, of the receivers of some rows (v,)."""
        own = self.raw.receivers
        grid = Cube(self.raw.resolution)
        texels = light.project(grid)
        lighting = haar.analyse(texels.movedim(-1, 0))[..., :COARSE, :COARSE].flatten(1).T
        paths = bounces.Bounces(self.raw, self.brdf, self.basis, self.t0, self.cuts)
        paths.change_lighting(lighting.contiguous())  # l is colour from here on
        h = slots.coefficients(paths.slots, self.basis, [materials[name] for name in own.names])
        everyone = torch.arange(len(own))
        one = torch.cat([torch.einsum("bqsc,qc->bsc", paths.first_bounce(some), h) for some in everyone.split(32)])
        again = [
            torch.einsum("bqc,qc->bc", paths.second_bounce(some, one[:, :, None])[:, :, 0], h)
            for some in rows.split(32)
        ]
        two = torch.zeros(len(rows), *one.shape[1:])
        two[:, 0] = torch.cat(again)
        toward = torch.nn.functional.normalize(eye - own.positions[rows], dim=1)
        wo = torch.einsum("vij,vj->vi", own.frames[rows], toward)
        to_factors = responses(self.brdf)
        filtered = paths.lobe_harmonics(wo)
        direct = self._direct(rows, grid, texels.reshape(-1, 3))
        mirrored = self._mirrored(rows, wo, light)
        shaded = [self._shade(rows, wo, materials, direct, mirrored)]
        for arriving in (one[rows], two):
            factors = torch.einsum("si,bsc->bic", to_factors, arriving)
            shaded.append(self._shade(rows, wo, materials, factors, torch.einsum("bks,bsc->bkc", filtered, arriving)))
        return shaded

    def _direct(self, rows: Tensor, grid: Cube, texels: Tensor) -> Tensor:
        directions = grid.directions().reshape(-1, 3).float()
        solid = grid.solid_angles().flatten().float()
        parts = []
        for some in rows.split(64):
            visible = transfer.unpack(self.raw.visible[some], grid.cells)
            frames = self.raw.receivers.frames[some]
            parts.append(transfer.direct_transfer(visible, frames, directions, solid, self.brdf.u_i) @ texels)
        return torch.cat(parts)

    def _mirrored(self, rows: Tensor, wo: Tensor, light: ptt.Environment) -> Tensor:
        """Light (v, k, c) about the axes of the lobes times its fractional visibility."""
        axes = lobes.lean(self.brdf.axes, wo)
        each = torch.arange(len(self.brdf.angles))
        world = axes @ self.raw.receivers.frames[rows]
        seen = light_about(
            light_maps.light_maps(light.map, self.brdf.angles).whole.blurred, world @ light.rotation.float()
        )
        through = self.cuts[rows[:, None], HemiOctahedral(bounces.CUTS).cell(axes), each].float() / 255
        return seen * through[..., None]

    def _shade(
        self, rows: Tensor, wo: Tensor, materials: Mapping[str, ptt.Material], incident: Tensor, mirrored: Tensor
    ) -> Tensor:
        own = self.raw.receivers
        out = torch.zeros(len(rows), 3)
        for name, (first, end) in zip(own.names, own.spans, strict=True):
            at = (rows >= first) & (rows < end)
            material = materials[name]
            lit = material.diffuse / math.pi * own.colours[rows[at]] * incident[at, 0]
            if material.shape is not None:
                matrix = self.brdf.matrix(material.shape)
                outgoing = self.brdf.outgoing(wo[at])
                specular = torch.einsum("ov,oi,vic->vc", outgoing, matrix, incident[at, 1:])
                if self.brdf.angles:
                    rho = lobes.lookup(self.brdf.lobe_tables(material.shape), wo[at])
                    specular = specular + torch.einsum("kv,vkc->vc", rho, mirrored[at])
                lit = lit + material.specular * specular
            out[at] = lit
        return out
