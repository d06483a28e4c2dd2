"""Shading by triple products as an operator; its plain function is `ptt.ops.shade.shade`.

In the kernel, tables in 16 or 8 bits are multiplied in float16, where the processor can, and summed in float32.
"""

from __future__ import annotations

import re
from typing import Any

import torch
from torch import Tensor

from ptt.ops import shade as plain
from ptt.ops.compiling import inlined
from ptt.ops.native.arguments import STORED, of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.near import Near
from ptt.ops.shade import Functions, RegionCoats, ShadedPoints
from ptt.ops.table import Table

SEEN = {1: (1,), 4: (1, 3, 4), 8: (1, 3, 4)}
"""The numbers of rows of visibility that are interpolated, by the number of rows of light."""
VIEWS = {1: 1, 4: 4, 8: 4}
"""The number of directions of view, by the number of rows of light."""
COATS = 2
"""As many coats are shaded at once."""
SCHEMA = (
    "shade(Tensor light, Tensor light_scale, Tensor visibility, Tensor dull, Tensor glossy, Tensor glossy_scale, "
    "Tensor diffuse, Tensor specular, Tensor first, Tensor light_rows, Tensor light_weights, Tensor seen_rows, "
    "Tensor seen_weights, Tensor view_rows, Tensor view_weights, Tensor region, Tensor colour, Tensor shares, "
    "Tensor? lamps) -> Tensor"
)


NAMES = tuple(re.findall(r"Tensor (\w+)", SCHEMA))


@inlined
def shade(functions: Functions, coats: RegionCoats, at: ShadedPoints, lamps: Tensor | None = None) -> Tensor:
    """B (p, c), as `ptt.ops.shade.shade`."""
    light, visibility, dull, glossy = functions
    tables = (*light, visibility, dull, *glossy)
    points = (*at.light, *at.seen, *at.view, at.region, at.colour)
    first, *others = range(0, len(coats.first), COATS)
    result: Tensor = _shade(
        *tables, *(x[first : first + COATS] for x in coats), *points, at.shares[first : first + COATS], lamps
    )
    for k in others:
        result = result + _shade(*tables, *(x[k : k + COATS] for x in coats), *points, at.shares[k : k + COATS], lamps)
    return result


def _packed(
    light: Tensor,
    light_scale: Tensor,
    visibility: Tensor,
    dull: Tensor,
    glossy: Tensor,
    glossy_scale: Tensor,
    diffuse: Tensor,
    specular: Tensor,
    first: Tensor,
    light_rows: Tensor,
    light_weights: Tensor,
    seen_rows: Tensor,
    seen_weights: Tensor,
    view_rows: Tensor,
    view_weights: Tensor,
    region: Tensor,
    colour: Tensor,
    shares: Tensor,
    lamps: Tensor | None,
) -> tuple[Functions, RegionCoats, ShadedPoints, Tensor | None]:
    """The arguments of the schema as the plain function takes them."""
    functions = Functions(Table(light, light_scale), visibility, dull, Table(glossy, glossy_scale))
    near = (Near(light_rows, light_weights), Near(seen_rows, seen_weights), Near(view_rows, view_weights))
    return functions, RegionCoats(diffuse, specular, first), ShadedPoints(*near, region, colour, shares), lamps


def _conditions(*arguments: Any) -> Conditions:
    functions, coats, at, lamps = _packed(*arguments)
    light, visibility, dull, glossy = functions
    n = len(dull)
    p = len(at.region)
    k = at.light.rows.shape[1]
    j = at.seen.rows.shape[1]
    i, r = coats.first.shape
    yield light.values.dtype == glossy.values.dtype, "light and BRDFs must be of one type"
    yield light.values.dtype in STORED and light.values.dtype != torch.bfloat16, "tables must have 32, 16 or 8 bits"
    yield of_type(torch.uint8, visibility), "visibility must be uint8"
    yield of_type(torch.int32, *(near.rows for near in at[:3]), at.region, coats.first), "rows must be int32"
    yield of_type(torch.float32, light.scale, dull, glossy.scale), "scales must be float32"
    yield of_type(torch.float32, *(near.weights for near in at[:3])), "weights must be float32"
    yield of_type(torch.float32, at.colour, at.shares, coats.diffuse, coats.specular), "coats must be float32"
    yield light.values.shape[1:] == (3, n), "light must be (f, 3, n)"
    yield visibility.shape[1:] == (n,) == glossy.values.shape[1:], "visibility and BRDFs must be (rows, n)"
    yield light.scale.shape == light.values.shape[:1], "a row of light must have one scale"
    yield glossy.scale.shape == glossy.values.shape[:1], "a row of BRDFs must have one scale"
    yield k in SEEN and j in SEEN[k], f"there are kernels for so many rows of visibility by rows of light: {SEEN}"
    yield at.view.rows.shape[1] == VIEWS[k], f"there are kernels for so many views by rows of light: {VIEWS}"
    yield 1 <= i <= COATS, "a region must have one coat or two"
    for near in at[:3]:
        yield near.rows.shape == near.weights.shape == (p, near.rows.shape[1]), "rows and weights must be (p, k)"
    yield at.shares.shape == (i, p, 3) and at.colour.shape == (p, 3), "shares must be (i, p, 3) and colour (p, 3)"
    yield coats.diffuse.shape == coats.specular.shape == (i, r, 3), "coats must be (i, r, 3)"
    if lamps is not None:
        yield of_type(torch.float32, lamps) and lamps.shape == (p, 3), "what comes of lamps must be float32, (p, 3)"


def _kernel(*arguments: Any) -> Tensor:
    *given, lamps = arguments
    tensors = {name: tensor.contiguous() for name, tensor in zip(NAMES, given, strict=True)}
    dtype = tensors["light"].dtype
    n = len(tensors["dull"])
    if dtype != torch.float32:
        tensors["dull"] = tensors["dull"].half()
    out = torch.empty_like(tensors["colour"])
    run(
        "shade",
        **tensors,
        lamps=None if lamps is None else lamps.contiguous(),
        out=out,
        points=len(out),
        n=n,
        regions=tensors["first"].shape[1],
        lights=tensors["light_rows"].shape[1],
        vertices=tensors["seen_rows"].shape[1],
        coats=len(tensors["first"]),
        type=STORED[dtype],
    )
    return out


_shade = operator(
    SCHEMA,
    plain=lambda *arguments: plain.shade(*_packed(*arguments)),
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda *arguments: arguments[16].new_empty(arguments[16].shape),
)
