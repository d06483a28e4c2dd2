"""The narrow lobes of materials, and the light that they see, as the relighters take them."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from ptt.materials.material import Material
from ptt.models.cache import Cache
from ptt.ops.cells import Gloss, gloss_of, width
from ptt.ops.compiling import in_python
from ptt.ops.constants import LEVELS, MOST_CELLS
from ptt.ops.gloss import GlossLight
from ptt.relight.light_step import SplitLight

WIDTHS = (0.0, *(width(level) for level in range(1, LEVELS)))
"""Degrees that lobes cover, by their levels; the first is as narrow as the maps are."""
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
        return Gloss(lobes, made.values.to(like), whole, parts, made.sharp)


def light_for(gloss: Gloss, light: SplitLight, through: Tensor) -> GlossLight:
    """The light of a material's narrow lobes, of whose lamps points see so much (m, n): a sharp one sees lamps as they
    are on the maps, areas or not."""
    if gloss.sharp:
        none = through.new_zeros(0, 3)
        return GlossLight(light.whole.maps, light.whole.turn, none, none, through[:0])
    return GlossLight(light.rest.maps, light.rest.turn, light.lamps.directions, light.lamps.powers, through)
