"""BRDF slices: for every direction of view, a BRDF times the cosine in Haar coefficients (Wang et al. 2006, section 3).

    F[o, j] = integral of  t_j(wi) f(wi, wo) max(wi . n, 0) dwi              in Haar coefficients over j
    B[v]    = sum over the four nearest normals k of  w[k, v]  sum over j of  F[o(v, k), j] L[k, j]

t_j is bilinear about the centre of cell j, so that light is interpolated between cells (the paper integrates over the
cell alone, and what is narrower than a cell then shows cells as squares). The integral is a quadrature that follows
lobes however narrow they are: four samples a cell reflected 13 % too little of GGX of roughness 0.1, and four times too
much at grazing views.

L is local light (`ops.rotation`), wo is sampled on `HemiOctahedral(views)` and not interpolated. o(v, k) is the
direction that normal k mirrors to where point v mirrors the viewer: so all four slices have their highlights in one
place of the world. (The paper looks up one slice, in the point's own frame, and sees four highlights as far apart as
the sampled normals; and since no frames are smooth all over the sphere, seams.)

An anisotropic BRDF is sampled at so many twists: turns of the tangent about the normal against that frame's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ptt.ops import haar, tucker
from ptt.ops.albedo import is_missed, lobe_nodes
from ptt.ops.directions import faces_eye, toward
from ptt.ops.mesh import SEEN
from ptt.ops.octahedral import HemiOctahedral, corners, hemi_octahedral, mix, octahedral

BRDF = Callable[[Tensor, Tensor], Tensor]  # f(wi, wo): (..., 3), (..., 3) -> (...) [1/sr]
ALIGNED = 16  # points, and terms, come in multiples of it
FINE = 64  # samples along the edge of a map; a cell has one at least
_VIEWS = 32  # whose samples take 20 MB
_POINTS = 1 << 12  # whose products are in the cache at once


class Slices(NamedTuple):
    """The slices of one shape: s = twists * views^2 slices of t terms.

    terms (s, t) int16: which coefficients, or rows of `basis`
    values (s, t) float16: theirs; none exceeds the albedo
    views: along the edge of the grid of view directions
    basis (t, M) or None: of `factorised` slices, what the terms stand for
    """

    terms: Tensor
    values: Tensor
    views: int
    basis: Tensor | None = None

    @property
    def twists(self) -> int:
        """Turns of the tangent, evenly around the circle."""
        return len(self.terms) // self.views**2

    @property
    def bytes(self) -> int:
        """Size of all tables."""
        return sum(t.numel() * t.element_size() for t in (self.terms, self.values, self.basis) if t is not None)

    def to(self, device: torch.device) -> Slices:
        """The same on a device."""
        basis = None if self.basis is None else self.basis.to(device)
        return Slices(self.terms.to(device), self.values.to(device), self.views, basis)

    def to_dense(self, cells: int) -> Tensor:
        """(s, cells)."""
        if self.basis is not None:
            return self.values.float() @ self.basis
        dense = self.values.new_zeros(len(self.terms), cells, dtype=torch.float32)
        return dense.scatter_add(1, self.terms.long(), self.values.float())

    def to_tensorly(self, cells: int) -> Any:
        """tensorly's TuckerTensor (s, cells) of `to_dense`: the products of `factorised` slices, else at full rank."""
        if self.basis is None:
            values = self.to_dense(cells)
            columns = torch.eye(cells, device=values.device, dtype=torch.float32)
        else:
            columns = self.basis[self.basis.abs().amax(1) > 0].T  # shape: (cells, r), without the padding
            values = self.values[:, : columns.shape[1]].float()
        return tucker.Tucker(torch.eye(columns.shape[1]).to(columns), (values, columns)).to_tensorly()

    def with_tensorly(self, tucker_tensor: Any) -> Slices:
        """The same views of slices that a TuckerTensor (s, cells) stands for, rounded to 16 bits: 5e-4 of a value.

        At a rank r below `cells` on the second axis they are `factorised`, the sum of r products. At full rank those
        of a table are a table again, of the largest terms, as many as before.

        Raises:
            ValueError: another shape, fewer cells than the terms need, or values beyond those of 16 bits.
        """
        length = None if self.basis is None else self.basis.shape[1]
        fit = tucker.Tucker.checked(tucker_tensor, (len(self.terms), length), self.values.float(), "slices")
        cells = len(fit.factors[1])
        if self.basis is None and cells <= int(self.terms.max()):
            raise ValueError(f"slices must have more than {int(self.terms.max())} cells, the last term, got {cells}")
        if self.basis is None and fit.core.shape[1] >= cells:
            terms, values = haar.truncate(fit.to_dense(), min(self.terms.shape[1], cells))
            padding = 0, -values.shape[1] % ALIGNED
            terms = torch.nn.functional.pad(terms, padding).to(torch.int16)
            made = Slices(terms, torch.nn.functional.pad(values, padding).half(), self.views)
        else:
            core, (rows, columns) = fit.orthonormal([1])
            made = _products(rows @ core, columns.T.contiguous(), self.views)
        if not bool(made.values.isfinite().all()):
            raise ValueError("slices must have values of at most 65504, which 16 bits hold")
        return made


