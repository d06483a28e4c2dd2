"""What the three relighters share: one signature, three cached steps, one way to name materials and views."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

from torch import Tensor, nn

from ptt import threads
from ptt.imaging.gbuffer import GBuffer
from ptt.light.environment import Environment
from ptt.materials.varying import SurfaceMaterial, materials_of_regions
from ptt.models.cache import Cache, Kept, watched
from ptt.ops import kinds, native
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.relight.viewpoint import View, eye_of


@in_python
class Relighter(nn.Module, ABC):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    Light, materials and view change apart from each other: the results of each step are kept for as long as what they
    were made from is unchanged, and never longer. Nobody manages caches.

        light    incident = light_step(environment)
        BRDF     exitant = brdf_step(incident, materials, points)
        view     radiance = view_step(exitant, points, eye)

    A factor or a tint of a light multiplies the radiance: it costs no step.

    `torch.func` transforms it in maps, factors, weights of materials and eyes; `vmap` of parameters of shapes is
    refused, since the tables to read depend on them. Torch alone answers there: in a trial of 8 maps a loop was two to
    four times as fast as `vmap` of their radiance, and not as fast as `vmap` of their gradients.

    `torch.compile(relighter)` fuses the steps where torch does them; where kernels do, nothing is left to fuse (in a
    trial, 0.15 ms for a graph of what stands around them that takes 0.05 without), and it changes nothing.
    """

    pixels: ClassVar[bool] = True
    """Whether a view may be a `GBuffer`."""
    lights: ClassVar[tuple[type, ...]] = (Environment,)
    """What may light it."""
    sources_in_c: ClassVar[tuple[str, ...]]
    """The files of kernels that the steps may call, in `ptt/ops/native`."""

    def __init__(self, compiled: bool, sources: Sequence[str] | None = None) -> None:
        """sources: the files of kernels that are called, where they are not all of `sources_in_c`"""
        super().__init__()
        self.compiled = compiled
        if compiled:
            native.prepare(*(self.sources_in_c if sources is None else sources))
        self._incident = Cache()
        self._exitant = Cache()

    @uncompiled
    def forward(self, environment: Environment, materials: Mapping[str, SurfaceMaterial], view: View) -> Tensor:
        """Radiance (v, 3) of every vertex, or (p, 3) of every pixel of a `GBuffer`, toward the viewer.

        environment: the light
        materials: by region, a `Material`, or one that varies over the surface (`Mixed`, `MetalRough`); a region that
            is left out has the scene's own
        view: a Camera, an eye (3,), directions (v, 3) from the vertices to the viewer, or a GBuffer

        Points that face away have the radiance of the mirrored direction, so that silhouettes interpolate well. Those
        of which an eye sees no triangle from the front may lack their highlights, since a picture does not show them.

        Raises:
            ValueError: an unknown region, what is no material, or a view of another shape; what a relighter cannot
                show is named in its own documentation.
        """
        threads.share()
        relit = self._relit_by_kernels if self.compiled else self._relit
        return relit(environment, materials, view)

    def _relit(self, environment: Environment, materials: Mapping[str, SurfaceMaterial], view: View) -> Tensor:
        """The three steps."""
        if isinstance(view, GBuffer) and not self.pixels:
            raise ValueError(f"{type(self).__name__} relights vertices: view must be a Camera or a tensor")
        kinds.check("environment", environment, self.lights)
        chosen = self.chosen(materials)
        eye = eye_of(view, self.positions)
        points = self.points(view, eye, chosen)
        light, factor = environment.factored() if isinstance(environment, Environment) else (environment, None)
        radiance = self.view_step(self.exitant(light, chosen, points), points, eye)
        radiance = radiance if factor is None else radiance * factor.to(radiance)
        glow = self.glow(view)
        return radiance if glow is None else radiance + glow.to(radiance)

    _relit_by_kernels = opaque(_relit)

    @uncompiled
    def incident(self, environment: Environment) -> Any:
        """The result of the light step, which depends on the light alone."""
        inputs = environment, watched(*self.sources())
        return self._incident(inputs, partial(self.light_step, environment))

    @uncompiled
    def exitant(self, environment: Any, materials: Mapping[str, Any], points: Any = None) -> Any:
        """The result of the BRDF step, which depends on the light and the materials (of every region, in order)."""
        incident = self.incident(environment)
        arrived = self._incident.named(incident)
        own = None if isinstance(arrived, Kept) else watched(*self.sources())  # what is kept was made of the same
        inputs = arrived, dict(materials), own, points
        return self._exitant(inputs, partial(self.brdf_step, incident, list(materials.values()), points))

    def chosen(self, materials: Mapping[str, Any]) -> dict[str, Any]:
        """The materials of every region, in their order: the given ones, else its own."""
        return materials_of_regions(self.materials, materials)

    @property
    @abstractmethod
    def materials(self) -> Mapping[str, SurfaceMaterial]:
        """The scene's own materials, by region."""

    @abstractmethod
    def glow(self, view: View) -> Tensor | None:
        """Radiance (v, 3), or (p, 3) of pixels, that points send out by themselves; None where none do."""

    @property
    @abstractmethod
    def positions(self) -> Tensor:
        """The vertices (v, 3) that are relit."""

    @abstractmethod
    def sources(self) -> list[nn.Module]:
        """The modules whose buffers the light and the BRDF step read."""

    def points(self, view: View, eye: Tensor, materials: Mapping[str, Any]) -> Any:
        """What a view shows, vertices or pixels, as the steps take it; None where it is always the same."""
        return None

    @abstractmethod
    def light_step(self, environment: Environment) -> Any: ...

    @abstractmethod
    def brdf_step(self, incident: Any, materials: list[Any], points: Any) -> Any: ...

    @abstractmethod
    def view_step(self, exitant: Any, points: Any, eye: Tensor) -> Tensor: ...
