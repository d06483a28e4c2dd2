"""Rotation of light, and what slices reflect of it, by kernels in C++; by the plain functions where none fits.

They take and give what those of `ptt.ops.rotation` and `ptt.ops.slices` do, in float32 with up to four channels.
"""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_float, c_int, c_int32, c_int64, c_void_p
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops import haar, rotation, slices
from ptt.ops.native.arguments import KINDS, address, ready
from ptt.ops.native.kernels import library
from ptt.ops.rotation import Quantised, Resampling
from ptt.ops.slices import ALIGNED, Located, Slices
from ptt.ops.sphere import Grid
from ptt.ops.table import LARGEST, Table

CHANNELS = 4  # of a value in the kernels
POINTERS = ("position", "normal", "frames", "eye", "weights", "light", "near", "first", "terms", "values", "out")
LONGS = ("points", "width", "kept")
INTS = ("distant", "views", "threads")


class _Form(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in ("starts", "begins", "reads", "at", "parts", "worth", "shares")),
        *((name, c_void_p) for name in ("kept", "columns", "numbers")),
        *((name, c_int64) for name in ("frames", "m", "cells", "terms")),
        ("scale", c_double),
        *((name, c_int32) for name in ("threshold", "wide", "threads")),
    )


class _Reflect(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in POINTERS),
        *((name, c_int64) for name in LONGS),
        *((name, c_int32) for name in INTS),
    )


def rotates(coefficients: Tensor) -> bool:
    """Whether the kernels are for this light."""
    return ready(coefficients) and len(coefficients) <= CHANNELS and library() is not None


