"""The kernels of rotation against the plain functions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ptt.materials.shapes import BlinnPhong, Ward
from ptt.ops import haar, native, rotation, slices
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.slices import NormalLookup, Slices

pytestmark = pytest.mark.usefixtures("built")


def frames_for(count: int) -> Tensor:
    g = torch.Generator().manual_seed(count)
    return rotation.frames_of(torch.randn(count, 3, generator=g, dtype=torch.float64))


def light_for(n: int, channels: int) -> Tensor:
    return haar.analyse(torch.rand(channels, n, n, generator=torch.Generator().manual_seed(n)))


@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 2), (16, 8), (8, 16), (64, 32)])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_local_light(n: int, m: int, channels: int) -> None:
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), frames_for(7))
    light = light_for(n, channels)
    got = native.local_light(light, s, m)
    wanted = rotation.local_light(light, s, m)
    torch.testing.assert_close(got, wanted, rtol=0, atol=2e-6 * m)  # coefficients of light 1 reach m


@pytest.mark.parametrize("samples", [1, 3, 4])
@pytest.mark.parametrize(("n", "m"), [(2, 1), (16, 8), (64, 32)])
def test_resampled_light(n: int, m: int, samples: int) -> None:
    """Samples on the edge of a cell may fall to either side in float32: few, and each is one part of one mean."""
    frames = frames_for(5).float()
    target = HemiOctahedral(m)
    light = light_for(n, 3)
    got = native.resampled_light(light, frames, target, samples)
    wanted = rotation.resampled_light(light, frames, target, samples)
    off = (got - wanted).abs()
    assert float((off > 2e-6 * m).float().mean()) < 0.002
    assert float(off.max()) <= 2 / samples**2


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("storage", [torch.float32, torch.float16, torch.uint8], ids=str)
def test_resampled_values(level: int, storage: torch.dtype) -> None:
    """The same table but for ties of its rounding, whose last place counts as one."""
    grid = Geodesic(level)
    s = rotation.resampling(Octahedral(16), grid, frames_for(5))
    values = 1e9 * torch.rand(256, 3, generator=torch.Generator().manual_seed(0)) ** 8
    got = native.resampled_values(values, s, grid.cells, storage)
    wanted = rotation.resampled_values(values, s, grid.cells, storage)
    assert got.values.shape == (5, 3, grid.cells) and got.values.dtype == storage
    torch.testing.assert_close(got.scale, wanted.scale, rtol=1e-6, atol=0)
    last = {torch.float32: 1e-6, torch.float16: 2**-10, torch.uint8: 1 / 255}[storage]
    largest = wanted.to_dense().amax((1, 2), keepdim=True)
    assert bool(((got.to_dense() - wanted.to_dense()).abs() <= 1.01 * last * largest).all())


@pytest.mark.parametrize(("n", "m"), [(2, 1), (16, 8), (8, 16)])
@pytest.mark.parametrize("wide", [False, True])
def test_rotated_light(n: int, m: int, wide: bool) -> None:
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), frames_for(6))
    matrix = rotation.quantised(s, n, m, 1 / 32767, 1)
    csr = matrix.to_csr(n * n)
    if wide:
        matrix = matrix._replace(columns=matrix.columns.int())
    light = light_for(n, 3)
    got = native.rotated_light(light, matrix, m)
    torch.testing.assert_close(got, rotation.rotated_light(light, csr, m), rtol=0, atol=4e-6 * m)


@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 2), (16, 8), (8, 16), (64, 32)])
@pytest.mark.parametrize("threshold", [1, 300])
def test_quantised(n: int, m: int, threshold: int) -> None:
    """The same numbers, but where a half is rounded: R itself is exact in float64 up to the order of a sum."""
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), frames_for(3))
    unit = 1 / 32767
    got = native.quantised(s, n, m, unit, threshold).to_csr(n * n, torch.float64).to_dense()
    wanted = rotation.quantised(s, n, m, unit, threshold).to_csr(n * n, torch.float64).to_dense()
    off = (got - wanted).abs()
    assert float(off.max()) <= unit * threshold * 1.001
    assert float((off > 0).float().mean()) < 1e-4


def view(count: int, views: int = 8, twists: int = 1) -> tuple[Tensor, Slices, Tensor, Tensor, NormalLookup]:
    g = torch.Generator().manual_seed(0)
    sampled = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3)).float()
    shape = BlinnPhong(20.0) if twists == 1 else Ward(0.1, 0.3)
    cut = slices.tabulate(shape.evaluate, 4, views, 10, twists=twists)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=g))
    dip = torch.rand(count, generator=g)
    at = slices.located(torch.randn(count, 3, generator=g), q * q.det().sign()[:, None, None], sampled, dip)
    light = torch.rand(16, 16, 4, generator=g)
    return light, cut, slices.first_slice(cut, at.twist), sampled, at


@pytest.mark.parametrize("twists", [1, 6])
@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
def test_reflected(twists: int, distant: bool, channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    light, cut, first, sampled, at = view(48, twists=twists)
    light = light[..., :channels]
    eye = torch.nn.functional.normalize(torch.randn(3, 48), dim=0) if distant else torch.tensor([0.0, 0.5, 3.0])
    wanted = slices.reflected(light, cut, first, sampled, at, eye)
    monkeypatch.setattr(slices, "reflected", None)  # so that it cannot have been the plain one
    torch.testing.assert_close(native.reflected(light, cut, first, sampled, at, eye), wanted, rtol=0, atol=2e-6)


def test_a_point_at_the_eye_is_finite() -> None:
    light, cut, first, sampled, at = view(16)
    eye = at.position[:, 3].clone()
    assert bool(native.reflected(light, cut, first, sampled, at, eye).isfinite().all())
    assert bool(slices.reflected(light, cut, first, sampled, at, eye).isfinite().all())


def test_what_kernels_do_not_take_is_computed_plainly() -> None:
    s = rotation.resampling(Octahedral(4), HemiOctahedral(2), frames_for(2))
    light = light_for(4, 3)
    assert native.local_light(light.double(), s, 2).dtype == torch.float64
    assert native.local_light(torch.rand(5, 4, 4), s, 2).shape == (2, 4, 5)
    matrix = rotation.quantised(s, 4, 2, 1 / 32767, 1)
    assert native.rotated_light(light.double(), matrix, 2).dtype == torch.float64
    light.requires_grad_()
    native.local_light(light, s, 2).sum().backward()
    assert light.grad is not None and bool((light.grad != 0).any())
    args = view(16)
    with native.refusals() as found:
        native.reflected(torch.rand(16, 16, 5), *args[1:], torch.ones(3))
    assert found == {"reflected": "light must be (f, x, c), c at most 4"}
