"""The rotation matrices R, formed in 16 bits: first how many numbers each row keeps, then those numbers.

Both are operators; their plain function is `ptt.ops.rotation.quantised`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops import rotation
from ptt.ops.compiling import inlined
from ptt.ops.native.arguments import contiguous
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.rotation import Quantised, Resampling

SIZES = "Tensor starts, Tensor reads, int samples, int n, int m, float unit, int threshold"


class _Given(NamedTuple):
    """What both schemas begin with: S, sizes of the maps, and what is kept."""

    starts: Tensor
    reads: Tensor
    samples: int
    n: int
    m: int
    unit: float
    threshold: int


@inlined
def quantised(s: Resampling, n: int, m: int, unit: float, threshold: int) -> Quantised:
    """R in 16 bits, as `ptt.ops.rotation.quantised`, on all cores."""
    given = _Given(s.starts, s.reads, s.samples, n, m, unit, threshold)
    begin = pad(_quantised_counts(*given).cumsum(0), (1, 0))
    columns, numbers = _quantised_rows(*given, begin, int(begin[-1]))
    return Quantised(begin, columns, numbers, unit)


def _run(given: _Given, **out: Tensor | None) -> None:
    source = rotation.haar_matrix(given.n)
    begins, parts, shares = _analysis(given.m)
    run(
        "quantised_rows",
        starts=given.starts,
        reads=given.reads,
        at=source.col_indices(),
        worth=source.values(),
        begins=begins,
        parts=parts,
        shares=shares,
        frames=(len(given.starts) - 1) // given.m**2,
        m=given.m,
        cells=given.n**2,
        terms=source.values().numel() // given.n**2,
        scale=1 / (given.unit * given.samples**2),
        threshold=max(1, given.threshold),
        wide=rotation.column_type(given.n) == torch.int32,
        **out,
    )


@cache
def _analysis(m: int) -> tuple[Tensor, Tensor, Tensor]:
    """W_M by its rows: begins (M + 1,), cells int32, shares float64."""
    transform = rotation.haar_matrix(m).to_sparse_coo().transpose(0, 1).to_sparse_csr()
    return transform.crow_indices().long(), transform.col_indices().int(), transform.values()


def _plain(*arguments: Any) -> Quantised:
    starts, reads, samples, *sizes = arguments
    return rotation.quantised(Resampling(starts, reads, samples), *sizes)


def _counts_kernel(*arguments: Any) -> Tensor:
    given = _Given(*arguments)
    counts = given.starts.new_empty(len(given.starts) - 1)
    _run(given, counts=counts, begin=None, columns=None, numbers=None)
    return counts


def _rows_kernel(*arguments: Any) -> tuple[Tensor, Tensor]:
    *given, begin, total = arguments
    columns, numbers = _rows_fake(*arguments)
    if total:  # a kernel without `numbers` would count
        _run(_Given(*given), counts=None, begin=begin, columns=columns, numbers=numbers)
    return columns, numbers


def _rows_fake(*arguments: Any) -> tuple[Tensor, Tensor]:
    *given, _, total = arguments
    reads = _Given(*given).reads
    columns = reads.new_empty(total, dtype=rotation.column_type(_Given(*given).n))
    return columns, reads.new_empty(total, dtype=torch.int16)


def _conditions(starts: Tensor, reads: Tensor, *others: object) -> Conditions:
    yield contiguous(starts, reads), "tables must be contiguous"


_quantised_counts = operator(
    f"quantised_counts({SIZES}) -> Tensor",
    plain=lambda *given: _plain(*given).starts.diff(),
    kernel=_counts_kernel,
    conditions=_conditions,
    fake=lambda starts, *others: starts.new_empty(len(starts) - 1),
    calls="quantised_rows",
)
_quantised_rows = operator(
    f"quantised_rows({SIZES}, Tensor begin, SymInt total) -> (Tensor, Tensor)",
    plain=lambda *arguments: tuple(_plain(*arguments[:7])[1:3]),
    kernel=_rows_kernel,
    conditions=_conditions,
    fake=_rows_fake,
)
