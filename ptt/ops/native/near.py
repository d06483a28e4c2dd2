"""Lookups of points, by kernels in C++; by the plain functions where they do not fit."""

from __future__ import annotations

import math
from ctypes import c_int, c_int64

import torch
from torch import Tensor

from ptt.ops import near as plain
from ptt.ops.native.arguments import address, ready
from ptt.ops.native.kernels import library
from ptt.ops.near import Near

FEWEST = 16  # points: the kernels take as many at once


def of_frames(frames: Tensor, sampled: Tensor, twists: int, between: bool = False) -> Near:
    """As `ptt.ops.near.of_frames`."""
    kernels = library() if len(frames) >= FEWEST and ready(frames, sampled) else None
    if kernels is None:
        return plain.of_frames(frames, sampled, twists, between)
    out = _empty(len(frames), 4 + 4 * between)
    (frames, sampled) = (frames.contiguous(), sampled.contiguous())
    sizes = map(c_int64, (len(frames), math.isqrt(len(sampled)), twists))
    last = c_int(between), c_int(torch.get_num_threads())
    kernels.ptt_near_frames(*map(address, (frames, sampled, *out)), *sizes, *last)
    return out


def of_views(frames: Tensor, positions: Tensor, eye: Tensor, views: int) -> Near:
    """As `ptt.ops.near.of_views`."""
    kernels = library() if len(frames) >= FEWEST and ready(frames, positions, eye) else None
    if kernels is None:
        return plain.of_views(frames, positions, eye, views)
    out = _empty(len(frames))
    frames = frames.contiguous()
    positions = positions.contiguous()
    eye = eye.contiguous()
    sizes = c_int64(len(frames)), c_int64(views), c_int(torch.get_num_threads())
    tensors = frames, positions if eye.ndim == 1 else None, eye, *out
    kernels.ptt_near_views(*map(address, tensors), *sizes)
    return out


def of_texels(corner_uv: Tensor, triangle: Tensor, barycentric: Tensor, rows: Tensor) -> Near:
    """As `ptt.ops.near.of_texels`."""
    integers = ready(triangle, types=(torch.int64,)) and ready(rows, types=(torch.int32,))
    fits = len(triangle) >= FEWEST and integers and ready(corner_uv, barycentric)
    kernels = library() if fits else None
    if kernels is None:
        return plain.of_texels(corner_uv, triangle, barycentric, rows)
    out = _empty(len(triangle))
    given = [x.contiguous() for x in (corner_uv, triangle, barycentric, rows)]
    sizes = c_int64(len(triangle)), c_int64(math.isqrt(len(rows))), c_int(torch.get_num_threads())
    kernels.ptt_near_texels(*map(address, (*given, *out)), *sizes)
    return out


def _empty(points: int, rows: int = 4) -> Near:
    return Near(torch.empty(points, rows, dtype=torch.int32), torch.empty(points, rows))
