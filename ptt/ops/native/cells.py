"""Cells of f cos as an operator; its plain function is `ptt.ops.cells.cell_sums`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ptt.ops import cells
from ptt.ops.compiling import inlined
from ptt.ops.native.arguments import of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator


@inlined
def cell_sums(mirrored: Tensor, reflected: Tensor, counts: Sequence[int]) -> Tensor:
    """Moments and sums (turns * tilts, n, 6), as `ptt.ops.cells.cell_sums`."""
    result: Tensor = _cell_sums(mirrored, reflected, list(counts))
    return result


def _cell_conditions(mirrored: Tensor, reflected: Tensor, counts: list[int]) -> Conditions:
    yield of_type(torch.float32, mirrored, reflected), "directions and what is reflected must be float32"
    yield mirrored.ndim == 3 and mirrored.shape[1] == 3, "directions must be (tilts, 3, nodes)"
    yield reflected.shape[1:] == (mirrored.shape[2], 3), "what is reflected must be (turns * tilts, nodes, 3)"
    yield len(reflected) % len(mirrored) == 0, "there must be as many tilts of each turn"


def _cell_kernel(mirrored: Tensor, reflected: Tensor, counts: list[int]) -> Tensor:
    tilts, _, m = mirrored.shape
    whole, mass = cells.whole_numbers(mirrored, reflected)
    centres = [torch.cat(cells.first_centres(whole, some, counts)) for some in mass.split(tilts)]
    out = _cell_fake(mirrored, reflected, counts)
    run(
        "cell_sums",
        mirrored=mirrored.contiguous(),
        whole=whole.contiguous(),
        mass=mass.contiguous(),
        reflected=reflected.contiguous(),
        centres=torch.stack(centres),
        counts=torch.tensor(counts),
        out=out,
        turns=len(centres),
        tilts=tilts,
        nodes=m,
        sets=len(counts),
        cells=sum(counts),
        first=cells.FIRST,
        rounds=cells.ROUNDS,
        steps=cells.STEPS,
    )
    return out


def _cell_fake(mirrored: Tensor, reflected: Tensor, counts: list[int]) -> Tensor:
    return reflected.new_empty(len(reflected), sum(counts), 3 + reflected.shape[2])


_cell_sums = operator(
    "cell_sums(Tensor mirrored, Tensor reflected, int[] counts) -> Tensor",
    plain=lambda *arguments: cells.cell_sums(*arguments),
    kernel=_cell_kernel,
    conditions=_cell_conditions,
    fake=_cell_fake,
)
