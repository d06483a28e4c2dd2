"""Shading by triple products: against a loop, and the kernel against the plain function."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ptt.ops import native, shade
from ptt.ops.native import shading
from ptt.ops.shade import Points, Tables


def scene(n: int, p: int = 37, k: int = 4, j: int = 4, i: int = 1, half: bool = True) -> tuple[Tables, Points]:
    g = torch.Generator().manual_seed(100 * k + 10 * j + i)

    def rows(count: int, most: int) -> tuple[Tensor, Tensor]:
        weights = torch.rand(count, p, generator=g)
        return torch.randint(most, (count, p), generator=g).int(), weights / weights.sum(0)

    kind = torch.float16 if half else torch.float32
    light, glossy = torch.rand(6, 3, n, generator=g).to(kind), torch.rand(9, n, generator=g).to(kind)
    visibility = torch.randint(256, (7, n), generator=g).to(torch.uint8)
    tables = Tables(light, 2.5, visibility, torch.rand(n, generator=g), glossy)
    view, specular = rows(i, 9)[0], torch.rand(i, p, 3, generator=g)
    return tables, Points(*rows(k, 6), *rows(j, 7), view, specular, torch.rand(p, 3, generator=g))


def test_the_sum_written_out() -> None:
    tables, at = scene(20, p=5, i=2)
    got = shade.shade(tables, at)
    for p in range(5):
        for c in range(3):
            total = 0.0
            for t in range(20):
                light = sum(float(at.weights[k, p] * tables.light[at.frames[k, p], c, t]) for k in range(4))
                seen = sum(float(at.shares[j, p] * tables.visibility[at.seen[j, p], t]) / 255 for j in range(4))
                f = float(at.diffuse[p, c] * tables.dull[t])
                f += sum(float(at.specular[i, p, c] * tables.glossy[at.view[i, p], t]) for i in range(2))
                total += light * seen * f
            assert float(got[p, c]) == pytest.approx(2.5 * total, rel=1e-5)  # 20 / n = 1


@pytest.mark.parametrize("n", [80, 320])
@pytest.mark.parametrize("k", [1, 4, 8])
@pytest.mark.parametrize("j", [1, 3, 4])
@pytest.mark.parametrize("i", [1, 2])
def test_kernel(n: int, k: int, j: int, i: int, built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    tables, at = scene(n, 150, k, j, i)
    for first in (3, 40, 63, 100):  # neighbours of the same frames, which are shaded together
        at.frames[:, first + 1] = at.frames[:, first]
    wanted = shade.shade(tables, at)
    monkeypatch.setattr(shade, "shade", None)  # so that it cannot have been the plain one
    torch.testing.assert_close(native.shade(tables, at), wanted, rtol=2e-5, atol=1e-6)


def test_what_the_kernel_does_not_take_is_computed_plainly(built: None) -> None:
    for arguments in (scene(20), scene(80, half=False), scene(80, k=2), scene(80, i=3)):
        assert not shading._fits(*arguments)
        torch.testing.assert_close(native.shade(*arguments), shade.shade(*arguments))
    tables, at = scene(80)
    diffuse = at.diffuse.clone().requires_grad_()
    native.shade(tables, at._replace(diffuse=diffuse)).sum().backward()
    assert diffuse.grad is not None and bool((diffuse.grad > 0).all())
    nothing = Points(*(x[:0] if x is at.diffuse else x[:, :0] for x in at))
    assert native.shade(tables, nothing).shape == (0, 3)
