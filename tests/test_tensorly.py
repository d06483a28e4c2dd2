"""What is compressed goes to tensorly and back into a relighter: dense tensors, round trips, other ranks, the example.

Bounds: a round trip of clusters and slices is exact, that of a BRDF tensor rounds in float32; what tensorly changes
shows as radiance within the bounds that the tests derive.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorly
import torch
from tensorly.decomposition import partial_tucker
from tensorly.tucker_tensor import TuckerTensor
from torch import Tensor

import ptt
from ptt.models.clustered_transfer import WIDTH, ClusteredTransfer, ClusterTensors
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import lobes, relight, rotation, slices
from ptt.ops.octahedral import Octahedral
from ptt.ops.slices import Slices

ROOT = Path(__file__).resolve().parent.parent
LIGHT = ptt.Environment.sun_sky(radius=15.0)
ROUNDING = 1e-5  # float32, relative to the largest value


def evaluated(tucker_tensor: Any) -> Tensor:
    with tensorly.backend_context("pytorch"):
        dense: Tensor = tensorly.tucker_to_tensor(tucker_tensor)
    return dense


def decomposed(dense: Tensor, ranks: list[int], backend: str = "pytorch") -> Any:
    """A TuckerTensor of the first axes at some ranks, from either backend."""
    with tensorly.backend_context(backend):
        given = dense if backend == "pytorch" else dense.numpy()
        fit, _ = partial_tucker(given, rank=ranks, modes=list(range(len(ranks))))
    return fit


def radiance(model: ptt.TransferModel) -> Tensor:
    eye = torch.tensor([1.5, 2.0, 3.0])
    found: Tensor = ptt.TransferRelighter(model, compiled=False)(LIGHT, {}, eye)
    return found


def close(got: Tensor, wanted: Tensor, bound: float = ROUNDING) -> None:
    largest = float(wanted.abs().max()) if wanted.numel() else 0.0
    torch.testing.assert_close(got, wanted, rtol=0, atol=bound * largest)


@pytest.fixture(scope="module")
def coarse() -> TensorBRDF:
    """On few texels, which tensorly decomposes in a second."""
    return TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((4.0, 8.0, 16.0, 32.0)), (3, 10, 10), separated=0, resolution=12)


@pytest.fixture(scope="module")
def coarse_model(small_raw: ptt.RawTransfer, coarse: TensorBRDF) -> ptt.TransferModel:
    return ptt.compress(small_raw, 64, coarse, clusters=None)


# The BRDF tensor.


@pytest.mark.parametrize("which", ["coarse", "glossy"])
def test_brdf_is_what_it_evaluates_to(which: str, request: pytest.FixtureRequest) -> None:
    """f at the centres of texels, where lookups do not interpolate, without lobes, times the roots of the angles."""
    fixture = request.getfixturevalue(which)
    brdf: TensorBRDF = fixture if which == "coarse" else fixture[0]
    d = brdf.texels.directions
    roots = brdf.texels.roots
    dense = evaluated(brdf.to_tensorly())
    assert dense.shape == (len(brdf.space.samples), len(d), len(d))
    for h, shape in enumerate(brdf.space.samples):
        values = brdf.evaluate(shape, d, d[:, None])
        reflected = lobes.lookup(brdf.lobe_tables(shape), d)[..., None]
        values = values - lobes.evaluate(reflected, brdf.axes, d, d[:, None], brdf.angles)
        close(dense[h], values * roots * roots[:, None], 1e-4 if brdf.angles else ROUNDING)  # peaks cancel


def test_brdf_factors_of_directions_are_orthonormal(coarse: TensorBRDF) -> None:
    for factor in coarse.to_tensorly().factors[1:]:
        torch.testing.assert_close(factor.T @ factor, torch.eye(factor.shape[1]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("which", ["coarse_model", "small_model", "clustered_model"])
def test_brdf_round_trip(which: str, request: pytest.FixtureRequest) -> None:
    model: ptt.TransferModel = request.getfixturevalue(which)
    back = model.brdf.with_tensorly(model.brdf.to_tensorly())
    for name, buffer in model.brdf.named_buffers():
        close(back.get_buffer(name), buffer)
    close(radiance(model.with_parts(brdf=back)), radiance(model))


@pytest.mark.parametrize("backend", ["pytorch", "numpy"])
@pytest.mark.parametrize("ranks", [[3, 10, 10], [3, 6, 6], [2, 5, 10], [4, 12, 5]])
def test_brdf_at_other_ranks(coarse_model: ptt.TransferModel, ranks: list[int], backend: str) -> None:
    """Radiance changes by at most  k_s |U| max over o of |dA[o]| / root[o].

    In the direction wo the tensor has the coefficients a(wo) in orthonormal incident factors, and B = k_s a(wo) . U.
    Their change is a row dA[o] of the dense tensor's, over the root of the outgoing angle, or between several such
    rows: so is that of B, by Cauchy and Schwarz. U is the light that the relighter finds in the incident factors.
    """
    brdf = coarse_model.brdf
    dense = evaluated(brdf.to_tensorly())
    new = brdf.with_tensorly(decomposed(dense, ranks, backend))
    material = ptt.blinn_phong(0.3, 0.4, 12.0)
    assert material.shape is not None
    mixture = brdf.space.coordinates(material.shape).float()
    change = torch.einsum("h,hoi->oi", mixture, evaluated(new.to_tensorly()) - dense)
    row = float((change.norm(dim=1) / brdf.texels.roots).max())
    before = radiance(coarse_model)
    model = coarse_model.with_parts(brdf=new)
    difference = (radiance(model) - before).abs()
    incident = ptt.TransferRelighter(coarse_model).incident(LIGHT)  # shape: (c, 1 + i, v)
    bound = 0.4 * row * incident[:, 1:].norm(dim=1).T
    assert bool((difference <= bound + ROUNDING * float(before.max())).all())
    if ranks[1] >= 10 and ranks[2] >= 10:
        close(before + difference, before, 1e-4)  # nothing is lost
    else:
        assert (
            float((difference / bound)[difference > 0.1 * difference.max()].max()) > 0.05
        )  # the bound is no formality
    floor = slice(*coarse_model.receivers.spans[0])
    assert float(difference[floor].max()) == 0  # a matt region has no share in it


def test_brdf_error_is_a_bound(coarse: TensorBRDF) -> None:
    """Of a space without lobes, against the samples themselves."""
    new = coarse.with_tensorly(decomposed(evaluated(coarse.to_tensorly()), [2, 6, 6]))
    d = coarse.texels.directions
    roots = coarse.texels.roots
    for h, shape in enumerate(coarse.space.samples):
        exact = shape.evaluate(d, d[:, None]) * roots * roots[:, None]
        got = evaluated(new.to_tensorly())[h]
        reached = float((got - exact).norm() / exact.norm())
        assert reached <= float(new.error[h]) <= 3 * reached


def test_brdf_of_fewer_factors_with_lobes_and_bounces(clustered_model: ptt.TransferModel) -> None:
    """By the core alone, which is as good as the dense tensor, because the factors of directions are orthonormal."""
    core, (samples, outgoing, incident) = clustered_model.brdf.to_tensorly()
    before = radiance(clustered_model)
    errors = []
    for rank in (8, 7, 6, 4, 2):
        with tensorly.backend_context("pytorch"):
            small = tensorly.tenalg.mode_dot(core, samples, 0)
            (new, (h, o, i)), _ = partial_tucker(small, rank=[3, rank, rank], modes=[0, 1, 2])
        brdf = clustered_model.brdf.with_tensorly((new, [h, outgoing @ o, incident @ i]))
        assert brdf.core.shape == (3, rank, rank)
        errors.append(ptt.relative_rmse(radiance(clustered_model.with_parts(brdf=brdf)), before))
    assert errors[0] < ROUNDING
    assert errors[0] < errors[1] < errors[2] < errors[3] < 0.05


def test_brdf_is_differentiable(coarse_model: ptt.TransferModel) -> None:
    """Radiance follows a TuckerTensor's core, linearly: the derivative along the core itself is the specular part."""
    core, factors = coarse_model.brdf.to_tensorly()
    core = core.clone().requires_grad_()
    model = coarse_model.with_parts(brdf=coarse_model.brdf.with_tensorly((core, factors)))
    with_all = radiance(model).sum()
    with_all.backward()
    none = coarse_model.brdf.with_tensorly((torch.zeros_like(core), factors))
    without = radiance(coarse_model.with_parts(brdf=none)).sum()
    assert core.grad is not None
    assert float((core.grad * core).detach().sum()) == pytest.approx(float((with_all - without).detach()), rel=1e-3)


