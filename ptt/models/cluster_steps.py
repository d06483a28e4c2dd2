"""The steps of relighting by clusters: light and BRDF for eigen-points, the view for points in blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.bounces import COARSE, ORDER, blurs, responses
from ptt.clustering import COARSEST
from ptt.environment import Environment
from ptt.materials import Material
from ptt.models import light_maps, slots
from ptt.models.cache import Cache
from ptt.models.clustered_transfer import ClusteredTransfer
from ptt.models.light_maps import LightMaps
from ptt.models.point_steps import matrix
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, harmonics, relight, view
from ptt.ops.view import Gloss, Points

TINY = 1e-30
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
    outgoing: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("to_factors", responses(model.brdf), persistent=False)
        self.register_buffer("to_harmonics", harmonics.hemispherical(ORDER).float(), persistent=False)
        self.register_buffer("blurs", blurs(model.brdf.angles).float(), persistent=False)
        for r, (region, (first, end)) in enumerate(zip(self.regions, model.receivers.spans, strict=True)):
            own = slice(first, end)
            self.register_buffer(f"weights{r}", region.weights.float(), persistent=False)
            self.register_buffer(f"position{r}", region.in_line(model.positions[own]), persistent=False)
            self.register_buffer(f"frame{r}", region.in_line(model.frames[own]), persistent=False)
            colours = model.colours[own]
            if bool((colours != 1).any()):
                self.register_buffer(f"colour{r}", region.in_line(colours), persistent=False)
        self._prepared = Cache()
        self._view = relight.compiled(view.view) if compiled else view.view

    @property
    def regions(self) -> list[ClusteredTransfer]:
        """Of the model."""
        return [region for region in self.model.regions if isinstance(region, ClusteredTransfer)]

    def incident(self, environment: Environment) -> Lit:
        """Light step."""
        angles, dtype = self.model.brdf.angles, self.to_factors.dtype
        maps: LightMaps = self._prepared(environment.map, lambda: light_maps.light_maps(environment, angles))
        turn = environment.rotation.to(self.to_factors)
        texels = light_maps.texels(maps.fine.to(dtype), turn, self.model.grid).movedim(-1, 0)  # shape: (c, 6, n, n)
        peak = texels.detach().abs().amax().clamp(min=TINY)  # 16 bits hold no sun
        haared = haar.analyse(texels / peak)
        fine, coarse, coarsest = (haared[..., :n, :n].flatten(1).T for n in (texels.shape[-1], COARSE, COARSEST))
        lit = Lit([], [], [], maps.blurred.to(dtype), turn)
        for region in self.regions:
            stored, e = region.direct.dtype, region.eigenvectors
            reduced = region.lighting @ coarse
            direct = region.direct @ fine[region.columns].to(stored)
            one, two = region.one @ reduced.to(stored), region.two @ coarsest.to(stored)
            lit.direct.append(direct.to(dtype).mul(peak).unflatten(1, (e, -1)))
            lit.one.append(one.to(dtype).mul(peak).unflatten(1, (e, len(region.slots), ORDER**2)))
            lit.two.append(two.to(dtype).mul(peak).unflatten(1, (e, len(region.pairs))))
        return lit

    def exitant(self, lit: Lit, materials: Sequence[Material]) -> Sent:
        """BRDF step."""
        assert self.model.basis is not None
        h = slots.coefficients(self.model.slots, self.model.basis, materials)
        out = Sent([], [])
        for r, (region, material) in enumerate(zip(self.regions, materials, strict=True)):
            gloss = self._gloss(material, lit)
            incident = lit.direct[r]
            eigen = []
            if region.slots:
                last, first = torch.tensor(region.pairs, dtype=torch.int64, device=h.device).reshape(-1, 2).T
                light = relight.bounced(lit.one[r], lit.two[r], h[region.slots], h[last] * h[first])
                incident = incident + torch.einsum("si,kesc->keic", self.to_factors, light)
                if gloss is not None:
                    eigen.append(torch.einsum("st,kesc->kcte", self.to_harmonics, light))
            eigen.insert(0, relight.exitant(matrix(self.model.brdf, material), incident))
            sent = relight.expand(torch.cat(eigen, 2), self.get_buffer(f"weights{r}"), region.cluster)
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
        rho, maps = tables[which].flatten(1).T.contiguous(), lit.maps[:, which].flatten(1)
        specular = material.specular.to(rho)
        return Gloss(which, rho, tables.shape[2], specular, maps, lit.turn, self.blurs[which])

    def radiance(self, exitant: Sent, eye: Tensor) -> Tensor:
        """View step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        u_o = self.model.brdf.u_o.flatten(1).T.contiguous()
        rows = []
        for r, (region, (first, end)) in enumerate(zip(self.regions, self.model.receivers.spans, strict=True)):
            points = Points(self.get_buffer(f"position{r}"), self.get_buffer(f"frame{r}"), region.cuts)
            toward = eye if eye.ndim == 1 else region.in_line(eye[first:end])
            seen = self._view(points, toward, u_o, exitant.sent[r], exitant.gloss[r])
            rows.append(seen.index_select(0, region.place))
        return torch.cat(rows)
