"""Lookups of points as operators; their plain functions are those of `ptt.ops.near`."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.ops import near as plain
from ptt.ops.compiling import inlined
from ptt.ops.constants import CORNERS, GROUP
from ptt.ops.native.arguments import of_type, side
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.near import Near


def _enough(points: Tensor) -> tuple[bool, str]:
    return len(points) >= GROUP, f"there must be {GROUP} points, which kernels take at once"


def _empty(points: Tensor, rows: int = CORNERS) -> tuple[Tensor, Tensor]:
    shape = (len(points), rows)
    return points.new_empty(shape, dtype=torch.int32), points.new_empty(shape, dtype=torch.float32)


@inlined
def of_frames(frames: Tensor, sampled: Tensor, twists: int, between: bool = False) -> Near:
    """As `ptt.ops.near.of_frames`."""
    return Near(*_near_frames(frames, sampled, twists, between))


def _frames_kernel(frames: Tensor, sampled: Tensor, twists: int, between: bool) -> tuple[Tensor, Tensor]:
    rows, weights = _empty(frames, CORNERS * (1 + between))
    run(
        "near_frames",
        frames=frames.contiguous(),
        sampled=sampled.contiguous(),
        rows=rows,
        weights=weights,
        points=len(frames),
        n=side(len(sampled)),
        twists=twists,
        between=between,
    )
    return rows, weights


def _frames_conditions(frames: Tensor, sampled: Tensor, twists: int, between: bool) -> Conditions:
    yield _enough(frames)
    yield of_type(torch.float32, frames, sampled), "frames must be float32"


_near_frames = operator(
    "near_frames(Tensor frames, Tensor sampled, int twists, bool between) -> (Tensor, Tensor)",
    plain=lambda *arguments: plain.of_frames(*arguments),
    kernel=_frames_kernel,
    conditions=_frames_conditions,
    fake=lambda frames, sampled, twists, between: _empty(frames, CORNERS * (1 + between)),
)


@inlined
def of_views(frames: Tensor, positions: Tensor, eye: Tensor, views: int) -> Near:
    """As `ptt.ops.near.of_views`."""
    return Near(*_near_views(frames, positions, eye, views))


def _views_kernel(frames: Tensor, positions: Tensor, eye: Tensor, views: int) -> tuple[Tensor, Tensor]:
    rows, weights = _empty(frames)
    run(
        "near_views",
        frames=frames.contiguous(),
        positions=positions.contiguous() if eye.ndim == 1 else None,
        eye=eye.contiguous(),
        rows=rows,
        weights=weights,
        points=len(frames),
        views=views,
    )
    return rows, weights


def _views_conditions(frames: Tensor, positions: Tensor, eye: Tensor, views: int) -> Conditions:
    yield _enough(frames)
    yield of_type(torch.float32, frames, positions, eye), "points and eye must be float32"


_near_views = operator(
    "near_views(Tensor frames, Tensor positions, Tensor eye, int views) -> (Tensor, Tensor)",
    plain=lambda *arguments: plain.of_views(*arguments),
    kernel=_views_kernel,
    conditions=_views_conditions,
    fake=lambda frames, positions, eye, views: _empty(frames),
)


@inlined
def of_texels(corner_uv: Tensor, triangle: Tensor, barycentric: Tensor, rows: Tensor) -> Near:
    """As `ptt.ops.near.of_texels`."""
    return Near(*_near_texels(corner_uv, triangle, barycentric, rows))


def _texels_kernel(corner_uv: Tensor, triangle: Tensor, barycentric: Tensor, in_use: Tensor) -> tuple[Tensor, Tensor]:
    rows, weights = _empty(triangle)
    run(
        "near_texels",
        corner_uv=corner_uv.contiguous(),
        triangle=triangle.contiguous(),
        barycentric=barycentric.contiguous(),
        in_use=in_use.contiguous(),
        rows=rows,
        weights=weights,
        points=len(triangle),
        side=side(len(in_use)),
    )
    return rows, weights


def _texels_conditions(corner_uv: Tensor, triangle: Tensor, barycentric: Tensor, in_use: Tensor) -> Conditions:
    yield _enough(triangle)
    yield of_type(torch.float32, corner_uv, barycentric), "uv and barycentric coordinates must be float32"
    yield of_type(torch.int64, triangle), "triangle must be int64"
    yield of_type(torch.int32, in_use), "rows must be int32"


_near_texels = operator(
    "near_texels(Tensor corner_uv, Tensor triangle, Tensor barycentric, Tensor in_use) -> (Tensor, Tensor)",
    plain=lambda *arguments: plain.of_texels(*arguments),
    kernel=_texels_kernel,
    conditions=_texels_conditions,
    fake=lambda corner_uv, triangle, barycentric, in_use: _empty(triangle),
)
