"""The four forms of a relighter in one run: eager, torch.compile alone, kernels, torch.compile with kernels."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from itertools import count
from typing import Any

import torch

import ptt
from bench.table import Table, setting
from ptt.relight.relighter import Relighter
from ptt.relight.viewpoint import View

FORMS = {
    "eager": (False, False),
    "torch.compile alone": (False, True),
    "kernels": (True, False),
    "torch.compile with kernels": (True, True),
}
"""By kernels or by torch, and whether torch.compile fuses what there is."""

BLOCKS = 5
PAIRS = 100
LASTING = 0.3  # seconds of a block at least: the mood of a machine lasts longer than a few frames
NUMBERS = count(1)  # no two changes are alike


def four_forms(
    table: Table,
    name: str,
    make: Callable[[bool], Relighter],
    light: ptt.Environment,
    material: Callable[[int], dict[str, ptt.Material]],
    view: Callable[[int], View],
    how: str,
    repeats: int = 8,
) -> None:
    """Rows of the time of a frame after a change of the view, of a material, or of the light, in each form.

    The forms take turns in blocks, so that the machine's mood is theirs alike, and that no frame waits for the threads
    of another form, which spin for a while. With and without torch.compile it is one relighter, since where in memory
    two of them lie makes one or the other faster.

    make: a relighter, by kernels or by torch alone; material, view: the k-th that the user chooses
    """
    by = {kernels: make(kernels) for kernels in (False, True)}
    relighters = {form: made(by[kernels], fused) for form, (kernels, fused) in FORMS.items()}
    for step, change in changes(light, material, view).items():
        seconds: dict[str, list[float]] = {form: [] for form in FORMS}  # medians of blocks
        for _ in range(BLOCKS):
            for form, relighter in relighters.items():
                seconds[form].append(statistics.median(block(relighter, change, repeats)))
        for form, taken in seconds.items():
            table.row(f"{name}, {step} changes, {form}", 1e3 * statistics.median(taken), "ms", f"{how}; {setting()}")
        ratio = over(relighters["torch.compile with kernels"], relighters["kernels"], change)
        aside = f"medians of {PAIRS} frames each, in turns; {setting()}"
        table.row(f"{name}, {step} changes, torch.compile with kernels over kernels", ratio, "", aside, "<= 1.03")


def over(one: Any, other: Any, change: Callable[[int], tuple[Any, ...]]) -> float:
    """The time of a frame by one form over that by another, frame by frame: these two wait for the same threads.

    By blocks the ratio was 0.94 to 1.06 from run to run.
    """
    seconds: list[list[float]] = []
    for pair in range(2 + PAIRS):
        turns = (one, other) if pair % 2 else (other, one)
        taken = [frame(relighter, change) for relighter in turns]
        seconds.append(taken if pair % 2 else taken[::-1])
    first, second = zip(*seconds[2:], strict=True)
    ratio: float = statistics.median(first) / statistics.median(second)
    return ratio


def block(relighter: Any, change: Callable[[int], tuple[Any, ...]], repeats: int) -> list[float]:
    """The seconds of at least so many frames, after two that compile, fill the caches and calm the threads."""
    seconds: list[float] = []
    while len(seconds) < 2 + repeats or sum(seconds[2:]) < LASTING:
        seconds.append(frame(relighter, change))
    return seconds[2:]


def frame(relighter: Any, change: Callable[[int], tuple[Any, ...]]) -> float:
    """The seconds of a frame after a change that no frame had."""
    inputs = change(next(NUMBERS))
    start = time.perf_counter()
    relighter(*inputs)
    return time.perf_counter() - start


def made(relighter: Relighter, fused: bool) -> Any:
    """The relighter, or torch.compile of it."""
    torch._dynamo.config.recompile_limit = 64  # all forms share the code of the steps
    return torch.compile(relighter) if fused else relighter


def changes(
    light: ptt.Environment, material: Callable[[int], dict[str, ptt.Material]], view: Callable[[int], View]
) -> dict[str, Callable[[int], tuple[ptt.Environment, dict[str, ptt.Material], View]]]:
    """What a relighter is given for the k-th frame of each kind."""
    given = material(0)
    camera = view(0)
    return {
        "view": lambda k: (light, given, view(k)),
        "material": lambda k: (light, material(k), camera),
        "light": lambda k: (light.rotated(y=0.7 * k), given, camera),
    }
