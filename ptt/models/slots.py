"""Slots: the ways light can be reflected on its path, each with one coefficient per colour (Sun 2007, section 3.1).

An editable region has a slot for the diffuse function and one for each specular function of the BRDF basis; a fixed one
has a slot for each part of the material that it has. Where the base colour varies over a region its diffuse function
has a slot for each colour channel, and all others are monochrome: H carries the colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.materials import Material
from ptt.models.brdf_basis import BRDFBasis
from ptt.receivers import Receivers

OWN = -1  # the function of a fixed region's own shape


class Slot(NamedTuple):
    """region: its number; function: 0 diffuse, 1.. of the basis, or OWN; channel: 0..2, or -1 for all colours."""

    region: int
    function: int
    channel: int = -1


def slots_of(receivers: Receivers, functions: int) -> list[Slot]:
    """Those of every region, region by region, for a basis of so many specular functions."""
    found = []
    for r, (name, editable, (first, end)) in enumerate(
        zip(receivers.names, receivers.editable, receivers.spans, strict=True)
    ):
        material, colours = receivers.materials[name], receivers.colours[first:end]
        if editable or bool((material.diffuse > 0).any()):
            grey = bool((colours == colours[:, :1]).all())
            found += [Slot(r, 0)] if grey else [Slot(r, 0, c) for c in range(3)]
        if editable:
            found += [Slot(r, p) for p in range(1, functions + 1)]
        elif material.shape is not None and bool((material.specular > 0).any()):
            found.append(Slot(r, OWN))
    return found


def coefficients(slots: Sequence[Slot], basis: BRDFBasis, materials: Sequence[Material]) -> Tensor:
    """H (q, 3), of materials in the order of the regions; differentiable in their weights and parameters."""
    rows = []
    tables = [basis.coefficients(material) if material.shape else None for material in materials]
    for slot in slots:
        material, table = materials[slot.region], tables[slot.region]
        if slot.function == 0:
            colour = material.diffuse.to(basis.table)
            keep = torch.arange(3) == slot.channel if slot.channel >= 0 else torch.ones(3, dtype=torch.bool)
            rows.append(colour * keep.to(colour))
        elif slot.function == OWN:
            rows.append(material.specular.to(basis.table))
        else:
            rows.append(basis.table.new_zeros(3) if table is None else table[slot.function])
    return torch.stack(rows) if rows else basis.table.new_zeros(0, 3)
