"""The steps of relighting where every point has a sparse T0 of its own: direct light, without lobes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial, all_shares
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, relight, transfer
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.directions import toward


class PointMaterials(NamedTuple):
    """The materials of r regions in k layers: M (c, r, 1 + o, 1 + i) of each, how much of it (v, c) there is at every
    point, None for all, and the base colours (v, c)."""

    couplings: list[Tensor]
    shares: list[Tensor | None]
    colours: Tensor


@in_python
class PointSteps(nn.Module):
    """Light, BRDF and view step of a model without clusters; they have no kernels of their own."""

    t0: Tensor

    def __init__(self, model: TransferModel) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("t0", model.transfer(), persistent=False)

    def __getstate__(self) -> dict[str, Any]:
        """Without T0, which is sparse and cannot be copied so; it is made of the model again."""
        return self.__dict__ | {"_buffers": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self.register_buffer("t0", self.model.transfer(), persistent=False)

    @opaque
    def incident(self, environment: Environment) -> Tensor:
        """The light step: U (c, i, v), the light that reaches each point through each incident factor."""
        texels = environment.project(self.model.grid).to(self.t0)  # shape: (6, n, n, c)
        lighting = haar.analyse(texels.movedim(-1, 0)).flatten(1).T.contiguous()
        return relight.light_step(self.t0, lighting, len(self.model.kept))

    @opaque
    def materials(self, materials: Sequence[SurfaceMaterial]) -> PointMaterials:
        """The tables of the materials of all regions."""
        brdf = self.model.brdf
        receivers = self.model.receivers
        layers = [[brdf.coupling(layer) for layer in _parts(material)] for material in materials]
        none = torch.zeros_like(layers[0][0])
        couplings = [torch.stack(row, 1) for row in zip_longest(*layers, fillvalue=none)]
        if len(couplings) == 1:
            return PointMaterials(couplings, [None], self.model.colours)
        at = [receivers.layers_at(region, material) for region, material in enumerate(materials)]
        shares = torch.zeros(len(couplings), len(receivers), 3, dtype=none.dtype)
        for (first, end), material, found in zip(receivers.spans, materials, at, strict=True):
            own = found.shares.new_ones(1) if isinstance(material, Material) else all_shares(material, found)
            shares[: len(own), first:end] = own
        return PointMaterials(couplings, list(shares.to(none)), torch.cat([found.colour for found in at]).to(none))

    @uncompiled
    def exitant(self, incident: Tensor, materials: Sequence[SurfaceMaterial]) -> Tensor:
        """The BRDF step: Q (c, o, v), what each point sends out through each outgoing factor."""
        return self.contracted(incident, self.materials(materials))

    def contracted(self, incident: Tensor, materials: PointMaterials) -> Tensor:
        """The BRDF step, of what `materials` gives."""
        spans = self.model.receivers.spans
        each = zip(materials.couplings, materials.shares, strict=True)
        parts = [exitant(incident, m, materials.colours, spans, share) for m, share in each]
        return torch.stack(parts).sum(0) if len(parts) > 1 else parts[0]

    def radiance(self, exitant: Tensor, eye: Tensor) -> Tensor:
        """The view step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        return radiance(self.model.positions, self.model.frames, self.model.brdf.u_o, exitant, eye)


def radiance(positions: Tensor, frames: Tensor, u_o: Tensor, exitant: Tensor, eye: Tensor) -> Tensor:
    """B (v, c) of points (v, 3) with frames (v, 3, 3), of outgoing factors on the disk grid (o, n, n)."""
    local = torch.einsum("vij,vj->vi", frames, toward(eye, positions))
    factors = transfer.lookup(u_o, local.T[None])[0]
    return relight.view_step(torch.cat((torch.ones_like(factors[:1]), factors)), exitant)


def exitant(
    incident: Tensor, couplings: Tensor, colours: Tensor, spans: list[tuple[int, int]], share: Tensor | None = None
) -> Tensor:
    """Q (c, o, v) of U (c, i, v), M (c, r, 1 + o, 1 + i) of the regions, base colours (v, c), and how much (v, c)."""
    q = relight.brdf_step(couplings, incident, spans)
    q = torch.cat((q[:, :1] * colours.T[:, None], q[:, 1:]), dim=1)
    return q if share is None else q * share.T[:, None]


def _parts(material: SurfaceMaterial) -> tuple[Material, ...]:
    """What is reflected apart: the layers of a material that varies, or all of one that does not."""
    return (material,) if isinstance(material, Material) else material.layers