def test_a_model_takes_only_tensors_that_fit(
    coarse_model: ptt.TransferModel, glossy: tuple[TensorBRDF, object]
) -> None:
    brdf = coarse_model.brdf
    with pytest.raises(ValueError, match="brdf must be of the model's space"):
        coarse_model.with_parts(brdf=glossy[0])
    core, (samples, outgoing, incident) = brdf.to_tensorly()
    other = torch.linalg.qr(torch.randn(incident.shape, generator=torch.Generator().manual_seed(0)))[0]
    with pytest.raises(ValueError, match="brdf must have incident factors that those of the model combine to"):
        coarse_model.with_parts(brdf=brdf.with_tensorly((core, [samples, outgoing, other])))
    coarse_model.with_parts(brdf=brdf.with_tensorly((core, [samples, other, incident])))  # the view step has its own
    for wrong, message in [
        ((core, [samples, outgoing]), r"brdf must be a TuckerTensor of shape \(4, 112, 112\)"),
        ((core, [samples, outgoing, incident[1:]]), r"brdf must be a TuckerTensor of shape"),
        ((core[:, :3], [samples, outgoing, incident]), r"got factors .* and a core \(3, 3, 10\)"),
        ((core * torch.inf, [samples, outgoing, incident]), "brdf must be finite"),
        (torch.zeros(4, 112, 112), r"a pair \(core, factors\), got Tensor"),
        (None, r"a pair \(core, factors\), got NoneType"),
    ]:
        with pytest.raises(ValueError, match=message):
            brdf.with_tensorly(wrong)


