"""Relighters under torch.func: batches of lights, and derivatives that are right whatever ran before."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, jacrev, jvp, vmap

import ptt
from ptt.light import prefiltered
from ptt.relight.relighter import Relighter
from ptt.relight.triple_relighter import Storage

RANDOM = torch.Generator().manual_seed(0)
MAPS = torch.rand(3, 16, 32, 3, generator=RANDOM)
SKY = ptt.Environment(torch.rand(8, 16, 3, generator=RANDOM))
EYE = torch.tensor([1.0, 2.0, 3.0])
COLOUR = torch.tensor([0.1, 0.2, 0.3])
ROTATIONS = ("factored", "resample", "matrix")
pytestmark = pytest.mark.filterwarnings("error:There is a performance drop")  # samples taken one by one


@pytest.fixture(params=["clusters", "clusters, eager", "points", *ROTATIONS, "triple products", "in bytes"])
def make(request: pytest.FixtureRequest, small_scene: ptt.Scene) -> Callable[[], Relighter]:
    """Make a relighter that nothing was asked of."""
    kind = request.param
    if kind == "points" or kind.startswith("clusters"):
        model = request.getfixturevalue("small_model" if kind == "points" else "clustered_model")
        return lambda: ptt.TransferRelighter(model, compiled="eager" not in kind)
    if kind in ROTATIONS:
        rotation = ptt.LightRotation.build(16, 4, operator=kind)
        return lambda: ptt.EnvMapRelighter(small_scene, rotation, terms=16, views=16, lamps=False)
    storage: Storage = "8-bit" if kind == "in bytes" else "float"
    return lambda: ptt.TripleProductRelighter(
        small_scene, 1, normals=6, twists=6, source=16, views=16, storage=storage, highlights="triangles"
    )


def relit(
    relighter: Relighter, light: ptt.Environment, materials: Mapping[str, ptt.Material] | None = None, eye: Tensor = EYE
) -> Tensor:
    """Radiance (v, 3)."""
    radiance: Tensor = relighter(light, materials or {}, eye)
    return radiance


def under(relighter: Relighter) -> Callable[[Tensor], Tensor]:
    """Radiance (v, 3) as a function of a map."""

    def radiance(texels: Tensor) -> Tensor:
        light = ptt.Environment(texels).scaled((1.0, 0.5, 2.0)).rotated(y=30) + SKY
        return relit(relighter, light)

    return radiance


def tinted(relighter: Relighter) -> Callable[[Tensor], Tensor]:
    """The sum of the radiance as a function of the ball's diffuse colour."""

    def total(colour: Tensor) -> Tensor:
        return relit(relighter, SKY, {"ball": ptt.Material(colour, 0.4, ptt.BlinnPhong(12.0))}).sum()

    return total


