"""Materials of several highlights, and of coloured reflectance, in every evaluator: laws that one highlight obeys."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import ptt
from ptt.materials.material import Highlight
from ptt.relight.relighter import Relighter

pytestmark = pytest.mark.usefixtures("built")
SKY = ptt.Environment.sun_sky(radius=8.0)
EYE = torch.tensor([1.0, 2.0, 3.0])
SPACES = {
    "blinn-phong": ptt.BRDFSpace.blinn_phong((2.0, 8.0, 32.0, 64.0)),
    "ggx": ptt.BRDFSpace.ggx((0.25, 0.5, 0.8)),
}


@pytest.fixture(params=["clusters", "fixed", "points", "environment map", "triples"])
def make(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Callable[[bool, str, ptt.Material], Relighter]:
    """A relighter, by kernels or not, for a space, whose ball has a material.

    fixed: the ball is not editable, and has the material from the beginning
    """
    kind = request.param
    raw = request.getfixturevalue("small_bounced")

    def relighter(compiled: bool, space: str, material: ptt.Material) -> Relighter:
        if kind == "environment map":
            rotation = ptt.LightRotation.build(16, 4)
            return ptt.EnvMapRelighter(small_scene, rotation, terms=16, views=16, compiled=compiled)
        if kind == "triples":
            return ptt.TripleProductRelighter(
                small_scene, 1, normals=6, twists=6, source=16, views=16, highlights="triangles", compiled=compiled
            )
        brdf = ptt.TensorBRDF.fit(SPACES[space], ranks=(3, 8, 8), separated=3, resolution=16)
        if kind == "points":
            return ptt.TransferRelighter(ptt.compress(request.getfixturevalue("small_raw"), 64, brdf), compiled)
        own = raw
        if kind == "fixed":
            names = raw.receivers.names
            materials = raw.receivers.materials | {"ball": material}
            editable = tuple(name != "ball" for name in names)
            own = ptt.RawTransfer(**{**vars(raw), "receivers": _with(raw.receivers, materials, editable)})
        basis = ptt.BRDFBasis.fit(SPACES[space], 2)
        fine = ptt.Clusters(200, 64, 128, 1536, torch.float32)
        clusters = fine if kind == "fixed" else ptt.Clusters(60, 8, 32, 128)
        return ptt.TransferRelighter(ptt.compress(own, 64, brdf, basis, clusters), compiled)

    return relighter


def _with(receivers: object, materials: object, editable: object) -> object:
    from dataclasses import replace

    return replace(receivers, materials=materials, editable=editable)  # type: ignore[type-var]


Make = Callable[[bool, str, ptt.Material], Relighter]


def relit(make: Make, compiled: bool, space: str, material: ptt.Material) -> Tensor:
    radiance: Tensor = make(compiled, space, material)(SKY, {"ball": material}, EYE)
    return radiance


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "kernels"])
def test_a_highlight_in_two_parts_is_the_whole(make: Make, compiled: bool, request: pytest.FixtureRequest) -> None:
    """Also what it reflects of bounced light, and sends to others."""
    whole = ptt.blinn_phong((0.1, 0.5, 0.3), (0.5, 0.2, 0.4), 20.0)
    a, b = whole.specular * 0.3, whole.specular * 0.7
    parts = ptt.Material(whole.diffuse, a, whole.shape, Highlight(b, whole.highlights[0].shape))
    one, two = (relit(make, compiled, "blinn-phong", material) for material in (whole, parts))
    fixed = "fixed" in request.node.name  # which has a slot for each channel then, and is compressed with them
    assert float((one - two).abs().max() / one.abs().max()) < (2e-3 if compiled or fixed else 1e-5)


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "kernels"])
def test_each_channel_of_a_coloured_metal_is_that_of_a_grey_one(
    make: Make, compiled: bool, request: pytest.FixtureRequest
) -> None:
    """Channels of light do not mix, so that gold's red is the red of a metal that reflects as much of every colour.

    To the rounding of 16 bits; slices of an environment map's BRDF keep 16 terms each, other ones of each shape, and
    light that bounces off a fixed material is compressed with each.
    """
    gold = (1.0, 0.7, 0.3)
    rounded = 2e-3 if compiled else 1e-4
    bound = 2e-2 if any(kind in request.node.name for kind in ("environment", "fixed")) else rounded
    coloured = relit(make, compiled, "ggx", ptt.ggx(0.05, 0.9, gold, 0.5))
    for channel, f0 in enumerate(gold):
        grey = relit(make, compiled, "ggx", ptt.ggx(0.05, 0.9, f0, 0.5))
        error = (coloured - grey)[:, channel].abs().max() / coloured[:, channel].abs().max()
        assert float(error) < bound


def test_a_coloured_metal_by_its_formula() -> None:
    """Schlick's reflectance is f0 + (1 - f0) (1 - cos)^5, channel by channel."""
    gold = ptt.ggx(0.0, (1.0, 0.5, 0.2), (1.0, 0.7, 0.3), 0.4)
    wi, wo = torch.nn.functional.normalize(torch.rand(2, 500, 3, dtype=torch.float64) + 0.01, dim=2)
    for channel, (weight, f0) in enumerate(zip((1.0, 0.5, 0.2), (1.0, 0.7, 0.3), strict=True)):
        expected = weight * ptt.GGX(f0, 0.4).evaluate(wi, wo)
        torch.testing.assert_close(gold.evaluate(wi, wo)[:, channel], expected, rtol=1e-6, atol=1e-12)


