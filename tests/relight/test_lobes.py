"""Models whose highlights are narrow lobes: metals beside the reference, what is saved, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import ptt
from ptt.materials.shapes import GGX
from ptt.ops import mesh
from ptt.ops.cells import CellSums, Gloss, Reflects, gloss_of
from ptt.relight import glosses
from ptt.scene.parts import Part

GOLD = (1.0, 0.78, 0.34)
EYE = torch.tensor([0.4, 1.6, 3.0])


@pytest.fixture(scope="module")
def scene() -> ptt.Scene:
    """A ball that is half in a trough, so that some of its points see a third of the sky, on a matt floor."""
    vertices, faces = mesh.sphere_mesh(2, 0.5)
    trough, sides = mesh.box_mesh((0.3, 0.8, 2.0), 6)
    parts = [
        Part("ball", vertices + torch.tensor([0.0, 0.55, 0.0]), faces, material=ptt.ggx(0.0, 1.0, GOLD, 0.3)),
        Part("left", trough + torch.tensor([-0.8, 0.45, 0.0]), sides, material=ptt.lambert(0.4)),
        Part("right", trough + torch.tensor([0.8, 0.45, 0.0]), sides, material=ptt.lambert(0.4)),
    ]
    return ptt.Scene.from_parts(parts, ptt.Environment.constant(1.0), ptt.Camera((0.4, 1.6, 3.0), (0.0, 0.5, 0.0)))


@pytest.fixture(scope="module")
def raw(scene: ptt.Scene) -> ptt.RawTransfer:
    return ptt.precompute(scene, bounces=0)


@pytest.fixture(scope="module")
def model(raw: ptt.RawTransfer) -> ptt.TransferModel:
    return ptt.compress(raw, highlights="lobes")


@pytest.fixture(scope="module")
def sky() -> ptt.Environment:
    """A sun over a sky that is brighter on one side."""
    return ptt.Environment.sun_sky(direction=(0.5, 1.0, 0.6), radius=1.0)


def facing(scene: ptt.Scene) -> Tensor:
    """Vertices of the ball that the eye sees at more than 17 degrees from the horizon."""
    to = torch.nn.functional.normalize(EYE - scene.points, dim=1)
    return torch.nonzero((scene.vertex_region == 0) & ((to * scene.frames[:, 2]).sum(1) > 0.3))[:, 0]


def error_of_gold(scene: ptt.Scene, model: ptt.TransferModel, sky: ptt.Environment, roughness: float) -> float:
    """The relative error of a ball of gold, with the reference's noise taken out, where nothing is negative."""
    materials = scene.materials | {"ball": ptt.ggx(0.0, 1.0, GOLD, roughness)}
    rows = facing(scene)
    wo = torch.nn.functional.normalize(EYE - scene.points[rows], dim=1)
    points = ptt.reference.vertex_points(scene).take(rows)
    truth = ptt.reference.radiance(scene, sky, materials, points, wo, bounces=model.bounces, samples=512)
    got = ptt.TransferRelighter(model, compiled=False)(sky, materials, EYE)
    assert bool((got >= -1e-3 * got.mean()).all())
    excess = (got[rows] - truth.mean).square().mean() - truth.standard_error.square().mean()
    return float(excess.clamp(min=0).sqrt() / truth.mean.square().mean().sqrt())


@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.6])
def test_metals_beside_the_reference(
    scene: ptt.Scene, model: ptt.TransferModel, sky: ptt.Environment, roughness: float
) -> None:
    """Within 6 %, the noise of the reference taken out, and nothing is negative."""
    assert error_of_gold(scene, model, sky, roughness) < 0.06


def test_more_lobes_come_nearer(raw: ptt.RawTransfer, scene: ptt.Scene, model: ptt.TransferModel) -> None:
    """To 64: of a light of many colours; each step leaves at most two thirds of the error."""
    light = ptt.Environment(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 4)
    one = [ptt.TransferRelighter(model, compiled=False, lobes=n)(light, {}, EYE)[facing(scene)] for n in (4, 16, 64)]
    errors = [float((b - one[-1]).norm()) for b in one[:2]]
    assert 0 < errors[1] < errors[0] * 2 / 3


