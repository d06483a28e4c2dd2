"""The narrow lobes of materials, and the light that they see, as the relighters take them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ptt.light.lamps import INNER, Lamps
from ptt.materials.material import Material
from ptt.models.cache import Cache
from ptt.ops.cells import Gloss, gloss_of, width
from ptt.ops.compiling import in_python
from ptt.ops.constants import LEVELS, MOST_CELLS
from ptt.ops.gloss import GlossLight
from ptt.relight.light_step import SplitLight

WIDTHS = (0.0, *(width(level) for level in range(1, LEVELS)))
"""Degrees that lobes cover, by their levels; the first is as narrow as the maps are."""
CELL = 0.8  # degrees between the cells that the areas of lamps have (`ptt.light.prefiltered.FINE_SIDE`)
MOST = 32  # tables of lobes that are kept: a textured metal has 26, which changes of colour leave as they are


@in_python
class Glosses:
    """glosses(material, like) -> the tables of a material's lobes, None where it is dull, in the type of a tensor.

    count: lobes of each material; None for `ptt.ops.cells.enough`
    operations: `ptt.relight.operations.operations`

    Raises:
        ValueError: a count that is not in 1..64.
    """

    def __init__(self, count: int | None, operations: Any) -> None:
        if count is not None and not 1 <= count <= MOST_CELLS:
            raise ValueError(f"lobes must be in 1..{MOST_CELLS}, got {count}")
        self.count = count
        self._operations = operations
        self._kept = Cache(MOST)

    def __call__(self, material: Material, like: Tensor) -> Gloss | None:
        if not material.shining:
            return None
        made: Gloss = self._kept(
            material.highlights,
            lambda: gloss_of(material.glossy, material.isotropic, self.count, self._operations.cell_sums),
        )
        lobes = made.lobes._replace(table=made.lobes.table.to(like))
        whole, parts = made.whole.to(like), made.parts.to(like)
        return Gloss(lobes, made.values.to(like), whole, parts, made.spread)


def lamps_for(spread: float, lamps: Lamps) -> tuple[Tensor, Tensor, Tensor] | None:
    """The directions (k, 3) and powers (k, c) in which a material whose highlight is so wide [degrees] shows lamps, and
    of which lamps they are parts (k,): all of each at once; as many as its area has cells; None for the map.

    In a trial on a statue under a room, GGX of roughness 0.1 erred by 91 % with lamps on the map, 19 with whole ones
    and 0 with their areas, at one of 500 vertices that mirrors a lamp.
    """
    if spread < CELL:
        return None
    if spread > INNER:
        return lamps.directions, lamps.powers, torch.arange(len(lamps.powers), device=lamps.powers.device)
    lit = lamps.shares > 0
    powers = (lamps.powers[:, None] * lamps.shares[..., None])[lit]
    return lamps.areas[lit], powers, lit.nonzero()[:, 0]


def light_for(gloss: Gloss, light: SplitLight, through: Tensor) -> GlossLight:
    """The light of a material's narrow lobes, of whose lamps points see so much (m, n)."""
    found = lamps_for(gloss.spread, light.lamps)
    if found is None:
        none = through.new_zeros(0, 3)
        return GlossLight(light.whole.maps, light.whole.turn, none, none, through[:0])
    directions, powers, number = found
    return GlossLight(light.rest.maps, light.rest.turn, directions, powers, through[number])
