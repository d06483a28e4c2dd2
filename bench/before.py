"""The time of a frame over that of an older checkout, by turns on one machine: rows of bench/results/before.csv.

    git worktree add ../before COMMIT && python -m bench.before ../before     # about 25 minutes on two cores

Of each relighter two processes live at once, one with the code of each checkout, and answer in turn, so that the
machine's mood is theirs alike: eight balls on a floor, 82,377 vertices, by kernels.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from bench.before_frames import CHANGES, RELIGHTERS
from bench.table import ROOT, Table, commit, setting

ROUNDS = 16
FRAMES = 12  # after each change in a round


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="the older code, such as a git worktree of a commit")
    older = parser.parse_args().checkout.resolve()
    if not (older / "ptt" / "__init__.py").is_file():
        parser.error(f"{older} holds no ptt/__init__.py; give a checkout of this project")
    table = Table("before")
    for relighter in RELIGHTERS:
        compare(table, relighter, older)
    table.write()


def compare(table: Table, relighter: str, older: Path) -> None:
    """Rows of a relighter: medians over the rounds, of the time and of its ratio."""
    with tempfile.TemporaryDirectory() as folder:
        new = served(relighter, ROOT, f"{folder}/new")
        old = served(relighter, older, f"{folder}/old")
        rounds = [(answer(new), answer(old)) for _ in range(ROUNDS)]
        for process in (new, old):
            process.communicate()
    for step, change in enumerate(CHANGES):
        times = [statistics.median(taken[step] for taken in side) for side in zip(*rounds, strict=True)]
        ratios = [ours[step] / theirs[step] for ours, theirs in rounds]
        low, ratio, high = statistics.quantiles(ratios)
        how = (
            f"{times[0]:.2f} ms over {times[1]:.2f}; {ROUNDS} rounds of {FRAMES} frames by turns, half of their ratios"
        )
        how = f"{how} between {low:.3f} and {high:.3f}; {setting()}"
        table.row(f"{relighter}, {change} changes, over {commit(older)}", ratio, "", how, "<= 1.03")


def served(relighter: str, source: Path, cache: str) -> subprocess.Popen[str]:
    """A process with the code of a checkout that is ready to answer; with kernels of its own.

    The number of threads is given: to a process that chooses it, the threads of the other look busy.
    """
    program = Path(__file__).with_name("before_frames.py")
    threads = str(torch.get_num_threads())
    variables = os.environ | {"PYTHONPATH": str(source), "XDG_CACHE_HOME": cache, "OMP_NUM_THREADS": threads}
    command = [sys.executable, "-P", "-W", "ignore", str(program), relighter]
    process = subprocess.Popen(
        command, cwd=source, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        raise RuntimeError(f"the frames of {source} ended early; see the error above")
    return process


def answer(process: subprocess.Popen[str]) -> list[float]:
    """Milliseconds of a frame after each change."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{FRAMES}\n")
    process.stdin.flush()
    return [float(value) for value in process.stdout.readline().split()]


if __name__ == "__main__":
    main()