# Clusters.


def of_points(region: ClusteredTransfer, name: str) -> list[Tensor]:
    """T0 (m, 1 + i), T1 (l', q, s) or T2 (l'', pairs) of every point, one eigen-point after the other."""
    e = region.eigenvectors
    found = []
    for place in region.place.tolist():
        block = place // WIDTH
        k = int(region.cluster[block])
        weights = region.weights[block, :, place % WIDTH]
        direct = region.direct[k].float().unflatten(1, (e, -1))
        one = region.lighting[k] @ region.one[k].float()
        one = one.unflatten(1, (len(region.slots), e, 16))
        two = region.two[k].float().unflatten(1, (len(region.pairs), e))
        eigen = {"direct": direct.movedim(1, 0), "one": one.movedim(2, 0), "two": two.movedim(2, 0)}[name]
        found.append(torch.stack([w * values for w, values in zip(weights, eigen, strict=True)]).sum(0))
    return found


@pytest.mark.parametrize("name", ["floor", "ball"])
def test_clusters_are_what_their_points_receive(clustered_model: ptt.TransferModel, name: str) -> None:
    region = clustered_model.by_region[name]
    clusters = region.to_tensorly()
    assert sorted(torch.cat([region.rows(k) for k in range(region.clusters)]).tolist()) == list(range(region.points))
    for part in ClusterTensors._fields:
        wanted = of_points(region, part)
        for k, tensors in enumerate(clusters):
            close(evaluated(getattr(tensors, part)), torch.stack([wanted[v] for v in region.rows(k).tolist()]))


