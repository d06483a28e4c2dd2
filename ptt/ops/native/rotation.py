"""Rotation of light, and what slices reflect of it, as operators.

Their plain functions are those of `ptt.ops.rotation` and `ptt.ops.slices`. The kernels are for float32 with up to four
channels.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops import haar, rotation, slices
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, CORNERS, GROUP
from ptt.ops.native.arguments import STORED, contiguous, of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.rotation import Quantised, Resampling
from ptt.ops.slices import NormalLookup, Slices
from ptt.ops.table import LARGEST, Table

KEPT = (torch.float32, torch.float16, torch.uint8)
"""The types in which a `Table` is stored."""


def _light_conditions(coefficients: Tensor) -> Conditions:
    yield of_type(torch.float32, coefficients), "light must be float32"
    yield len(coefficients) <= CHANNELS, f"light must have at most {CHANNELS} channels"


def _four(maps: Tensor) -> Tensor:
    """Maps (c, n, n) as (n * n, 4), zeros beyond c."""
    return pad(maps.flatten(1), (0, 0, 0, CHANNELS - len(maps))).T.contiguous()


# The three operators: S between two transforms, S looked up anew, R


@inlined
def local_light(coefficients: Tensor, s: Resampling, m: int) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.local_light`."""
    result: Tensor = _local_light(coefficients, s.starts, s.reads, s.samples, m)
    return result


def _local_light_kernel(coefficients: Tensor, starts: Tensor, reads: Tensor, samples: int, m: int) -> Tensor:
    frames = (len(starts) - 1) // m**2
    out = coefficients.new_empty(frames, m * m, CHANNELS)
    run(
        "local_light",
        source=_four(haar.synthesise(coefficients)),
        starts=starts,
        reads=reads,
        out=out,
        frames=frames,
        m=m,
        unit=1 / samples**2,
    )
    return out[..., : len(coefficients)].contiguous()


def _local_light_conditions(coefficients: Tensor, starts: Tensor, reads: Tensor, samples: int, m: int) -> Conditions:
    yield from _light_conditions(coefficients)
    yield contiguous(starts, reads), "tables must be contiguous"


_local_light = operator(
    "local_light(Tensor coefficients, Tensor starts, Tensor reads, int samples, int m) -> Tensor",
    plain=lambda coefficients, starts, reads, samples, m: rotation.local_light(
        coefficients, Resampling(starts, reads, samples), m
    ).contiguous(),
    kernel=_local_light_kernel,
    conditions=_local_light_conditions,
    fake=lambda coefficients, starts, reads, samples, m: coefficients.new_empty(
        (len(starts) - 1) // m**2, m * m, len(coefficients)
    ),
)


