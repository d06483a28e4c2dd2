"""The light step that all relighters begin with: a map made ready once, turned, and projected."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from ptt.light import prefiltered
from ptt.light.environment import Environment
from ptt.light.prefiltered import LightMaps
from ptt.models.cache import Cache
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.sphere import Grid
from ptt.relight.operations import operations


@in_python
class LightStep(nn.Module):
    """step(environment) -> L (3, *grid.shape), Haar coefficients of the light's means over the cells of a grid.

    grid: cells around the world
    angles: of the lobes by which `maps` blurs the light [degrees]
    compiled: as `operations` says

    - A turn of the light costs a lookup; another map is made ready first, and kept until the next.
    - Differentiable in the map.

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
        self._maps = Cache()

    @uncompiled
    def forward(self, environment: Environment) -> Tensor:
        """L (3, *grid.shape)."""
        return self.projected(self.maps(environment).fine, self.turn(environment))

    def projected(self, fine: Tensor, turn: Tensor) -> Tensor:
        """L of a map that is ready, turned."""
        lighting: Tensor = self._operations.lighting(fine, turn, self.directions, self.shares, self.shape)
        return lighting

    @opaque
    def maps(self, environment: Environment) -> LightMaps:
        """The map, fine and blurred by each lobe, in its own frame."""
        kept: LightMaps = self._maps(environment.map, lambda: prefiltered.light_maps(environment, self.angles))
        return LightMaps(*(maps.to(self.directions) for maps in kept))

    def turn(self, environment: Environment) -> Tensor:
        """The turn (3, 3) of the light: world = turn @ map."""
        return environment.rotation.to(self.directions)