def test_clusters_receive_the_light_that_the_light_step_finds(clustered_model: ptt.TransferModel) -> None:
    """Some lighting times the dense T0, and the same by eigen-points and weights of points."""
    region = clustered_model.by_region["ball"]
    lighting = torch.rand(3, clustered_model.grid.cells, generator=torch.Generator().manual_seed(0))
    u = relight.light_eigen(region.direct, lighting, region.columns).unflatten(2, (region.eigenvectors, -1))
    sent = relight.expand(u, region.weights, region.cluster).values  # shape: (b, c, 1 + i, w)
    of_all = sent.permute(0, 3, 1, 2).flatten(0, 1)[region.place]
    for k, tensors in enumerate(region.to_tensorly()):
        light = lighting[:, region.columns[k]]
        close(torch.einsum("vmi,cm->vci", evaluated(tensors.direct), light), of_all[region.rows(k)])


@pytest.mark.parametrize("storage", [torch.float32, torch.float16, torch.bfloat16])
def test_clusters_round_trip_to_the_bit(
    small_bounced: ptt.RawTransfer, glossy: tuple[TensorBRDF, ptt.BRDFBasis], storage: torch.dtype
) -> None:
    model = ptt.compress(small_bounced, 64, *glossy, ptt.Clusters(60, 6, 20, 96, storage))
    regions = {name: region.with_tensorly(region.to_tensorly()) for name, region in model.by_region.items()}
    for name, region in regions.items():
        for part, buffer in model.by_region[name].named_buffers():
            assert torch.equal(region.get_buffer(part), buffer), part
            assert region.get_buffer(part).is_contiguous()
    assert torch.equal(radiance(model.with_parts(regions=regions)), radiance(model))


def truncated(tensors: ClusterTensors, rank: int) -> ClusterTensors:
    """A cluster with fewer eigen-points, the best for its T0, T1 and T2 together."""
    given = [t for t in tensors if t is not None]
    with tensorly.backend_context("pytorch"):
        rows = torch.cat([tensorly.tucker_to_tensor(t).flatten(1) for t in given], 1)
        (_, (points,)), _ = partial_tucker(rows, rank=[min(rank, len(rows))], modes=[0])
        cores = [tensorly.tenalg.mode_dot(t.core, points.T @ t.factors[0], 0) for t in given]
    pairs = zip(cores, given, strict=True)
    return ClusterTensors(*(TuckerTensor((core, [points, *t.factors[1:]])) for core, t in pairs))


def fewer(region: ClusteredTransfer, rank: int) -> ClusteredTransfer:
    return region.with_tensorly([truncated(tensors, rank) for tensors in region.to_tensorly()])


def stacked(tensors: ClusterTensors) -> Tensor:
    """All that a cluster's points receive, a row each, float64."""
    return torch.cat([evaluated(t).flatten(1) for t in tensors if t is not None], 1).double()


def test_truncated_clusters(clustered_model: ptt.TransferModel) -> None:
    """Error grows with every eigen-point that is left out; it is the tail of singular values, and seen as radiance."""
    region = clustered_model.by_region["ball"]
    whole = [stacked(tensors) for tensors in region.to_tensorly()]
    spectra = [torch.linalg.svdvals(rows) for rows in whole]
    before = radiance(clustered_model)
    errors = []
    shown = []
    for rank in (8, 7, 5, 2, 1):
        low = fewer(region, rank)
        assert low.eigenvectors == rank
        pairs = zip(whole, low.to_tensorly(), strict=True)
        errors.append(sum(float((rows - stacked(new)).square().sum()) for rows, new in pairs))
        tail = sum(float(values[rank:].square().sum()) for values in spectra)
        assert errors[-1] == pytest.approx(tail, rel=1e-3, abs=1e-8)
        shown.append(ptt.relative_rmse(radiance(clustered_model.with_parts(regions={"ball": low})), before))
    assert errors == sorted(errors)
    assert shown[0] < ROUNDING
    assert shown[0] < shown[1] < shown[2] < shown[3]
    assert [8 * low.get_buffer(name).numel() for name in ("weights", "direct", "one", "two")] == [
        region.get_buffer(name).numel() for name in ("weights", "direct", "one", "two")
    ]


