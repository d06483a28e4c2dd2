"""Shading by triple products, by a kernel in C++; by the plain function where it does not fit."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from ptt.ops import shade as plain
from ptt.ops.geodesic import ROOTS
from ptt.ops.native.arguments import ready
from ptt.ops.native.kernels import library
from ptt.ops.shade import BYTE, Points, Tables

ALIGNED = 16  # triangles
BYTES = (torch.uint8,)
LIGHTS, SEEN, MATERIALS = (1, 4, 8), (1, 3, 4), (1, 2)  # rows that are interpolated

POINTERS = (
    *("light", "visibility", "dull", "glossy", "frames", "seen", "view"),
    *("weights", "shares", "specular", "diffuse"),
)


class _Shade(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in (*POINTERS, "out")),
        *((name, c_int64) for name in ("points", "n")),
        ("unit", c_float),
        *((name, c_int32) for name in ("lights", "vertices", "materials", "threads")),
    )


def shade(tables: Tables, at: Points) -> Tensor:
    """B (p, c), as `ptt.ops.shade.shade`: three channels, tables in float16, n a multiple of 16."""
    kernels = library() if _fits(tables, at) else None
    if kernels is None:
        return plain.shade(tables, at)
    n, out = len(tables.dull), torch.empty_like(at.diffuse)
    given = tables._asdict() | at._asdict()
    tensors = {name: given[name].contiguous() for name in POINTERS} | {"out": out}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    sizes = {"lights": len(at.frames), "vertices": len(at.seen), "materials": len(at.view)}
    sizes |= {"points": len(out), "n": n, "threads": torch.get_num_threads()}
    kernels.ptt_shade(ctypes.byref(_Shade(**pointers, **sizes, unit=tables.unit * ROOTS / n / BYTE)))
    return out


def _fits(tables: Tables, at: Points) -> bool:
    """Whether the kernel is for these arguments."""
    n, p = len(tables.dull), len(at.diffuse)
    k, j, i = len(at.frames), len(at.seen), len(at.view)
    shapes = tables.light.shape[1:] == (3, n) and tables.visibility.shape[1:] == (n,) == tables.glossy.shape[1:]
    shapes = shapes and n % ALIGNED == 0 and k in LIGHTS and j in SEEN and i in MATERIALS
    shapes = shapes and at.frames.shape == at.weights.shape == (k, p) and at.seen.shape == at.shares.shape == (j, p)
    shapes = shapes and at.view.shape == (i, p) and at.specular.shape == (i, p, 3) and at.diffuse.shape == (p, 3)
    types = ready(tables.light, tables.glossy, types=(torch.float16,)) and ready(tables.visibility, types=BYTES)
    types = types and ready(at.frames, at.seen, at.view, types=(torch.int32,))
    return shapes and types and ready(tables.dull, at.weights, at.shares, at.specular, at.diffuse)