def test_a_wide_metal_comes_nearer_by_default(scene: ptt.Scene, model: ptt.TransferModel) -> None:
    """Than with 16 lobes, of the same light; a narrow one has as many."""
    light = ptt.Environment(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 4)
    rows = facing(scene)
    for roughness, left in ((0.3, 1.0), (0.6, 0.8)):
        gold = {"ball": ptt.ggx(0.0, 1.0, GOLD, roughness)}
        own, few, many = (
            ptt.TransferRelighter(model, compiled=False, lobes=n)(light, gold, EYE)[rows] for n in (None, 16, 64)
        )
        assert 0 < float((own - many).norm()) <= left * float((few - many).norm())


def test_turned_light_on_a_turned_eye(scene: ptt.Scene, model: ptt.TransferModel, sky: ptt.Environment) -> None:
    """Lights add up, and a factor is exact, lamps and all."""
    relighter = ptt.TransferRelighter(model, compiled=False)
    other = sky.rotated(y=70).scaled(0.5)
    both = relighter(sky + other, {}, EYE)
    assert torch.allclose(both, relighter(sky, {}, EYE) + relighter(other, {}, EYE), rtol=2e-2, atol=1e-3)
    assert torch.allclose(relighter(sky.scaled(3.0), {}, EYE), 3 * relighter(sky, {}, EYE), rtol=1e-5)


def test_kernels_and_plain_functions_agree(scene: ptt.Scene, model: ptt.TransferModel, sky: ptt.Environment) -> None:
    plain, kernels = (ptt.TransferRelighter(model, compiled=c)(sky, {}, EYE) for c in (False, True))
    assert torch.allclose(plain, kernels, rtol=0, atol=5e-4 * float(plain.max()))


def test_what_is_saved_relights_alike(model: ptt.TransferModel, sky: ptt.Environment, tmp_path: Path) -> None:
    model.save(tmp_path / "model.safetensors")
    loaded = ptt.TransferModel.load(tmp_path / "model.safetensors")
    assert loaded.highlights == "lobes"
    first, second = (ptt.TransferRelighter(m, compiled=False)(sky, {}, EYE) for m in (model, loaded))
    assert torch.equal(first, second)


def test_derivatives_reach_colours(model: ptt.TransferModel, sky: ptt.Environment) -> None:
    """Radiance is linear in the colour of a highlight: the derivative is what a unit of it reflects."""
    colour = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
    relighter = ptt.TransferRelighter(model, compiled=False)
    shape = GGX(1.0, 0.3)
    lit = relighter(sky, {"ball": ptt.Material(0.0, colour, shape)}, EYE)
    (got,) = torch.autograd.grad(lit.sum(), colour)
    more = relighter(sky, {"ball": ptt.Material(0.0, 1.5, shape)}, EYE).sum(0)
    assert torch.allclose(got, (more - lit.detach().sum(0)), rtol=1e-3)