def test_factors_of_points_may_differ(clustered_model: ptt.TransferModel) -> None:
    """T0 truncated alone: T1 and T2 stay, and one factor spans both, no larger than the old one."""
    region = clustered_model.by_region["ball"]
    clusters = [t._replace(direct=truncated(ClusterTensors(t.direct), 4).direct) for t in region.to_tensorly()]
    new = region.with_tensorly(clusters)
    assert new.eigenvectors == region.eigenvectors
    for old, given, tensors in zip(region.to_tensorly(), clusters, new.to_tensorly(), strict=True):
        close(evaluated(tensors.direct), evaluated(given.direct))
        close(evaluated(tensors.one), evaluated(old.one))
        close(evaluated(tensors.two), evaluated(old.two))


def test_every_cluster_may_have_ranks_of_its_own(clustered_model: ptt.TransferModel) -> None:
    """Fewer eigen-points, fewer lighting dimensions, no identities: clusters are padded to the highest ranks."""
    region = clustered_model.by_region["ball"]
    old = region.to_tensorly()
    small = truncated(old[0], 3)
    one = decomposed(evaluated(small.one), [3, 6, 1, 16])
    direct = decomposed(evaluated(small.direct), [3, 27, 9])
    new = region.with_tensorly([small._replace(one=one, direct=direct), *old[1:]])
    assert (new.eigenvectors, new.lighting.shape[2]) == (region.eigenvectors, region.lighting.shape[2])
    close(evaluated(new.to_tensorly()[0].one), evaluated(one))
    close(evaluated(new.to_tensorly()[0].direct), evaluated(direct))
    for was, now in zip(old[1:], new.to_tensorly()[1:], strict=True):
        close(evaluated(now.one), evaluated(was.one), 0.0)
    lower = region.with_tensorly(
        [truncated(t, 3)._replace(one=decomposed(evaluated(t.one), [3, 6, 1, 16])) for t in old]
    )
    assert lower.lighting.shape[2] == 6 and lower.eigenvectors <= 6


def test_large_factors_of_points_fit_16_bits(
    small_bounced: ptt.RawTransfer, glossy: tuple[TensorBRDF, ptt.BRDFBasis]
) -> None:
    """A factor a million times as large: cores would vanish in float16, were the two not brought back to about 1."""
    model = ptt.compress(small_bounced, 64, *glossy, ptt.Clusters(60, 6, 20, 96, torch.float16))
    region = model.by_region["ball"]
    scaled = []
    for tensors in region.to_tensorly():
        given = [t for t in tensors if t is not None]
        larger = (TuckerTensor((t.core / 2**20, [t.factors[0] * 2**20, *t.factors[1:]])) for t in given)
        scaled.append(ClusterTensors(*larger))
    back = region.with_tensorly(scaled)
    for name, buffer in region.named_buffers():
        assert torch.equal(back.get_buffer(name), buffer), name


def test_direct_light_alone(small_raw: ptt.RawTransfer, glossy: tuple[TensorBRDF, ptt.BRDFBasis]) -> None:
    """Nothing bounces: T1 and T2 are None, at any rank of T0."""
    model = ptt.compress(small_raw, 64, *glossy, ptt.Clusters(60, 8, 32, 128))
    region = model.by_region["ball"]
    clusters = region.to_tensorly()
    assert all(t.one is None and t.two is None for t in clusters)
    low = fewer(region, 5)
    assert low.eigenvectors == 5
    assert ptt.relative_rmse(radiance(model.with_parts(regions={"ball": low})), radiance(model)) < 0.05
    with pytest.raises(ValueError, match="one of cluster 0 must be None"):
        region.with_tensorly([t._replace(one=t.direct) for t in clusters])


