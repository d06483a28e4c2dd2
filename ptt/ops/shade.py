"""Shading by triple products on the triangles of a level (Ma et al. 2006, sections 3.3 and 4.2).

    B[p, c] = 20 / n sum over t of  L[p, c, t] V[p, t] F[p, c, t]
            + sum over i of  a[i, p, c] D[i, r, c] colour[p, c] E[p, c]
    F[p, c] = sum over i of  a[i, p, c] (D[i, r, c] colour[p, c] F_0 + S[i, r, c] G[i, p])

The three functions are interpolated at every point, and then multiplied: L between the frames that light was rotated
into, V between vertices or texels, G, the specular BRDF, between directions of view. F_0 is Lambert's BRDF; D and S are
the weights of the region r of the point for each of its coats i, and a[i, p, c] how much of that there is. E is what
Lambert's BRDF reflects of lamps that L is without.

All in the frame of the point (`ops.local`), n values for each function: a level of `ops.geodesic`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.compiling import spans
from ptt.ops.constants import ROOTS
from ptt.ops.near import Near
from ptt.ops.table import Table

BYTE = 255.0
_VALUES = 1 << 19  # of light, that are in the cache at once
_RECORDED = 1 << 24  # the same where a derivative is recorded, which adds up the whole table for every part


class Functions(NamedTuple):
    """On n triangles.

    light: (f, c, n), in every frame that it was rotated into
    visibility (v, n) uint8, of 255
    dull (n,): F_0
    glossy: (s * o, n), of every shape and direction of view
    """

    light: Table
    visibility: Tensor
    dull: Tensor
    glossy: Table


class RegionCoats(NamedTuple):
    """What r regions are coated with, i of them on each.

    diffuse, specular (i, r, c)
    first (i, r) int32: the row of `glossy` where the shape begins
    """

    diffuse: Tensor
    specular: Tensor
    first: Tensor


class ShadedPoints(NamedTuple):
    """p points.

    light, seen, view: where their light, visibility and BRDF are found; the rows of `view` are those of the first shape
    region (p,) int32, colour (p, c): the base colour; shares (i, p, c): how much of each of the region's coats
    """

    light: Near
    seen: Near
    view: Near
    region: Tensor
    colour: Tensor
    shares: Tensor

    def part(self, first: int, end: int) -> ShadedPoints:
        """Points first..end-1."""
        light, seen, view = (Near(*(x[first:end] for x in near)) for near in self[:3])
        return ShadedPoints(
            light, seen, view, self.region[first:end], self.colour[first:end], self.shares[:, first:end]
        )


def shade(functions: Functions, coats: RegionCoats, at: ShadedPoints, lamps: Tensor | None = None) -> Tensor:
    """B (p, c); differentiable in the light, the weights and the colours.

    lamps (p, c): E; None where the light has them
    """
    most = _RECORDED if functions.light.values.requires_grad else _VALUES
    parts = spans(len(at.region), most // functions.light.values[0].numel())
    return torch.cat(
        [_shaded(functions, coats, at.part(*some), None if lamps is None else lamps[slice(*some)]) for some in parts]
    )


def _shaded(functions: Functions, coats: RegionCoats, at: ShadedPoints, lamps: Tensor | None) -> Tensor:
    light, visibility, dull, glossy = functions
    region = at.region.long()
    seen = at.seen.mix(Table(visibility, dull.new_tensor(1 / BYTE).expand(len(visibility))))
    lit = at.light.mix(light) * seen[:, None]  # shape: (p, c, n)
    area = ROOTS / len(dull)
    matt = area * (lit @ dull.to(lit))
    matt = at.colour * (matt if lamps is None else matt + lamps)
    total = torch.zeros_like(matt)
    for diffuse, specular, first, share in zip(*coats, at.shares, strict=True):
        mirrored = at.view._replace(rows=at.view.rows + first[region][:, None]).mix(glossy)
        shine = area * (lit * mirrored[:, None]).sum(2)
        total = total + share * (diffuse[region] * matt + specular[region] * shine)
    return total
