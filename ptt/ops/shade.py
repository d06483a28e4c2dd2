"""Shading by triple products on the triangles of a level (Ma et al. 2006, sections 3.3 and 4.2).

    B[p, c] = 20 / n sum over t of  L[p, c, t] V[p, t] (D[p, c] F_0[t] + sum over i of  S[i, p, c] F[view[i, p], t])

The three functions are interpolated at every point, and then multiplied: L between the frames that light was rotated
into, V between vertices or texels; F is looked up. F_0 is Lambert's BRDF, D the diffuse colour, S the specular weights
of the materials that are mixed. All in the frame of the point (`ops.local`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.geodesic import ROOTS

BYTE = 255.0
_VALUES = 1 << 24  # a block


class Tables(NamedTuple):
    """Functions on n triangles.

    light (f, c, n): in every frame, float32 or float16, times the unit
    unit: so that float16 holds a sun
    visibility (v, n) uint8, of 255
    dull (n,), glossy (o, n): F_0, and F of every material and direction of view, float32 or float16
    """

    light: Tensor
    unit: float
    visibility: Tensor
    dull: Tensor
    glossy: Tensor


class Points(NamedTuple):
    """Where the functions of p points are found.

    frames (k, p) int32, weights (k, p): of the light
    seen (j, p) int32, shares (j, p): of the visibility
    view (i, p) int32, specular (i, p, c): of the glossy BRDFs
    diffuse (p, c)
    """

    frames: Tensor
    weights: Tensor
    seen: Tensor
    shares: Tensor
    view: Tensor
    specular: Tensor
    diffuse: Tensor


def shade(tables: Tables, at: Points) -> Tensor:
    """B (p, c); differentiable in the light, the weights and the colours."""
    n, count = tables.dull.shape[0], at.diffuse.shape[0]
    step, parts = max(1, _VALUES // (n * 8)), []
    for first in range(0, count, step):
        some = Points(*(x[first : first + step] if x is at.diffuse else x[:, first : first + step] for x in at))
        dtype = some.diffuse.dtype
        seen = torch.einsum("jp,jpt->pt", some.shares, tables.visibility[some.seen].to(dtype) / BYTE)
        glossy = torch.einsum("ipc,ipt->pct", some.specular, tables.glossy[some.view].to(dtype))
        factor = (glossy + some.diffuse[..., None] * tables.dull.to(dtype)) * seen[:, None]
        light = torch.einsum("kp,kpct->pct", some.weights, tables.light[some.frames].to(dtype))
        parts.append((light * factor).sum(2) * (tables.unit * ROOTS / n))
    return torch.cat(parts)