def test_tables_of_a_shape_are_made_once(model: ptt.TransferModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of base colour makes none anew, one of roughness those of roughnesses that are new."""
    made = []

    def counted(reflects: Reflects, isotropic: bool, n: int, sums: CellSums) -> Gloss:
        made.append(1)
        return gloss_of(reflects, isotropic, n, sums)

    monkeypatch.setattr(glosses, "gloss_of", counted)
    relighter = ptt.TransferRelighter(model, compiled=False)
    light = ptt.Environment.constant(1.0)
    rough = 0.5 + 0.5 * (torch.arange(len(model.positions)) % 2)
    counts = []
    for colour, most in ((0.9, 0.6), (0.4, 0.6), (0.4, 0.7)):
        ball = ptt.MetalRough(colour, 1.0, most, roughness_map=rough)
        got = relighter(light, {"ball": ball}, EYE)
        counts.append(len(made))
        again = ptt.TransferRelighter(model, compiled=False)(light, {"ball": ball}, EYE)
        assert torch.equal(got, again)
        made.clear()
    assert counts == [8, 0, 2]  # GGX with f0 of 0 and 1 at 0.28, 0.35, 0.52 and 0.62; at 0.74, too


@pytest.fixture(scope="module")
def bounced(scene: ptt.Scene) -> ptt.TransferModel:
    """With two bounces, and gold of any roughness as the ball."""
    return ptt.compress(ptt.precompute(scene, bounces=2, rays=256))


@pytest.mark.parametrize("roughness", [0.3, 0.6])
def test_metals_see_what_lies_around(
    scene: ptt.Scene, bounced: ptt.TransferModel, sky: ptt.Environment, roughness: float
) -> None:
    """Within 10 % of the reference, its noise taken out, where light that bounced is a third; nothing is negative."""
    assert error_of_gold(scene, bounced, sky, roughness) < 0.1


@pytest.mark.parametrize(("roughness", "reads"), [(0.3, True), (0.6, False)])
def test_what_a_broad_highlight_sees_reflects_as_one_lobe(
    scene: ptt.Scene, bounced: ptt.TransferModel, sky: ptt.Environment, roughness: float, reads: bool
) -> None:
    """The few lobes of what it sees are not read: nothing changes where what they reflect is no number."""
    steps = ptt.TransferRelighter(bounced, compiled=False).steps
    gold = scene.materials | {"ball": ptt.ggx(0.0, 1.0, GOLD, roughness)}
    region, *_ = steps.exitant(steps.incident(sky), list(gold.values()))
    nothing = region.around.parts.clone()
    nothing[..., 4:] = torch.nan
    unread = region._replace(around=region.around._replace(parts=nothing))
    right, got = (steps.radiance([each], EYE) for each in (region, unread))
    assert torch.equal(right, got) is not reads


def test_light_that_bounced_is_the_same_by_kernels_and_from_a_file(
    bounced: ptt.TransferModel, sky: ptt.Environment, tmp_path: Path
) -> None:
    bounced.save(tmp_path / "model.safetensors")
    loaded = ptt.TransferModel.load(tmp_path / "model.safetensors")
    plain = ptt.TransferRelighter(bounced, compiled=False)(sky, {}, EYE)
    assert torch.equal(ptt.TransferRelighter(loaded, compiled=False)(sky, {}, EYE), plain)
    kernels = ptt.TransferRelighter(bounced)(sky, {}, EYE)
    assert torch.allclose(plain, kernels, rtol=0, atol=5e-4 * float(plain.max()))


def test_a_furnace_with_surfaces_around(scene: ptt.Scene, bounced: ptt.TransferModel) -> None:
    """Under light of 1 from everywhere, a ball that reflects all of it sends no more than 1, and close to what the
    walls and the sky send it."""
    mirror = {"ball": ptt.ggx(0.0, 1.0, 1.0, 0.3)}
    got = ptt.TransferRelighter(bounced, compiled=False)(ptt.Environment.constant(1.0), mirror, EYE)
    rows = facing(scene)
    assert 0.6 < float(got[rows].mean()) < 1
    assert float(got[rows].max()) < 1.05


def test_the_default_is_lobes_but_for_a_given_brdf(raw: ptt.RawTransfer) -> None:
    assert ptt.compress(raw).highlights == "lobes"
    space = ptt.BRDFSpace.ggx((0.2, 0.3))
    brdf = ptt.TensorBRDF.fit(space, (2, 4, 4), separated=1)
    assert ptt.compress(raw, brdf=brdf).highlights == ptt.compress(raw, highlights="tensor").highlights == "tensor"


def test_a_brdf_of_your_own_is_shown_as_the_shape_that_it_is(
    raw: ptt.RawTransfer, sky: ptt.Environment, tmp_path: Path
) -> None:
    """Known by its function alone; a model that was saved asks for it."""
    shape = GGX(1.0, 0.3)
    mine = ptt.Material(0.0, GOLD, ptt.Named("mine", shape.evaluate))
    own = replace(raw.receivers, materials=raw.receivers.materials | {"ball": mine})
    model = ptt.compress(replace(raw, receivers=own), editable=[ptt.ggx()])
    assert model.highlights == "lobes"
    known = ptt.TransferRelighter(model)(sky, {"ball": ptt.Material(0.0, GOLD, shape)}, EYE)
    torch.testing.assert_close(ptt.TransferRelighter(model)(sky, {}, EYE), known)
    model.save(tmp_path / "mine.safetensors")
    loaded = ptt.TransferRelighter(ptt.TransferModel.load(tmp_path / "mine.safetensors"))
    torch.testing.assert_close(loaded(sky, {"ball": mine}, EYE), known)
    with pytest.raises(ValueError, match=r"'mine' came from a saved model, .* give its material again"):
        loaded(sky, {}, EYE)


def test_what_does_not_go_together_is_refused(raw: ptt.RawTransfer, model: ptt.TransferModel) -> None:
    with pytest.raises(ValueError, match="highlights must be one of lobes, tensor"):
        ptt.compress(raw, highlights="gloss")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs clusters"):
        ptt.compress(raw, clusters=None, highlights="lobes")
    with pytest.raises(ValueError, match=r"lobes must be in 1\.\.64"):
        ptt.TransferRelighter(model, lobes=0)
