"""Integrals of products of three sparse functions, by a kernel in C++; by the plain function where it does not fit."""

from __future__ import annotations

import ctypes
from ctypes import c_int, c_int64, c_void_p

import torch
from torch import Tensor

from ptt.ops import triple as plain
from ptt.ops.haar import Truncated
from ptt.ops.native.arguments import address, ready
from ptt.ops.native.kernels import library


class _Sparse(ctypes.Structure):
    _fields_ = (("indices", c_void_p), ("values", c_void_p), ("count", c_int64))


def adaptive(f: Truncated, g: Truncated, h: Truncated, n: int) -> Tensor:
    """The integrals (p,), as `ptt.ops.triple.adaptive`, of functions (p, k): down the tree where coefficients are."""
    three = [Truncated(x.indices.int().contiguous(), x.values.contiguous()) for x in (f, g, h)]
    points = {len(x.values) for x in three}
    alike = len(points) == 1 and all(x.values.ndim == 2 and x.values.shape == x.indices.shape for x in three)
    alike = alike and all(not x.indices.numel() or 0 <= x.indices.min() <= x.indices.max() < n for x in three)
    kernels = library() if alike and ready(*(x.values for x in three)) else None
    if kernels is None:
        return plain.adaptive(f, g, h, n)
    given = (_Sparse * 3)(*(_Sparse(x.indices.data_ptr(), x.values.data_ptr(), x.values.shape[1]) for x in three))
    out = torch.empty(points.pop())
    kernels.ptt_adaptive(given, address(out), c_int64(len(out)), c_int64(n), c_int(torch.get_num_threads()))
    return out