@inlined
def resampled_light(
    coefficients: Tensor, frames: Tensor, target: HemiOctahedral, samples: int = rotation.SAMPLES
) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.resampled_light`."""
    result: Tensor = _resampled_light(coefficients, frames, target.shape[-1], samples)
    return result


def _resampled_light_kernel(coefficients: Tensor, frames: Tensor, m: int, samples: int) -> Tensor:
    directions = _sample_directions(m, samples)
    out = coefficients.new_empty(len(frames), m * m, CHANNELS)
    run(
        "resampled_light",
        source=_four(haar.synthesise(coefficients)),
        frames=frames.contiguous(),
        directions=directions,
        out=out,
        count=len(frames),
        m=m,
        each=samples**2,
        padded=directions.shape[1],
        n=coefficients.shape[-1],
    )
    return out[..., : len(coefficients)].contiguous()


@cache
def _sample_directions(m: int, samples: int) -> Tensor:
    """Directions (3, padded) of the samples of every cell, padded to whole vectors."""
    directions = HemiOctahedral(m).samples(samples).float()
    return pad(directions.T, (0, -len(directions) % GROUP), value=1.0).contiguous()


def _resampled_light_conditions(coefficients: Tensor, frames: Tensor, m: int, samples: int) -> Conditions:
    yield from _light_conditions(coefficients)
    yield of_type(torch.float32, frames), "frames must be float32"


_resampled_light = operator(
    "resampled_light(Tensor coefficients, Tensor frames, int m, int samples) -> Tensor",
    plain=lambda coefficients, frames, m, samples: rotation.resampled_light(
        coefficients, frames, HemiOctahedral(m), samples
    ).contiguous(),
    kernel=_resampled_light_kernel,
    conditions=_resampled_light_conditions,
    fake=lambda coefficients, frames, m, samples: coefficients.new_empty(len(frames), m * m, len(coefficients)),
)


@inlined
def rotated_light(coefficients: Tensor, matrix: Quantised, m: int) -> Tensor:
    """(f, M, c), as `ptt.ops.rotation.rotated_light` of the matrix's `to_csr`."""
    result: Tensor = _rotated_light(coefficients, *matrix, m)
    return result


def _rotated_light_plain(
    coefficients: Tensor, starts: Tensor, columns: Tensor, numbers: Tensor, unit: float, m: int
) -> Tensor:
    matrix = Quantised(starts, columns, numbers, unit)
    csr = matrix.to_csr(coefficients[0].numel(), coefficients.dtype)
    return rotation.rotated_light(coefficients, csr, m).contiguous()


def _rotated_light_kernel(
    coefficients: Tensor, starts: Tensor, columns: Tensor, numbers: Tensor, unit: float, m: int
) -> Tensor:
    rows = len(starts) - 1
    out = coefficients.new_empty(rows // m**2, m * m, CHANNELS)
    run(
        "rotated_light",
        source=_four(coefficients),
        starts=starts,
        columns=columns,
        numbers=numbers,
        out=out,
        rows=rows,
        unit=unit,
        wide=columns.dtype == torch.int32,
    )
    return out[..., : len(coefficients)].contiguous()


def _rotated_light_conditions(
    coefficients: Tensor, starts: Tensor, columns: Tensor, numbers: Tensor, unit: float, m: int
) -> Conditions:
    yield from _light_conditions(coefficients)
    yield contiguous(starts, columns, numbers), "tables must be contiguous"


_rotated_light = operator(
    "rotated_light(Tensor coefficients, Tensor starts, Tensor columns, Tensor numbers, float unit, int m) -> Tensor",
    plain=_rotated_light_plain,
    kernel=_rotated_light_kernel,
    conditions=_rotated_light_conditions,
    fake=lambda coefficients, starts, columns, numbers, unit, m: coefficients.new_empty(
        (len(starts) - 1) // m**2, m * m, len(coefficients)
    ),
)

# S without a transform, as a table


@inlined
def resampled_values(values: Tensor, s: Resampling, cells: int, storage: torch.dtype = torch.float16) -> Table:
    """(f, c, cells), as `ptt.ops.rotation.resampled_values`."""
    return Table(*_resampled_values(values, s.starts, s.reads, s.samples, cells, storage))


def _resampled_values_kernel(
    values: Tensor, starts: Tensor, reads: Tensor, samples: int, cells: int, storage: torch.dtype
) -> tuple[Tensor, Tensor]:
    frames = (len(starts) - 1) // cells
    kept, scale = _resampled_values_fake(values, starts, reads, samples, cells, storage)
    run(
        "resampled_values",
        source=pad(values, (0, 1)).contiguous(),
        starts=starts,
        reads=reads,
        values=kept,
        scale=scale,
        frames=frames,
        cells=cells,
        unit=1 / samples**2,
        largest=LARGEST.get(storage, 0.0),
        type=STORED[storage],
    )
    return kept, scale


def _resampled_values_conditions(
    values: Tensor, starts: Tensor, reads: Tensor, samples: int, cells: int, storage: torch.dtype
) -> Conditions:
    yield of_type(torch.float32, values) and values.shape[1:] == (3,), "values must be (N, 3), float32"
    yield contiguous(starts, reads), "tables must be contiguous"
    yield storage in KEPT, "storage must be float32, float16 or uint8"


def _resampled_values_plain(
    values: Tensor, starts: Tensor, reads: Tensor, samples: int, cells: int, storage: torch.dtype
) -> tuple[Tensor, ...]:
    table = rotation.resampled_values(values, Resampling(starts, reads, samples), cells, storage)
    return tuple(t.contiguous() for t in table)


def _resampled_values_fake(
    values: Tensor, starts: Tensor, reads: Tensor, samples: int, cells: int, storage: torch.dtype
) -> tuple[Tensor, Tensor]:
    frames = (len(starts) - 1) // cells
    kept = values.dtype if values.dtype == torch.float64 else storage
    return values.new_empty(frames, values.shape[1], cells, dtype=kept), values.new_empty(frames)


_resampled_values = operator(
    "resampled_values(Tensor values, Tensor starts, Tensor reads, int samples, int cells, ScalarType storage)"
    " -> (Tensor, Tensor)",
    plain=_resampled_values_plain,
    kernel=_resampled_values_kernel,
    conditions=_resampled_values_conditions,
    fake=_resampled_values_fake,
)

# R, formed: first how many numbers each row keeps, then those numbers


@inlined
def quantised(s: Resampling, n: int, m: int, unit: float, threshold: int) -> Quantised:
    """R in 16 bits, as `ptt.ops.rotation.quantised`, on all cores."""
    given = (s.starts, s.reads, s.samples, n, m, unit, threshold)
    begin = pad(_quantised_counts(*given).cumsum(0), (1, 0))
    columns, numbers = _quantised_rows(*given, begin, int(begin[-1]))
    return Quantised(begin, columns, numbers, unit)


def _quantised_run(
    starts: Tensor,
    reads: Tensor,
    samples: int,
    n: int,
    m: int,
    unit: float,
    threshold: int,
    **out: Tensor | None,
) -> None:
    source = rotation.haar_matrix(n)
    begins, parts, shares = _analysis(m)
    run(
        "quantised_rows",
        starts=starts,
        reads=reads,
        at=source.col_indices(),
        worth=source.values(),
        begins=begins,
        parts=parts,
        shares=shares,
        frames=(len(starts) - 1) // m**2,
        m=m,
        cells=n * n,
        terms=source.values().numel() // n**2,
        scale=1 / (unit * samples**2),
        threshold=max(1, threshold),
        wide=rotation.column_type(n) == torch.int32,
        **out,
    )


@cache
def _analysis(m: int) -> tuple[Tensor, Tensor, Tensor]:
    """W_M by its rows: begins (M + 1,), cells int32, shares float64."""
    transform = rotation.haar_matrix(m).to_sparse_coo().transpose(0, 1).to_sparse_csr()
    return transform.crow_indices().long(), transform.col_indices().int(), transform.values()


def _quantised_plain(
    starts: Tensor, reads: Tensor, samples: int, n: int, m: int, unit: float, threshold: int
) -> Quantised:
    return rotation.quantised(Resampling(starts, reads, samples), n, m, unit, threshold)


def _counts_kernel(starts: Tensor, reads: Tensor, samples: int, n: int, m: int, unit: float, threshold: int) -> Tensor:
    counts = starts.new_empty(len(starts) - 1)
    _quantised_run(starts, reads, samples, n, m, unit, threshold, counts=counts, begin=None, columns=None, numbers=None)
    return counts


def _rows_kernel(
    starts: Tensor,
    reads: Tensor,
    samples: int,
    n: int,
    m: int,
    unit: float,
    threshold: int,
    begin: Tensor,
    total: int,
) -> tuple[Tensor, Tensor]:
    columns, numbers = _rows_fake(starts, reads, samples, n, m, unit, threshold, begin, total)
    if total:  # a kernel without `numbers` would count
        _quantised_run(
            starts, reads, samples, n, m, unit, threshold, counts=None, begin=begin, columns=columns, numbers=numbers
        )
    return columns, numbers


def _rows_fake(
    starts: Tensor,
    reads: Tensor,
    samples: int,
    n: int,
    m: int,
    unit: float,
    threshold: int,
    begin: Tensor,
    total: int,
) -> tuple[Tensor, Tensor]:
    columns = reads.new_empty(total, dtype=rotation.column_type(n))
    return columns, reads.new_empty(total, dtype=torch.int16)


def _quantised_conditions(starts: Tensor, reads: Tensor, *others: object) -> Conditions:
    yield contiguous(starts, reads), "tables must be contiguous"


_SIZES = "Tensor starts, Tensor reads, int samples, int n, int m, float unit, int threshold"
_quantised_counts = operator(
    f"quantised_counts({_SIZES}) -> Tensor",
    plain=lambda *given: _quantised_plain(*given).starts.diff(),
    kernel=_counts_kernel,
    conditions=_quantised_conditions,
    fake=lambda starts, *others: starts.new_empty(len(starts) - 1),
)
_quantised_rows = operator(
    f"quantised_rows({_SIZES}, Tensor begin, SymInt total) -> (Tensor, Tensor)",
    plain=lambda *given: tuple(_quantised_plain(*given[:7])[1:3]),
    kernel=_rows_kernel,
    conditions=_quantised_conditions,
    fake=_rows_fake,
)

# What slices reflect


@inlined
def reflected(light: Tensor, cut: Slices, first: Tensor, frames: Tensor, at: NormalLookup, eye: Tensor) -> Tensor:
    """B (v, c), as `ptt.ops.slices.reflected`; light is read in place where it has four channels."""
    points = (at.position, at.normal, at.near, at.weights, at.twist)
    result: Tensor = _reflected(light, cut.terms, cut.values, cut.views, first, frames, *points, eye)
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
    eye: Tensor


def _reflected_plain(*arguments: Any) -> Tensor:
    g = _Reflected(*arguments)
    at = NormalLookup(g.position, g.normal, g.near, g.weights, g.twist)
    return slices.reflected(g.light, Slices(g.terms, g.values, g.views), g.first, g.frames, at, g.eye).contiguous()


def _reflected_conditions(*arguments: Any) -> Conditions:
    g = _Reflected(*arguments)
    v = g.position.shape[1]
    reals = (g.light, g.eye, g.frames, g.position, g.normal, g.weights)
    yield of_type(torch.float32, *reals), "light and points must be float32"
    yield of_type(torch.int32, g.near, g.first), "near and first must be int32"
    yield of_type(torch.int16, g.terms), "terms must be int16"
    yield of_type(torch.float16, g.values), "values must be float16"
    kept = (g.position, g.normal, g.near, g.weights, g.terms, g.values, g.first)
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
    "Tensor normal, Tensor near, Tensor weights, Tensor twist, Tensor eye) -> Tensor",
    plain=_reflected_plain,
    kernel=_reflected_kernel,
    conditions=_reflected_conditions,
    fake=lambda light, terms, values, views, first, frames, position, *others: light.new_empty(
        position.shape[1], light.shape[2]
    ),
)
