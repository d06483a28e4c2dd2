"""BRDF slices against the integral they stand for."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.materials.shapes import GGX, BlinnPhong, Ward
from ptt.ops import haar, rotation, slices
from ptt.ops.albedo import albedo
from ptt.ops.octahedral import HemiOctahedral, Octahedral, corners, hemi_octahedral
from ptt.ops.slices import ALIGNED, NormalLookup, Slices

SHAPE = BlinnPhong(20.0)


def points(count: int = 32, normals: int = 8, seed: int = 0) -> tuple[NormalLookup, Tensor, Tensor]:
    """Points with random frames, among the sampled frames of normals x normals."""
    g = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))
    frames = q * q.det().sign()[:, None, None]
    sampled = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
    return slices.located(torch.randn(count, 3, generator=g).double(), frames, sampled), frames, sampled


@pytest.mark.parametrize("shape", [SHAPE, Ward(0.3, 0.6)])
def test_all_terms_are_the_integral(shape: BlinnPhong | Ward) -> None:
    """Every coefficient kept: slice times local light is the integral of light x BRDF x cosine, light being bilinear
    between the centres of cells."""
    m = 8
    views = 4
    cut = slices.tabulate(shape.evaluate, m, views, m * m, 1 if shape.isotropic else 2)
    light = torch.rand(m, m, dtype=torch.float64)
    fine = HemiOctahedral(m * 32)
    wi = fine.directions().reshape(-1, 3)
    index, weights = corners(hemi_octahedral(wi), m, wrap=False)
    lit = (light.flatten()[index] * weights).sum(1) * fine.solid_angles().flatten() * wi[:, 2]
    wo = HemiOctahedral(views).directions().reshape(-1, 1, 3)
    wanted = (shape.evaluate(wi, wo) * lit).sum(1)
    got = cut.to_dense(m * m).double() @ haar.analyse(light).flatten()
    torch.testing.assert_close(got[: views * views], wanted, rtol=3e-3, atol=1e-4)  # values are float16


@pytest.mark.parametrize("roughness", [0.03, 0.1, 0.2, 0.3, 0.6])
def test_no_lobe_falls_between_samples(roughness: float) -> None:
    """Even light is reflected as the albedo says, however narrow the lobe, and mirror images are looked at alike."""
    shape = GGX(0.04, roughness)
    views = 16
    cut = slices.tabulate(shape.evaluate, 32, views, 32 * 32)
    even = haar.analyse(torch.ones(32, 32, dtype=torch.float64)).flatten()
    wo = HemiOctahedral(views).directions().reshape(-1, 3)
    at = wo[:, 2] > 0.1
    got = (cut.to_dense(32 * 32).double() @ even)[at]
    torch.testing.assert_close(got, albedo(shape.evaluate, wo[at]), rtol=1e-2, atol=2e-4)


def test_half_of_the_twists_are_the_others_again() -> None:
    shape = Ward(0.2, 0.5)
    whole, half = (slices.tabulate(shape.evaluate, 8, 4, 16, 6, even) for even in (False, True))
    torch.testing.assert_close(half.to_dense(64), whole.to_dense(64), rtol=0, atol=1e-3)


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


@pytest.mark.parametrize("views", [1, 5, 8])
def test_mirror_images_are_what_sampling_gives(views: int) -> None:
    """An isotropic shape tabulated as if it were anisotropic, at one twist of two, is sampled everywhere."""
    eighth = slices.tabulate(SHAPE.evaluate, 8, views, 64)
    everywhere = slices.tabulate(SHAPE.evaluate, 8, views, 64, twists=2)
    assert len(everywhere.terms) == 2 * views**2 == 2 * len(eighth.terms)
    whole = everywhere.to_dense(64)[: views**2]
    torch.testing.assert_close(eighth.to_dense(64), whole, rtol=0, atol=1e-3 * float(whole.max()))


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


def test_at_a_sampled_normal_all_weight_is_on_it() -> None:
    sampled = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3))
    at = slices.located(torch.zeros(16, 3).double(), sampled, sampled)
    best = at.weights.argmax(0)
    torch.testing.assert_close(at.weights.amax(0), torch.ones(16).double(), rtol=0, atol=1e-12)
    assert at.near[best, torch.arange(16)].tolist() == list(range(16))
    torch.testing.assert_close(at.twist[best, torch.arange(16)], torch.zeros(16).double(), rtol=0, atol=1e-12)


def test_smallest_rotation() -> None:
    """It takes start to end, and leaves their common perpendicular alone."""
    g = torch.Generator().manual_seed(1)
    start, end = normalize(torch.randn(2, 20, 3, generator=g, dtype=torch.float64), dim=-1)
    axis = torch.linalg.cross(start, end)
    for d, wanted in ((start, end), (axis, axis)):
        torch.testing.assert_close(slices._leaned(d, start, end), wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("distant", [False, True])
def test_reflected_is_the_bilinear_sum(distant: bool) -> None:
    """Against a loop over points and normals; where the point mirrors the viewer, each of its normals does."""
    at, frames, sampled = points()
    cut = slices.tabulate(SHAPE.evaluate, 4, 8, 16)
    light = torch.rand(64, 16, 3, dtype=torch.float64)
    eye = torch.tensor([0.3, 2.0, -1.0]).double()
    eye = normalize(torch.randn(3, 32, dtype=torch.float64), dim=0) if distant else eye
    got = slices.reflected(light, cut, slices.first_slice(cut, at.twist), sampled, at, eye)
    dense = cut.to_dense(16).double()
    for v in range(32):
        toward = eye[:, v] if distant else normalize(eye - at.position[:, v], dim=0)
        normal = frames[v, 2]
        if normal @ toward < 0:
            toward = toward - 2 * (normal @ toward) * normal
        mirrored = 2 * (normal @ toward) * normal - toward
        wanted = torch.zeros(3).double()
        for k in range(4):
            frame = sampled[at.near[k, v]]
            local = frame @ (2 * (frame[2] @ mirrored) * frame[2] - mirrored)
            cell = int(HemiOctahedral(8).cell(local))  # that of the mirror image, below the horizon
            wanted += at.weights[k, v] * (dense[cell] @ light[int(at.near[k, v])])
        torch.testing.assert_close(got[v], wanted, rtol=1e-6, atol=1e-9)


def test_a_highlight_between_normals_stays_one() -> None:
    """A glossy point halfway between sampled normals, anywhere on the sphere, shows the light where it mirrors it.

    A small light that each point mirrors to its viewer: radiance is within a fifth of the quadrature's. Looking up the
    viewer's own direction at each normal, as if it were the point's, loses more than twice as much.
    """
    n = 64
    m = 32
    normals = 16
    shape = BlinnPhong(200.0)
    sampled = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), sampled)
    g = torch.Generator().manual_seed(0)
    frames = rotation.frames_of(torch.randn(16, 3, generator=g, dtype=torch.float64))
    normal = frames[:, 2]
    toward = normalize(normal + 0.7 * torch.randn(16, 3, generator=g, dtype=torch.float64), dim=1)
    toward = torch.where(((toward * normal).sum(1) < 0.4)[:, None], normal, toward)
    mirrored = 2 * (toward * normal).sum(1, keepdim=True) * normal - toward
    at = slices.located(torch.zeros(16, 3).double(), frames, sampled)
    cut = slices.tabulate(shape.evaluate, m, 128, 256)
    wi = HemiOctahedral(128).directions().reshape(-1, 3)
    weight = HemiOctahedral(128).solid_angles().flatten() * wi[:, 2]
    errors = []
    for v in range(16):
        light = (20 * (Octahedral(n).directions() @ mirrored[v] - 1)).exp()
        local = rotation.local_light(haar.analyse(light[None]), s, m)
        first = slices.first_slice(cut, at.twist)
        got = slices.reflected(local, cut, first, sampled, at, toward.T)[v]
        f = shape.evaluate(wi, (frames[v] @ toward[v]).expand_as(wi))
        wanted = (f * weight * (20 * ((wi @ frames[v]) @ mirrored[v] - 1)).exp()).sum()
        errors.append(abs(float(got / wanted) - 1))
    assert max(errors) < 0.1


def test_twists_of_an_anisotropic_shape() -> None:
    """A quarter turn of the tangent: the slice of that twist is the shape of swapped slopes, seen unturned."""
    brushed = Ward(0.1, 0.4)
    crossed = Ward(0.4, 0.1)
    four = slices.tabulate(brushed.evaluate, 8, 4, 64, twists=4).to_dense(64)
    plain = slices.tabulate(crossed.evaluate, 8, 4, 64, twists=2).to_dense(64)[:16]
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
