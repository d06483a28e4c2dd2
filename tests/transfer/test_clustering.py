"""Models with clusters, and how they are relit: the equations, their limits, degenerate scenes and the path tracer."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import ptt
from ptt.models import slots
from ptt.models.indirect import COARSE, blurs, responses
from ptt.ops import haar, harmonics, lobes, mesh, octahedral, plain
from ptt.ops.sphere import Cube
from ptt.scene.parts import Part
from ptt.transfer.assembly import Transfer
from ptt.transfer.bounces import CUTS, Bounces
from ptt.transfer.clustering import _eigenvectors_for, _RegionTransfer

SKY = ptt.Environment(
    nn.functional.avg_pool2d(ptt.Environment.sun_sky(radius=10.0).map.movedim(-1, 0), 8).movedim(0, -1)
)
EYE = torch.tensor([1.0, 2.0, 3.0])
Functions = tuple[ptt.TensorBRDF, ptt.BRDFBasis]


@pytest.fixture()
def relighter(clustered_model: ptt.TransferModel) -> ptt.TransferRelighter:
    return ptt.TransferRelighter(clustered_model, compiled=False)


def model_of(
    parts: Sequence[Part], functions: Functions, bounces: int = 2, index: Tensor | None = None, **clusters: Any
) -> ptt.TransferModel:
    raw = ptt.precompute(ptt.Scene.from_parts(parts), bounces, resolution=8, rays=64, index=index)
    return ptt.compress(
        raw, 32, *functions, ptt.Clusters(**{"points": 60, "eigenvectors": 8, "storage": torch.float32, **clusters})
    )


def plane(name: str, height: float, cells: int = 3, **fields: Any) -> Part:
    vertices, faces = mesh.plane_mesh(2.0, cells)
    return Part(name, vertices + torch.tensor([0.0, height, 0.0]), faces, **fields)


def ball(name: str, height: float, **fields: Any) -> Part:
    vertices, faces = mesh.sphere_mesh(1, 0.5)
    return Part(name, vertices + torch.tensor([0.0, height, 0.0]), faces, **fields)


def lit(model: ptt.TransferModel, materials: Mapping[str, ptt.Material] | None = None) -> Tensor:
    """Radiance under the sky: finite."""
    radiance: Tensor = ptt.TransferRelighter(model, compiled=False)(SKY, materials or {}, EYE)
    assert radiance.shape == model.positions.shape and radiance.isfinite().all()
    return radiance


def ramp(size: int = 64) -> ptt.Environment:
    """Light that is linear in the direction, 1 from the horizon: a Gaussian's mean of it is known in closed form."""
    polar = (torch.arange(size).double() + 0.5) * (math.pi / size)
    around = torch.arange(2 * size).double() * (math.pi / size)
    turned = torch.stack([c + 0 * around for c in (around.cos(), around.sin())])
    up = polar.cos()[:, None].expand(-1, 2 * size)
    side = polar.sin()[:, None] * turned[0]
    values = torch.stack((1 + 0.5 * up, 1 - 0.3 * up + 0.4 * side, 1 + 0.6 * side), -1)
    return ptt.Environment(values.float()).rotated(x=20, y=50)


# The equations


