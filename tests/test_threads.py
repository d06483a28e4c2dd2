"""How many threads work beside others, and how they wait."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ptt import threads

BUSY = [sys.executable, "-c", "while True: pass"]


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
    threads._own.number = threads._Own.number = before


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """Four cores, four threads, and the seconds that other processes have used of them, to be set."""
    seconds = [0.0]
    clock = iter(range(1000))
    monkeypatch.setattr(threads, "time", SimpleNamespace(monotonic=lambda: float(next(clock))))
    monkeypatch.setattr(threads._Load, "_used", lambda load: seconds[0])
    load = threads._Load()
    load.cores = {0, 1, 2, 3}
    for name, value in {"_load": load, "ALL": 4, "CHOSEN": False}.items():
        monkeypatch.setattr(threads, name, value)
    monkeypatch.setattr(threads._Own, "number", 4)
    threads._own.number = 4
    torch.set_num_threads(4)
    yield seconds


def shared() -> int:
    """The number of threads after `share`."""
    threads.share()
    return torch.get_num_threads()


def shared_by_a_new_thread() -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(shared).result()


@pytest.mark.parametrize(("used", "number"), [(0.0, 4), (0.3, 4), (0.8, 3), (2.2, 2), (4.0, 1), (-0.6, 4)])
def test_there_is_a_thread_for_each_core_that_others_leave(others: list[float], used: float, number: int) -> None:
    others[0] += used
    threads.share()
    assert torch.get_num_threads() == number
    threads.share()  # others are done
    assert torch.get_num_threads() == 4


def test_a_number_that_was_chosen_stays(others: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    torch.set_num_threads(3)
    others[0] += 4.0
    threads.share()
    assert torch.get_num_threads() == 3
    torch.set_num_threads(4)
    monkeypatch.setattr(threads, "CHOSEN", True)
    threads.share()
    assert torch.get_num_threads() == 4


def test_python_threads_share_alike(others: list[float]) -> None:
    """Torch keeps a number for each: one that is new begins with the last that was chosen."""
    others[0] += 3.0
    threads.share()
    others[0] += 2.0
    assert shared_by_a_new_thread() == 2


def test_after_a_fork_there_is_one_thread_for_good(others: list[float]) -> None:
    """In Python threads that are new, too, whatever was chosen before."""
    others[0] += 4.0
    threads.share()
    threads._alone()
    assert shared() == shared_by_a_new_thread() == 1


@pytest.mark.skipif(not Path("/proc/stat").exists(), reason="nothing tells what others use")
def test_processes_that_compute_are_seen() -> None:
    """And what this one uses is not taken for theirs."""
    load = threads._Load()
    until = time.monotonic() + 0.5
    while time.monotonic() < until:
        torch.rand(100, 100).matmul(torch.rand(100, 100))
    load.free()
    alone = load.others
    busy = [subprocess.Popen(BUSY) for _ in load.cores]
    try:
        time.sleep(1.0)
        assert load.free() < len(load.cores) or len(load.cores) == 1
        assert load.others > alone + 0.3
    finally:
        for process in busy:
            process.kill()


@pytest.mark.parametrize(
    ("before", "variables", "spins"),
    [
        ("", {}, "10000"),
        ("import torch; ", {}, "None"),
        ("", {"OMP_WAIT_POLICY": "active"}, "None"),
        ("", {"GOMP_SPINCOUNT": "7"}, "7"),
    ],
)
def test_threads_do_not_spin_for_long_unless_told_otherwise(before: str, variables: dict[str, str], spins: str) -> None:
    own = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    code = f"{before}import os, ptt; print(os.environ.get('GOMP_SPINCOUNT'))"
    done = subprocess.run([sys.executable, "-c", code], env=own | variables, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == spins
