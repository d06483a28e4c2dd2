"""One Tucker decomposition in a process of its own: seconds, relative error and the memory that it added, as JSON.

python -m bench.tucker_peer st-hosvd float32 tensor.pt
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import torch
from torch import Tensor

from ptt.ops import tucker

ROOT = Path(__file__).resolve().parent.parent
RANKS = (4, 8, 8)


def run(how: str, dtype: str, path: Path) -> dict[str, float]:
    """The figures of one decomposition, measured in a fresh process."""
    command = [sys.executable, "-m", "bench.tucker_peer", how, dtype, str(path)]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _decompose(how: str, tensor: Tensor) -> tucker.Tucker:
    if how.startswith("tensorly"):
        import tensorly
        from tensorly.decomposition import partial_tucker

        tensorly.set_backend("pytorch" if how == "tensorly-pytorch" else "numpy")
        given = tensor if how == "tensorly-pytorch" else tensor.numpy()
        (core, factors), _ = partial_tucker(given, rank=list(RANKS), modes=[0, 1, 2])
        return tucker.Tucker.from_tensorly((core, factors))
    return tucker.decompose(tensor, ranks=RANKS, method=how)  # type: ignore[arg-type]


def _peak() -> int:
    """The largest resident set so far [KiB], as Linux counts it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def main() -> None:
    how, dtype, path = sys.argv[1:]
    tensor = torch.load(path).to(getattr(torch, dtype))
    _decompose(how, torch.rand(5, 9, 9).to(tensor))  # imports, threads
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak that reading the tensor made
    before = _peak()
    start = time.perf_counter()
    fit = _decompose(how, tensor)
    seconds = time.perf_counter() - start
    added = (_peak() - before) / 1024
    print(json.dumps({"seconds": seconds, "error": tucker.relative_error(fit, tensor), "MiB": added}))


if __name__ == "__main__":
    main()
