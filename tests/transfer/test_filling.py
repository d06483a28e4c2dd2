"""What all points have is written to one place, and no memory stays with what made it."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from ptt.transfer.filling import of_all

TRACED = """
import ptt
from ptt.ops import mesh
from ptt.scene.parts import Part

def held():
    return sum(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("RssAnon")) / 2**10

parts = [Part("ball", *mesh.sphere_mesh(4, 0.5)), Part("floor", *mesh.plane_mesh(3.0, 60))]
scene = ptt.Scene.from_parts(parts)
before = held()
raw = ptt.precompute(scene, 1)
print(held() - before)
"""


@pytest.mark.parametrize("points", [0, 1, 4, 10])
def test_every_point_has_its_own(points: int) -> None:
    def values(rows: Tensor) -> tuple[Tensor, Tensor]:
        return rows * 2, rows[:, None].double().expand(-1, 3)

    twice, wide = of_all(points, 4, values, "", progress=False)
    assert torch.equal(twice, 2 * torch.arange(points))
    assert wide.dtype == torch.float64 and torch.equal(wide, torch.arange(points)[:, None].double().expand(-1, 3))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is read from /proc")
def test_rays_leave_no_memory_behind_but_their_results() -> None:
    """51 MiB of results; with a list of the parts of each block 1,032 MiB stay, on a large mesh many GiB."""
    done = subprocess.run([sys.executable, "-c", TRACED], check=True, capture_output=True, text=True)
    assert float(done.stdout) < 500
