"""Precomputed transfer tensors (Sun et al. 2007): light, materials and view change, shadows and bounces follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from ptt import materials as mat
from ptt.environment import Environment
from ptt.materials import Material
from ptt.models.cache import Cache, watched
from ptt.models.cluster_steps import ClusterSteps
from ptt.models.point_steps import PointSteps
from ptt.models.transfer_model import TransferModel
from ptt.scene import Camera

View = Camera | Tensor


class TransferRelighter(nn.Module):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    model: what `compress` made, or `TransferModel.load`
    compiled: every step by kernels in C++, built on first use, which takes some seconds; what points send out is then
        rounded to 16 bits, 2e-4 of it. Without clusters: the view step by torch.compile

    Each of the three inputs can change without the work of the others: results are kept for as long as what they
    were made from is unchanged, and never longer. Differentiable in the map, in the weights of the materials and
    in the parameters of their shapes.

    Example:
        >>> relighter = TransferRelighter(model)
        >>> radiance = relighter(light.rotated(y=30), {"knot": blinn_phong(0.1, 0.6, 40.0)}, camera)
    """

    def __init__(self, model: TransferModel, compiled: bool = False) -> None:
        super().__init__()
        self.model = model
        self.steps = (ClusterSteps if len(model.regions) else PointSteps)(model, compiled)
        self._incident, self._exitant = Cache(), Cache()
        self._parts = list(model.modules())

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
        return self.steps.radiance(self.exitant(environment, chosen), self._toward(view))

    def incident(self, environment: Environment) -> Any:
        """Light step: what depends on the light alone."""
        inputs = environment, watched(*self._parts)
        return self._incident(inputs, lambda: self.steps.incident(environment))

    def exitant(self, environment: Environment, materials: Mapping[str, Material]) -> Any:
        """BRDF step: what depends on the light and on the materials (of every region, in their order)."""
        incident = self.incident(environment)
        inputs = incident, dict(materials), watched(self.model.brdf)
        return self._exitant(inputs, lambda: self.steps.exitant(incident, list(materials.values())))

    def _toward(self, view: View) -> Tensor:
        """The eye (3,), or unit directions (v, 3) to the viewer."""
        positions = self.model.positions
        if isinstance(view, Camera):
            return torch.tensor(view.eye).to(positions)
        if view.shape not in ((3,), positions.shape):
            raise ValueError(f"view must be a Camera, (3,) or {tuple(positions.shape)}, got {tuple(view.shape)}")
        if not bool(torch.isfinite(view).all()) or (view.ndim == 2 and not bool((view != 0).any(1).all())):
            raise ValueError("view must be finite, and directions not zero")
        view = view.to(positions)
        return view if view.ndim == 1 else nn.functional.normalize(view, dim=1)

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
