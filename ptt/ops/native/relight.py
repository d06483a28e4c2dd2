"""Steps of relighting by kernels in C++; by the plain functions where a kernel does not fit.

They take and give what those of `ptt.ops.relight` and `ptt.ops.view` do. The kernels are for the CPU without gradients,
in float32 with three channels; what points send out is rounded to 16 bits.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from ctypes import c_int, c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from ptt.ops import relight
from ptt.ops import view as plain
from ptt.ops.native.arguments import address, ready, side, square
from ptt.ops.native.kernels import library
from ptt.ops.octahedral import TILE
from ptt.ops.relight import Arriving, Responses, Sent
from ptt.ops.view import Gloss, Seen

STORED = (torch.float32, torch.float16, torch.bfloat16)
INDEX = (torch.int64,)
WIDTH = 64
GROUP = 16  # multiples of what `expand`, and the others, take at a time
HARMONICS = 16
PAD = 16  # of order 4; of the tables of `eigen`
LOBES = 4

POINTERS = (
    *("position", "frame", "colour", "eye", "outgoing", "sent", "unit"),
    *("rho", "axes", "specular", "maps", "turn", "blurs", "cuts", "which", "place", "line", "out"),
)
LONGS = ("blocks", "width", "rows", "points")
INTS = ("distant", "factors", "harmonics", "tilts", "disk", "cells", "map", "threads")


class _Eigen(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in ("direct", "one", "two", "h", "pairs", "from_direct", "from_light", "out")),
        *((name, c_int64) for name in ("clusters", "eigen", "factors", "slots", "again", "width", "padded")),
        ("threads", c_int32),
    )


class _View(ctypes.Structure):
    _fields_ = (
        *((name, c_void_p) for name in POINTERS),
        *((name, c_int64) for name in LONGS),
        *((name, c_int32) for name in INTS),
    )


def lighting(fine: Tensor, turn: Tensor, directions: Tensor, shares: Tensor, shape: Sequence[int]) -> Tensor:
    """L (3, *shape), as `ptt.ops.relight.lighting`."""
    *squares, n, _ = shape
    count = math.prod(squares)
    cells = math.prod(shape)
    fits = ready(fine, turn, directions, shares) and fine.shape[1] == 4 and square(len(fine)) and cells % GROUP == 0
    fits = fits and turn.shape == (3, 3) and directions.shape == (4, 3, cells) and shares.shape == (4, cells)
    kernels = library() if fits else None
    if kernels is None:
        return relight.lighting(fine, turn, directions, shares, shape)
    out = fine.new_empty(3, *shape)
    tensors = [t.contiguous() for t in (fine, turn, directions, shares, out)]  # kept until the kernel has read them
    sizes = [c_int64(size) for size in (side(len(fine)), count, n)]
    kernels.ptt_lighting(*map(address, tensors), *sizes, c_int(torch.get_num_threads()))
    return out


def light_eigen(transfer: Tensor, lighting: Tensor, columns: Tensor | None = None) -> Tensor:
    """U (k, c, x), as `ptt.ops.relight.light_eigen`, summed in float32."""
    k, rows, x = transfer.shape
    fits = ready(lighting) and ready(transfer, types=STORED) and transfer.is_contiguous()
    if columns is None:
        fits = fits and lighting.shape in ((3, rows), (k, 3, rows))
    else:
        fits = fits and ready(columns, types=INDEX) and columns.shape == (k, rows) and lighting.shape[:-1] == (3,)
    kernels = library() if fits else None
    if kernels is None:
        return relight.light_eigen(transfer, lighting, columns)
    lighting, out = lighting.contiguous(), lighting.new_empty(k, 3, x)
    columns = None if columns is None else columns.contiguous()
    cluster = 0 if lighting.ndim == 2 else 3 * rows
    channel = lighting.shape[-1]
    sizes = [c_int64(size) for size in (cluster, channel, rows, x, k)]
    tensors = [address(t) for t in (lighting, columns, transfer, out)]
    numbers = c_int(STORED.index(transfer.dtype)), c_int(torch.get_num_threads())
    kernels.ptt_light(*tensors, *sizes, *numbers)
    return out


def eigen(arriving: Arriving, h: Tensor, pairs: Tensor, coupling: Tensor, responses: Responses, glossy: bool) -> Tensor:
    """Q and I (k, c, e, 1 + o + s), as `ptt.ops.relight.eigen`."""
    (k, c, e, i) = arriving.direct.shape
    q = arriving.one.shape[2]
    p = arriving.two.shape[2]
    to_factors, to_harmonics = responses
    fits = ready(*arriving, h, pairs, coupling, *responses) and c == 3 and h.shape == (3, q) and pairs.shape == (3, p)
    fits = fits and arriving.one.shape == (k, 3, q, e, HARMONICS) and arriving.two.shape == (k, 3, p, e)
    fits = fits and coupling.shape[::2] == (3, i) and to_factors.shape == (HARMONICS, i)
    fits = fits and to_harmonics.shape == (HARMONICS, HARMONICS)
    kernels = library() if fits else None
    if kernels is None:
        return relight.eigen(arriving, h, pairs, coupling, responses, glossy)
    glossy = glossy and bool(q or p)
    out = h.new_empty(k, 3, e, coupling.shape[1] + HARMONICS * glossy)
    padding = -out.shape[3] % PAD
    from_direct = torch.nn.functional.pad(coupling.transpose(1, 2), (0, out.shape[3] - coupling.shape[1] + padding))
    from_light = to_factors @ coupling.transpose(1, 2)  # shape: (3, s, 1 + o)
    harmonics = [to_harmonics.expand(3, -1, -1)] if glossy else []
    from_light = torch.nn.functional.pad(torch.cat((from_light, *harmonics), 2), (0, padding))
    inputs = [t.contiguous() for t in (*arriving, h, pairs, from_direct, from_light)]
    sizes = (k, e, i, q, p, out.shape[3], out.shape[3] + padding, torch.get_num_threads())
    kernels.ptt_eigen(ctypes.byref(_Eigen(*(t.data_ptr() for t in (*inputs, out)), *sizes)))
    return out


def expand(eigen: Tensor, weights: Tensor, cluster: Tensor) -> Sent:
    """Values, as `ptt.ops.relight.expand`, in float16, scaled so that none overflows, and in smaller blocks."""
    (_, c, e, x) = eigen.shape
    (b, _, w) = weights.shape
    fits = ready(eigen, weights) and weights.is_contiguous() and ready(cluster, types=INDEX)
    fits = fits and w % WIDTH == 0 and weights.shape[1] == e and cluster.shape == (b,)
    kernels = library() if fits else None
    if kernels is None:
        return relight.expand(eigen, weights, cluster)
    eigen = eigen.contiguous()
    cluster = cluster.contiguous()
    groups = b * w // GROUP
    sent = Sent(torch.empty(groups, c, x, GROUP, dtype=torch.float16), torch.empty(groups))
    sizes = [c_int64(size) for size in (b, c, e, x, w)]
    tensors = [address(t) for t in (eigen, weights, cluster, *sent)]
    kernels.ptt_expand(*tensors, *sizes, c_int(torch.get_num_threads()))
    return sent


def view(regions: Sequence[Seen], outgoing: Tensor) -> Tensor:
    """B (v, c), as `ptt.ops.view.view`; where a point is at the eye, its lobes are finite."""
    kernels = library() if all(_fits(region, outgoing) for region in regions) else None
    if kernels is None:
        return plain.view(regions, outgoing)
    outgoing = outgoing.contiguous()
    sizes = [len(region.points.place) for region in regions]
    line = outgoing.new_empty(max(region.points.position.shape[1] for region in regions), 3)
    out = outgoing.new_empty(sum(sizes), 3)
    for region, rows in zip(regions, out.split(sizes), strict=True):
        _write(kernels, region, outgoing, line, rows)
    return out


def _write(kernels: ctypes.CDLL, region: Seen, outgoing: Tensor, line: Tensor, out: Tensor) -> None:
    """Of one region into out (v, 3); line (n, 3) is overwritten."""
    points, eye, sent, gloss = region
    b, _, rows, width = sent.values.shape
    tensors = {"position": points.position, "frame": points.frame, "place": points.place, "eye": eye.contiguous()}
    tensors |= {"outgoing": outgoing, "sent": sent.values, "unit": sent.unit, "line": line, "out": out}
    numbers = {"blocks": b, "width": width, "rows": rows, "points": len(out), "threads": torch.get_num_threads()}
    numbers |= {"distant": eye.ndim == 2, "factors": 1 + outgoing.shape[1], "disk": side(len(outgoing))}
    if points.colour is not None:
        tensors["colour"] = points.colour
    if gloss is not None:
        tensors |= {name: tensor.contiguous() for name, tensor in gloss._asdict().items()} | {"cuts": points.cuts}
        numbers |= {"harmonics": rows - numbers["factors"], "tilts": len(gloss.axes)}
        numbers |= {"cells": side(points.cuts.shape[1]), "map": side(gloss.maps.shape[1])}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    kernels.ptt_view(ctypes.byref(_View(**pointers, **numbers)), 0 if gloss is None else len(gloss.which))


def _fits(region: Seen, outgoing: Tensor) -> bool:
    """Whether the kernel of the view step is for a region."""
    points, eye, (values, unit), gloss = region
    colour = () if points.colour is None else (points.colour,)
    large = points.position, points.frame, unit, *colour
    if not ready(*large, eye, outgoing) or not ready(values, types=(torch.float16,)):
        return False
    if not ready(points.place, types=INDEX) or not all(t.is_contiguous() for t in (*large, values, points.place)):
        return False
    if values.ndim != 4 or values.shape[1] != 3 or values.shape[3] % GROUP:
        return False
    b, _, rows, width = values.shape
    n = b * width
    o = 1 + outgoing.shape[1]
    shapes = points.position.shape == (3, n) and points.frame.shape == (3, 3, n) and eye.shape in ((3,), (3, n))
    shapes = shapes and all(t.shape == (3, n) for t in colour) and unit.shape == (b,)
    shapes = shapes and square(len(outgoing)) and rows >= o
    return shapes and (gloss is None or _fits_gloss(gloss, points.cuts, n, rows - o))


def _fits_gloss(gloss: Gloss, cuts: Tensor, n: int, harmonics: int) -> bool:
    which, rho, axes, specular, maps, turn, blurs = gloss
    if not ready(rho, axes, specular, maps, turn, blurs) or not ready(which, types=INDEX):
        return False
    if not ready(cuts, types=(torch.int32,)) or not cuts.is_contiguous():
        return False
    k = len(which)
    tilts = len(axes)
    shapes = 0 < k <= LOBES and rho.shape == (tilts, k) and axes.shape == (tilts, 2 * k) and specular.shape == (3,)
    shapes = shapes and turn.shape == (3, 3) and maps.shape[::2] == (k, 4)
    shapes = shapes and maps.shape[1] > 1 and square(maps.shape[1]) and len(blurs) == k
    shapes = shapes and (harmonics == 0 or harmonics == HARMONICS == blurs.shape[1])
    return shapes and cuts.shape[0] == n and square(cuts.shape[1]) and side(cuts.shape[1]) % TILE == 0
