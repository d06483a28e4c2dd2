"""The relighting equation (Sun et al. 2007, equation 3), in the order of what changes:

    light   U0[e, i, c]    = sum over l of  L[l, c] T0[e, i, l]
            U1[e, q, s, c] = sum over l of  L[l, c] T1[e, q, s, l]           U2[e, qq', c] alike
    BRDF    I[e, s, c]     = sum over q of  H[q, c] U1[e, q, s, c]  +  [s = 0] sum of  H[q, c] H[q', c] U2[e, qq', c]
            Q[c, o, v]     = sum over i of  M[c, o, i] (U0 + sum over s of C[s, i] I[s, c])[i, c]
    view    B[v, c]        = sum over o of  V[o, v] Q[c, o, v]               and the lobes (`ops.view`)

of every eigen-point e of every cluster k; points v are combinations of them. M is the BRDF tensor's core contracted
with a material's coordinates and weights, V its outgoing factors in each point's view direction; factor 0 of i and of o
is the diffuse part: M couples it to itself alone, and V[0] = 1. H and C: `models.slots` and `bounces.responses`.
Points are innermost everywhere and the small axes stay outside.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor


T = TypeVar("T")


def light_step(transfer: Tensor, lighting: Tensor, factors: int) -> Tensor:
    """U (c, i, v) from T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v), i < factors, and lighting (l, c)."""
    incident: Tensor = transfer @ lighting
    return incident.T.reshape(lighting.shape[1], factors, -1)


def brdf_step(matrices: Tensor, incident: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Q (c, o, v) from M (c, r, o, i) and U (c, i, v); region r holds the points spans[r] = (first, end)."""
    parts = [matrices[:, r] @ incident[:, :, a:b] for r, (a, b) in enumerate(spans)]
    return torch.cat(parts, dim=2)


def bounced(one: Tensor, two: Tensor, h: Tensor, pairs: Tensor) -> Tensor:
    """I (k, e, s, c) from U1 (k, e, q, s, c), U2 (k, e, pairs, c), H (q, c) of the slots of U1 and of the pairs."""
    arriving = torch.einsum("keqsc,qc->kesc", one, h)
    if two.shape[2]:
        again = torch.einsum("kepc,pc->kec", two, pairs)
        arriving = torch.cat((arriving[:, :, :1] + again[:, :, None], arriving[:, :, 1:]), 2)
    return arriving


def exitant(matrix: Tensor, incident: Tensor) -> Tensor:
    """Q (k, c, o, e) from M (c, o, i) and U (k, e, i, c)."""
    return torch.einsum("coi,keic->kcoe", matrix, incident)


def expand(eigen: Tensor, weights: Tensor, cluster: Tensor) -> Tensor:
    """Values (b, ..., w) of points from those of eigen-points (k, ..., e), weights (b, e, w) and cluster (b,)."""
    return (eigen.flatten(1, -2)[cluster] @ weights).unflatten(1, eigen.shape[1:-1])


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
