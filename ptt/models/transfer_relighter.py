"""Precomputed transfer tensors (Sun et al. 2007): light, materials and view change, and shadows follow."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ptt import materials as mat
from ptt.environment import Environment
from ptt.materials import Material
from ptt.models.cache import Cache
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, relight
from ptt.scene import Camera

View = Camera | Tensor


class TransferRelighter(nn.Module):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    model: what `compress` made, or `TransferModel.load`
    compiled: fuse the view step with torch.compile; the first call then takes some seconds

    Each of the three inputs can change without the work of the others: results are kept for as long as what they
    were made from is unchanged, and never longer. Differentiable in the map, in the weights of the materials and
    in the parameters of their shapes.

    Example:
        >>> relighter = TransferRelighter(model)
        >>> radiance = relighter(light.rotated(y=30), {"knot": blinn_phong(0.1, 0.6, 40.0)}, camera)
    """

    t0: Tensor

    def __init__(self, model: TransferModel, compiled: bool = False) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("t0", model.transfer(), persistent=False)
        self._view_step = relight.compiled(relight.view_step) if compiled else relight.view_step
        self._incident, self._exitant, self._outgoing = Cache(), Cache(), Cache()

    def forward(self, environment: Environment, materials: Mapping[str, Material], view: View) -> Tensor:
        """Radiance (v, 3) of every point toward the viewer.

        materials: by region; a region that is left out has the scene's own
        view: a Camera, an eye (3,), or directions (v, 3) from the points to the viewer

        Receivers that face away have the radiance of the mirrored direction, so that silhouettes interpolate well.

        Raises:
            ValueError: an unknown region, a fixed region with another material, a shape outside of the model's
                space, or a view of another shape.
        """
        chosen = self._chosen(materials)
        return self._view_step(self.outgoing(view), self.exitant(environment, chosen))

    def incident(self, environment: Environment) -> Tensor:
        """Light step: U (c, i, v), the light that reaches each point through each incident factor."""

        def compute() -> Tensor:
            texels = environment.project(self.model.grid).to(self.t0)  # shape: (6, n, n, c)
            lighting = haar.analyse(texels.movedim(-1, 0)).flatten(1).T.contiguous()
            return relight.light_step(self.t0, lighting, len(self.model.kept))

        return self._incident((environment, self.t0), compute)

    def exitant(self, environment: Environment, materials: Mapping[str, Material]) -> Tensor:
        """BRDF step: Q (c, o, v), what each point sends out through each outgoing factor."""
        incident = self.incident(environment)

        def compute() -> Tensor:
            q = relight.brdf_step(self.matrices(materials), incident, self.model.receivers.spans)
            return torch.cat((q[:, :1] * self.model.colours.T[:, None], q[:, 1:]), dim=1)

        return self._exitant((incident, dict(materials), list(self.model.brdf.buffers())), compute)

    def outgoing(self, view: View) -> Tensor:
        """View factors V (o, v): 1 for the diffuse part, then those of the BRDF tensor."""

        def compute() -> Tensor:
            local = torch.einsum("vij,vj->vi", self.model.frames, self._toward(view))
            factors = self.model.brdf.outgoing(local)
            return torch.cat((torch.ones_like(factors[:1]), factors))

        return self._outgoing((view, self.model.positions, self.model.brdf.u_o), compute)

    def matrices(self, materials: Mapping[str, Material]) -> Tensor:
        """M (c, r, 1 + o, 1 + i) of all regions, in their order."""
        return torch.stack([self._matrix(materials[name]) for name in self.model.receivers.names], 1)

    def _matrix(self, material: Material) -> Tensor:
        core = self.model.brdf.core
        diffuse = material.diffuse.to(core)[:, None, None] / math.pi
        if material.shape is None:
            specular = core.new_zeros(3, *core.shape[1:])
        else:
            specular = material.specular.to(core)[:, None, None] * self.model.brdf.matrix(material.shape)
        top = nn.functional.pad(diffuse, (0, core.shape[2]))
        return torch.cat((top, nn.functional.pad(specular, (1, 0))), dim=1)

    def _toward(self, view: View) -> Tensor:
        positions = self.model.positions
        if isinstance(view, Camera):
            return view.toward(positions)
        if view.shape not in ((3,), positions.shape):
            raise ValueError(f"view must be a Camera, (3,) or {tuple(positions.shape)}, got {tuple(view.shape)}")
        directions = view.to(positions) - positions if view.shape == (3,) else view.to(positions)
        if not bool(torch.isfinite(view).all()) or (view.ndim == 2 and not bool((view != 0).any(1).all())):
            raise ValueError("view must be finite, and directions not zero")
        return nn.functional.normalize(directions, dim=1)

    def _chosen(self, materials: Mapping[str, Material]) -> dict[str, Material]:
        own = self.model.receivers
        if unknown := [name for name in materials if name not in own.names]:
            raise ValueError(f"no region {', '.join(unknown)}; the model has {', '.join(own.names)}")
        if wrong := [name for name, given in materials.items() if not isinstance(given, Material)]:
            raise ValueError(f"materials must map regions to ptt.Material, got {type(materials[wrong[0]]).__name__}")
        for name, editable in zip(own.names, own.editable, strict=True):
            given = materials.get(name)
            if given is not None and not editable and mat.to_config(given) != mat.to_config(own.materials[name]):
                raise ValueError(f"region {name} is fixed: make it editable in the scene to change its material")
        return own.materials | dict(materials)
