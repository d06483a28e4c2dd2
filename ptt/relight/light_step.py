"""The light step that all relighters begin with: a map made ready once, turned, and projected."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ptt.light import prefiltered
from ptt.light.environment import Environment, Layer
from ptt.light.prefiltered import LightMaps
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.sphere import Grid
from ptt.relight.operations import operations


@in_python
class LightStep(nn.Module):
    """step(environment) -> L (3, *grid.shape), Haar coefficients of the light's means over the cells of a grid.

    grid: cells around the world
    angles: of the lobes by which `maps` blurs the light [degrees]
    compiled: as `operations` says

    - A turn, a factor or a sum of lights costs a lookup a map; another map is made ready first, and kept with it.
    - Differentiable in the map and in factors.

    Sun et al. 2007, section 3.1: L is a plain expansion; solid angles belong to the transfer.
    """

    directions: Tensor
    shares: Tensor

    def __init__(self, grid: Grid, angles: Sequence[float] = (), compiled: bool = True) -> None:
        super().__init__()
        self.shape = tuple(grid.shape)
        self.angles = tuple(angles)
        self._operations = operations(compiled)
        directions, shares = prefiltered.samples(grid)
        self.register_buffer("directions", directions, persistent=False)
        self.register_buffer("shares", shares, persistent=False)

    @uncompiled
    def forward(self, environment: Environment) -> Tensor:
        """L (3, *grid.shape)."""
        return self._light(environment, self._ready(environment))

    def with_lobes(self, environment: Environment) -> tuple[Tensor, Tensor, Tensor]:
        """L, the light blurred by each lobe (k, cells, 4), and its turn (3, 3): world = turn @ map."""
        ready = self._ready(environment)
        return self._light(environment, ready), *self._lobes(environment, ready)

    def _ready(self, environment: Environment) -> list[LightMaps]:
        """The maps of every layer."""
        return [self.maps(layer) for layer in environment.layers]

    def _light(self, environment: Environment, ready: list[LightMaps]) -> Tensor:
        first, *others = [self._projected(*pair) for pair in zip(environment.layers, ready, strict=True)]
        return sum(others, first)

    def _projected(self, layer: Layer, ready: LightMaps) -> Tensor:
        """L of one map."""
        light = self.projected(ready.fine, layer.rotation.to(self.directions))
        return light * layer.gain.to(light).reshape(3, *[1] * len(self.shape)) if layer.changed else light

    def projected(self, fine: Tensor, turn: Tensor) -> Tensor:
        """L of a map that is ready, turned."""
        lighting: Tensor = self._operations.lighting(fine, turn, self.directions, self.shares, self.shape)
        return lighting

    def _lobes(self, environment: Environment, ready: list[LightMaps]) -> tuple[Tensor, Tensor]:
        """The light blurred by each lobe, in the frame of the first layer, and that layer's turn."""
        first, *others = environment.layers
        maps = self._blurred(first, ready[0])
        for layer, own in zip(others, ready[1:], strict=True):
            turn = first.rotation.T @ layer.rotation
            more = self._blurred(layer, own)
            maps = maps + (more if torch.equal(first.rotation, layer.rotation) else prefiltered.turned(more, turn))
        return maps, first.rotation.to(self.directions)

    def _blurred(self, layer: Layer, ready: LightMaps) -> Tensor:
        blurred = ready.blurred
        return blurred * pad(layer.gain, (0, 1)).to(blurred) if layer.changed else blurred

    @opaque
    def maps(self, layer: Layer) -> LightMaps:
        """One map, fine and blurred by each lobe, in its own frame."""
        ready = prefiltered.light_maps(layer.texels, self.angles, self._operations.octahedral_means)
        return LightMaps(*(maps.to(self.directions) for maps in ready))
