"""The relighting equation (Sun et al. 2007, equation 3), in the order of what changes:

    light   U0[c, e, i]    = sum over l of  L[c, l] T0[l, e, i]
            U1[c, q, e, s] = sum over l of  L[c, l] T1[l, q, e, s]           U2[c, qq', e] alike
    BRDF    I[c, e, s]     = sum over q of  H[c, q] U1[c, q, e, s]  +  [s = 0] sum of  H[c, q] H[c, q'] U2[c, qq', e]
            Q[c, e, o]     = sum over i of  M[c, o, i] (U0[c, e, i] + sum over s of  C[s, i] I[c, e, s])
    view    B[v, c]        = sum over o of  V[o, v] Q[c, o, v]               and the lobes (`ops.view`)

of every eigen-point e of every cluster k; points v are combinations of them. M is the BRDF tensor's core contracted
with a material's coordinates and weights, V its outgoing factors in each point's view direction; factor 0 of i and of o
is the diffuse part: M couples it to itself alone, and V[0] = 1. H and C: `models.slots` and `models.indirect`.
Points are innermost everywhere and the small axes stay outside.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
TINY = 1e-30


def light_step(transfer: Tensor, lighting: Tensor, factors: int) -> Tensor:
    """U (c, i, v) from T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v), i < factors, and lighting (l, c)."""
    incident: Tensor = transfer @ lighting
    return incident.T.reshape(lighting.shape[1], factors, -1)


def brdf_step(matrices: Tensor, incident: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Q (c, o, v) from M (c, r, o, i) and U (c, i, v); region r holds the points spans[r] = (first, end)."""
    parts = [matrices[:, r] @ incident[:, :, a:b] for r, (a, b) in enumerate(spans)]
    return torch.cat(parts, dim=2)


def light_eigen(transfer: Tensor, lighting: Tensor) -> Tensor:
    """U (k, c, x) from T (k, l, x) of eigen-points and lighting (k, c, l) or (c, l); the product in the type of T.

    In 16 bits lighting is divided by its largest value before, and U multiplied after: float16 holds no sun, and a
    light times a factor rounds as the light itself.
    """
    if transfer.dtype.itemsize > 2 or not transfer.numel():
        return torch.matmul(lighting, transfer.to(lighting.dtype))
    scale = lighting.detach().abs().amax().clamp(min=TINY)
    return torch.matmul((lighting / scale).to(transfer.dtype), transfer).to(lighting.dtype) * scale


def bounced(one: Tensor, two: Tensor, h: Tensor, pairs: Tensor) -> Tensor:
    """I (k, c, e, s) from U1 (k, c, q, e, s), U2 (k, c, pairs, e), H (c, q) of their slots and (c, pairs) of pairs."""
    arriving: Tensor = (h[:, None] @ one.flatten(3)).unflatten(3, one.shape[3:])[:, :, 0]
    if not two.shape[2]:
        return arriving
    again = (pairs[:, None] @ two)[:, :, 0]
    return torch.cat((arriving[..., :1] + again[..., None], arriving[..., 1:]), -1)


def exitant(matrix: Tensor, incident: Tensor) -> Tensor:
    """Q (k, c, e, o) from M (c, o, i) and U (k, c, e, i)."""
    sent: Tensor = incident @ matrix.transpose(1, 2)
    return sent


def expand(eigen: Tensor, weights: Tensor, cluster: Tensor) -> Tensor:
    """Values (b, c, x, w) of points from those of eigen-points (k, c, e, x), weights (b, e, w) and cluster (b,)."""
    rows = eigen.transpose(2, 3).flatten(1, 2).index_select(0, cluster)  # shape: (b, c * x, e)
    sent: Tensor = (rows @ weights).unflatten(1, (eigen.shape[1], eigen.shape[3]))
    return sent


def view_step(outgoing: Tensor, sent: Tensor) -> Tensor:
    """B (v, c) from V (o, v) and Q (c, o, v)."""
    return (outgoing * sent).sum(1).T.contiguous()


def compiled(function: Callable[..., T]) -> Callable[..., T]:
    """`torch.compile(function)`, or the function itself, with a warning, where there is no C++ compiler."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except Exception as error:  # torch has a class of its own for it, in a private place
        warnings.warn(f"no C++ compiler, relighting stays eager: {error}", UserWarning, stacklevel=3)
        return function
    return torch.compile(function)
