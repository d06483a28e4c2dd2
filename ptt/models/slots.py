"""Slots: the ways light can be reflected on its path, each with one coefficient per colour (Sun 2007, section 3.1).

An editable region has a slot for the diffuse function and one for each specular function of the BRDF basis; a fixed
region has a slot for each part that its material has. Where the base colour varies over a region, its diffuse function
has a slot for each colour channel; all other slots are monochrome, and H carries the colours.

A region whose own material varies (`ptt.materials.varying`) has it whole, in a slot for each channel. Where it is
editable, another material takes the other slots; one that varies otherwise counts as its mean over the region there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.materials.material import Material
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.receivers import Receivers
from ptt.ops.compiling import in_python

OWN = -1  # the function of a fixed region's own highlight, or of a channel of all that its own material reflects


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
        if editable or (isinstance(material, Material) and bool((material.diffuse > 0).any())):
            grey = bool((colours == colours[:, :1]).all())
            found += [Slot(r, 0)] if grey else [Slot(r, 0, c) for c in range(3)]
        if editable:
            found += [Slot(r, p) for p in range(1, functions + 1)]
        if isinstance(material, Material) and not editable:
            count = len(material.shining)
            found += [Slot(r, OWN)] * (count == 1) + [Slot(r, OWN, c) for c in range(3) if count > 1]
        elif not isinstance(material, Material):
            found += [Slot(r, OWN, c) for c in range(3)]
    return found


def chosen(slots: Sequence[Slot], functions: int) -> tuple[Tensor, Tensor]:
    """Rows (q,) int64 of slots among the functions of all regions, and the colours (q, 3) that they keep, 1 or 0."""
    rows = [slot.region * (2 + functions) + slot.function % (2 + functions) for slot in slots]
    keep = [[float(slot.channel in (-1, c)) for c in range(3)] for slot in slots]
    return torch.tensor(rows, dtype=torch.int64), torch.tensor(keep).reshape(-1, 3)


def functions_of(basis: BRDFBasis, material: Material, coloured: Tensor, whole: bool = False) -> Tensor:
    """Coefficients (1 + p + 1, 3) of a material: of the diffuse function, those of the basis, and OWN.

    coloured (h, 3): its coordinates in the space (`BRDFSpace.coloured`)
    whole: says whether OWN is a material that varies, which this one is not
    """
    diffuse = material.diffuse.to(basis.table)
    shining = () if whole else material.shining
    own = shining[0].colour.to(diffuse) if len(shining) == 1 else torch.full_like(diffuse, float(not whole))
    return torch.cat((diffuse[None], basis.table.T @ coloured.to(basis.table), own[None]))


def whole_of(basis: BRDFBasis) -> Tensor:
    """Coefficients (1 + p + 1, 3) of a region's own material that varies: OWN alone."""
    functions = basis.table.new_zeros(2 + basis.table.shape[1], 3)
    functions[-1] = 1
    return functions


def mean_of(basis: BRDFBasis, layers: Sequence[Material], shares: Tensor, tint: Tensor, whole: bool) -> Tensor:
    """Coefficients (1 + p + 1, 3) of a material that varies, of its mean over a region.

    layers, shares (k, n, 3): its layers, and how much of each is at the region's points
    tint (3,): by what it multiplies the mean base colour
    """
    mean = shares.mean(1)
    parts = [functions_of(basis, layer, basis.space.coloured(layer), whole) for layer in layers]
    functions = (torch.stack(parts) * mean[:, None].to(parts[0])).sum(0)
    return torch.cat((functions[:1] * tint, functions[1:]))


@in_python
class SlotWeights(nn.Module):
    """H (q, c) of the slots that light each region, and its products (pairs, c) of each two by which light comes twice.

    slots: of the model; functions: of the basis, so many
    regions: which of the slots (q,), and of the pairs of them (pairs, 2), light each
    """

    rows: Tensor
    keep: Tensor

    def __init__(
        self, slots: Sequence[Slot], functions: int, regions: Sequence[tuple[Sequence[int], Sequence[Sequence[int]]]]
    ) -> None:
        super().__init__()
        once = [slot for own, _ in regions for slot in own]
        twice = [pair for _, pairs in regions for pair in pairs]
        rows, keep = chosen(slots, functions)
        all_of_them = torch.tensor(once + [a for a, _ in twice] + [b for _, b in twice], dtype=torch.int64)
        self.register_buffer("rows", rows[all_of_them], persistent=False)
        self.register_buffer("keep", keep[all_of_them], persistent=False)
        self._together = len(once), len(twice), len(twice)
        self._once = [len(own) for own, _ in regions]
        self._twice = [len(pairs) for _, pairs in regions]

    def forward(self, functions: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """Of each region; functions (1 + p + 1, c): of the material of each (`functions_of`)."""
        h = torch.cat(list(functions))[self.rows] * self.keep.to(functions[0])
        once, first, second = h.split(self._together)
        return list(zip(once.split(self._once), (first * second).split(self._twice), strict=True))


def coefficients(slots: Sequence[Slot], basis: BRDFBasis, materials: Sequence[Material]) -> Tensor:
    """H (q, 3) of slots, for materials in the order of the regions; differentiable in their weights and parameters."""
    functions = [functions_of(basis, material, basis.space.coloured(material)) for material in materials]
    rows, keep = chosen(slots, basis.table.shape[1])
    return torch.cat(functions)[rows] * keep.to(basis.table)