def written_out(
    model: ptt.TransferModel, environment: ptt.Environment, materials: Mapping[str, ptt.Material], v: int
) -> Tensor:
    """Radiance (3,) of one point towards EYE by the equations of `ops.relight`, in float64, from its own T0, T1, T2."""
    own = model.receivers
    brdf = model.brdf
    basis = model.basis
    assert basis is not None
    r = next(k for k, (first, end) in enumerate(own.spans) if first <= v < end)
    region: Any = model.regions[r]
    material = materials[own.names[r]]
    block, lane = divmod(int(region.place[v - own.spans[r][0]]), region.weights.shape[2])
    k = int(region.cluster[block])
    weights = region.weights[block, :, lane].double()
    e = len(weights)
    q = len(region.slots)
    pairs = torch.tensor(region.pairs, dtype=torch.int64).reshape(-1, 2)

    light = haar.analyse(environment.project(model.grid).double().movedim(-1, 0))
    coarse = light[..., :8, :8].flatten(1).T
    t0 = torch.einsum("e,mei->im", weights, region.direct[k].double().unflatten(1, (e, -1)))
    u0 = t0 @ light.flatten(1).T[region.columns[k]]
    t1 = (
        torch.einsum("e,nqes->qsn", weights, region.one[k].double().reshape(-1, q, e, 16))
        @ region.lighting[k].double().T
    )
    t2 = torch.einsum("e,lpe->pl", weights, region.two[k].double().reshape(-1, len(pairs), e))
    h = slots.coefficients(model.slots, basis, [materials[name] for name in own.names]).double()
    arriving = torch.einsum("qc,qsl,lc->sc", h[region.slots], t1, coarse)
    arriving[0] += (h[pairs[:, 0]] * h[pairs[:, 1]] * (t2 @ region.twice.double().T @ coarse)).sum(0)
    incident = u0 + responses(brdf).double().T @ arriving

    frame = model.frames[v].double()
    wo = frame @ nn.functional.normalize(EYE - model.positions[v], dim=0).double()
    out = model.colours[v] * material.diffuse / math.pi * incident[0]
    if material.shape is None:
        return out
    specular = brdf.outgoing(wo[None].float())[:, 0].double() @ brdf.matrix(material.shape).double() @ incident[1:]
    if brdf.angles:
        axes = lobes.lean(brdf.axes.double(), wo)
        n = CUTS
        rho = lobes.lookup(brdf.lobe_tables(material.shape).double(), wo)
        cuts = region.cuts[int(region.place[v - own.spans[r][0]])].view(torch.uint8).reshape(n * n, -1)
        through = []
        blurred = []
        for k, (angle, axis) in enumerate(zip(brdf.angles, axes, strict=True)):
            cell, share = octahedral.corners(octahedral.hemi_octahedral(axis), n, wrap=False)
            through.append(share @ cuts[octahedral.tiles(n)[cell], k].double() / 255)
            towards = nn.functional.normalize(axis, dim=0) @ frame
            blurred.append(1 + lobes.zonal(angle, 2)[1] * (environment.radiance(towards[None].float())[0].double() - 1))
        mean = nn.functional.normalize(rho @ axes, dim=0)
        z = (blurs(brdf.angles) * harmonics.evaluate(mean, 4)) @ harmonics.hemispherical(4).T
        specular = specular + rho @ (torch.stack(through)[:, None] * torch.stack(blurred) + z @ arriving)
    return out + material.specular * specular


def coloured(functions: Functions) -> ptt.TransferModel:
    colours = torch.rand(16, 3, generator=torch.Generator().manual_seed(0))
    floor = plane("floor", 0.0, colours=colours, material=ptt.blinn_phong(0.8, 0.3, 5.0), editable=False)
    return model_of([floor, ball("ball", 0.6, material=ptt.blinn_phong(0.3, 0.4, 12.0))], functions, points=12)


