"""Slots: the ways light can be reflected on its path, each with one coefficient per colour (Sun 2007, section 3.1).

An editable region has a slot for the diffuse function and one for each specular function of the BRDF basis; a fixed
region has a slot for each part that its material has. Where the base colour varies over a region, its diffuse function
has a slot for each colour channel; all other slots are monochrome, and H carries the colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.materials.material import Material
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.receivers import Receivers

OWN = -1  # the function of a fixed region's own highlight, or of a channel of its highlights where it has several


class Slot(NamedTuple):
    """One way of reflecting light.

    region: number of the region
    function: 0 for the diffuse one, 1.. for those of the basis, or OWN
    channel: colour channel 0..2, or -1 for all
    """

    region: int
    function: int
    channel: int = -1


def slots_of(receivers: Receivers, functions: int) -> list[Slot]:
    """The slots of every region, region by region, for a basis of so many specular functions."""
    found = []
    for r, (first, end) in enumerate(receivers.spans):
        material = receivers.materials[receivers.names[r]]
        editable = receivers.editable[r]
        colours = receivers.colours[first:end]
        if editable or bool((material.diffuse > 0).any()):
            grey = bool((colours == colours[:, :1]).all())
            found += [Slot(r, 0)] if grey else [Slot(r, 0, c) for c in range(3)]
        if editable:
            found += [Slot(r, p) for p in range(1, functions + 1)]
        else:
            count = len(material.shining)
            found += [Slot(r, OWN)] * (count == 1) + [Slot(r, OWN, c) for c in range(3) if count > 1]
    return found


def chosen(slots: Sequence[Slot], functions: int) -> tuple[Tensor, Tensor]:
    """Rows (q,) int64 of slots among the functions of all regions, and the colours (q, 3) that they keep, 1 or 0."""
    rows = [slot.region * (2 + functions) + slot.function % (2 + functions) for slot in slots]
    keep = [[float(slot.channel in (-1, c)) for c in range(3)] for slot in slots]
    return torch.tensor(rows, dtype=torch.int64), torch.tensor(keep).reshape(-1, 3)


def functions_of(basis: BRDFBasis, material: Material, coloured: Tensor) -> Tensor:
    """Coefficients (1 + p + 1, 3) of a material: of the diffuse function, those of the basis, and OWN.

    coloured (h, 3): its coordinates in the space (`BRDFSpace.coloured`)
    """
    diffuse = material.diffuse.to(basis.table)
    shining = material.shining
    own = shining[0].colour.to(diffuse) if len(shining) == 1 else torch.ones_like(diffuse)
    return torch.cat((diffuse[None], basis.table.T @ coloured.to(basis.table), own[None]))


def coefficients(slots: Sequence[Slot], basis: BRDFBasis, materials: Sequence[Material]) -> Tensor:
    """H (q, 3) of slots, for materials in the order of the regions; differentiable in their weights and parameters."""
    functions = [functions_of(basis, material, basis.space.coloured(material)) for material in materials]
    rows, keep = chosen(slots, basis.table.shape[1])
    return torch.cat(functions)[rows] * keep.to(basis.table)
