"""How many threads work, and how they wait for each other: what OpenMP reads once, when torch is first imported.

OMP_NUM_THREADS says how many threads torch and the kernels have together (default: one a core; `torch.set_num_threads`
changes it later). OMP_WAIT_POLICY and GOMP_SPINCOUNT say how they wait between two pieces of work: a thread that spins
is there at once and keeps a core from others. OpenMP's default spins for milliseconds, and a job beside two busy
processes on two cores took 4 times as long for compression and 27 times for a frame; with none (passive) frames alone
take nearly twice as long. `import ptt` sets SPINS, unless one of the two variables is set, or torch came first: import
ptt before torch, or set GOMP_SPINCOUNT yourself. The same trial took 2.6 and 3.3 times as long with it, and as long as
before alone.

In a process forked from one that imported ptt there is one thread, as in the workers of torch's DataLoader: OpenMP's
others stay behind, and the next piece of work would wait for them without end. What runs another program is as ever.
"""

from __future__ import annotations

import os
import sys

SPINS = 10000  # turns of a waiting thread, about 0.1 ms

if "torch" not in sys.modules and "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def _alone() -> None:
    """Leave torch and the kernels one thread."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_alone)