@pytest.mark.parametrize("which", ["grey", "coloured"])
def test_the_equations_written_out(which: str, clustered_model: ptt.TransferModel, glossy: Functions) -> None:
    """To the float32 of the steps and what an octahedral map of 128 cells an edge leaves of linear light: 0.2 %."""
    model = clustered_model if which == "grey" else coloured(glossy)
    materials = {**model.receivers.materials, "ball": ptt.blinn_phong((0.1, 0.5, 0.3), (0.6, 0.4, 0.2), 23.0)}
    light = ramp()
    radiance = ptt.TransferRelighter(model, compiled=False)(light, {"ball": materials["ball"]}, EYE)
    assert any(slot.channel == 2 for slot in model.slots) == (which == "coloured")
    wo = nn.functional.normalize(EYE - model.positions, dim=1)
    seen = torch.nonzero((model.frames[:, 2] * wo).sum(1) > 0.05)[:, 0].tolist()
    for v in [*seen[:: max(1, len(seen) // 12)], seen[-1]]:
        expected = written_out(model, light, materials, v)
        assert torch.allclose(radiance[v].double(), expected, rtol=2e-3, atol=1e-4), (v, radiance[v], expected)


@pytest.fixture(scope="module")
def tiny() -> ptt.RawTransfer:
    """A ball of 42 vertices over a floor of 25."""
    scene = ptt.Scene.from_parts([plane("floor", 0.0, 4), ball("ball", 0.6)])
    return ptt.precompute(scene, 2, resolution=16, rays=64)


def test_as_many_eigenvectors_as_points_are_exact(tiny: ptt.RawTransfer, monkeypatch: pytest.MonkeyPatch) -> None:
    """One cluster a region, nothing left out: every point's own T0, to float32, under the same texels, as seen from
    directions, by which all points show their highlights."""
    lighting = haar.analyse(SKY.project(Cube(16)).movedim(-1, 0))
    monkeypatch.setattr(plain, "lighting", lambda *_: lighting)
    space = ptt.BRDFSpace.blinn_phong((2.0, 8.0, 32.0))
    brdf = ptt.TensorBRDF.fit(space, ranks=(3, 4, 4), separated=0)
    basis = ptt.BRDFBasis.fit(space, 1)
    direct = tiny.part(slice(None))
    whole = ptt.Clusters(10_000, max(tiny.receivers.counts), columns=6 * 16**2, storage=torch.float32)
    for coefficients in (64, None):
        exact, clustered = (
            ptt.TransferRelighter(ptt.compress(direct, coefficients, brdf, basis, clusters), compiled=False)(
                SKY, {}, EYE - tiny.receivers.positions
            )
            for clusters in (None, whole)
        )
        assert ptt.relative_rmse(clustered, exact) < 1e-5


@pytest.fixture(scope="module")
def assembled(tiny: ptt.RawTransfer, glossy: Functions) -> Transfer:
    return ptt.assemble(tiny, *glossy, 64)


def test_clusters_of_an_assembly_are_those_of_compress(
    assembled: Transfer, tiny: ptt.RawTransfer, glossy: Functions
) -> None:
    clusters = ptt.Clusters(30, 8, 32, 128)
    once = ptt.compress(tiny, 64, *glossy, clusters)
    twice = ptt.cluster(assembled, clusters)
    assert twice.bounces == tiny.bounces and once.truncation_error == twice.truncation_error
    for (name, a), (other, b) in zip(once.named_buffers(), twice.named_buffers(), strict=True):
        assert name == other and torch.equal(a, b), name


def test_keeping_more_is_nearer_to_the_whole(assembled: Transfer) -> None:
    """Each approximation alone, from the same transfer: less of it errs more, and never by much."""
    best = {"points": 10_000, "eigenvectors": 42, "columns": 1536, "lighting": 128, "storage": torch.float32}

    def of(**change: Any) -> Tensor:
        return lit(ptt.cluster(assembled, ptt.Clusters(**{**best, **change})))

    whole = of()
    for name, coarse, fine, bound in (("eigenvectors", 4, 16, 0.2), ("columns", 24, 192, 0.3), ("lighting", 1, 8, 0.1)):
        errors = [ptt.relative_rmse(of(**{name: size}), whole) for size in (coarse, fine)]
        assert 1e-6 < errors[1] < errors[0] / 2 and errors[0] < bound, (name, errors)


def test_storage_rounds_and_no_more(assembled: Transfer) -> None:
    """Relative roundings of 2^-11 and 2^-8 in a product of two."""
    models = {
        dtype: ptt.cluster(assembled, ptt.Clusters(30, 8, 32, 128, storage=dtype))
        for dtype in (torch.float32, torch.float16, torch.bfloat16)
    }
    exact = lit(models[torch.float32])
    for dtype, bound in ((torch.float16, 2.0**-10), (torch.bfloat16, 2.0**-7)):
        error = ptt.relative_rmse(lit(models[dtype]), exact)
        assert bound / 100 < error < bound
        stored = [b for b in models[dtype].regions.buffers() if b.dtype == dtype]
        assert len(stored) == 3 * len(models[dtype].regions) and all(b.isfinite().all() for b in stored)


@pytest.mark.parametrize("share", [1.0, 0.4, 0.1])
def test_as_many_bytes_as_are_given(share: float, assembled: Transfer) -> None:
    """Of what the clusters hold, not the points: near the bytes from below, as far as whole clusters can."""
    stored = ("columns", "direct", "lighting", "one", "two")

    def bytes_of(**clusters: Any) -> int:
        model = ptt.cluster(assembled, ptt.Clusters(eigenvectors=6, lighting=16, columns=64, **clusters))
        return sum(getattr(region, name).nbytes for region in model.clustered for name in stored)

    most = bytes_of(points=4)
    least = bytes_of(points=1000)
    limit = least + share * (most - least)
    assert 0.6 * limit < bytes_of(bytes=limit) <= limit
    assert bytes_of(bytes=least) == least
    with pytest.raises(ValueError, match=f"bytes must be at least {least}, one cluster a region, got {least - 1}"):
        bytes_of(bytes=least - 1)


def test_a_larger_error_needs_fewer_eigenvectors(assembled: Transfer) -> None:
    """And it is met: what the points' combinations span leaves no more of the features, region by region."""
    count = {}
    for error in (0.3, 0.1, 0.03):
        model = ptt.cluster(assembled, ptt.Clusters(points=30, columns=64, lighting=8, error=error))
        for r, region in enumerate(model.clustered):
            x = _RegionTransfer(assembled, r)._sketch().double()
            weights = region.weights.transpose(1, 2).flatten(0, 1)[region.place].double()
            labels = region.cluster[region.place // region.weights.shape[2]]
            left = 0.0
            for k in labels.unique():
                own = x[labels == k]
                w = weights[labels == k]
                left += float((own - w @ torch.linalg.pinv(w) @ own).square().sum())
            assert math.sqrt(left / float(x.square().sum())) < error * 1.001
        count[error] = [region.eigenvectors for region in model.clustered]
    assert sum(count[0.3]) < sum(count[0.1]) < sum(count[0.03])
    with pytest.raises(ValueError, match=r"error must be at least .* fewer points reach less"):
        _eigenvectors_for(torch.randn(80, 100), ptt.Clusters(points=80, error=0.01))


def test_light_that_arrives_after_two_reflections_alone(assembled: Transfer) -> None:
    """Points that see nothing that is lit, and beyond it something that is: pairs without slots."""
    none = torch.zeros_like(assembled.indirect.one)
    indirect = assembled.indirect
    once, twice, dark = (
        ptt.cluster(replace(assembled, indirect=part), ptt.Clusters(30, 8, 32, 128))
        for part in (indirect, indirect._replace(one=none), indirect._replace(one=none, two=0 * indirect.two))
    )
    assert all(not region.slots and region.pairs for region in twice.clustered)
    assert all(region.lighting.numel() == 0 for region in twice.clustered)
    of = [float(lit(model).mean()) for model in (dark, twice, once)]
    assert of[0] < of[1] < of[2]


def test_light_that_bounces_twice_under_a_strip_of_sky(assembled: Transfer) -> None:
    """The axes that matter most keep it: cells of a quarter of a cube's face, as in the paper, lose a quarter here."""
    raw = assembled.raw
    sky = torch.zeros(64, 128, 3)
    sky[20:24, 30:40] = 1.0
    light = haar.analyse(ptt.Environment(sky).project(Cube(raw.resolution)).movedim(-1, 0))
    coarse = light[..., :COARSE, :COARSE].flatten(1).T.contiguous()
    paths = Bounces(raw, assembled.brdf, assembled.basis, assembled.direct.coarse, assembled.cuts)
    paths.change_lighting(coarse)
    rows = torch.arange(len(raw.receivers))
    once = paths.first_bounce(rows)
    exact = paths.second_bounce(rows, once.transpose(1, 2).contiguous())
    indirect = assembled.indirect
    two = indirect.two.float() / indirect.scale
    found = two @ (indirect.axes[: two.shape[3]] @ coarse)
    assert float((found - exact).norm() / exact.norm()) < 0.1
    assert abs(float(found.sum() / exact.sum()) - 1) < 0.05


def test_memory(tiny: ptt.RawTransfer, glossy: Functions) -> None:
    """What the message asks for is enough; then T1 and T2 fill half of it, with 32 axes of lighting."""
    with pytest.raises(ValueError, match=r"67 points and 10 slots, got 1000: allow more, or make regions fixed") as got:
        ptt.compress(tiny, 32, *glossy, max_memory=1e3)
    need = float(re.findall(r"at least (\S+) for", str(got.value))[0])
    indirect = ptt.assemble(tiny, *glossy, 32, max_memory=need).indirect
    assert len(indirect.axes) == 32
    assert indirect.one.nbytes + indirect.two.nbytes == need / 2


# Light


@pytest.mark.parametrize(
    ("storage", "rounding"), [(torch.float32, 1e-4), (torch.float16, 4e-3), (torch.bfloat16, 3e-2)]
)
def test_linear_in_light_and_black_in_the_dark(storage: torch.dtype, rounding: float, assembled: Transfer) -> None:
    relighter = ptt.TransferRelighter(ptt.cluster(assembled, ptt.Clusters(30, 8, 32, 128, storage)), compiled=False)

    def of(environment: ptt.Environment) -> Tensor:
        radiance: Tensor = relighter(environment, {}, EYE)
        return radiance

    whole = of(SKY)
    for factor in (1e-6, 1e6):
        assert torch.allclose(of(SKY.scaled(factor)) / factor, whole, rtol=rounding, atol=rounding / 10)
    both = of(ptt.Environment(SKY.map + torch.arange(3.0)))
    assert torch.allclose(
        both, whole + of(ptt.Environment(0 * SKY.map + torch.arange(3.0))), rtol=rounding, atol=rounding
    )
    assert (of(ptt.Environment.constant(0.0)) == 0).all()
    spike = torch.zeros(32, 64, 3)
    spike[5, 40] = 1e5
    assert of(ptt.Environment(spike)).isfinite().all()


def test_indirect_light_is_a_polynomial_in_the_weights(relighter: ptt.TransferRelighter) -> None:
    """Two bounces between a ball and a fixed floor: the floor's radiance is a quadratic of the ball's weight."""
    count = relighter.model.receivers.counts[0]
    at = [relighter(SKY, {"ball": ptt.lambert(w)}, EYE)[:count].double() for w in (0.0, 0.3, 0.6, 0.9)]
    third = at[3] - 3 * at[2] + 3 * at[1] - at[0]
    assert third.abs().max() < 1e-5
    assert (at[3] - at[0]).max() > 1e-2  # the ball lights the floor


def test_black_materials(relighter: ptt.TransferRelighter) -> None:
    ball = slice(relighter.model.receivers.counts[0], None)
    for black in (ptt.lambert(0.0), ptt.blinn_phong(0.0, 0.0, 20.0)):
        radiance = relighter(SKY, {"ball": black}, EYE)
        assert (radiance[ball] == 0).all() and radiance.isfinite().all()
        assert (radiance[: ball.start] > 0).all()


# Caches, gradients, compiled


def test_caches_never_go_stale(relighter: ptt.TransferRelighter, small_scene: ptt.Scene) -> None:
    """Each input in turn changes, is changed in place, and is changed back; always as a fresh relighter says."""

    def check(environment: ptt.Environment, materials: dict[str, ptt.Material], view: Any) -> None:
        fresh = ptt.TransferRelighter(relighter.model, compiled=False)
        assert torch.equal(relighter(environment, materials, view), fresh(environment, materials, view))

    ball = small_scene.materials["ball"]
    other = ptt.blinn_phong(0.2, 0.1, 3.0)
    texels = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0))
    light = ptt.Environment(texels)
    eye = EYE.clone()
    check(light, {"ball": ball}, eye)
    first = relighter.incident(light)
    check(light, {"ball": other}, eye)
    assert relighter.incident(light) is first  # kept through an edit of the material
    check(light, {"ball": ptt.lambert(0.3)}, eye)
    other.diffuse[0] = 0.9
    check(light, {"ball": other}, eye)
    other.specular[1] = 0.9
    check(light, {"ball": other}, eye)
    eye[0] = -2.0
    check(light, {"ball": other}, eye)
    light.map[10] *= 3
    check(light, {"ball": other}, eye)
    assert relighter.incident(light) is not first
    check(light.rotated(y=40), {"ball": other}, eye)
    check(light, {"ball": ball}, small_scene.camera)
    assert small_scene.camera is not None
    check(light, {"ball": ball}, replace(small_scene.camera, eye=(0.0, 3.0, 0.1)))
    check(light, {"ball": ball}, small_scene.camera.toward(small_scene.vertices))
    model: Any = relighter.model
    for buffer in (model.brdf.core, model.brdf.peaks, model.basis.table, model.regions[1].direct, model.regions[0].one):
        buffer.mul_(0.5)
        check(light, {"ball": ball}, eye)
        buffer.mul_(2.0)
    check(light, {"ball": ball}, eye)


@pytest.fixture(scope="module")
def double(small_bounced: ptt.RawTransfer, glossy: Functions) -> ptt.TransferRelighter:
    clusters = ptt.Clusters(points=60, eigenvectors=4, lighting=8, columns=32)
    functions = copy.deepcopy(glossy)  # .double() turns a model's parts in place
    return ptt.TransferRelighter(ptt.compress(small_bounced, 16, *functions, clusters), compiled=False).double()


def test_gradients_reach_light_weights_and_exponent(double: ptt.TransferRelighter) -> None:
    """Against central differences: exact for the light and the weights, of which the loss is a polynomial."""
    texels = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(0))

    def loss(texels: Tensor, diffuse: Tensor, specular: Tensor, exponent: Tensor) -> Tensor:
        material = ptt.Material(diffuse, specular, ptt.BlinnPhong(exponent))
        radiance: Tensor = double(ptt.Environment(texels), {"ball": material}, EYE)
        assert radiance.dtype == torch.float64
        return radiance[::7].square().sum()

    inputs = [texels, torch.tensor([0.3, 0.2, 0.1]), torch.tensor([0.2, 0.3, 0.4]), torch.tensor(5.5)]
    leaves = [x.clone().requires_grad_() for x in inputs]
    loss(*leaves).backward()
    for k, row in enumerate([(1, 3, 0), (2,), (1,), ()]):
        moved = [[x.clone() for x in inputs] for _ in range(2)]
        moved[0][k][row] += 1e-2
        moved[1][k][row] -= 1e-2
        numeric = (loss(*moved[0]) - loss(*moved[1])) / 2e-2
        grad = leaves[k].grad
        assert grad is not None
        assert float(grad[row]) == pytest.approx(float(numeric), rel=5e-3)
    loss(*leaves).backward()  # no graph is kept from the first time


def test_inference_mode_results_do_not_leak_into_training(relighter: ptt.TransferRelighter) -> None:
    with torch.inference_mode():
        relighter(SKY, {}, EYE)
    weight = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    relighter(SKY, {"ball": ptt.Material(weight)}, EYE).sum().backward()
    assert weight.grad is not None and (weight.grad > 0).all()


def test_compiled_agrees_with_eager(clustered_model: ptt.TransferModel) -> None:
    """To what 16 bits hold: eight of the light in the eager one, eleven of what points send out in the compiled one."""
    eager, compiled = (ptt.TransferRelighter(clustered_model, compiled=c) for c in (False, True))
    for eye in ([1.0, 2.0, 3.0], [-2.0, 1.0, 0.0]):  # a region with lobes, one without
        a, b = (r(SKY, {}, torch.tensor(eye)) for r in (eager, compiled))
        assert ptt.relative_rmse(b, a) < 5e-4


# Degenerate scenes


def test_one_triangle(glossy: Functions) -> None:
    """In constant light, unoccluded: diffuse light is the albedo, exactly."""
    part = Part("t", torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]), torch.tensor([[0, 1, 2]]))
    model = model_of([part], glossy)
    assert model.regions[0].slots == [] and model.regions[0].pairs == []
    lit(model)
    radiance = ptt.TransferRelighter(model, compiled=False)(ptt.Environment.constant(2.0), {"t": ptt.lambert(0.3)}, EYE)
    assert torch.allclose(radiance, torch.tensor(0.6), rtol=2e-3)


