"""How many threads work, and how they wait for each other.

Torch and the kernels share one number of threads, OMP_NUM_THREADS. Where it is not set there is one for each core that
other programs leave free: `share` looks every quarter of a second at what they used, before each frame and each block
of a long computation. Threads wait for each other after every operation, and one whose core is taken is waited for as
long as the system gives it to others, 3 to 8 ms: beside two busy processes on two cores a frame took 3,000 ms by two
threads and 40 by one, and the first command of README 263 s by two and 157 by one (alone, by two, 90).
OMP_NUM_THREADS, or `torch.set_num_threads` at any time, is a number that stays. Where no /proc/stat tells what others
use (not Linux), all cores count as free. torch.compile makes a version of its graphs for each number of threads.

OMP_WAIT_POLICY and GOMP_SPINCOUNT say how they wait between two pieces of work: a thread that spins is there at once
and keeps a core from others. OpenMP's default spins for milliseconds; with none (passive) frames alone take nearly
twice as long. `import ptt` sets SPINS, unless one of the two variables is set, or torch came first: import ptt before
torch, or set GOMP_SPINCOUNT yourself.

In a process forked from one that imported ptt there is one thread, as in the workers of torch's DataLoader: OpenMP's
others stay behind, and the next piece of work would wait for them without end. What runs another program is as ever.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

SPINS = 10000  # turns of a waiting thread, about 0.1 ms

if "torch" not in sys.modules and "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))

import torch  # noqa: E402  reads it

from ptt.ops.compiling import opaque  # noqa: E402

ALL = torch.get_num_threads()
CHOSEN = "OMP_NUM_THREADS" in os.environ
EVERY = 0.25  # seconds between two looks at what others use, which is counted in 10 ms
BUSY = (1, 2, 3, 6, 7)  # fields of a line of /proc/stat: user, nice, system, irq, softirq


class _Load:
    """What other processes use of the cores that this one may run on."""

    def __init__(self) -> None:
        self.cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(ALL))
        self.asked, self.used, self.others = time.monotonic(), self._used(), 0.0

    def free(self) -> int:
        """Cores that others leave, at least one."""
        now = time.monotonic()
        if now - self.asked >= EVERY:
            used = self._used()
            self.others = (used - self.used) / (now - self.asked)
            self.asked, self.used = now, used
        return max(1, len(self.cores) - max(0, round(self.others)))

    def _used(self) -> float:
        """Seconds of these cores that went to other processes, since some time; 0 where nothing tells."""
        try:
            lines = [line.split() for line in Path("/proc/stat").read_text().splitlines() if line.startswith("cpu")]
        except OSError:
            return 0.0
        mine = [line for line in lines if line[0][3:].isdigit() and int(line[0][3:]) in self.cores]
        busy = sum(int(line[field]) for line in mine for field in BUSY) / os.sysconf("SC_CLK_TCK")
        return busy - sum(os.times()[:4])


class _Own(threading.local):
    """The number that `share` chose for a Python thread (torch keeps one for each); at first, the last of any."""

    number = ALL


_load = _Load()
_own = _Own()


@opaque
def share() -> None:
    """Have as many threads as cores are free, unless OMP_NUM_THREADS or `torch.set_num_threads` chose a number."""
    before = torch.get_num_threads()
    if CHOSEN or before not in (_own.number, ALL):
        return
    number = min(ALL, _load.free())
    if number != before:
        torch.set_num_threads(number)
    _own.number = _Own.number = number


def _alone() -> None:
    """Leave torch and the kernels one thread, for good."""
    torch.set_num_threads(1)
    _own.number = _Own.number = ALL  # so that 1 is not what `share` chose, in any Python thread


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_alone)
