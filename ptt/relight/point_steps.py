"""The steps of relighting where every point has a sparse T0 of its own: direct light, without lobes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, relight, transfer
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.directions import toward


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
    def materials(self, materials: Sequence[Material]) -> list[Tensor]:
        """M (c, 1 + o, 1 + i) of the materials of all regions."""
        return [self.model.brdf.coupling(material) for material in materials]

    @uncompiled
    def exitant(self, incident: Tensor, materials: Sequence[Material]) -> Tensor:
        """The BRDF step: Q (c, o, v), what each point sends out through each outgoing factor."""
        return self.contracted(incident, self.materials(materials))

    def contracted(self, incident: Tensor, couplings: Sequence[Tensor]) -> Tensor:
        """The BRDF step, of what `materials` gives."""
        return exitant(incident, list(couplings), self.model.colours, self.model.receivers.spans)

    def radiance(self, exitant: Tensor, eye: Tensor) -> Tensor:
        """The view step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        return radiance(self.model.positions, self.model.frames, self.model.brdf.u_o, exitant, eye)


def radiance(positions: Tensor, frames: Tensor, u_o: Tensor, exitant: Tensor, eye: Tensor) -> Tensor:
    """B (v, c) of points (v, 3) with frames (v, 3, 3), of outgoing factors on the disk grid (o, n, n)."""
    local = torch.einsum("vij,vj->vi", frames, toward(eye, positions))
    factors = transfer.lookup(u_o, local.T[None])[0]
    return relight.view_step(torch.cat((torch.ones_like(factors[:1]), factors)), exitant)


def exitant(incident: Tensor, couplings: list[Tensor], colours: Tensor, spans: list[tuple[int, int]]) -> Tensor:
    """Q (c, o, v) of U (c, i, v), M (c, 1 + o, 1 + i) of the regions and base colours (v, c)."""
    q = relight.brdf_step(torch.stack(couplings, 1), incident, spans)
    return torch.cat((q[:, :1] * colours.T[:, None], q[:, 1:]), dim=1)
