"""BRDF slices: for every direction of view, a BRDF times the cosine in Haar coefficients (Wang et al. 2006, section 3).

    F[o, j] = integral over cell j of  f(wi, wo) max(wi . n, 0) dwi          in Haar coefficients over j
    B[v]    = sum over the four nearest normals k of  w[v, k]  sum over j of  F[o(v, k), j] L[k, j]

wo is sampled on `HemiOctahedral(views)` and not interpolated; L is local light (`ops.rotation`). Each of the four
normals has a frame of its own, and the view direction is looked up in each: in that frame leaned over, by the smallest
rotation, until its normal is the point's (`located`). So it does not matter how fast frames turn from one normal to the
next, which they do somewhere on every sphere; the paper looks up once, in the frame of the point.

An anisotropic BRDF is sampled at so many twists: turns of the tangent about the normal against that frame's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import haar
from ptt.ops.octahedral import HemiOctahedral, Octahedral, corners, hemi_octahedral, octahedral
from ptt.ops.rotation import samples_of

BRDF = Callable[[Tensor, Tensor], Tensor]  # f(wi, wo): (..., 3), (..., 3) -> (...) [1/sr]
ALIGNED = 16  # points, and terms, come in multiples of it
TINY = 1e-30
_VALUES = 1 << 22  # a block, of BRDF values or of products


class Slices(NamedTuple):
    """Of one shape: s = twists * views^2 slices of t terms.

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

    def to_dense(self, cells: int) -> Tensor:
        """(s, cells)."""
        if self.basis is not None:
            return self.values.float() @ self.basis
        dense = self.values.new_zeros(len(self.terms), cells, dtype=torch.float32)
        return dense.scatter_add(1, self.terms.long(), self.values.float())


class Located(NamedTuple):
    """Points among the sampled normals; v is a multiple of `ALIGNED`.

    position, normal (3, v)
    near (v, 4) int32, weights (v, 4): the nearest sampled normals, bilinear
    leaned (4, 2, 3, v): tangent and bitangent of their frames, leaned over until their normals are the point's
    twist (v, 4): the angle from the frame's tangent to the point's [rad]
    """

    position: Tensor
    normal: Tensor
    near: Tensor
    weights: Tensor
    leaned: Tensor
    twist: Tensor


def located(position: Tensor, frames: Tensor, sampled: Tensor) -> Located:
    """Points (v, 3) with frames (v, 3, 3) among those (n * n, 3, 3) of the normals `Octahedral(n).directions()`."""
    normal, tangent = frames[:, 2], frames[:, 0]
    index, weights = corners(octahedral(normal), math.isqrt(len(sampled)), wrap=True)
    around = sampled.to(frames)[index]  # shape: (v, 4, 3, 3)
    leaned = _lean(around[:, :, :2], around[:, :, 2], normal[:, None].expand(-1, 4, -1))
    x, y = torch.einsum("vjkx,vx->kvj", leaned, tangent)
    return Located(
        position.T.contiguous(),
        normal.T.contiguous(),
        index.int(),
        weights,
        leaned.permute(1, 2, 3, 0).contiguous(),
        torch.atan2(y, x),
    )


