"""BRDF spaces: coordinates between samples, names, paths, and the fitted table."""

from __future__ import annotations

import json
import math
from importlib import resources
from typing import Any

import pytest
import torch
from torch import Tensor

import ptt
from ptt import BRDFSpace
from ptt.materials import shapes
from ptt.materials.shapes import Shape
from ptt.ops import brdf


def numbers(shape: Shape | None) -> list[float]:
    """The parameters of an analytic shape, in their order."""
    assert shape is not None
    return [shapes.number(value) for value in shapes.parameters(shape).values()]


FITTED = BRDFSpace.fitted()
PLANE = torch.tensor([numbers(shape) for shape in FITTED.samples], dtype=torch.float64)  # f0, m
TABLE = resources.files("ptt").joinpath("data", "ngan_cooktorrance.csv").read_text().splitlines()


def test_coordinates_reproduce_samples_and_are_linear_between_them() -> None:
    space = BRDFSpace.blinn_phong((1.0, 4.0, 10.0))
    assert space.coordinates(ptt.BlinnPhong(4.0)).tolist() == [0, 1, 0]
    assert torch.allclose(space.coordinates(ptt.BlinnPhong(5.5)), torch.tensor([0.0, 0.75, 0.25]).double())
    space = BRDFSpace.blinn_phong((3.0,))
    assert space.coordinates(ptt.BlinnPhong(3.0)).tolist() == [1]


def test_coordinates_carry_gradients() -> None:
    exponent = torch.tensor(5.0, requires_grad=True)
    BRDFSpace.blinn_phong((1.0, 4.0, 10.0)).coordinates(ptt.BlinnPhong(exponent))[2].backward()
    assert exponent.grad is not None and float(exponent.grad) == pytest.approx(1 / 6)


def test_space_refusals() -> None:
    with pytest.raises(ValueError, match=r"exponent must be in 1..200, the model's space, got 300"):
        BRDFSpace.blinn_phong().coordinates(ptt.BlinnPhong(300.0))
    with pytest.raises(ValueError, match="the model's space holds blinn-phong shapes, got cook-torrance"):
        BRDFSpace.blinn_phong().coordinates(ptt.CookTorrance(0.1, 0.3))
    with pytest.raises(ValueError, match="exponents must hold ascending values"):
        BRDFSpace.blinn_phong((3.0, 2.0))


@pytest.mark.parametrize("space", [BRDFSpace.blinn_phong(), FITTED], ids=["blinn-phong", "fitted"])
def test_a_sample_is_its_own_coordinate(space: BRDFSpace) -> None:
    for h in range(0, len(space.samples), 5):
        weights = space.coordinates(space.samples[h])
        assert float(weights[h]) == pytest.approx(1.0, abs=1e-6)
        assert float(weights.abs().sum()) == pytest.approx(1.0, abs=1e-6)


def test_coordinates_are_barycentric_in_the_plane() -> None:
    """Inside the hull the weighted samples lie at the point itself; everywhere at most three weigh, none below 0."""
    plane = PLANE
    for f0, m in torch.rand(200, 2, generator=torch.Generator().manual_seed(0)).double().tolist():
        weights = FITTED.coordinates(ptt.CookTorrance(f0, max(m, 1e-3)))
        assert (weights >= 0).all() and int((weights > 0).sum()) <= 3
        assert float(weights.sum()) == pytest.approx(1.0)
    inside = plane[:3].mean(0) * 0.5 + plane[10:13].mean(0) * 0.5
    reached = FITTED.coordinates(ptt.CookTorrance(*inside.tolist())) @ plane
    assert torch.allclose(reached, inside, atol=1e-9)


def test_outside_of_the_hull_the_nearest_point_in_it() -> None:
    """Against a dense sampling of all segments between samples, which the hull's border is part of."""
    plane = PLANE
    point = torch.tensor([0.9, 0.95], dtype=torch.float64)
    reached = FITTED.coordinates(ptt.CookTorrance(0.9, 0.95)) @ plane
    t = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None, None, None]
    segments = plane[:, None] + t * (plane[None] - plane[:, None])
    assert float((reached - point).norm()) == pytest.approx(float((segments - point).norm(dim=-1).min()), abs=1e-3)