def test_a_changed_model_is_saved_and_moved(clustered_model: ptt.TransferModel, tmp_path: Path) -> None:
    regions = {name: fewer(region, 5) for name, region in clustered_model.by_region.items()}
    core, (samples, outgoing, incident) = clustered_model.brdf.to_tensorly()
    brdf = clustered_model.brdf.with_tensorly((core[:2, :5], [samples[:, :2], outgoing[:, :5], incident]))
    model = clustered_model.with_parts(brdf, regions)
    model.save(tmp_path / "model.safetensors")
    loaded = ptt.TransferModel.load(tmp_path / "model.safetensors")
    assert torch.equal(radiance(loaded), radiance(model))
    assert loaded.by_region["ball"].eigenvectors == 5


def test_regions_that_do_not_fit(clustered_model: ptt.TransferModel, small_model: ptt.TransferModel) -> None:
    regions = clustered_model.by_region
    ball = regions["ball"].to_tensorly()
    with pytest.raises(ValueError, match=r"clusters must be the \d+ of the region, got 1"):
        regions["ball"].with_tensorly(ball[:1])
    with pytest.raises(ValueError, match="one of cluster 0 must be a TuckerTensor, a pair"):
        regions["ball"].with_tensorly([t._replace(one=None) for t in ball])
    with pytest.raises(ValueError, match="direct of cluster 1 must be a TuckerTensor of shape"):
        regions["ball"].with_tensorly([ball[0], ball[0], *ball[2:]])
    with pytest.raises(ValueError, match="no clusters of a region dragon; there are floor, ball"):
        clustered_model.with_parts(regions={"dragon": regions["ball"]})
    with pytest.raises(ValueError, match="clusters must have the points, slots, pairs and factors"):
        clustered_model.with_parts(regions={"floor": regions["ball"]})
    with pytest.raises(ValueError, match="no clusters of a region ball; there are none"):
        small_model.with_parts(regions={"ball": regions["ball"]})


# Slices.

SHAPE = ptt.BlinnPhong(20.0)
KINDS: dict[str, Callable[[], Slices]] = {
    "table": lambda: slices.tabulate(SHAPE.evaluate, 8, 16, 20),
    "whole table": lambda: slices.tabulate(SHAPE.evaluate, 8, 16, 64),
    "factorised": lambda: slices.factorise(SHAPE.evaluate, 8, 16, 6),
    "all products": lambda: slices.factorise(SHAPE.evaluate, 8, 16, 64),
    "brushed": lambda: slices.tabulate(ptt.Ward(0.2, 0.6).evaluate, 8, 8, 20, twists=4),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


def seen(cut: Slices, light: Tensor) -> Tensor:
    """What 32 points with random frames reflect of local light (64, 64, 3)."""
    g = torch.Generator().manual_seed(0)
    frames = rotation.frames_of(torch.randn(32, 3, generator=g, dtype=torch.float64)).float()
    sampled = rotation.frames_of(Octahedral(8).directions().reshape(-1, 3)).float()
    at = slices.located(torch.randn(32, 3, generator=g), frames, sampled)
    first = slices.first_slice(cut, at.twist)
    return slices.reflected(slices.project(light, cut), cut, first, sampled, at, torch.tensor([0.3, 2.0, -1.0]))


def local_light() -> Tensor:
    return torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(1))


@every_kind
def test_slices_are_their_dense_table_and_come_back(kind: str) -> None:
    """Values in 16 bits stay: a table comes back whole, its terms in another order; a basis is rounded in float32."""
    cut = KINDS[kind]()
    dense = cut.to_dense(64)
    torch.testing.assert_close(evaluated(cut.to_tensorly(64)), dense, rtol=0, atol=0)
    back = cut.with_tensorly(cut.to_tensorly(64))
    assert (back.values.shape, back.views, back.twists) == (cut.values.shape, cut.views, cut.twists)
    assert (back.basis is None) == (cut.basis is None)
    close(back.to_dense(64), dense, 0.0 if cut.basis is None else 1e-6)
    close(seen(back, local_light()), seen(cut, local_light()))