def _lean(rows: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Rows (..., k, 3) turned by the smallest rotation that takes unit vectors start to end (..., 3)."""
    middle = start + end
    scale = 1 / (1 + (start * end).sum(-1)).clamp(min=1e-6)
    along_middle = torch.einsum("...kx,...x->...k", rows, middle) * scale[..., None]
    along_start = torch.einsum("...kx,...x->...k", rows, start)
    return rows - along_middle[..., None] * middle[..., None, :] + 2 * along_start[..., None] * end[..., None, :]


def tabulate(f: BRDF, m: int, views: int, terms: int, twists: int = 1, samples: int = 2) -> Slices:
    """The `terms` largest Haar coefficients of every slice of a BRDF on `HemiOctahedral(m)`.

    twists: 1 for an isotropic BRDF
    samples: along the edge of a cell, of the midpoint rule

    Raises:
        ValueError: terms is not in 1..m^2, or the BRDF returns what is not finite.
    """
    if not 1 <= terms <= m * m:
        raise ValueError(f"terms must be in 1..{m * m}, the cells of a local map, got {terms}")
    kept = [
        haar.truncate(haar.analyse(block.reshape(-1, m, m)).flatten(1), terms)
        for block in _dense(f, m, views, twists, samples)
    ]
    order, values = (torch.cat(parts) for parts in zip(*kept, strict=True))
    padding = -terms % ALIGNED
    order, values = (torch.nn.functional.pad(x, (0, padding)) for x in (order, values))
    return Slices(order.to(torch.int16), values.half(), views)


def factorise(f: BRDF, m: int, views: int, rank: int, twists: int = 1, samples: int = 2) -> Slices:
    """As `tabulate`, but the best approximation of all slices together by `rank` products of two factors."""
    dense = torch.cat([haar.analyse(b.reshape(-1, m, m)).flatten(1) for b in _dense(f, m, views, twists, samples)])
    if not 1 <= rank <= min(dense.shape):
        raise ValueError(f"rank must be in 1..{min(dense.shape)}, got {rank}")
    gram = sum(block.double().T @ block.double() for block in dense.split(1 << 14))
    _, vectors = torch.linalg.eigh(gram)
    basis = vectors[:, -rank:].flip(1).T.float().contiguous()
    terms = torch.arange(rank, dtype=torch.int16).expand(len(dense), -1)
    padding = -rank % ALIGNED
    order, values, basis = (
        torch.nn.functional.pad(terms, (0, padding)),
        torch.nn.functional.pad(dense @ basis.T, (0, padding)),
        torch.nn.functional.pad(basis, (0, 0, 0, padding)),
    )
    return Slices(order.contiguous(), values.half(), views, basis)


def cosine(m: int) -> Tensor:
    """The slice (M,) of the BRDF 1: its sum with local light is the irradiance. float64."""
    return haar.analyse(_projected(m, max(8, 128 // m)).reshape(m * m, -1).sum(1).reshape(m, m)).flatten()


def project(light: Tensor, slices: Slices) -> Tensor:
    """What the terms of slices are multiplied by: local light (f, M, c), or its part along each row of the basis."""
    return light if slices.basis is None else slices.basis @ light


def reflected(light: Tensor, slices: Slices, first: Tensor, at: Located, eye: Tensor) -> Tensor:
    """B (v, c) of points, of local light (f, x, c) as `project` gives it.

    first (v, 4) int32: the first slice of each point's twist (`first_slice`)
    eye (3,), or directions (3, v) from the points to the viewer; from behind, points look as from the mirrored side
    """
    which = first + _view_cell(slices.views, at, eye)
    parts, step = [], max(1, _VALUES // (slices.terms.shape[1] * 16))
    for some, index, weights in zip(which.split(step), at.near.split(step), at.weights.split(step), strict=True):
        values = slices.values[some].to(light) * weights[..., None].to(light)
        picked = light[index[..., None].long(), slices.terms[some].long()]  # shape: (v, 4, t, c)
        parts.append(torch.einsum("vjt,vjtc->vc", values, picked))
    return torch.cat(parts)


def _view_cell(views: int, at: Located, eye: Tensor) -> Tensor:
    """Cells (v, 4) of the directions to the viewer, in the frame of each of a point's normals."""
    toward = eye if eye.ndim == 2 else eye[:, None] - at.position
    toward = toward / toward.norm(dim=0).clamp(min=TINY)
    x, y = torch.einsum("jkxv,xv->kvj", at.leaned, toward)
    z = (at.normal * toward).sum(0).abs()[:, None].expand_as(x)
    ab = hemi_octahedral(torch.stack((x, y, z), -1))
    column, row = (((ab + 1) * (views / 2)).long().clamp(0, views - 1)).unbind(-1)
    return row * views + column


def first_slice(slices: Slices, twist: Tensor) -> Tensor:
    """The first slice (v, 4) int32 of the nearest twist (v, 4) [rad]."""
    turn = (twist * (slices.twists / (2 * math.pi))).round().long() % slices.twists
    return (turn * slices.views**2).int()


def normals_of(n: int) -> Tensor:
    """(n * n, 3) float64."""
    return Octahedral(n).directions().reshape(-1, 3)


def _projected(m: int, samples: int) -> Tensor:
    """Projected solid angles (M * samples^2,) of the parts of each cell, float64."""
    fine = HemiOctahedral(m * samples)
    weight = fine.solid_angles() * fine.directions()[..., 2]
    return weight.reshape(m, samples, m, samples).transpose(1, 2).flatten()


def _dense(f: BRDF, m: int, views: int, twists: int, samples: int) -> Iterator[Tensor]:
    """Slices (b, M) in texels, in blocks, float32."""
    wi, weight = samples_of(HemiOctahedral(m), samples).float(), _projected(m, samples).float()
    wo = HemiOctahedral(views).directions().reshape(-1, 3).float()
    for k in range(twists):
        c, s = math.cos(2 * math.pi * k / twists), math.sin(2 * math.pi * k / twists)
        turned = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # into the frame of the tangent
        for some in wo.split(max(1, _VALUES // len(wi))):
            values = f(wi @ turned, (some @ turned)[:, None]) * weight
            if not bool(values.isfinite().all()):
                raise ValueError("the BRDF must be finite")
            yield values.reshape(len(some), m * m, -1).sum(2)