def test_coordinates_of_the_plane_carry_gradients() -> None:
    f0 = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    m = torch.tensor(0.15, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: FITTED.coordinates(ptt.CookTorrance(a, b)), (f0, m), eps=1e-7)


def test_names_give_the_published_numbers_in_merl_colours() -> None:
    """gold-metallic-paint, the file's row times (1, 1.15, 1.66)."""
    gold = ptt.fitted("gold-metallic-paint")
    row = next(r for r in TABLE if r.startswith("gold-metallic-paint,")).split(",")
    kd, ks = ([float(x) * s for x, s in zip(part, (1, 1.15, 1.66), strict=True)] for part in (row[1:4], row[4:7]))
    assert gold.diffuse.tolist() == pytest.approx(kd)
    assert gold.specular.tolist() == pytest.approx(ks)
    assert gold.shape == ptt.CookTorrance(float(row[7]), float(row[8]))
    up = torch.tensor([0.0, 0.0, 1.0])
    peak = float(brdf.cook_torrance(up, up, float(row[7]), float(row[8])))
    expected = [d / torch.pi + s * peak for d, s in zip(gold.diffuse.tolist(), gold.specular.tolist(), strict=True)]
    assert gold.evaluate(up, up).tolist() == pytest.approx(expected, rel=1e-5)


def test_a_wrong_name_suggests_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"no material 'gold-metal-paint' among 86; near it: .*gold-metallic-paint"):
        ptt.fitted("gold-metal-paint")


def test_paths_reach_both_ends_in_even_steps() -> None:
    a = FITTED.samples[3]
    b = FITTED.samples[40]
    path = FITTED.path(a, b, 5)
    assert numbers(path[0]) == pytest.approx(numbers(a)) and numbers(path[-1]) == pytest.approx(numbers(b))
    exponents = BRDFSpace.blinn_phong().path(ptt.BlinnPhong(2.0), ptt.BlinnPhong(10.0), 5)
    assert [numbers(shape)[0] for shape in exponents] == pytest.approx([2, 4, 6, 8, 10])
    with pytest.raises(ValueError, match=r"exponent must be in 1\.\.200"):
        BRDFSpace.blinn_phong().at(exponent=201.0)


# Names for what follows: a user's own BRDFs, and directions off every symmetry plane


def matt(wi: Tensor, wo: Tensor) -> Tensor:
    return 0.2 + 0 * wi[..., 2] * wo[..., 2]


def cosines(wi: Tensor, wo: Tensor) -> Tensor:
    return wi[..., 2] * wo[..., 2]


WI, WO = (
    torch.nn.functional.normalize(torch.tensor(v, dtype=torch.float64), dim=1)
    for v in ([[0.3, -0.5, 0.7], [0.1, 0.9, 0.4]], [[-0.6, 0.2, 0.9], [-0.3, -0.4, 0.5]])
)
USER = BRDFSpace.user({"matt": matt, "cosines": cosines, "paint": ptt.ggx(0.1, (0.2, 0.4, 0.6), 0.3, 0.5)})
TRIANGLE = BRDFSpace((ptt.CookTorrance(0.0, 0.1), ptt.CookTorrance(1.0, 0.1), ptt.CookTorrance(0.0, 0.5)))
SPACES = {
    "blinn-phong": BRDFSpace.blinn_phong((1.0, 4.0, 10.0)),
    "fitted": FITTED,
    "ward": BRDFSpace.ward((0.1, 0.2, 0.5)),
    "anisotropic": BRDFSpace.ward((0.1, 0.2, 0.5), anisotropic=True),
    "ggx": BRDFSpace.ggx((0.1, 0.3, 0.7)),
    "user": USER,
    "one": BRDFSpace((ptt.GGX(0.3, 0.4),)),
    "mixed": BRDFSpace((ptt.Named("first", matt), ptt.BlinnPhong(3.0), ptt.Named("mid", cosines), ptt.BlinnPhong(9.0))),
    "more": FITTED.with_brdf("mine", cosines),
}


