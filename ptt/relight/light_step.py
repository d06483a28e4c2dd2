"""The light step that all relighters begin with: a map made ready once, turned, and projected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ptt.light import prefiltered
from ptt.light.environment import Environment, Layer
from ptt.light.lamps import Lamps
from ptt.light.prefiltered import LightMaps, SplitMaps
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.sphere import Grid
from ptt.relight.operations import operations


class BlurredLight(NamedTuple):
    """A light for lobes.

    light (3, *grid.shape): L
    maps (k, cells, 4): blurred by each lobe; turn (3, 3): world = turn @ map
    """

    light: Tensor
    maps: Tensor
    turn: Tensor


class SplitLight(NamedTuple):
    """A whole light, its lamps in the world, and the rest, which is the whole where there are no lamps."""

    whole: BlurredLight
    lamps: Lamps
    rest: BlurredLight


@in_python
class LightStep(nn.Module):
    """step(environment) -> L (3, *grid.shape), Haar coefficients of the light's means over the cells of a grid.

    grid: cells around the world
    angles: of the lobes by which `maps` blurs the light [degrees]
    compiled: as `operations` says
    lamps: says whether what is small and bright is kept apart where it is asked for

    - A turn, a factor or a sum of lights costs a lookup a map; another map is made ready first, and kept with it.
    - Differentiable in the map and in factors.

    Sun et al. 2007, section 3.1: L is a plain expansion; solid angles belong to the transfer.
    """

    directions: Tensor
    shares: Tensor

    def __init__(self, grid: Grid, angles: Sequence[float] = (), compiled: bool = True, lamps: bool = False) -> None:
        super().__init__()
        self.shape = tuple(grid.shape)
        self.angles = tuple(angles)
        self.lamps = lamps
        self._operations = operations(compiled)
        directions, shares = prefiltered.samples(grid)
        self.register_buffer("directions", directions, persistent=False)
        self.register_buffer("shares", shares, persistent=False)

    @uncompiled
    def forward(self, environment: Environment) -> Tensor:
        """L (3, *grid.shape)."""
        return self._light(environment, [maps.whole for maps in self._ready(environment)])

    @uncompiled
    def without_lamps(self, environment: Environment) -> tuple[Tensor, Lamps]:
        """L without the lamps that are kept apart, and these."""
        ready = self._ready(environment)
        return self._light(environment, [maps.rest for maps in ready]), self._lamps(environment, ready)

    def blurred(self, environment: Environment) -> BlurredLight:
        """L, and the light as lobes see it, all of it together."""
        return self._blurred(environment, [maps.whole for maps in self._ready(environment)])

    def with_lobes(self, environment: Environment) -> SplitLight:
        """The same, and its lamps apart from the rest."""
        ready = self._ready(environment)
        whole = self._blurred(environment, [maps.whole for maps in ready])
        alike = all(maps.rest is maps.whole for maps in ready)
        rest = whole if alike else self._blurred(environment, [maps.rest for maps in ready])
        return SplitLight(whole, self._lamps(environment, ready), rest)

    def _blurred(self, environment: Environment, ready: list[LightMaps]) -> BlurredLight:
        turn = environment.layers[0].rotation.to(self.directions)
        maps = self._lobes(environment, [maps.blurred for maps in ready])
        return BlurredLight(self._light(environment, ready), maps, turn)

    def _lamps(self, environment: Environment, ready: list[SplitMaps]) -> Lamps:
        """The lamps of all layers."""
        found = []
        for layer, maps in zip(environment.layers, ready, strict=True):
            directions, powers, areas, shares = maps.lamps
            turn = layer.rotation.to(self.directions).T
            found.append(Lamps(directions @ turn, powers * layer.gain.to(powers), areas @ turn, shares))
        return Lamps.together(found)

    def _ready(self, environment: Environment) -> list[SplitMaps]:
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

    def _lobes(self, environment: Environment, ready: list[Tensor]) -> Tensor:
        """The light blurred by each lobe (k, cells, 4), in the frame of the first layer, of the maps of every layer."""
        first, *others = environment.layers
        maps = self._times(ready[0], first)
        for layer, own in zip(others, ready[1:], strict=True):
            turn = first.rotation.T @ layer.rotation
            more = self._times(own, layer)
            maps = maps + (more if torch.equal(first.rotation, layer.rotation) else prefiltered.turned(more, turn))
        return maps

    def _times(self, blurred: Tensor, layer: Layer) -> Tensor:
        return blurred * pad(layer.gain, (0, 1)).to(blurred) if layer.changed else blurred

    @opaque
    def maps(self, layer: Layer) -> SplitMaps:
        """One map, fine and blurred by each lobe, in its own frame."""
        means = self._operations.octahedral_means
        ready = prefiltered.light_maps(layer.texels, self.angles, means, self.lamps)
        whole = LightMaps(*(maps.to(self.directions) for maps in ready.whole))
        lamps = Lamps(*(part.to(self.directions) for part in ready.lamps))
        if ready.rest is ready.whole:
            return SplitMaps(whole, lamps, whole)
        return SplitMaps(whole, lamps, LightMaps(*(maps.to(self.directions) for maps in ready.rest)))
