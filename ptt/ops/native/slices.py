"""What slices reflect of local light as an operator; its plain function is `ptt.ops.slices.reflected`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops import slices
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, CORNERS, GROUP
from ptt.ops.native.arguments import contiguous, of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.slices import NormalLookup, Slices


@inlined
def reflected(light: Tensor, cut: Slices, first: Tensor, frames: Tensor, at: NormalLookup, eye: Tensor) -> Tensor:
    """B (v, c), as `ptt.ops.slices.reflected`; light is read in place where it has four channels."""
    result: Tensor = _reflected(light, cut.terms, cut.values, cut.views, first, frames, *at, eye)
    return result


class _Reflected(NamedTuple):
    """What the schema says."""

    light: Tensor
    terms: Tensor
    values: Tensor
    views: int
    first: Tensor
    frames: Tensor
    position: Tensor
    normal: Tensor
    near: Tensor
    weights: Tensor
    twist: Tensor
    dip: Tensor
    eye: Tensor


def _reflected_plain(*arguments: Any) -> Tensor:
    g = _Reflected(*arguments)
    at = NormalLookup(g.position, g.normal, g.near, g.weights, g.twist, g.dip)
    return slices.reflected(g.light, Slices(g.terms, g.values, g.views), g.first, g.frames, at, g.eye)


def _reflected_conditions(*arguments: Any) -> Conditions:
    g = _Reflected(*arguments)
    v = g.position.shape[1]
    reals = (g.light, g.eye, g.frames, g.position, g.normal, g.weights, g.dip)
    yield of_type(torch.float32, *reals), "light and points must be float32"
    yield of_type(torch.int32, g.near, g.first), "near and first must be int32"
    yield of_type(torch.int16, g.terms), "terms must be int16"
    yield of_type(torch.float16, g.values), "values must be float16"
    kept = (g.position, g.normal, g.near, g.weights, g.dip, g.terms, g.values, g.first)
    yield contiguous(*kept), "points and slices must be contiguous"
    yield g.light.ndim == 3 and g.light.shape[2] <= CHANNELS, f"light must be (f, x, c), c at most {CHANNELS}"
    yield v % GROUP == 0, f"points must come in multiples of {GROUP}"
    yield g.terms.shape[1] % GROUP == 0, f"terms must come in multiples of {GROUP}"
    yield g.eye.shape in ((3,), (3, v)), "eye must be (3,) or (3, v)"
    yield g.first.shape == (CORNERS, v), "first must be (4, v)"
    yield g.frames.shape == (len(g.light), 3, 3), "frames must be (f, 3, 3)"


def _reflected_kernel(*arguments: Any) -> Tensor:
    g = _Reflected(*arguments)
    v = g.position.shape[1]
    channels = g.light.shape[2]
    light = g.light if channels == CHANNELS else pad(g.light, (0, CHANNELS - channels))
    out = light.new_empty(v, CHANNELS)
    run(
        "reflected",
        position=g.position,
        normal=g.normal,
        dip=g.dip,
        frames=g.frames.contiguous(),
        eye=g.eye.contiguous(),
        weights=g.weights,
        light=light.contiguous(),
        near=g.near,
        first=g.first,
        terms=g.terms,
        values=g.values,
        out=out,
        points=v,
        width=light.shape[1],
        kept=g.terms.shape[1],
        distant=g.eye.ndim == 2,
        views=g.views,
    )
    return out if channels == CHANNELS else out[:, :channels].contiguous()


_reflected = operator(
    "reflected(Tensor light, Tensor terms, Tensor values, int views, Tensor first, Tensor frames, Tensor position, "
    "Tensor normal, Tensor near, Tensor weights, Tensor twist, Tensor dip, Tensor eye) -> Tensor",
    plain=_reflected_plain,
    kernel=_reflected_kernel,
    conditions=_reflected_conditions,
    fake=lambda light, terms, values, views, first, frames, position, *others: light.new_empty(
        position.shape[1], light.shape[2]
    ),
)
