"""What places see of lamps as operators; their plain functions are those of `ptt.ops.hemispheres`."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.ops import hemispheres as plain
from ptt.ops.compiling import inlined
from ptt.ops.constants import CORNERS
from ptt.ops.hemispheres import Between
from ptt.ops.native.arguments import contiguous, of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator


def of_hemispheres(seen: Tensor) -> Conditions:
    """That what places see (n, words) is laid out as the kernels take it."""
    side = plain.side_of(seen)
    yield of_type(torch.int32, seen) and contiguous(seen), "what is seen must be int32, contiguous"
    fits = side % 32 == 0 < side and seen.shape[1] * 4 == side * side // 8 + plain.BYTES
    yield fits, f"what is seen must be bits of a map with a multiple of 32 along its edge, and {plain.BYTES} bytes"
    yield 4 * seen.numel() < 2**31, "what is seen must have fewer than 2^31 bytes"


@inlined
def lamps_seen(seen: Tensor, frames: Tensor, areas: Tensor, shares: Tensor) -> Tensor:
    """Shares (m, places), as `ptt.ops.hemispheres.lamps_seen`."""
    result: Tensor = _lamps_seen(seen, frames, areas, shares)
    return result


def _seen_conditions(seen: Tensor, frames: Tensor, areas: Tensor, shares: Tensor) -> Conditions:
    yield from of_hemispheres(seen)
    yield of_type(torch.float32, frames, areas, shares), "frames and lamps must be float32"
    yield contiguous(frames, areas, shares) and len(seen) > 0, "frames and lamps must be contiguous"
    yield frames.shape == (len(seen), 3, 3), "frames must be (places, 3, 3)"
    yield areas.shape == (*shares.shape, 3) and shares.ndim == 2, "areas must be (m, k, 3), and shares (m, k)"


def _seen_fake(seen: Tensor, frames: Tensor, areas: Tensor, shares: Tensor) -> Tensor:
    return shares.new_empty(len(areas), len(seen))


def _seen_kernel(seen: Tensor, frames: Tensor, areas: Tensor, shares: Tensor) -> Tensor:
    out = _seen_fake(seen, frames, areas, shares)
    run(
        "lamps_seen",
        seen=seen,
        frames=frames,
        areas=areas,
        shares=shares,
        out=out,
        places=len(seen),
        sources=shares.shape[0],
        each=shares.shape[1],
        bits=plain.side_of(seen),
    )
    return out


_lamps_seen = operator(
    "lamps_seen(Tensor seen, Tensor frames, Tensor areas, Tensor shares) -> Tensor",
    plain=lambda *arguments: plain.lamps_seen(*arguments),
    kernel=_seen_kernel,
    conditions=_seen_conditions,
    fake=_seen_fake,
)


@inlined
def lamps_between(through: Tensor, between: Between, lamps: Tensor) -> Tensor:
    """Shares (m, p), as `ptt.ops.hemispheres.lamps_between`."""
    result: Tensor = _lamps_between(through, *between, lamps)
    return result


def _between_conditions(through: Tensor, rows: Tensor, weights: Tensor, frames: Tensor, lamps: Tensor) -> Conditions:
    yield of_type(torch.int32, rows), "rows must be int32"
    yield of_type(torch.float32, through, weights, frames, lamps), "shares, weights, frames and lamps must be float32"
    yield contiguous(through, rows, weights, frames, lamps), "all must be contiguous"
    yield rows.shape == weights.shape and rows.ndim == 2, "rows and weights must be (p, k)"
    yield 1 <= rows.shape[-1] <= CORNERS and len(rows) > 0, f"points must lie between 1..{CORNERS} places"
    yield frames.shape[1:] == (3, 3), "frames must be (places, 3, 3)"
    yield lamps.shape == (len(lamps), 3), "lamps must be (m, 3)"
    yield through.shape == (len(lamps), len(frames)), "what places see of lamps must be (m, places)"


def _between_fake(through: Tensor, rows: Tensor, weights: Tensor, frames: Tensor, lamps: Tensor) -> Tensor:
    return through.new_empty(len(lamps), len(rows))


def _between_kernel(through: Tensor, rows: Tensor, weights: Tensor, frames: Tensor, lamps: Tensor) -> Tensor:
    out = _between_fake(through, rows, weights, frames, lamps)
    run(
        "lamps_between",
        through=through,
        rows=rows,
        weights=weights,
        frames=frames,
        lamps=lamps,
        out=out,
        points=len(rows),
        places=len(frames),
        sources=len(lamps),
        each=rows.shape[1],
        rise=1 / plain.RISEN,
    )
    return out


def _between_plain(through: Tensor, rows: Tensor, weights: Tensor, frames: Tensor, lamps: Tensor) -> Tensor:
    return plain.lamps_between(through, Between(rows, weights, frames), lamps)


_lamps_between = operator(
    "lamps_between(Tensor through, Tensor rows, Tensor weights, Tensor frames, Tensor lamps) -> Tensor",
    plain=_between_plain,
    kernel=_between_kernel,
    conditions=_between_conditions,
    fake=_between_fake,
)
