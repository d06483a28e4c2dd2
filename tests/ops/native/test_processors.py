"""Kernels are right for vectors of 4 and of 8 floats too: their tests pass when they are built for such processors."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ptt.ops.native import building

TESTS = Path(__file__).parent.parent
AGAINST_PLAIN = (
    "native/test_glossing.py",
    "native/test_hemispheres.py",
    "native/test_relight.py",
    "native/test_rotation.py",
    "test_near.py",
    "test_shade.py",
    "test_slices.py",
)


@pytest.mark.parametrize("processor", ["x86-64", "x86-64-v3"])
def test_kernels_built_for_another_processor(built: None, processor: str) -> None:
    if "__x86_64__" not in building.toolchain()[2]:
        pytest.skip("the processor is no x86")
    if os.environ.get("PTT_MARCH"):
        pytest.skip("a processor is named")
    command = [sys.executable, "-m", "pytest", "-q", *(str(TESTS / name) for name in AGAINST_PLAIN)]
    done = subprocess.run(
        command, env=os.environ | {"PTT_MARCH": processor}, cwd=TESTS.parent.parent, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert "skipped" not in done.stdout.splitlines()[-1]
