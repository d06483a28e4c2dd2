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
from ptt.models import lobe_light, slots
from ptt.models.cache import Cache
from ptt.models.clustered_transfer import ClusteredTransfer
from ptt.models.point_steps import matrix
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, harmonics, lobes, relight, transfer


class Lit(NamedTuple):
    """Under one light: U0, U1 and U2 of every region, and the prefiltered maps with the turn into them."""

    direct: list[Tensor]
    one: list[Tensor]
    two: list[Tensor]
    maps: Tensor
    turn: Tensor


class Sent(NamedTuple):
    """With materials: Q (b, c, o, w) and indirect light (b, c, s, w) of every region, tables and weights of lobes."""

    sent: list[Tensor]
    arriving: list[Tensor]
    tables: list[Tensor | None]
    specular: list[Tensor]
    maps: Tensor
    turn: Tensor


class ClusterSteps(nn.Module):
    """Light, BRDF and view step of a model with clusters."""

    to_factors: Tensor
    to_harmonics: Tensor
    blurs: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("to_factors", responses(model.brdf), persistent=False)
        self.register_buffer("to_harmonics", harmonics.hemispherical(ORDER).float(), persistent=False)
        self.register_buffer("blurs", blurs(model.brdf.angles).float(), persistent=False)
        for r, (region, (first, end)) in enumerate(zip(model.regions, model.receivers.spans, strict=True)):
            own = slice(first, end)
            for name, values in (("position", model.positions), ("frame", model.frames), ("colour", model.colours)):
                self.register_buffer(f"{name}{r}", region.blocked(values[own]), persistent=False)
        self._prefiltered = Cache()
        self._view = relight.compiled(relight.view_blocks) if compiled else relight.view_blocks

    def incident(self, environment: Environment) -> Lit:
        """Light step."""
        grid, dtype = self.model.grid, self.to_factors.dtype
        texels = environment.project(grid).to(self.to_factors).movedim(-1, 0)  # shape: (c, 6, n, n)
        haared = haar.analyse(texels)
        fine = haared.flatten(1).T.contiguous()
        coarse = haared[..., :COARSE, :COARSE].flatten(1).T
        coarsest = haared[..., :COARSEST, :COARSEST].flatten(1).T
        angles = self.model.brdf.angles
        maps = self._prefiltered(environment.map, lambda: lobe_light.prefiltered(environment, angles)) if angles else texels
        lit = Lit([], [], [], maps.to(dtype), environment.rotation.to(self.to_factors))
        for region in self.model.regions:
            e = region.eigenvectors
            lit.direct.append((region.direct.to(dtype) @ fine[region.columns]).unflatten(1, (e, -1)))
            reduced = region.lighting.to(dtype) @ coarse
            shape = (e, len(region.slots), ORDER**2)
            lit.one.append((region.one.to(dtype) @ reduced).unflatten(1, shape))
            lit.two.append((region.two.to(dtype) @ coarsest).unflatten(1, (e, len(region.pairs))))
        return lit

    def exitant(self, lit: Lit, materials: Sequence[Material]) -> Sent:
        """BRDF step."""
        brdf, basis = self.model.brdf, self.model.basis
        assert basis is not None
        h = slots.coefficients(self.model.slots, basis, materials)
        out = Sent([], [], [], [], lit.maps, lit.turn)
        for r, (region, material) in enumerate(zip(self.model.regions, materials, strict=True)):
            tables = None if material.shape is None or not brdf.angles else brdf.lobe_tables(material.shape)
            weights = region.weights.to(h.dtype)
            incident = lit.direct[r]
            arriving = weights.new_zeros(len(region.cluster), 3, 0, 1)
            if region.slots:
                last, first = torch.tensor(region.pairs, dtype=torch.int64).reshape(-1, 2).T
                light = relight.bounced(lit.one[r], lit.two[r], h[region.slots], h[last] * h[first])
                incident = incident + torch.einsum("si,kesc->keic", self.to_factors, light)
                if tables is not None:
                    there = torch.einsum("st,kesc->kcte", self.to_harmonics, light)
                    arriving = relight.expand(there, weights, region.cluster)
            sent = relight.expand(relight.exitant(matrix(brdf, material), incident), weights, region.cluster)
            colour = getattr(self, f"colour{r}")  # shape: (b, c, w)
            out.sent.append(torch.cat((sent[:, :, :1] * colour[:, :, None], sent[:, :, 1:]), 2))
            out.arriving.append(arriving)
            out.tables.append(tables)
            out.specular.append(material.specular.to(h))
        return out

    def radiance(self, exitant: Sent, view: Tensor) -> Tensor:
        """View step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        rows = []
        for r, region in enumerate(self.model.regions):
            frame = getattr(self, f"frame{r}")  # shape: (b, 3, 3, w)
            if view.ndim == 1:
                toward = nn.functional.normalize(view[:, None] - getattr(self, f"position{r}"), dim=1)
            else:
                first, end = self.model.receivers.spans[r]
                toward = region.blocked(view[first:end])
            wo = (frame * toward[:, None]).sum(2)
            axis = 2 * wo[:, 2:] * frame[:, 2] - toward
            flat = wo.transpose(0, 1).flatten(1)[None]  # shape: (1, 3, b * w)
            factors = transfer.lookup(self.model.brdf.u_o, flat)[0].unflatten(1, (-1, wo.shape[2])).transpose(0, 1)
            outgoing = torch.cat((torch.ones_like(factors[:, :1]), factors), 1)
            tables = exitant.tables[r]
            glossy = None
            if tables is not None:
                glossy = relight.Glossy(
                    tables, exitant.specular[r], exitant.maps, exitant.turn, region.cuts, self.blurs
                )
            blocks = self._view(outgoing, exitant.sent[r], exitant.arriving[r], wo, axis, glossy)
            rows.append(blocks.transpose(1, 2).flatten(0, 1)[region.place])
        return torch.cat(rows)
