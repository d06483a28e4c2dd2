"""Rotation of light as operators; their plain functions are those of `ptt.ops.rotation`.

The kernels are for float32 with up to four channels.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops import haar, rotation
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, GROUP
from ptt.ops.native.arguments import STORED, contiguous, of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.rotation import Quantised, Resampling
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
    ),
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
    ),
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
    return rotation.rotated_light(coefficients, csr, m)


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
) -> Table:
    return rotation.resampled_values(values, Resampling(starts, reads, samples), cells, storage)


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
