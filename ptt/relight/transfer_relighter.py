"""Precomputed transfer tensors (Sun et al. 2007): light, materials and view change, shadows and bounces follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials import material as mat
from ptt.materials.material import Material
from ptt.models.cache import Cache, watched
from ptt.models.transfer_model import TransferModel
from ptt.relight.cluster_steps import ClusterSteps
from ptt.relight.point_steps import PointSteps
from ptt.relight.viewpoint import View, toward


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
        self._incident = Cache()
        self._exitant = Cache()
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
        return self.steps.radiance(self.exitant(environment, chosen), toward(view, self.model.positions))

    def incident(self, environment: Environment) -> Any:
        """Light step: what depends on the light alone."""
        inputs = environment, watched(*self._parts)
        return self._incident(inputs, lambda: self.steps.incident(environment))

    def exitant(self, environment: Environment, materials: Mapping[str, Material]) -> Any:
        """BRDF step: what depends on the light and on the materials (of every region, in their order)."""
        incident = self.incident(environment)
        inputs = incident, dict(materials), watched(self.model.brdf)
        return self._exitant(inputs, lambda: self.steps.exitant(incident, list(materials.values())))

    def _chosen(self, materials: Mapping[str, Material]) -> dict[str, Material]:
        own = self.model.receivers
        chosen = mat.materials_of_regions(own.materials, materials)
        for name, editable in zip(own.names, own.editable, strict=True):
            given = materials.get(name)
            if given is not None and not editable and mat.to_config(given) != mat.to_config(own.materials[name]):
                raise ValueError(f"region {name} is fixed: make it editable in the scene to change its material")
        return chosen