def local_light(coefficients: Tensor, s: Resampling, m: int) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.local_light`."""
    kernels = library() if rotates(coefficients) else None
    if kernels is None:
        return rotation.local_light(coefficients, s, m)
    frames = (len(s.starts) - 1) // m**2
    source = _four(haar.synthesise(coefficients))
    out = coefficients.new_empty(frames, m * m, CHANNELS)
    tensors = map(address, (source, s.starts, s.reads, out))
    numbers = c_int64(frames), c_int64(m), c_float(1 / s.samples**2), c_int(torch.get_num_threads())
    kernels.ptt_local_light(*tensors, *numbers)
    return out[..., : len(coefficients)]


def resampled_light(coefficients: Tensor, frames: Tensor, target: Grid, samples: int = rotation.SAMPLES) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.resampled_light`."""
    kernels = library() if rotates(coefficients) and ready(frames) else None
    if kernels is None:
        return rotation.resampled_light(coefficients, frames, target, samples)
    m = target.shape[-1]
    frames = frames.contiguous()
    directions = _directions(target, samples)
    source = _four(haar.synthesise(coefficients))
    out = coefficients.new_empty(len(frames), m * m, CHANNELS)
    tensors = map(address, (source, frames, directions, out))
    sizes = (len(frames), m, samples**2, directions.shape[1], coefficients.shape[-1])
    kernels.ptt_resampled_light(*tensors, *map(c_int64, sizes), c_int(torch.get_num_threads()))
    return out[..., : len(coefficients)]


def resampled_values(values: Tensor, s: Resampling, cells: int, storage: torch.dtype = torch.float16) -> Table:
    """(f, c, cells), as `ptt.ops.rotation.resampled_values`."""
    fits = ready(values) and values.shape[1:] == (3,) and storage in KINDS
    kernels = library() if fits else None
    if kernels is None:
        return rotation.resampled_values(values, s, cells, storage)
    frames = (len(s.starts) - 1) // cells
    out = Table(torch.empty(frames, 3, cells, dtype=storage), torch.empty(frames))
    numbers = c_int64(frames), c_int64(cells), c_float(1 / s.samples**2), c_float(LARGEST.get(storage, 0.0))
    tensors = pad(values, (0, 1)).contiguous(), s.starts, s.reads, *out
    kernels.ptt_resampled_values(
        *map(address, tensors), *numbers, c_int(KINDS[storage]), c_int(torch.get_num_threads())
    )
    return out


def quantised(s: Resampling, n: int, m: int, unit: float, threshold: int) -> Quantised:
    """R in 16 bits, as `ptt.ops.rotation.quantised`, on all cores."""
    kernels = library()
    if kernels is None:
        return rotation.quantised(s, n, m, unit, threshold)
    source = rotation.haar_matrix(n)
    analysis = _analysis(m)
    rows = len(s.starts) - 1
    tensors = {"starts": s.starts, "reads": s.reads, "at": source.col_indices(), "worth": source.values()}
    tensors |= dict(zip(("begins", "parts", "shares"), analysis, strict=True))
    tensors |= {"kept": torch.empty(rows, dtype=torch.int64)}
    numbers = {"frames": rows // m**2, "m": m, "cells": n * n, "terms": source.values().numel() // n**2}
    column = rotation.column_type(n)
    numbers |= {"threshold": max(1, threshold), "wide": column == torch.int32, "threads": torch.get_num_threads()}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    scale = 1 / (unit * s.samples**2)
    kernels.ptt_form(ctypes.byref(_Form(**pointers, **numbers, scale=scale)))
    starts = pad(tensors["kept"].cumsum(0), (1, 0))
    columns, values = (torch.empty(int(starts[-1]), dtype=t) for t in (column, torch.int16))
    pointers |= {"kept": starts.data_ptr(), "columns": columns.data_ptr(), "numbers": values.data_ptr()}
    kernels.ptt_form(ctypes.byref(_Form(**pointers, **numbers, scale=scale)))
    return Quantised(starts, columns, values, unit)


def rotated_light(coefficients: Tensor, matrix: Quantised, m: int) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.rotated_light` of the matrix's `to_csr`."""
    kernels = library() if rotates(coefficients) else None
    if kernels is None:
        csr = matrix.to_csr(coefficients[0].numel(), coefficients.dtype)
        return rotation.rotated_light(coefficients, csr, m)
    rows = len(matrix.starts) - 1
    source = _four(coefficients)
    out = coefficients.new_empty(rows // m**2, m * m, CHANNELS)
    tensors = map(address, (source, matrix.starts, matrix.columns, matrix.numbers, out))
    wide = c_int(matrix.columns.dtype == torch.int32)
    kernels.ptt_rotated_light(*tensors, c_int64(rows), c_float(matrix.unit), wide, c_int(torch.get_num_threads()))
    return out[..., : len(coefficients)]


def reflected(light: Tensor, cut: Slices, first: Tensor, frames: Tensor, at: Located, eye: Tensor) -> Tensor:
    """B (v, c), as `ptt.ops.slices.reflected`; light is read in place where it has four channels."""
    kernels = library() if _fits(light, cut, first, frames, at, eye) else None
    if kernels is None:
        return slices.reflected(light, cut, first, frames, at, eye)
    v = at.position.shape[1]
    channels = light.shape[2]
    light = (light if channels == CHANNELS else pad(light, (0, CHANNELS - channels))).contiguous()  # pad copies
    tensors = {"light": light, "eye": eye.contiguous(), "first": first, "out": light.new_empty(v, CHANNELS)}
    tensors |= {name: getattr(at, name) for name in ("position", "normal", "weights", "near")}
    tensors |= {"frames": frames.contiguous(), "terms": cut.terms, "values": cut.values}
    numbers = {"points": v, "width": light.shape[1], "kept": cut.terms.shape[1]}
    numbers |= {"distant": eye.ndim == 2, "views": cut.views, "threads": torch.get_num_threads()}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    kernels.ptt_reflected(ctypes.byref(_Reflect(**pointers, **numbers)))
    return tensors["out"][:, :channels]


def _fits(light: Tensor, cut: Slices, first: Tensor, frames: Tensor, at: Located, eye: Tensor) -> bool:
    """Whether the kernel is for these arguments."""
    v = at.position.shape[1]
    t = cut.terms.shape[1]
    kept = at.position, at.normal, at.weights
    shapes = light.ndim == 3 and light.shape[2] <= CHANNELS and v % ALIGNED == 0 and t % ALIGNED == 0
    shapes = shapes and eye.shape in ((3,), (3, v)) and first.shape == (4, v) and frames.shape == (len(light), 3, 3)
    contiguous = all(x.is_contiguous() for x in (*kept, at.near, cut.terms, cut.values, first))
    types = ready(at.near, first, types=(torch.int32,)) and ready(cut.terms, types=(torch.int16,))
    return (
        shapes
        and contiguous
        and types
        and ready(light, eye, frames, *kept)
        and ready(cut.values, types=(torch.float16,))
    )


def _four(maps: Tensor) -> Tensor:
    """Maps (c, n, n) as (n * n, 4), zeros beyond c."""
    return pad(maps.flatten(1), (0, 0, 0, CHANNELS - len(maps))).T.contiguous()


@cache
def _analysis(m: int) -> tuple[Tensor, Tensor, Tensor]:
    """W_M by its rows: begins (M + 1,), cells int32, shares float64."""
    transform = rotation.haar_matrix(m).to_sparse_coo().transpose(0, 1).to_sparse_csr()
    return transform.crow_indices().long(), transform.col_indices().int(), transform.values()


@cache
def _directions(target: Grid, samples: int) -> Tensor:
    """(3, padded): of the samples of every cell, in whole vectors."""
    directions = target.samples(samples).float()
    return pad(directions.T, (0, -len(directions) % ALIGNED), value=1.0).contiguous()
