"""Precomputed transfer tensors (Sun et al. 2007): light, materials and view change, shadows and bounces follow."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial, same
from ptt.models.cache import Cache
from ptt.models.transfer_model import TransferModel
from ptt.ops import kinds
from ptt.ops.compiling import in_python, uncompiled
from ptt.relight.cluster_steps import ClusterSteps
from ptt.relight.lobe_steps import LobeSteps
from ptt.relight.point_steps import PointSteps
from ptt.relight.relighter import Relighter
from ptt.relight.viewpoint import View


@in_python
class TransferRelighter(Relighter):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    model: what `compress` made, or `TransferModel.load`
    compiled: by kernels in C++, built on first use; what points send out is then rounded to 16 bits, 3e-5 of the most
    lobes: of every material, 1..64, in a model whose highlights are lobes: with more the error is less, and a frame
        takes longer. None for 16, and 32 for metals that are wide (`ptt.ops.cells.enough`)

    Radiance is that of the vertices; `ptt.render` interpolates it. Differentiable in the map, in the weights of the
    materials and in the parameters of their shapes.

    Raises, when called:
        ValueError: as `Relighter`; a fixed region with another material, a shape outside of the model's space, or a
            G-buffer as the view.

    Example:
        >>> relighter = TransferRelighter(model)
        >>> radiance = relighter(light.rotated(y=30), {"knot": blinn_phong(0.1, 0.6, 40.0)}, camera)
    """

    pixels = False
    sources_in_c = ("maps", "light", "brdf", "view", "cells", "gloss")
    sources_by_highlights: ClassVar[dict[str, tuple[str, ...]]] = {
        "tensor": ("maps", "light", "brdf", "view"),
        "lobes": ("maps", "light", "cells", "gloss"),
    }

    def __init__(self, model: TransferModel, compiled: bool = True, lobes: int | None = None) -> None:
        kinds.check("model", model, TransferModel)
        super().__init__(compiled, self.sources_by_highlights[model.highlights])
        self.model = model
        self.steps = _steps(model, compiled, lobes).to(model.positions.device)
        self._sources = list(model.modules())
        self._at_points = {name: Cache() for name in model.receivers.names}

    @property
    def materials(self) -> Mapping[str, SurfaceMaterial]:
        """The materials that the scene was traced with, by region."""
        return self.model.receivers.materials

    @property
    def positions(self) -> Tensor:
        """The points (v, 3) of the model."""
        return self.model.positions

    def sources(self) -> list[nn.Module]:
        """The modules of the model."""
        return self._sources

    def chosen(self, materials: Mapping[str, Any]) -> dict[str, Any]:
        """The materials of every region; those of fixed regions must be their own."""
        chosen = super().chosen(materials)
        own = self.model.receivers
        for name, editable in zip(own.names, own.editable, strict=True):
            given = chosen[name]
            if not isinstance(given, Material):
                chosen[name] = self._at_points[name](given, partial(own.at_points, name, given))
            if name in materials and not editable and not same(chosen[name], own.materials[name]):
                raise ValueError(f"region {name} is fixed: make it editable in the scene to change its material")
        return chosen

    def glow(self, view: View) -> Tensor | None:
        """What the vertices send out by themselves."""
        return None if self.model.receivers.glow is None else self.model.get_buffer("glow")

    @uncompiled
    def light_step(self, environment: Environment) -> Any:
        """What arrives at the points, or at the eigen-points of their clusters."""
        return self.steps.incident(environment)

    @uncompiled
    def brdf_step(self, incident: Any, materials: list[SurfaceMaterial], points: None) -> Any:
        """What they send out through each outgoing factor."""
        return self.steps.exitant(incident, materials)

    def view_step(self, exitant: Any, points: None, eye: Tensor) -> Tensor:
        """What of it goes to the eye."""
        radiance: Tensor = self.steps.radiance(exitant, eye)
        return radiance


def _steps(model: TransferModel, compiled: bool, lobes: int | None) -> Any:
    if not len(model.regions):
        return PointSteps(model)
    return LobeSteps(model, compiled, lobes) if model.highlights == "lobes" else ClusterSteps(model, compiled)