def interpolated(space: BRDFSpace, shape: Shape) -> Tensor:
    """What the space makes of a shape at WI, WO: its samples times their weights."""
    values = torch.stack([sample.evaluate(WI, WO) for sample in space.samples])
    return space.coordinates(shape) @ values


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_every_sample_is_its_own_coordinate(space: BRDFSpace) -> None:
    for h, sample in enumerate(space.samples):
        weights = space.coordinates(sample)
        assert weights.shape == (len(space.samples),) and weights.dtype == torch.float64
        expected = torch.zeros(len(space.samples)).double()
        expected[h] = 1
        assert torch.allclose(weights, expected, atol=1e-6), h


def test_at_takes_parameters_in_either_case() -> None:
    assert FITTED.at(F0=0.4, m=0.2) == FITTED.at(f0=0.4, M=0.2)
    shape = FITTED.at(F0=0.4, m=0.2)
    assert numbers(shape) == pytest.approx([0.4, 0.2])
    assert BRDFSpace.ggx().at(F0=0.3, roughness=0.5) == ptt.GGX(0.3, 0.5)
    assert BRDFSpace.ward(anisotropic=True).at(ax=0.3, ay=0.5) == ptt.Ward(0.3, 0.5)


@pytest.mark.parametrize("given", [{}, {"F0": 0.1}, {"F0": 0.1, "slope": 0.2}, {"F0": 0.1, "f0": 0.2, "m": 0.2},
                                   {"f0": 0.1, "m": 0.2, "k": 1.0}], ids=str)  # fmt: skip
def test_at_names_the_parameters_it_wants(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"parameters must be f0, m, got {', '.join(given) or 'none'}"):
        FITTED.at(**given)


def test_at_of_names_and_of_wrong_ward() -> None:
    with pytest.raises(ValueError, match="the space holds BRDFs by name, not by parameters: matt, cosines, paint"):
        USER.at(exponent=3.0)
    with pytest.raises(ValueError, match="parameters must be ax, ay, got ax"):
        SPACES["anisotropic"].at(ax=0.2)
    with pytest.raises(ValueError, match="parameters must be ax, got ax, ay"):
        SPACES["ward"].at(ax=0.2, ay=0.2)


def test_at_outside_is_the_nearest_inside_or_refused() -> None:
    """In a triangle's box but across its long side, clamped, (1, 0.5) is the middle of that side: (0.5, 0.3)."""
    for parameters in ({"f0": 0.9, "m": 0.45}, {"f0": 1.0, "m": 0.5}, {"f0": 0.2, "m": 0.6}, {"f0": 0.2, "m": 0.05}):
        with pytest.raises(ValueError, match="the model's space, got"):
            TRIANGLE.at(**parameters)
        with pytest.raises(ValueError, match="the model's space, got"):
            TRIANGLE.coordinates(ptt.CookTorrance(**parameters))
    assert TRIANGLE.at(f0=0.5, m=0.3) == ptt.CookTorrance(0.5, 0.3)
    reached = BRDFSpace(TRIANGLE.samples, clamped=True).at(f0=1.0, m=0.5)
    assert numbers(reached) == pytest.approx([0.5, 0.3])
    low = BRDFSpace(SPACES["blinn-phong"].samples, clamped=True)
    assert low.at(exponent=99.0) == ptt.BlinnPhong(10.0) and low.at(exponent=0.1) == ptt.BlinnPhong(1.0)


def test_what_does_not_vary_is_clamped_or_refused_too() -> None:
    samples = ptt.CookTorrance(0.0, 0.2), ptt.CookTorrance(1.0, 0.2)
    assert BRDFSpace(samples).at(f0=0.3, m=0.2) == ptt.CookTorrance(0.3, 0.2)
    with pytest.raises(ValueError, match=r"m must be in 0.2..0.2, the model's space, got 0.9"):
        BRDFSpace(samples).at(f0=0.3, m=0.9)
    reached = BRDFSpace(samples, clamped=True).at(f0=0.3, m=0.9)
    assert numbers(reached) == pytest.approx([0.3, 0.2])


@pytest.mark.parametrize("clamped", [False, True])
def test_at_keeps_gradients(clamped: bool) -> None:
    f0 = torch.tensor(0.25, requires_grad=True)
    shape = BRDFSpace(TRIANGLE.samples, clamped=clamped).at(f0=f0, m=0.2)
    assert isinstance(shape, ptt.CookTorrance) and isinstance(shape.f0, Tensor) and isinstance(shape.m, float)
    shape.f0.backward()
    assert float(shape.f0.detach()) == pytest.approx(0.25) and shape.f0.dtype == torch.float32
    assert f0.grad is not None and float(f0.grad) == pytest.approx(1)


