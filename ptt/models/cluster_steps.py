"""The steps of relighting by clusters: light and BRDF for eigen-points, the view for points in blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.environment import Environment
from ptt.materials import Material
from ptt.models import light_maps, slots
from ptt.models.cache import Cache
from ptt.models.indirect import COARSE, COARSEST, ORDER, blurs, responses
from ptt.models.light_maps import LightMaps
from ptt.models.point_steps import matrix
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, harmonics, native, relight, view
from ptt.ops.view import Gloss, Points

DULL = 1e-4  # a lobe that reflects no more than this is left out


class Lit(NamedTuple):
    """Under one light: U0, U1 and U2 of every region; the blurred maps (cells, k, c), and the turn of the light."""

    direct: list[Tensor]
    one: list[Tensor]
    two: list[Tensor]
    maps: Tensor
    turn: Tensor


class Sent(NamedTuple):
    """With materials: Q and I (b, c, 1 + o + s, w) and the lobes of every region."""

    sent: list[Tensor]
    gloss: list[Gloss | None]


class ClusterSteps(nn.Module):
    """Light, BRDF and view step of a model with clusters."""

    to_factors: Tensor
    to_harmonics: Tensor
    blurs: Tensor
    directions: Tensor
    shares: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("to_factors", responses(model.brdf), persistent=False)
        self.register_buffer("to_harmonics", harmonics.hemispherical(ORDER).float(), persistent=False)
        self.register_buffer("blurs", blurs(model.brdf.angles).float(), persistent=False)
        for r, (region, (first, end)) in enumerate(zip(model.clustered, model.receivers.spans, strict=True)):
            own = slice(first, end)
            pairs = torch.tensor(region.pairs, dtype=torch.int64).reshape(-1, 2)
            self.register_buffer(f"slots{r}", torch.tensor(region.slots, dtype=torch.int64), persistent=False)
            self.register_buffer(f"pairs{r}", pairs, persistent=False)
            self.register_buffer(f"position{r}", region.in_line(model.positions[own]), persistent=False)
            self.register_buffer(f"frame{r}", region.in_line(model.frames[own]), persistent=False)
            colours = model.colours[own]
            if bool((colours != 1).any()):
                self.register_buffer(f"colour{r}", region.in_line(colours), persistent=False)
        self.slots, self._prepared = model.slots, Cache()
        for name, samples in zip(("directions", "shares"), light_maps.samples(model.grid), strict=True):
            self.register_buffer(name, samples, persistent=False)
        self._view = native.view if compiled else view.view
        self._texels = relight.compiled(light_maps.texels) if compiled else light_maps.texels

    def incident(self, environment: Environment) -> Lit:
        """Light step."""
        angles, dtype = self.model.brdf.angles, self.to_factors.dtype
        maps: LightMaps = self._prepared(environment.map, lambda: light_maps.light_maps(environment, angles))
        turn = environment.rotation.to(self.to_factors)
        texels = self._texels(maps.fine.to(dtype), turn, self.directions, self.shares)
        texels = texels.reshape(*self.model.grid.shape, 3).movedim(-1, 0)  # shape: (c, 6, n, n)
        haared = haar.analyse(texels)
        fine, coarse, coarsest = (haared[..., :n, :n].flatten(1) for n in (texels.shape[-1], COARSE, COARSEST))
        lit = Lit([], [], [], maps.blurred.to(dtype), turn)
        for region in self.model.clustered:
            e, q = region.eigenvectors, len(region.slots)
            reduced = coarse @ region.lighting.transpose(1, 2)  # shape: (k, c, n)
            own = fine.index_select(1, region.columns.flatten()).unflatten(1, region.columns.shape).transpose(0, 1)
            direct = relight.light_eigen(region.direct, own)
            lit.direct.append(direct.unflatten(2, (e, -1)))
            lit.one.append(relight.light_eigen(region.one, reduced).unflatten(2, (q, e, ORDER**2)))
            lit.two.append(relight.light_eigen(region.two, coarsest).unflatten(2, (len(region.pairs), e)))
        return lit

    def exitant(self, lit: Lit, materials: Sequence[Material]) -> Sent:
        """BRDF step."""
        assert self.model.basis is not None
        h = slots.coefficients(self.slots, self.model.basis, materials).T  # shape: (c, q)
        out = Sent([], [])
        for r, (region, material) in enumerate(zip(self.model.clustered, materials, strict=True)):
            gloss, incident, light = self._gloss(material, lit), lit.direct[r], None
            if region.slots or region.pairs:
                last, first = self.get_buffer(f"pairs{r}").T
                own = h[:, self.get_buffer(f"slots{r}")]
                light = relight.bounced(lit.one[r], lit.two[r], own, h[:, last] * h[:, first])
                incident = incident + light @ self.to_factors
            eigen = relight.exitant(matrix(self.model.brdf, material), incident)
            if light is not None and gloss is not None:
                eigen = torch.cat((eigen, light @ self.to_harmonics), 3)
            sent = relight.expand(eigen, region.weights, region.cluster)
            if f"colour{r}" in self._buffers:
                colour = self.get_buffer(f"colour{r}").unflatten(1, (len(sent), -1)).transpose(0, 1)  # shape: (b, c, w)
                sent = torch.cat((sent[:, :, :1] * colour[:, :, None], sent[:, :, 1:]), 2)
            out.sent.append(sent)
            out.gloss.append(gloss)
        return out

    def _gloss(self, material: Material, lit: Lit) -> Gloss | None:
        """The lobes that a material has."""
        if material.shape is None or not self.model.brdf.angles:
            return None
        tables = self.model.brdf.lobe_tables(material.shape)
        which = torch.nonzero(tables.detach().abs().amax((1, 2)) > DULL)[:, 0]
        if not len(which):
            return None
        maps = lit.maps if len(which) == len(tables) else lit.maps[:, which]
        rho, maps = tables[which].flatten(1).T.contiguous(), maps.flatten(1)
        specular = material.specular.to(rho)
        return Gloss(which, rho, tables.shape[2], specular, maps, lit.turn, self.blurs[which])

    def radiance(self, exitant: Sent, eye: Tensor) -> Tensor:
        """View step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        u_o = self.model.brdf.u_o.flatten(1).T.contiguous()
        rows = []
        for r, (region, (first, end)) in enumerate(zip(self.model.clustered, self.model.receivers.spans, strict=True)):
            points = Points(self.get_buffer(f"position{r}"), self.get_buffer(f"frame{r}"), region.cuts)
            toward = eye if eye.ndim == 1 else region.in_line(eye[first:end])
            seen = self._view(points, toward, u_o, exitant.sent[r], exitant.gloss[r])
            rows.append(seen.index_select(0, region.place))
        return torch.cat(rows)
