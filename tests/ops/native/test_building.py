"""Kernels are built once, whatever compiler, folder and neighbours do; where they cannot be, it is said why.

Every test builds "maps", the file that takes least, in a folder of its own.
"""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from ptt.ops import keeping, latlong, native
from ptt.ops.native import building, kernels

TEXELS = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(1))


def forget() -> None:
    """What a new process does not know."""
    kernels._prepared.clear()
    for cached in (building.toolchain, keeping.folder, kernels.library, kernels._kernel, kernels._warn):
        cached.cache_clear()


@pytest.fixture
def folder(built: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder for libraries, and a process that knows none."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    forget()
    yield tmp_path / "ptt"
    forget()


@pytest.fixture
def compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets CXX to a script of these lines, then the real compiler."""
    real = building.toolchain()[0][0]

    def use(lines: str) -> None:
        script = tmp_path / "compiler"
        script.write_text(f'#!/bin/bash\n{lines}\nexec {real} "$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("CXX", str(script))
        building.toolchain.cache_clear()

    return use


def works() -> bool:
    """Whether the kernel answers, and agrees with the plain function."""
    with native.refusals() as found:
        means = native.octahedral_means(TEXELS, 4, 6, 0.3)
    assert torch.allclose(means, latlong.octahedral_means(TEXELS, 4, 6, 0.3), atol=1e-4)
    return not found


@pytest.mark.parametrize(
    ("cxx", "cause"),
    [
        ("/nowhere/g++ -O1", "/nowhere/g\\+\\+ cannot be run: .*No such file"),
        ("false", "false fails: .*exit status 1"),
        ("", "there is none of c\\+\\+, g\\+\\+, clang\\+\\+; install one, or name it in CXX"),
    ],
)
def test_without_a_compiler_one_warning_names_the_cause(
    folder: Path, monkeypatch: pytest.MonkeyPatch, cxx: str, cause: str
) -> None:
    monkeypatch.setenv("CXX", cxx)
    if not cxx:
        monkeypatch.setenv("PATH", "")
    with pytest.warns(UserWarning, match=f"no C\\+\\+ kernels, relighting stays eager: {cause}") as seen:
        assert not works()
    assert len(seen) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not works() and not native.available("lighting")


def test_a_source_that_does_not_compile_says_what_the_compiler_says(
    folder: Path, compiler: Callable[[str], None]
) -> None:
    compiler('[[ "$*" == *-shared* ]] && { echo "no space left" >&2; exit 1; }')
    with pytest.warns(UserWarning, match="fails: no space left"):
        assert not works()
    assert not os.listdir(folder)


def test_a_compiler_may_have_arguments(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", f"env PTT=1 {building.toolchain()[0][0]} -O1")
    building.toolchain.cache_clear()
    assert works()


def test_flags_that_a_compiler_does_not_know_are_dropped(folder: Path, compiler: Callable[[str], None]) -> None:
    compiler('[[ "$*" == *-march=* || "$*" == *-mprefer* ]] && { echo "unknown option" >&2; exit 1; }')
    assert works()
    _, flags, _ = building.toolchain()
    assert "-O3" in flags and not any(flag.startswith("-m") for flag in flags)


def test_the_processor_can_be_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = building.kept("maps")
    monkeypatch.setenv("PTT_MARCH", "x86-64-v2")
    building.toolchain.cache_clear()
    assert building.kept("maps") != own
    assert works()


def test_a_folder_that_cannot_be_written_is_replaced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert works()
    assert "nothing is kept for the next time" in capsys.readouterr().err
    assert keeping.folder().parent != Path(os.devnull)


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_library_is_built_anew(folder: Path, damage: str) -> None:
    """It is damaged in a process's absence: one that has it loaded is not asked."""
    [path] = building.build(["maps"])
    content = path.read_bytes()
    middle = len(content) // 2
    damaged = {
        "cut": content[:middle],
        "changed": content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :],
        "empty": b"",
    }
    path.write_bytes(damaged[damage])
    assert works()
    assert path.read_bytes()[:middle] == content[:middle] and building.whole(path)


def test_an_interrupted_build_leaves_nothing_behind(folder: Path, compiler: Callable[[str], None]) -> None:
    started = folder.parent / "started"
    # no program but the last: bash ignores an interrupt that comes while one ends well
    compiler(f'[[ "$*" == *-shared* ]] && {{ : > {started}; exec sleep 60; }}')
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)  # which `&` in a shell turns off\n"
    code += "from ptt.ops.native import building; building.build(['maps'])"
    process = subprocess.Popen([sys.executable, "-c", code], start_new_session=True, stderr=subprocess.DEVNULL)
    while not started.exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(30) != 0
    assert not os.listdir(folder)


def test_builds_at_the_same_time_are_safe(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    building.toolchain()
    barrier = threading.Barrier(2)
    run = building._run

    def both(*command: str) -> str:
        if "-shared" in command:
            barrier.wait()  # both have found no library
        return run(*command)

    monkeypatch.setattr(building, "_run", both)
    made: list[list[Path]] = []
    threads = [threading.Thread(target=lambda: made.append(building.build(["maps"]))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made[0] == made[1] and os.listdir(folder) == [made[0][0].name]
    assert building.build(["maps"]) == made[0]  # which finds it: the barrier would hold a second build for ever
    assert works()


def test_a_first_use_says_so_once_and_builds_no_more_than_it_needs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    native.prepare("maps")
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("ptt: building C++ kernels") and said.endswith("maps\n")
    native.prepare("maps")
    assert works()
    assert not capsys.readouterr().err
    assert len(os.listdir(folder)) == 1


def test_a_process_whose_kernels_are_built_does_not_import_the_compiler_of_torch(built: None) -> None:
    code = """
import sys, torch
from ptt.ops import native
native.prepare("maps")
native.octahedral_means(torch.ones(4, 8, 3), 4, 3, 0.5)
assert not [name for name in sys.modules if name.startswith(("torch._inductor", "torch._dynamo"))]
"""
    subprocess.run([sys.executable, "-c", code], check=True)