@pytest.fixture(scope="module")
def lobeless(glossy: Functions) -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(glossy[0].space, ranks=(3, 8, 8), separated=0)


@pytest.mark.parametrize("bounces", [0, 2])
def test_a_tensor_without_lobes(
    bounces: int, tiny: ptt.RawTransfer, lobeless: ptt.TensorBRDF, glossy: Functions
) -> None:
    """No cuts, no maps; and under the same light nearly what a tensor with lobes shows of dull materials."""
    raw = tiny if bounces else tiny.part(slice(None))
    best = ptt.Clusters(10_000, 42, 64, 1536, torch.float32)
    dull = {"ball": ptt.blinn_phong(0.3, 0.4, 3.0), "floor": ptt.blinn_phong(0.3, 0.4, 3.0)}
    models = [ptt.compress(raw, 64, brdf, glossy[1], best) for brdf in (lobeless, glossy[0])]
    assert all(region.cuts.shape[1] == 0 for region in models[0].clustered)
    assert [model.bounces for model in models] == [bounces] * 2
    without, with_lobes = (lit(model, dull) for model in models)
    assert ptt.relative_rmse(without, with_lobes) < 0.03


def test_one_point_a_region_and_regions_without_points(glossy: Functions, tmp_path: Path) -> None:
    parts = [plane("floor", 0.0, editable=False), ball("ball", 0.6)]
    whole = lit(model_of(parts, glossy, bounces=0, eigenvectors=32, points=16, columns=384))
    for index in ([3, 20], [0, 1, 2], [17, 20]):
        at = torch.tensor(index)
        model = model_of(parts, glossy, bounces=0, index=at, columns=384)
        part = lit(model)
        model.save(tmp_path / "m.safetensors")
        assert torch.equal(lit(ptt.TransferModel.load(tmp_path / "m.safetensors")), part)
        assert ptt.relative_rmse(part, whole[at]) < 0.02