def test_one_brdf_in_the_space() -> None:
    one = SPACES["one"]
    assert one.coordinates(ptt.GGX(0.3, 0.4)).tolist() == [1] and one.at(F0=0.3, roughness=0.4) == one.samples[0]
    for f0, roughness in ((0.4, 0.4), (0.3, 0.5)):
        with pytest.raises(ValueError, match="the model's space, got"):
            one.at(f0=f0, roughness=roughness)


def test_ward_is_linear_along_slopes_and_barycentric_in_the_plane() -> None:
    assert SPACES["ward"].coordinates(ptt.Ward(0.15)).tolist() == pytest.approx([0.5, 0.5, 0])
    space = BRDFSpace.ward(anisotropic=True)
    plane = torch.tensor([numbers(shape) for shape in space.samples], dtype=torch.float64)  # ax, ay
    assert len(plane) == 49 and not space.isotropic and BRDFSpace.ward().isotropic
    for ax, ay in ((0.05, 0.6), (0.6, 0.05), (0.4, 0.4), (0.03, 0.9)):
        weights = space.coordinates(ptt.Ward(ax, ay))
        assert bool((weights >= 0).all()) and int((weights > 1e-12).sum()) <= 4
        assert (weights @ plane).tolist() == pytest.approx([ax, ay])


def test_ggx_is_exactly_linear_in_f0() -> None:
    """Schlick's F is (1 - f0) F_0 + f0 F_1: with F0 0 and 1 at each roughness, what lies between is exact."""
    space = BRDFSpace.ggx()
    for shape in (ptt.GGX(0.3, numbers(space.samples[20])[1]), ptt.GGX(0.04, 1.0), ptt.GGX(0.9, 0.1)):
        weights = space.coordinates(shape)
        assert int((weights > 1e-9).sum()) == 2
        assert torch.allclose(interpolated(space, shape), shape.evaluate(WI, WO), rtol=1e-9)


def test_ggx_between_roughnesses_is_as_good_at_every_f0() -> None:
    """At the peak, proportional to r^-4: between two roughnesses a tenth apart the chord lies above it by
    4 * 5 / 2 * (0.1 / 2)^2 = 2.5 % at the middle, at every F0 alike. Triangles would be 20 % beside it."""
    space = BRDFSpace.ggx()
    up = torch.tensor([[0.0, 0.0, 1.0]]).double()
    peaks = torch.cat([sample.evaluate(up, up) for sample in space.samples])
    for k in (4, 5, 12, 17):
        middle = math.sqrt(ptt.materials.spaces.ROUGHNESSES[k] * ptt.materials.spaces.ROUGHNESSES[k + 1])
        for f0 in (0.04, 0.5, 1.0):
            shape = ptt.GGX(f0, middle)
            assert float(space.coordinates(shape) @ peaks / shape.evaluate(up, up)) == pytest.approx(1.025, abs=0.005)


def test_named_ones_may_stand_anywhere_among_the_samples() -> None:
    space = SPACES["mixed"]
    assert space.coordinates(ptt.BlinnPhong(6.0)).tolist() == pytest.approx([0, 0.5, 0, 0.5])
    assert space.at(exponent=6.0) == ptt.BlinnPhong(6.0)
    assert space.coordinates(ptt.Named("mid")).tolist() == [0, 0, 1, 0]


def test_users_brdfs_are_functions_or_materials() -> None:
    assert torch.allclose(USER.material("matt").evaluate(WI, WO), torch.full((2, 3), 0.2).double())
    paint = ptt.ggx(0.1, (0.2, 0.4, 0.6), 0.3, 0.5)
    assert torch.equal(USER.material("paint").evaluate(WI, WO), paint.evaluate(WI, WO))
    assert USER.coordinates(ptt.Named("cosines")).tolist() == [0, 1, 0]
    assert not BRDFSpace.user({"a": ptt.ward(ax=0.1, ay=0.2)}).isotropic and USER.isotropic
    with pytest.raises(ValueError, match="material 'a' must have a shape"):
        BRDFSpace.user({"a": ptt.lambert(0.3)})