class NormalLookup(NamedTuple):
    """Points among the sampled normals; v is a multiple of `ALIGNED`.

    position, normal (3, v)
    near (4, v) int32, weights (4, v): the nearest sampled normals, bilinear
    twist (4, v): the angle from their frames' tangents to the point's, seen about the normal [rad]
    dip (v,): `mesh.dips`
    """

    position: Tensor
    normal: Tensor
    near: Tensor
    weights: Tensor
    twist: Tensor
    dip: Tensor


def located(position: Tensor, frames: Tensor, sampled: Tensor, dip: Tensor | None = None) -> NormalLookup:
    """Points (v, 3) with frames (v, 3, 3) among those (n * n, 3, 3) of the normals `Octahedral(n).directions()`.

    dip (v,): `mesh.dips`; None for points that are seen from everywhere
    """
    normal = frames[:, 2]
    tangent = frames[:, 0]
    near, weights = corners(octahedral(normal), math.isqrt(len(sampled)), wrap=True)
    around = sampled.to(frames)[near]  # shape: (v, 4, 3, 3)
    x, y, _ = torch.einsum("vkax,vkx->akv", around, _leaned(tangent[:, None], normal[:, None], around[:, :, 2]))
    return NormalLookup(
        position.T.contiguous(),
        normal.T.contiguous(),
        near.T.int().contiguous(),
        weights.T.contiguous(),
        torch.atan2(y, x),
        position.new_full((len(position),), SEEN) if dip is None else dip,
    )