def test_no_editable_region(glossy: Functions) -> None:
    materials = {"floor": ptt.lambert(0.6), "ball": ptt.blinn_phong(0.3, 0.4, 12.0)}
    for black in (False, True):
        both = {name: ptt.lambert(0.0) if black else material for name, material in materials.items()}
        parts = [plane("floor", 0.0), ball("ball", 0.6)]
        fixed, free = (
            model_of([replace(p, material=both[p.name], editable=e) for p in parts], glossy, eigenvectors=42)
            for e in (False, True)
        )
        radiance = lit(fixed)
        assert ptt.relative_rmse(radiance, lit(free)) < 0.02
        assert (radiance == 0).all() == black
        assert len(fixed.slots) == (0 if black else 3) and len(free.slots) == 10


def test_slots_of_what_is_seen_alone(glossy: Functions) -> None:
    """A floor and a ball light each other, not themselves; a floor below sees the other's back, which sends nothing."""
    model = model_of([plane("floor", 0.0), ball("ball", 0.6), plane("cellar", -1.0)], glossy)
    floor, above, cellar = model.clustered

    def regions(numbers: Sequence[int]) -> set[int]:
        return {model.slots[k].region for k in numbers}

    assert (regions(floor.slots), regions(above.slots), regions(cellar.slots)) == ({1}, {0}, set())
    assert {tuple(model.slots[k].region for k in pair) for pair in floor.pairs} == {(1, 0)}
    assert {tuple(model.slots[k].region for k in pair) for pair in above.pairs} == {(0, 1)}
    assert cellar.pairs == []
    lit(model)
    a, b = (lit(model, {"cellar": ptt.lambert(w)}) for w in (0.0, 1.0))
    assert torch.equal(a[: -floor.points], b[: -floor.points])


