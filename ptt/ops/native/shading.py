"""Shading by triple products, by a kernel in C++; by the plain function where it does not fit."""

from __future__ import annotations

import ctypes
from ctypes import c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from ptt.ops import shade as plain
from ptt.ops.native.arguments import KINDS, ready
from ptt.ops.native.kernels import library
from ptt.ops.shade import Coats, Functions, Points

SEEN = {1: (1,), 4: (1, 3, 4), 8: (1, 3, 4)}
VIEWS = {1: 1, 4: 4, 8: 4}  # rows that are interpolated, by those of light
COATS = 1, 2

POINTERS = (
    *("light", "dull", "glossy", "visibility", "light_scale", "glossy_scale"),
    *("light_rows", "seen_rows", "view_rows", "region", "start"),
    *("light_weights", "seen_weights", "view_weights", "colour", "second", "diffuse", "specular", "out"),
)
LONGS = ("points", "n", "regions")
INTS = ("lights", "vertices", "coats", "kind", "threads")


class _Shade(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in POINTERS),
        *((name, c_int64) for name in LONGS),
        *((name, c_int32) for name in INTS),
    )


def shade(functions: Functions, coats: Coats, at: Points) -> Tensor:
    """B (p, c), as `ptt.ops.shade.shade`, for three channels.

    Tables in 16 or 8 bits are multiplied in float16, where the processor can, and summed in float32.
    """
    kernels = library() if _fits(functions, coats, at) else None
    if kernels is None:
        return plain.shade(functions, coats, at)
    light, visibility, dull, glossy = functions
    kind = KINDS[light.values.dtype]
    tensors = {"light": light.values, "light_scale": light.scale, "glossy": glossy.values, "glossy_scale": glossy.scale}
    tensors |= {"visibility": visibility, "dull": dull.half() if kind else dull, "out": torch.empty_like(at.colour)}
    tensors |= {f"{name}_rows": near.rows for name, near in zip(("light", "seen", "view"), at[:3], strict=True)}
    tensors |= {f"{name}_weights": near.weights for name, near in zip(("light", "seen", "view"), at[:3], strict=True)}
    tensors |= {"region": at.region, "colour": at.colour, "second": at.second, "start": coats.first}
    tensors |= {"diffuse": coats.diffuse, "specular": coats.specular}
    tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
    sizes = {"points": len(at.region), "n": len(dull), "regions": coats.first.shape[1], "kind": kind}
    sizes |= {"lights": at.light.rows.shape[1], "vertices": at.seen.rows.shape[1], "coats": len(coats.first)}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    kernels.ptt_shade(ctypes.byref(_Shade(**pointers, **sizes, threads=torch.get_num_threads())))
    return tensors["out"]


def _fits(functions: Functions, coats: Coats, at: Points) -> bool:
    """Whether the kernel is for these arguments."""
    (light, by), visibility, dull, (glossy, of) = functions
    n = len(dull)
    p = len(at.region)
    (i, r) = coats.first.shape
    k = at.light.rows.shape[1]
    j = at.seen.rows.shape[1]
    shapes = light.shape[1:] == (3, n) and visibility.shape[1:] == (n,) == glossy.shape[1:]
    shapes = shapes and by.shape == light.shape[:1] and of.shape == glossy.shape[:1]
    shapes = shapes and k in SEEN and j in SEEN[k] and i in COATS and at.view.rows.shape[1] == VIEWS[k]
    shapes = shapes and all(near.rows.shape == near.weights.shape == (p, near.rows.shape[1]) for near in at[:3])
    shapes = shapes and at.region.shape == at.second.shape == (p,) and at.colour.shape == (p, 3)
    shapes = shapes and coats.diffuse.shape == coats.specular.shape == (i, r, 3)
    types = light.dtype == glossy.dtype and ready(light, glossy, types=tuple(KINDS))
    types = types and ready(visibility, types=(torch.uint8,))
    types = types and ready(*(near.rows for near in at[:3]), at.region, coats.first, types=(torch.int32,))
    reals = by, of, dull, *(near.weights for near in at[:3]), at.colour, at.second, coats.diffuse, coats.specular
    return shapes and types and ready(*reals)