def _leaned(d: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Directions d (..., 3) turned by the smallest rotation that takes unit vectors start to end (..., 3)."""
    middle = start + end
    along_middle = (d * middle).sum(-1, keepdim=True) / (1 + (start * end).sum(-1, keepdim=True)).clamp(min=1e-6)
    return d - along_middle * middle + 2 * (d * start).sum(-1, keepdim=True) * end


def tabulate(f: BRDF, m: int, views: int, terms: int, twists: int = 1, even: bool = False) -> Slices:
    """The `terms` largest Haar coefficients of every slice of a BRDF on `HemiOctahedral(m)`.

    twists: 1 for an isotropic BRDF, of which an eighth is sampled: the rest are its mirror images
    even: says that f turned by half a circle is f, so that half of the twists are the other half again

    Raises:
        ValueError: terms is not in 1..m^2, or the BRDF returns what is not finite.
    """
    if not 1 <= terms <= m * m:
        raise ValueError(f"terms must be in 1..{m * m}, the cells of a local map, got {terms}")
    rows, columns = torch.meshgrid(torch.arange(views), torch.arange(views), indexing="ij")
    eighth = (columns >= rows) & (rows >= views // 2) if twists == 1 else torch.ones_like(rows, dtype=torch.bool)
    again = 2 if even and twists % 2 == 0 else 1
    angles = torch.arange(twists // again, dtype=torch.float64) * (2 * math.pi / twists)
    kept = [
        haar.truncate(haar.analyse(block.unflatten(2, (m, m))).flatten(2), terms)
        for block in _dense(f, m, HemiOctahedral(views).directions()[eighth], angles)
    ]
    order, values = (torch.cat(parts, 1).flatten(0, 1).repeat(again, 1) for parts in zip(*kept, strict=True))
    if twists == 1:
        order, values = _mirrored(order, values, m, eighth)
    order, values = (torch.nn.functional.pad(x, (0, -terms % ALIGNED)) for x in (order, values))
    return Slices(order.to(torch.int16), values.half(), views)


def factorise(f: BRDF, m: int, views: int, rank: int, twists: int = 1, even: bool = False) -> Slices:
    """As `tabulate`, but the best approximation of all slices together by `rank` products of two factors."""
    dense = tabulate(f, m, views, m * m, twists, even).to_dense(m * m)
    if not 1 <= rank <= min(dense.shape):
        raise ValueError(f"rank must be in 1..{min(dense.shape)}, got {rank}")
    gram = torch.stack([block.double().T @ block.double() for block in dense.split(1 << 14)]).sum(0)
    basis = torch.linalg.eigh(gram).eigenvectors[:, -rank:].flip(1).T.float().contiguous()
    return _products(dense @ basis.T, basis, views)


def _products(values: Tensor, basis: Tensor, views: int) -> Slices:
    """Slices values (s, r) @ basis (r, M), of orthonormal rows: so no value exceeds the norm of its slice."""
    rank = len(basis)
    padding = -rank % ALIGNED
    terms = torch.arange(rank, dtype=torch.int16, device=basis.device).expand(len(values), -1)
    terms = torch.nn.functional.pad(terms, (0, padding)).contiguous()
    values = torch.nn.functional.pad(values, (0, padding)).half()
    return Slices(terms, values, views, torch.nn.functional.pad(basis, (0, 0, 0, padding)))


def cosine(m: int) -> Tensor:
    """The slice (M,) of the BRDF 1: its sum with local light is the irradiance. float64."""
    return haar.analyse(_projected(m, max(8, 128 // m)).reshape(m * m, -1).sum(1).reshape(m, m)).flatten()


def project(light: Tensor, slices: Slices) -> Tensor:
    """What the terms of slices are multiplied by: local light (f, M, c), or its part along each row of the basis."""
    return light if slices.basis is None else slices.basis @ light


def reflected(light: Tensor, slices: Slices, first: Tensor, frames: Tensor, at: NormalLookup, eye: Tensor) -> Tensor:
    """B (v, c) of points, of local light (f, x, c) as `project` gives it, in frames (f, 3, 3).

    first (4, v) int32: the first slice of each point's twist (`first_slice`)
    eye (3,), or directions (3, v) from the points to the viewer; from behind, points look as from the mirrored side,
        those that an eye sees no front of reflect nothing (`faces_eye`)
    """
    wo = toward(eye, at.position, 0)
    which = first + _view_cell(slices.views, frames, at, wo)
    _, rows, channels = light.shape
    parts = []
    for some, near, weights in zip(*(x.split(_POINTS, 1) for x in (which, at.near, at.weights)), strict=True):
        terms, values = (x.index_select(0, some.flatten()) for x in slices[:2])  # shape: (4 * v, t)
        found = mix(light.flatten(0, 1), rows * near.long().reshape(-1, 1) + terms, values.to(light))
        parts.append((weights.to(light)[..., None] * found.reshape(*weights.shape, channels)).sum(0))
    seen = faces_eye(at.dip, (at.normal * wo).sum(0), eye)
    return torch.cat(parts) * seen[:, None]


def _view_cell(views: int, frames: Tensor, at: NormalLookup, wo: Tensor) -> Tensor:
    """Cells (4, v) of the directions that each normal mirrors to where the point mirrors the viewer, in wo (3, v)."""
    mirrored = 2 * (at.normal * wo).sum(0).clamp(min=0) * at.normal - wo
    x, y, z = torch.einsum("kvax,xv->akv", frames[at.near.long()], mirrored)
    ab = hemi_octahedral(torch.stack((-x, -y, z.abs()), -1))
    column, row = (((ab + 1) * (views / 2)).long().clamp(0, views - 1)).unbind(-1)
    return row * views + column


def first_slice(slices: Slices, twist: Tensor) -> Tensor:
    """The first slice (4, v) int32 of the nearest twist (4, v) [rad]."""
    turn = (twist * (slices.twists / (2 * math.pi))).round().long() % slices.twists
    return (turn * slices.views**2).int()


def _projected(m: int, samples: int) -> Tensor:
    """Projected solid angles (M * samples^2,) of the parts of each cell, float64."""
    fine = HemiOctahedral(m * samples)
    weight = fine.solid_angles() * fine.directions()[..., 2]
    return weight.reshape(m, samples, m, samples).transpose(1, 2).flatten()


def _dense(f: BRDF, m: int, wo: Tensor, angles: Tensor) -> Iterator[Tensor]:
    """Slices (twists, b, M) in texels, float32, for twists by some angles (twists,) [rad] and directions of view
    (v, 3), in blocks of these."""
    samples = _samples(m)
    narrow = is_missed(f, lambda some: _texels(f, some.float(), samples, m).sum(1))
    for some in wo.split(_VIEWS):
        on = _incident(*lobe_nodes(some), m) if narrow else samples
        blocks = []
        for c, s in zip(angles.cos().tolist(), angles.sin().tolist(), strict=True):
            turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)  # into the tangent's
            blocks.append(_texels(f, some.float() @ turn, on._replace(wi=on.wi @ turn), m))
        yield torch.stack(blocks)


class _Incident(NamedTuple):
    """Samples of light: directions (..., s, 3), cosines times solid angles (..., s), their cells, and the shares of
    these (..., s, 4)."""

    wi: Tensor
    weights: Tensor
    cells: Tensor
    tents: Tensor


def _incident(wi: Tensor, weights: Tensor, m: int) -> _Incident:
    """Samples on a local map, of directions (..., s, 3) of which those below the horizon weigh nothing (..., s)."""
    up = torch.where(weights[..., None] > 0, wi, wi.new_tensor([0.0, 0.0, 1.0]))
    cells, tents = corners(hemi_octahedral(up), m, wrap=False)
    return _Incident(up.float(), weights.float(), cells, tents.float())


@lru_cache(maxsize=4)
def _samples(m: int) -> _Incident:
    """Samples that are the same for all directions of view, by the midpoint rule."""
    fine = HemiOctahedral(max(m, FINE))
    wi = fine.directions().reshape(-1, 3)
    return _incident(wi, fine.solid_angles().flatten() * wi[:, 2], m)


def _texels(f: BRDF, wo: Tensor, on: _Incident, m: int) -> Tensor:
    """Slices (v, M) in texels for local directions of view (v, 3)."""
    values = torch.where(on.weights > 0, f(on.wi, wo[:, None].expand(-1, on.wi.shape[-2], -1)), 0.0)
    if not bool(values.isfinite().all()):
        raise ValueError("the BRDF must be finite")
    parts = on.tents * (values * on.weights)[..., None]
    cells = on.cells.expand_as(parts)
    return parts.new_zeros(len(wo), m * m).scatter_add_(1, cells.flatten(1), parts.flatten(1))


def _mirrored(order: Tensor, values: Tensor, m: int, eighth: Tensor) -> tuple[Tensor, Tensor]:
    """Positions and values (views^2, t) of all slices from those of an eighth (views, views) of the view directions.

    Mirroring view and light alike changes no isotropic BRDF: it turns the square of a slice over, which permutes its
    coefficients and changes signs.
    """
    views = len(eighth)
    number = torch.full(eighth.shape, -1)
    number[eighth] = torch.arange(len(order))
    rows, columns = torch.meshgrid(torch.arange(views), torch.arange(views), indexing="ij")
    up = rows < views // 2
    left = columns < views // 2
    row = torch.where(up, views - 1 - rows, rows)
    column = torch.where(left, views - 1 - columns, columns)
    swapped = row > column
    source = number[torch.minimum(row, column), torch.maximum(row, column)].flatten()
    order = order[source].long()
    values = values[source]
    flipped, sign = _flip(m)
    over = order % m * m + order // m  # rows and columns swapped
    order = torch.where(swapped.flatten()[:, None], over, order)
    values = torch.where(left.flatten()[:, None], values * sign[order], values)
    order = torch.where(left.flatten()[:, None], flipped[order], order)
    over = order % m * m + order // m
    values = torch.where(up.flatten()[:, None], values * sign[over], values)
    down = flipped[over]
    return torch.where(up.flatten()[:, None], down % m * m + down // m, order), values


def _flip(m: int) -> tuple[Tensor, Tensor]:
    """What turning a map (m, m) over, left to right, does to its coefficients: new positions (M,), signs (M,)."""
    at = torch.arange(m)
    row, column = (x.flatten() for x in torch.meshgrid(at, at, indexing="ij"))
    level = torch.maximum(row, column)
    half = torch.where(level > 0, 1 << level.clamp(min=1).log2().floor().long(), 0)
    detail = (column >= half) & (half > 0)
    first = torch.where(detail, half, 0)
    new = torch.where(half > 0, first + half - 1 - (column - first), column)
    return row * m + new, torch.where(detail, -1.0, 1.0)
