"""BRDF slices against the integral they stand for."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops import haar, rotation, slices
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.slices import ALIGNED, Located, Slices
from ptt.shapes import BlinnPhong, Ward

SHAPE = BlinnPhong(20.0)


def points(count: int = 32, normals: int = 8, seed: int = 0) -> tuple[Located, Tensor, Tensor]:
    """Points with random frames, among the sampled frames of normals x normals."""
    g = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))
    frames = q * q.det().sign()[:, None, None]
    sampled = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
    return slices.located(torch.randn(count, 3, generator=g).double(), frames, sampled), frames, sampled


def test_all_terms_are_the_integral() -> None:
    """Every coefficient kept: slice times local light is the sum over cells of light x BRDF x cosine x solid angle."""
    m, views = 8, 4
    cut = slices.tabulate(SHAPE.evaluate, m, views, m * m, samples=4)
    light = torch.rand(m, m, dtype=torch.float64)
    fine = HemiOctahedral(m * 4)
    wi, weight = fine.directions(), fine.solid_angles() * fine.directions()[..., 2]
    wo = HemiOctahedral(views).directions().reshape(-1, 1, 1, 3)
    spread = light.repeat_interleave(4, 0).repeat_interleave(4, 1)
    wanted = (SHAPE.evaluate(wi, wo) * weight * spread).sum((1, 2))
    got = cut.to_dense(m * m).double() @ haar.analyse(light).flatten()
    torch.testing.assert_close(got, wanted, rtol=2e-3, atol=1e-4)  # values are float16


def test_cosine_is_the_irradiance() -> None:
    """Under radiance 1 the irradiance is pi."""
    for m in (1, 4, 32):
        light = haar.analyse(torch.ones(m, m, dtype=torch.float64)).flatten()
        assert abs(float(slices.cosine(m) @ light) - math.pi) < 0.02 / m


def test_fewer_terms_are_the_largest() -> None:
    whole = slices.tabulate(SHAPE.evaluate, 8, 4, 64).to_dense(64)
    few = slices.tabulate(SHAPE.evaluate, 8, 4, 10)
    assert few.terms.shape == (16, ALIGNED) and bool((few.values[:, 10:] == 0).all())
    dense = few.to_dense(64)
    assert bool((dense[dense != 0] == whole[dense != 0]).all())
    largest = whole.abs().sort(1, descending=True).values[:, :10]
    torch.testing.assert_close(dense.abs().sort(1, descending=True).values[:, :10], largest)


def test_factorised_is_the_best_of_its_rank() -> None:
    """Eckart and Young: the error is the tail of the singular values."""
    whole = slices.tabulate(SHAPE.evaluate, 8, 8, 64).to_dense(64)
    tail = torch.linalg.svdvals(whole.double())[6:].square().sum().sqrt()
    low = slices.factorise(SHAPE.evaluate, 8, 8, 6)
    assert low.basis is not None and low.basis.shape == (ALIGNED, 64)
    error = (low.to_dense(64) - whole).double().norm()
    torch.testing.assert_close(error, tail, rtol=1e-2, atol=1e-3 * float(whole.norm()))
    light = torch.rand(5, 64, 3)
    direct = torch.einsum("sm,fmc->fsc", low.to_dense(64), light)
    by_terms = torch.einsum("sk,fkc->fsc", low.values.float(), slices.project(light, low)[:, low.terms[0].long()])
    torch.testing.assert_close(by_terms, direct, rtol=1e-4, atol=1e-5)


def test_leaned_frames_are_frames_around_the_point() -> None:
    at, frames, _ = points()
    rows = at.leaned.permute(3, 0, 1, 2)  # shape: (v, 4, 2, 3)
    normal = frames[:, 2][:, None].expand(-1, 4, -1)
    whole = torch.cat((rows, normal[:, :, None]), 2)
    one = torch.eye(3).double().expand(32, 4, 3, 3)
    torch.testing.assert_close(whole @ whole.transpose(2, 3), one, rtol=0, atol=1e-12)
    torch.testing.assert_close(whole.det(), torch.ones(32, 4).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(at.weights.sum(1), torch.ones(32).double())


def test_at_a_sampled_normal_nothing_leans() -> None:
    sampled = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3))
    at = slices.located(torch.zeros(16, 3).double(), sampled, sampled)
    best = at.weights.argmax(1)
    torch.testing.assert_close(at.weights.amax(1), torch.ones(16).double(), rtol=0, atol=1e-12)
    assert at.near[torch.arange(16), best].tolist() == list(range(16))
    rows = at.leaned.permute(3, 0, 1, 2)[torch.arange(16), best]
    torch.testing.assert_close(rows, sampled[:, :2], rtol=0, atol=1e-12)
    torch.testing.assert_close(at.twist[torch.arange(16), best], torch.zeros(16).double(), rtol=0, atol=1e-12)


def test_smallest_rotation() -> None:
    """It takes start to end, and leaves their common perpendicular alone."""
    g = torch.Generator().manual_seed(1)
    start, end = normalize(torch.randn(2, 20, 3, generator=g, dtype=torch.float64), dim=-1)
    axis = torch.linalg.cross(start, end)
    turned = slices._lean(torch.stack((start, axis), 1), start, end)
    torch.testing.assert_close(turned, torch.stack((end, axis), 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("distant", [False, True])
def test_reflected_is_the_bilinear_sum(distant: bool) -> None:
    """Against a loop over points and normals."""
    at, frames, _ = points()
    cut = slices.tabulate(SHAPE.evaluate, 4, 8, 16)
    light = torch.rand(64, 16, 3, dtype=torch.float64)
    eye = torch.tensor([0.3, 2.0, -1.0]).double()
    eye = normalize(torch.randn(3, 32, dtype=torch.float64), dim=0) if distant else eye
    got = slices.reflected(light, cut, slices.first_slice(cut, at.twist), at, eye)
    dense = cut.to_dense(16).double()
    for v in range(32):
        toward = eye[:, v] if distant else normalize(eye - at.position[:, v], dim=0)
        wanted = torch.zeros(3).double()
        for k in range(4):
            local = torch.stack((*(at.leaned[k][:, :, v] @ toward), (frames[v, 2] @ toward).abs()))
            cell = int(HemiOctahedral(8).cell(local))
            wanted += at.weights[v, k] * (dense[cell] @ light[int(at.near[v, k])])
        torch.testing.assert_close(got[v], wanted, rtol=1e-6, atol=1e-9)


def test_frames_that_jump_do_not_matter() -> None:
    """Frames of neighbouring normals jump across z = 0: a glossy point there still sees what is mirrored.

    With one lookup for all four normals, in the frame of the point, the error is more than twice as large.
    """
    n, m, normals = 64, 32, 32
    sampled = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), sampled)
    local = rotation.local_light(haar.analyse((2 + (4 * Octahedral(n).directions()[..., 0]).sin())[None]), s, m)
    cut = slices.tabulate(SHAPE.evaluate, m, 128, 256)
    g = torch.Generator().manual_seed(0)
    normal = torch.randn(16, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.01])
    frames = rotation.frames_of(normal)
    at = slices.located(torch.zeros(16, 3).double(), frames, sampled)
    toward = normalize(frames[:, 2] + torch.tensor([0.5, 0.3, 0.2]), dim=1)
    wi = HemiOctahedral(96).directions().reshape(-1, 3)
    weight = HemiOctahedral(96).solid_angles().flatten() * wi[:, 2]
    wo = torch.einsum("vkx,vx->vk", frames, toward)
    light = 2 + (4 * (wi @ frames)[..., 0]).sin()
    wanted = (SHAPE.evaluate(wi, wo[:, None]) * weight * light).sum(1, keepdim=True)

    def error(points: Located) -> float:
        got = slices.reflected(local, cut, slices.first_slice(cut, points.twist), points, toward.T)
        return float((got - wanted).norm() / wanted.norm())

    once = frames[:, None, :2].expand(-1, 4, -1, -1).permute(1, 2, 3, 0).contiguous()
    assert error(at) < 0.02
    assert error(at._replace(leaned=once)) > 2 * error(at)


def test_twists_of_an_anisotropic_shape() -> None:
    """A quarter turn of the tangent: the slice of that twist is the shape of swapped slopes, seen unturned."""
    brushed, crossed = Ward(0.1, 0.4), Ward(0.4, 0.1)
    four = slices.tabulate(brushed.evaluate, 8, 4, 64, twists=4).to_dense(64)
    plain = slices.tabulate(crossed.evaluate, 8, 4, 64, twists=1).to_dense(64)
    torch.testing.assert_close(four[16:32], plain, rtol=0, atol=2e-4)
    assert float((four[:16] - plain).norm() / plain.norm()) > 0.2
    cut = Slices(torch.zeros(64, 16, dtype=torch.int16), torch.zeros(64, 16).half(), 4)
    angles = torch.tensor([[0.0, math.pi / 2, math.pi, -math.pi / 2], [0.7, -0.7, 0.8, 3.1]])
    assert slices.first_slice(cut, angles).tolist() == [[0, 16, 32, 48], [0, 0, 16, 32]]


def test_refuses() -> None:
    with pytest.raises(ValueError, match=r"terms must be in 1\.\.16"):
        slices.tabulate(SHAPE.evaluate, 4, 4, 17)
    with pytest.raises(ValueError, match=r"rank must be in 1\.\.16"):
        slices.factorise(SHAPE.evaluate, 4, 4, 17)
    with pytest.raises(ValueError, match="finite"):
        slices.tabulate(lambda wi, wo: (wi * wo).sum(-1) * math.nan, 4, 4, 16)
