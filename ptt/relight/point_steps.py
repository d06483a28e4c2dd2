"""The steps of relighting where every point has a sparse T0 of its own: direct light, without lobes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, relight


class PointSteps(nn.Module):
    """Light, BRDF and view step of a model without clusters."""

    t0: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("t0", model.transfer(), persistent=False)
        self._view_step = relight.compiled(relight.view_step) if compiled else relight.view_step

    def incident(self, environment: Environment) -> Tensor:
        """Light step: U (c, i, v), the light that reaches each point through each incident factor."""
        texels = environment.project(self.model.grid).to(self.t0)  # shape: (6, n, n, c)
        lighting = haar.analyse(texels.movedim(-1, 0)).flatten(1).T.contiguous()
        return relight.light_step(self.t0, lighting, len(self.model.kept))

    def exitant(self, incident: Tensor, materials: Sequence[Material]) -> Tensor:
        """BRDF step: Q (c, o, v), what each point sends out through each outgoing factor."""
        matrices = torch.stack([self.model.brdf.coupling(material) for material in materials], 1)
        q = relight.brdf_step(matrices, incident, self.model.receivers.spans)
        return torch.cat((q[:, :1] * self.model.colours.T[:, None], q[:, 1:]), dim=1)

    def radiance(self, exitant: Tensor, view: Tensor) -> Tensor:
        """View step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        toward = nn.functional.normalize(view - self.model.positions, dim=1) if view.ndim == 1 else view
        local = torch.einsum("vij,vj->vi", self.model.frames, toward)
        factors = self.model.brdf.outgoing(local)
        return self._view_step(torch.cat((torch.ones_like(factors[:1]), factors)), exitant)
