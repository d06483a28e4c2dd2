"""Integrals of products of three sparse functions as an operator; its plain function is `ptt.ops.triple.adaptive`."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.ops import triple as plain
from ptt.ops.compiling import inlined
from ptt.ops.haar import Truncated
from ptt.ops.native.arguments import of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator


@inlined
def adaptive(f: Truncated, g: Truncated, h: Truncated, n: int) -> Tensor:
    """The integrals (p,), as `ptt.ops.triple.adaptive`, of functions (p, k): down the tree where coefficients are."""
    result: Tensor = _adaptive(*f, *g, *h, n)
    return result


def _plain(f: Tensor, f_values: Tensor, g: Tensor, g_values: Tensor, h: Tensor, h_values: Tensor, n: int) -> Tensor:
    three = (Truncated(f, f_values), Truncated(g, g_values), Truncated(h, h_values))
    return plain.adaptive(*three, n)


def _kernel(f: Tensor, f_values: Tensor, g: Tensor, g_values: Tensor, h: Tensor, h_values: Tensor, n: int) -> Tensor:
    out = f_values.new_empty(len(f_values))
    run(
        "adaptive",
        indices_f=f.int().contiguous(),
        indices_g=g.int().contiguous(),
        indices_h=h.int().contiguous(),
        values_f=f_values.contiguous(),
        values_g=g_values.contiguous(),
        values_h=h_values.contiguous(),
        out=out,
        count_f=f.shape[1],
        count_g=g.shape[1],
        count_h=h.shape[1],
        points=len(out),
        n=n,
    )
    return out


def _conditions(
    f: Tensor, f_values: Tensor, g: Tensor, g_values: Tensor, h: Tensor, h_values: Tensor, n: int
) -> Conditions:
    yield of_type(torch.float32, f_values, g_values, h_values), "values must be float32"
    yield len(f) == len(g) == len(h), "the functions must be of as many points"
    for indices, values in ((f, f_values), (g, g_values), (h, h_values)):
        yield values.ndim == 2 and values.shape == indices.shape, "indices and values must be (p, k)"
        within = not indices.numel() or bool(0 <= indices.min() <= indices.max() < n)
        yield within, "indices must be in 0..n-1"


_adaptive = operator(
    "adaptive(Tensor f, Tensor f_values, Tensor g, Tensor g_values, Tensor h, Tensor h_values, int n) -> Tensor",
    plain=_plain,
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda f, f_values, *others: f_values.new_empty(f_values.shape[:-1]),
)