@every_kind
@pytest.mark.parametrize("backend", ["pytorch", "numpy"])
def test_slices_at_other_ranks(kind: str, backend: str) -> None:
    """Radiance changes by at most  max over o of |dF[o]|  times  max over k of |L[k]|.

    B is the mean, with weights that sum to 1, of F[o(k)] . L[k] at four normals k: by Cauchy and Schwarz. dF holds what
    tensorly left out and the rounding of values to 16 bits, 2^-11 of each: together the difference of dense tables.
    """
    cut = KINDS[kind]()
    dense = cut.to_dense(64)
    light = local_light()
    before = seen(cut, light)
    errors = []
    for rank in (24, 12, 6, 3):
        given = decomposed(dense, [rank, rank], backend)
        new = cut.with_tensorly(given)
        assert new.basis is not None and new.values.shape[1] == -(-rank // slices.ALIGNED) * slices.ALIGNED
        wanted = torch.as_tensor(np.asarray(evaluated([torch.as_tensor(given[0]), [*map(torch.as_tensor, given[1])]])))
        rounded = (new.to_dense(64) - wanted).norm(dim=1) <= 2**-11 * wanted.norm(dim=1) + 1e-6
        assert bool(rounded.all())
        change = (new.to_dense(64) - dense).norm(dim=1).max()
        difference = (seen(new, light) - before).abs().amax(0)
        bound = change * light.norm(dim=1).amax(0)
        assert bool((difference <= bound + ROUNDING * before.abs().max()).all())
        errors.append(float((new.to_dense(64) - dense).norm()))
    tails = [float(torch.linalg.svdvals(dense.double())[r:].square().sum().sqrt()) for r in (24, 12, 6, 3)]
    assert errors == pytest.approx(tails, rel=0.02, abs=1e-3 * float(dense.norm()))  # Eckart and Young; 16 bits


def test_an_edited_table_stays_a_table() -> None:
    """At full rank: half of the table, its terms the same."""
    cut = KINDS["table"]()
    core, factors = cut.to_tensorly(64)
    half = cut.with_tensorly((core / 2, factors))
    assert half.basis is None and half.values.shape == cut.values.shape
    torch.testing.assert_close(half.to_dense(64), cut.to_dense(64) / 2, rtol=1e-3, atol=1e-7)  # subnormal in 16 bits


def test_products_of_any_scale_fit_16_bits() -> None:
    cut = KINDS["factorised"]()
    core, (rows, columns) = cut.to_tensorly(64)
    back = cut.with_tensorly((core, [rows * 1e8, columns / 1e8]))
    close(back.to_dense(64), cut.to_dense(64), 1e-3)


def test_slices_that_do_not_fit() -> None:
    table = KINDS["table"]()
    low = KINDS["factorised"]()
    core, factors = low.to_tensorly(64)
    with pytest.raises(ValueError, match=r"slices must be a TuckerTensor of shape \(256, 64\)"):
        low.with_tensorly((core, [factors[0], factors[1][:32]]))
    with pytest.raises(ValueError, match=r"slices must have more than \d+ cells, the last term, got 16"):
        table.with_tensorly((core, [factors[0], factors[1][:16]]))
    with pytest.raises(ValueError, match="at most 65504"):
        low.with_tensorly((core * 1e8, factors))


# All of them.


def test_the_backend_stays(coarse: TensorBRDF, clustered_model: ptt.TransferModel) -> None:
    """Conversions work under any backend and set none."""
    for backend in ("numpy", "pytorch"):
        with tensorly.backend_context(backend):
            coarse.with_tensorly(coarse.to_tensorly())
            region = clustered_model.by_region["ball"]
            region.with_tensorly(region.to_tensorly())
            cut = KINDS["factorised"]()
            cut.with_tensorly(cut.to_tensorly(64))
            assert tensorly.get_backend() == backend


def test_tensorly_is_imported_on_demand() -> None:
    code = "import sys, ptt; sys.exit('tensorly' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0


def test_the_example_runs() -> None:
    """docs/tensorly.md has one block of code."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "tensorly.md").read_text(), re.DOTALL)
    exec(compile(code, "docs/tensorly.md", "exec"), {})