def test_more_clusters_than_points(assembled: Transfer) -> None:
    few, many = (
        ptt.cluster(assembled, ptt.Clusters(points, e, columns=1536, storage=torch.float32))
        for points, e in ((1000, 64), (1, 4))
    )
    assert ptt.relative_rmse(lit(many), lit(few)) < 0.02


def test_duplicated_points_look_alike(glossy: Functions) -> None:
    """Every vertex once a triangle, direct light: copies have the same radiance to the storage."""
    vertices, faces = mesh.sphere_mesh(1, 0.5)
    normals = vertices / vertices.norm(dim=1, keepdim=True)
    at = faces.flatten()
    part = Part("ball", vertices[at], torch.arange(len(at)).reshape(-1, 3), normals=normals[at])
    radiance = lit(model_of([part], glossy, bounces=0, points=30, eigenvectors=6))
    first = torch.stack([radiance[at == k][0] for k in range(len(vertices))])
    assert torch.allclose(radiance, first[at], rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_size_of_a_scene_changes_nothing(scale: float, glossy: Functions) -> None:
    def of(scale: float) -> Tensor:
        parts = [replace(p, vertices=p.vertices * scale) for p in (plane("floor", 0.0), ball("ball", 0.6))]
        radiance: Tensor = ptt.TransferRelighter(model_of(parts, glossy), compiled=False)(SKY, {}, EYE * scale)
        return radiance

    assert ptt.relative_rmse(of(scale), of(1.0)) < 2e-3


def test_refusals(small_raw: ptt.RawTransfer, small_bounced: ptt.RawTransfer, glossy: Functions) -> None:
    with pytest.raises(ValueError, match="light that bounces needs clusters"):
        ptt.compress(small_bounced, clusters=None)
    with pytest.raises(ValueError, match="brdf must be fitted with separated=0"):
        ptt.compress(small_raw, 32, glossy[0], clusters=None)
    with pytest.raises(ValueError, match="basis must be fitted to the space of brdf"):
        ptt.compress(small_raw, 32, glossy[0], ptt.BRDFBasis.fit(ptt.BRDFSpace.blinn_phong((1.0, 5.0)), 1))
    with pytest.raises(ValueError, match="must be at least 1"):
        ptt.Clusters(points=0)
    with pytest.raises(ValueError, match="bytes and error exclude each other"):
        ptt.Clusters(bytes=1e6, error=0.1)
    with pytest.raises(ValueError, match="error must satisfy 0 < error < 1, got 1"):
        ptt.Clusters(error=1.0)
    with pytest.raises(ValueError, match="storage must be one of float32, float16, bfloat16"):
        ptt.Clusters(storage=torch.float64)
    coarse = ptt.precompute(ptt.Scene.from_parts([plane("floor", 0.0)]), resolution=4)
    with pytest.raises(ValueError, match="clusters need a resolution of at least 8, got 4"):
        ptt.compress(coarse, 6, *glossy)


# The path tracer


def test_against_the_path_tracer(
    clustered_model: ptt.TransferModel, small_bounced: ptt.RawTransfer, small_scene: ptt.Scene, glossy: Functions
) -> None:
    """At 16 cells an edge, ranks (3, 8, 8) and 8 eigen-points a cluster: within 6 % in all.

    What bounces add is interpolated between vertices 0.3 apart, over a shadow 1 wide: under the ball a fourth too much.
    """
    camera = small_scene.camera
    counts = small_bounced.receivers.counts
    assert camera is not None
    truth = [
        ptt.reference.at_vertices(small_scene, SKY, small_scene.materials, camera, bounces=b, samples=1024).mean
        for b in (0, 2)
    ]
    at = (camera.toward(small_scene.vertices) * small_scene.normals).sum(1) > 0.05
    whole = ptt.TransferRelighter(clustered_model, compiled=False)(SKY, {}, camera).double()
    assert ptt.relative_rmse(whole[at], truth[1][at]) < 0.06
    best = ptt.Clusters(10_000, max(counts), 128, 16**2 * 6, torch.float32)
    once, twice = (
        ptt.TransferRelighter(ptt.compress(raw, 64, *glossy, best), compiled=False)(SKY, {}, camera).double()
        for raw in (small_bounced.part(slice(None)), small_bounced)
    )
    assert ptt.relative_rmse(twice[at], truth[1][at]) < 0.035
    below = (torch.arange(len(at)) < counts[0]) & (small_scene.vertices[:, [0, 2]].norm(dim=1) < 0.6)
    ratio = (twice - once)[below].sum() / (truth[1] - truth[0])[below].sum()
    assert 1.0 < ratio < 1.35
    assert ((twice - once)[below] > 0.05 * once[below]).all()
