"""What a stranger's machine gives: first use, a new light, both instruction sets, busy neighbours; rows `machine`.

    PTT_DATA=... python -m bench.machine                          # about half an hour on two cores
    PTT_DATA=... python -m bench.machine --only lights            # or first, engine, compression, neighbours

Parts run in processes of their own, since much happens once a process; for AVX2 with ATEN_CPU_CAPABILITY,
ONEDNN_MAX_CPU_ISA and PTT_MARCH set, which any x86 machine takes. The engine is traced once, and kept where the scripts
keep their models.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

from bench.table import ROOT, Table, setting

AVX2 = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "PTT_MARCH": "x86-64-v3"}
SETS: dict[str, dict[str, str]] = {"AVX2": AVX2, "own": {}}
RELIGHTERS = {"TransferRelighter": 15, "EnvMapRelighter": 25, "TripleProductRelighter": 25}
RELIGHT = [sys.executable, str(ROOT / "scripts" / "relight.py")]
BUSY = "x = 1\nwhile True: x = x * 3 % 1000003"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, help="parts whose rows are made anew")
    parts = parser.parse_args().only or list(PARTS)
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with meshes and hdri")
    for name in parts:
        table = Table("machine")
        PARTS[name](table)
        table.replace(name, PARTS)


def printed(module: str, *arguments: str, **variables: str) -> list[dict[str, str]]:
    """The rows that a module prints, one a line, in a process with these variables."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | variables, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    return [json.loads(line) for line in done.splitlines() if line.startswith("{")]


def first(table: Table) -> None:
    """From an empty cache to kernels that are built, and `import ptt` with them."""
    for instructions, variables in SETS.items():
        for relighter, goal in RELIGHTERS.items():
            with tempfile.TemporaryDirectory() as empty:
                code = f"import ptt; from ptt.ops import native; native.prepare(*ptt.{relighter}.sources_in_c)"
                seconds = timed([sys.executable, "-c", code], variables | {"XDG_CACHE_HOME": empty})
                again = timed([sys.executable, "-c", code], variables | {"XDG_CACHE_HOME": empty})
            what = f"first, {relighter}, {instructions}"
            table.row(f"{what}, empty cache", seconds, "s", f"import ptt and kernels; {setting()}", f"<= {goal}")
            table.row(f"{what}, built", again, "s", f"import ptt and kernels that are kept; {setting()}")


def elsewhere(part: str, table: Table) -> None:
    """The rows of a part of `bench.machine_parts`, with both sets of instructions.

    Each has a cache of torch.compile's own: what was compiled for AVX2 and is loaded where AVX-512 is used corrupts
    memory (torch 2.13).
    """
    for variables in SETS.values():
        with tempfile.TemporaryDirectory() as folder:
            for row in printed("bench.machine_parts", part, **variables, TORCHINDUCTOR_CACHE_DIR=folder):
                table.row(**row)  # type: ignore[arg-type]


def neighbours(table: Table) -> None:
    """README's first command alone, and beside two processes that compute without end."""
    for instructions, variables in SETS.items():
        alone = main_job(variables)
        busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(2)]
        try:
            beside = main_job(variables)
        finally:
            for process in busy:
                process.kill()
        how = f"scripts/relight.py, default scene, kernels and fits made in it; {setting()}"
        table.row(f"neighbours, {instructions}, the main job alone", alone, "s", how, "<= 90")
        table.row(f"neighbours, {instructions}, beside two busy processes", beside, "s", how)
        table.row(f"neighbours, {instructions}, their ratio", beside / alone, "", how, "<= 3.5")


def main_job(variables: dict[str, str]) -> float:
    """Seconds of README's first command, from an empty cache."""
    with tempfile.TemporaryDirectory() as empty:
        return timed([*RELIGHT, "--out", f"{empty}/out"], variables | {"XDG_CACHE_HOME": empty})


def timed(command: list[str], variables: dict[str, str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, env=os.environ | variables, cwd=ROOT, check=True, capture_output=True)
    return time.perf_counter() - start


PARTS: dict[str, Callable[[Table], None]] = {
    "first": first,
    "lights": partial(elsewhere, "lights"),
    "engine": partial(elsewhere, "engine"),
    "compression": partial(elsewhere, "compression"),
    "neighbours": neighbours,
}

if __name__ == "__main__":
    main()