def test_with_brdf_keeps_what_was_there() -> None:
    space = FITTED.with_brdf("mine", cosines).with_brdf("paint", ptt.ggx(0.1, 0.5, 0.3, 0.5))
    assert len(space.samples) == 88 and len(FITTED.samples) == 86 and "mine" not in FITTED.materials
    assert space.clamped and space.material("chrome").shape == FITTED.material("chrome").shape
    assert torch.equal(
        space.coordinates(ptt.CookTorrance(0.3, 0.2))[:86], FITTED.coordinates(ptt.CookTorrance(0.3, 0.2))
    )
    assert space.coordinates(ptt.Named("paint"))[87] == 1 and space.at(F0=0.3, m=0.2) == FITTED.at(F0=0.3, m=0.2)
    with pytest.raises(ValueError, match="is taken"):
        space.with_brdf("mine", matt)


def test_all_highlights_of_a_material_join_a_space() -> None:
    gold = ptt.ggx(0.0, 1.0, (1.0, 0.8, 0.3), 0.5)
    for space in (BRDFSpace.user({"gold": gold}), FITTED.with_brdf("gold", gold)):
        assert [shape.name for shape in space.samples[-2:]] == ["gold", "gold/2"]  # type: ignore[union-attr]
        assert torch.equal(space.material("gold").evaluate(WI, WO), gold.evaluate(WI, WO))
        weights = space.coloured(space.material("gold"))[-2:]
        assert torch.equal(weights, torch.stack([h.colour.double() for h in gold.highlights]))


def test_a_blends_coordinates_are_the_weighted_sum() -> None:
    """Of names, of parameters, of blends; they sum to the weights' sum, and gradients reach weights and parameters."""
    space = SPACES["more"]
    weight = torch.tensor(0.5, requires_grad=True)
    m = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    shape = ptt.CookTorrance(0.3, m)
    inner = ptt.Blend((shape, ptt.Named("mine")), (weight, 2.0))
    outer = space.coordinates(ptt.Blend((inner, ptt.Named("mine")), (3.0, 1.0)))
    expected = 1.5 * space.coordinates(shape) + 7 * space.coordinates(ptt.Named("mine"))
    assert torch.allclose(outer, expected) and outer.sum().item() == pytest.approx(8.5)
    outer.sum().backward(retain_graph=True)
    assert weight.grad is not None and float(weight.grad) == pytest.approx(3)
    assert m.grad is not None and float(m.grad) == pytest.approx(0, abs=1e-9)
    outer.square().sum().backward()
    assert abs(float(m.grad)) > 1e-3


def test_ggx_coordinates_carry_gradients() -> None:
    at = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.3, 0.5)]
    assert torch.autograd.gradcheck(lambda f0, r: BRDFSpace.ggx().coordinates(ptt.GGX(f0, r)), at, eps=1e-7)


def test_paths_by_name_reach_both_materials() -> None:
    gold = ptt.fitted("gold-metallic-paint")
    chrome = ptt.fitted("chrome")
    path = FITTED.path("gold-metallic-paint", "chrome", steps=5)
    for material, end in ((path[0], gold), (path[4], chrome)):
        assert torch.allclose(material.evaluate(WI, WO), end.evaluate(WI, WO), rtol=1e-5)
    middle = path[2]
    assert torch.allclose(middle.diffuse, (gold.diffuse + chrome.diffuse) / 2)
    assert torch.allclose(middle.specular, (gold.specular + chrome.specular) / 2)
    ends = torch.tensor([numbers(gold.shape), numbers(chrome.shape)])
    assert numbers(middle.shape) == pytest.approx(ends.mean(0).tolist())


def test_paths_of_named_ones_blend() -> None:
    path = USER.path("matt", "paint", steps=5)
    ends = USER.material("matt"), USER.material("paint")
    for t, material in zip((0, 0.25, 0.5, 0.75, 1), path, strict=True):
        specular = torch.lerp(ends[0].specular, ends[1].specular, t)
        assert ends[0].shape is not None and ends[1].shape is not None and material.shape is not None
        shape = (1 - t) * ends[0].shape.evaluate(WI, WO) + t * ends[1].shape.evaluate(WI, WO)
        assert torch.allclose(material.evaluate(WI, WO), t * 0.1 / math.pi + shape[:, None] * specular, atol=1e-7)
        assert USER.coordinates(material.shape).tolist() == pytest.approx([1 - t, 0, t])
    across = SPACES["more"].path(ptt.CookTorrance(0.3, 0.2), ptt.Named("mine"), 3)
    assert SPACES["more"].coordinates(across[1])[86] == pytest.approx(0.5)