def total(radiance: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda texels: radiance(texels).sum()


def test_a_batch_of_lights_is_each_of_them(make: Callable[[], Relighter]) -> None:
    """Of the maximum: kernels, which answer one light at a time, round what points send out to 16 bits; and a table in
    bytes is rounded to half of one, 2e-3 of its largest."""
    relighter = make()
    found = vmap(under(relighter))(MAPS)
    each = torch.stack([under(relighter)(texels) for texels in MAPS])
    bytes_ = getattr(relighter, "storage", None) == torch.uint8
    torch.testing.assert_close(found, each, rtol=0, atol=(4e-3 if bytes_ else 5e-4) * float(each.max()))


def test_gradients_of_a_batch_are_each_of_them(make: Callable[[], Relighter]) -> None:
    """By samples, and of their sum; the gradient of one by autograd."""
    radiance = under(make())
    expected = []
    for texels in MAPS:
        leaf = texels.clone().requires_grad_()
        radiance(leaf).sum().backward()
        assert leaf.grad is not None
        expected.append(leaf.grad)
    each = torch.stack(expected)
    near = 1e-5 * float(each.abs().max())
    torch.testing.assert_close(vmap(grad(total(radiance)))(MAPS), each, rtol=0, atol=near)
    torch.testing.assert_close(grad(lambda maps: vmap(radiance)(maps).sum())(MAPS), each, rtol=0, atol=near)


def test_batches_of_weights_and_of_eyes(make: Callable[[], Relighter]) -> None:
    """As the lights: each is what it is alone."""
    relighter = make()
    colours = torch.rand(3, 3, generator=RANDOM)

    def coated(colour: Tensor) -> Tensor:
        return relit(relighter, SKY, {"ball": ptt.Material(colour, colour, ptt.BlinnPhong(12.0))})

    def seen(eye: Tensor) -> Tensor:
        return relit(relighter, SKY, eye=eye)

    for function, batch in ((coated, colours), (seen, colours + 1)):
        each = torch.stack([function(one) for one in batch])
        torch.testing.assert_close(vmap(function)(batch), each, rtol=0, atol=1e-3 * float(each.max()))


def test_batches_of_shapes_are_refused(make: Callable[[], Relighter]) -> None:
    """Which BRDFs a model reads depends on them."""
    relighter = make()

    def rough(exponent: Tensor) -> Tensor:
        return relit(relighter, SKY, {"ball": ptt.blinn_phong(0.3, 0.4, exponent)})

    with pytest.raises(ValueError, match=r"parameters of shapes cannot be a batch of torch.func.vmap: loop over them"):
        vmap(rough)(torch.tensor([4.0, 9.0]))


def test_tangents_of_shapes_are_refused_where_tables_would_lose_them(make: Callable[[], Relighter]) -> None:
    """`TransferRelighter` has them: the derivative by the exponent is a difference quotient's."""
    relighter = make()

    def rough(exponent: Tensor) -> Tensor:
        return relit(relighter, SKY, {"ball": ptt.blinn_phong(0.3, 0.4, exponent)}).sum()

    exponent = torch.tensor(10.0)
    if isinstance(relighter, ptt.TransferRelighter):
        quotient = (rough(exponent + 0.5) - rough(exponent - 0.5)) / 1.0
        found = jvp(rough, (exponent,), (torch.ones(()),))[1]
        torch.testing.assert_close(found, quotient, rtol=0.05, atol=0)
    else:
        with pytest.raises(ValueError, match="shapes carry no gradients here"):
            jvp(rough, (exponent,), (torch.ones(()),))


def test_what_runs_first_under_a_transform_serves_later(make: Callable[[], Relighter]) -> None:
    """Tables that a transform needs first are kept as what they are, not as what stands for them."""
    expected = make()(SKY, {}, EYE)
    transforms: tuple[Callable[[Callable[[Tensor], Tensor]], Any], ...] = (
        lambda f: grad(total(f))(MAPS[0]),
        lambda f: vmap(f)(MAPS),
    )
    for transform in transforms:
        relighter = make()
        for table in (prefiltered._axes, prefiltered._blur, prefiltered._solid_angles):
            table.cache_clear()
        transform(under(relighter))
        assert torch.equal(relighter(SKY, {}, EYE), expected)


def test_tangents_are_those_that_are_given(make: Callable[[], Relighter]) -> None:
    """The same value with another tangent is no repetition: the derivative by each colour, twice over."""
    function = tinted(make())
    gradient = jacrev(function)(COLOUR)
    for tangent in [*torch.eye(3), *torch.eye(3)]:
        torch.testing.assert_close(jvp(function, (COLOUR,), (tangent,))[1], gradient @ tangent, rtol=1e-4, atol=0)
        with forward_ad.dual_level():
            result = forward_ad.unpack_dual(function(forward_ad.make_dual(COLOUR, tangent))).tangent
        torch.testing.assert_close(result, gradient @ tangent, rtol=1e-4, atol=0)


def test_the_tangent_of_a_map_is_the_light_of_it(make: Callable[[], Relighter]) -> None:
    """Radiance is linear in the map; torch alone answers, without the kernels' rounding."""
    relighter = make()
    found = jvp(lambda texels: relit(relighter, ptt.Environment(texels)), (MAPS[0],), (MAPS[1],))[1]
    expected = jvp(lambda texels: relit(relighter, ptt.Environment(texels)), (MAPS[1],), (MAPS[0],))[0]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_tint_of_one_has_a_derivative(make: Callable[[], Relighter]) -> None:
    """Radiance is linear in a tint t: its derivative in the direction t, at t = 1, is the radiance."""
    relighter = make()
    one = torch.ones(3)
    found = jvp(lambda tint: relit(relighter, SKY.scaled(tint)), (one,), (one,))
    torch.testing.assert_close(found[1], found[0])
    assert float(found[0].mean()) > 0.1


def test_values_of_a_batch_are_checked() -> None:
    maps = MAPS.clone()
    maps[1, 2, 3, 0] = torch.nan
    with pytest.raises(ValueError, match=r"map must be finite: 1 of 4608 values are NaN"):
        vmap(lambda texels: ptt.Environment(texels).integral())(maps)
    with pytest.raises(ValueError, match="factor must be one or three finite numbers >= 0"):
        vmap(lambda factor: SKY.scaled(factor).integral())(torch.tensor([1.0, -1.0]))