def test_materials_of_several_highlights_say_so_and_are_saved() -> None:
    gold = ptt.ggx(0.0, 1.0, (1.0, 0.7, 0.3), 0.4)
    with pytest.raises(ValueError, match=r"2 highlights: see Material\.highlights"):
        _ = gold.shape
    again = ptt.materials.material.from_config(ptt.materials.material.to_config(gold))
    assert again.highlights[1].shape == ptt.GGX(0.0, 0.4)
    torch.testing.assert_close(again.highlights[0].colour, gold.highlights[0].colour)
    assert len(ptt.ggx(0.0, 1.0, 0.9, 0.4).highlights) == 1
    with pytest.raises(ValueError, match=r"f0 must be finite and in \[0, 1\]"):
        ptt.ggx(f0=(1.5, 0.2, 0.2))
    with pytest.raises(ValueError, match="exponent must be one number"):
        ptt.blinn_phong(exponent=(1.0, 2.0, 3.0))  # type: ignore[arg-type]


def test_the_reference_draws_from_every_highlight() -> None:
    """A mixture of three: its density integrates to 1, and directions drawn by it have that density."""
    from ptt.reference.path_tracer import _mixture

    more = [Highlight(0.2, ptt.GGX(0.5, 0.3)), Highlight(0.1, ptt.GGX(0.1, 0.3))]
    mixture = _mixture(ptt.Material(0.2, 0.3, ptt.BlinnPhong(5.0), *more))
    assert len(mixture.lobes) == 2 and sum(mixture.shares) < 0.9  # those of GGX draw alike
    generator = torch.Generator().manual_seed(0)
    wo = torch.nn.functional.normalize(torch.tensor([[0.4, 0.1, 0.9]]), dim=1).expand(1 << 19, 3)
    uniform = torch.nn.functional.normalize(torch.randn(1 << 19, 3, generator=generator), dim=1)
    assert float(mixture.density(uniform, wo).mean()) * 4 * torch.pi == pytest.approx(1, abs=0.01)
    drawn = mixture.sample(torch.rand(1 << 19, 3, generator=generator), wo)
    for axis in range(3):  # the mean of a function of the directions, by both
        expected = float((uniform[:, axis] * mixture.density(uniform, wo)).mean()) * 4 * torch.pi
        assert float(drawn[:, axis].mean()) == pytest.approx(expected, abs=0.01)