def test_paths_refused() -> None:
    space = SPACES["blinn-phong"]
    a = ptt.BlinnPhong(2.0)
    b = ptt.BlinnPhong(3.0)
    refused: list[tuple[tuple[Any, Any, int], str]] = [
        ((a, b, 1), "steps must be at least 2, got 1"),
        ((a, ptt.BlinnPhong(30.0), 3), "exponent must be in 1..10"),
        ((a, ptt.GGX(0.1, 0.2), 3), "the model's space holds blinn-phong shapes, got ggx"),
        ((a, ptt.Named("mine", matt), 3), "no BRDF 'mine' in the space"),
        ((a, ptt.Material(0.1, 0.2, b), 3), "start and end must both be shapes, or both materials"),
        ((ptt.lambert(0.5), ptt.Material(0.1, 0.2, b), 3), "both materials of a path must have a shape"),
        ((ptt.Material(0.1, 0.2, b), ptt.ggx(0.1), 3), "the model's space holds blinn-phong shapes, got ggx"),
    ]
    for ends, message in refused:
        with pytest.raises(ValueError, match=message):
            space.path(*ends)
    with pytest.raises(ValueError, match="no BRDF 'mat' in the space, whose named ones are: matt, cosines, paint"):
        USER.path(ptt.Named("mat", matt), ptt.Named("matt", matt), 3)
    with pytest.raises(ValueError, match="no material 'pant' among 3; near it: paint"):
        USER.path("matt", "pant", 3)


@pytest.mark.parametrize(("samples", "message"), [
    ((), "at least one shape"),
    ((ptt.Blend((ptt.Ward(0.1),), (1.0,)),), "and no Blend"),
    ((ptt.Ward(0.1), ptt.Ward(torch.tensor(0.1, dtype=torch.float64))), "samples must differ"),
    ((ptt.Named("a", matt), ptt.Named("a", cosines)), "the same name twice"),
    (tuple(ptt.GGX(x, x) for x in (0.1, 0.2, 0.3)), "must not lie on one line"),
], ids=str)  # fmt: skip
def test_samples_refused(samples: tuple[Shape, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BRDFSpace(samples)


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_config_round_trip(space: BRDFSpace) -> None:
    """Through JSON. Coordinates and materials survive; functions do not, and say so."""
    again = BRDFSpace.from_config(json.loads(json.dumps(space.to_config())))
    assert again.to_config() == space.to_config()
    assert again.clamped == space.clamped and list(again.materials) == list(space.materials)
    for ours, theirs in zip(again.samples, space.samples, strict=True):
        assert torch.equal(again.coordinates(theirs), space.coordinates(ours))
        if isinstance(ours, ptt.Named):
            with pytest.raises(ValueError, match=f"the BRDF '{ours.name}' came from a saved model"):
                ours.evaluate(WI, WO)
        else:
            assert ours == theirs


def test_a_wrong_name_among_ones_own() -> None:
    with pytest.raises(ValueError, match="no BRDF 'mat' in the space, whose named ones are: matt, cosines, paint; see"):
        USER.coordinates(ptt.Named("mat"))
    with pytest.raises(ValueError, match="whose named ones are: none"):
        FITTED.coordinates(ptt.Named("mat"))
    with pytest.raises(ValueError, match="the model's space holds named shapes, got ward"):
        USER.coordinates(ptt.Ward(0.2))


def test_functions_are_found_to_be_isotropic_or_not() -> None:
    for function, expected in [
        (lambda i, o: brdf.ward(i, o, 0.1, 0.12), False),
        (lambda i, o: brdf.ward(i, o, 0.02, 0.03), False),
        (lambda i, o: brdf.ward(i, o, 0.1), True),
        (lambda i, o: brdf.ggx(i, o, 0.04, 0.05), True),
        (brdf.lambert, True),
    ]:
        assert BRDFSpace.user({"mine": function}).isotropic is expected


def test_a_space_of_several_models() -> None:
    """Each shape lies between the samples of its own model, and what holds a scene's materials holds their models."""
    space = ptt.BRDFSpace(
        (ptt.BlinnPhong(4.0), ptt.GGX(0.0, 0.3), ptt.BlinnPhong(8.0), ptt.GGX(1.0, 0.3), ptt.Ward(0.2))
    )
    assert space.coordinates(ptt.BlinnPhong(5.0)).tolist() == pytest.approx([0.75, 0, 0.25, 0, 0])
    assert space.coordinates(ptt.GGX(0.25, 0.3)).tolist() == pytest.approx([0, 0.75, 0, 0.25, 0])
    assert space.coordinates(ptt.Ward(0.2)).tolist() == [0, 0, 0, 0, 1]
    assert space.at(exponent=6.0) == ptt.BlinnPhong(6.0)
    middle = space.path(ptt.BlinnPhong(4.0), ptt.Ward(0.2), 3)[1]
    assert space.coordinates(middle).tolist() == pytest.approx([0.5, 0, 0, 0, 0.5])
    with pytest.raises(ValueError, match="holds blinn-phong, ggx, ward shapes, got cook-torrance"):
        space.coordinates(ptt.CookTorrance(0.1, 0.2))
    with pytest.raises(ValueError, match="ward must have ax here, got ax, ay"):
        space.coordinates(ptt.Ward(0.2, 0.3))
    materials = [
        ptt.lambert(),
        ptt.blinn_phong(exponent=30.0),
        ptt.ggx(f0=(1.0, 0.7, 0.3)),
        ptt.ward(0.1, 0.2, 0.1, 0.3),
    ]
    held = ptt.BRDFSpace.holding(materials)
    assert {sample.model for sample in held.samples} == {"blinn-phong", "ggx", "ward"}
    assert ptt.BRDFSpace.from_config(held.to_config()).samples == held.samples
    for material in materials:
        held.coloured(material)
    assert {sample.model for sample in ptt.BRDFSpace.holding([ptt.lambert()]).samples} == {"blinn-phong"}


def test_a_space_reaches_as_far_as_its_materials() -> None:
    """Beyond the usual samples, and with materials and spaces that may be chosen later."""
    far = [ptt.ggx(roughness=0.03), ptt.blinn_phong(exponent=3000.0), ptt.ward(ax=0.97), ptt.ward(ax=0.01, ay=0.5)]
    worn = ptt.MetalRough(roughness_map=torch.tensor([0.02, 0.3]))
    space = ptt.BRDFSpace.holding([*far, worn, ptt.BRDFSpace.fitted(), ptt.BRDFSpace.ggx()])
    for material in (*far, *worn.layers, ptt.fitted("nickel"), ptt.ggx(roughness=0.5)):
        space.coloured(material)
    assert space.material("nickel") is not None
    with pytest.raises(ValueError, match="a space holds materials and spaces, got str"):
        ptt.BRDFSpace.holding(["nickel"])  # type: ignore[list-item]


def test_one_model_shows_materials_of_several_families() -> None:
    """What each shows alone, by default: a plastic of GGX beside a Blinn-Phong floor, both edited."""
    from ptt.ops import mesh
    from ptt.scene.parts import Part

    v, f = mesh.sphere_mesh(1, 0.5)
    floor = Part("floor", *mesh.plane_mesh(3.0, 4), material=ptt.blinn_phong(0.5, 0.2, 10.0))
    plastic = ptt.ggx(0.3, 1.0, (0.1, 0.05, 0.04), 0.4)
    parts = [floor, Part("ball", v + torch.tensor([0, 0.7, 0]), f, material=plastic)]
    scene = ptt.Scene.from_parts(parts)
    model = ptt.compress(ptt.precompute(scene, resolution=8), clusters=ptt.Clusters(60, 8, 32, 64))
    relighter = ptt.TransferRelighter(model, compiled=False)
    light = ptt.Environment.gradient_sky()
    for materials in ({}, {"ball": ptt.ggx(0.1, 1.0, (0.9, 0.6, 0.3), 0.3), "floor": ptt.blinn_phong(0.2, 0.5, 40.0)}):
        radiance = relighter(light, materials, scene.camera)
        assert bool(radiance.isfinite().all()) and float(radiance.mean()) > 0.01
