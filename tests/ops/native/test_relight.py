"""The kernels against the plain functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from ptt.light.prefiltered import samples
from ptt.ops import native, relight
from ptt.ops import view as plain
from ptt.ops.directions import turn
from ptt.ops.native.relight import TRANSFER
from ptt.ops.relight import ArrivingLight, LitRegion, OutgoingLight, Responses
from ptt.ops.sphere import Cube
from ptt.ops.view import LitLobes, SurfaceBlocks, ViewedRegion, light_about, points_at

W = 32
TILTS = 20
Inputs = tuple[list[ViewedRegion], Tensor]


def inputs(
    k: int = 2, s: int = 16, o: int = 8, b: int = 3, distant: bool = False, turns: int = 1, white: bool = False
) -> Inputs:
    g = torch.Generator().manual_seed(1000 * k + 100 * s + 10 * o + b)
    n = b * W
    frame = rotations(n, g).permute(1, 2, 0).contiguous()
    cuts = torch.randint(-(2**31), 2**31, (n, 64), generator=g).int()
    place = torch.randperm(n, generator=g)[: n - 5]
    colour = None if white else torch.rand(3, n, generator=g)
    lies = place, points_at(place, n)
    points = SurfaceBlocks(torch.randn(3, n, generator=g), frame, torch.rand(n, generator=g), colour, cuts, *lies)
    eye = torch.nn.functional.normalize(torch.randn(3, n, generator=g), dim=0) if distant else torch.ones(3)
    rho = torch.rand(turns * TILTS, k, generator=g)
    axes = 0.1 + torch.rand(TILTS, 2 * k, generator=g)
    maps = torch.rand(k, 12 * 12, 4, generator=g)
    which = torch.randperm(4, generator=g)[:k]
    turn = rotations(1, g)[0].contiguous()
    blurs = torch.rand(k, s, generator=g)
    gloss = LitLobes(which, rho, axes, torch.rand(3, generator=g), maps, turn, blurs) if k else None
    values = (4000 * torch.randn(b, 3, o + s + 1, W, generator=g)).to(torch.int16)
    sent = OutgoingLight(values, torch.rand(b, 3, o + s + 1, generator=g) / 4000)
    return [ViewedRegion(points, eye, sent, gloss)], torch.randn(14 * 14, o - 1, generator=g)


def rotations(n: int, g: torch.Generator) -> Tensor:
    rotation: Tensor = torch.linalg.qr(torch.randn(n, 3, 3, generator=g))[0]
    return rotation


def double(x: Inputs) -> Inputs:
    regions, outgoing = x
    return [in_double(region) for region in regions], outgoing.double()


def in_double(region: ViewedRegion) -> ViewedRegion:
    points, eye, sent, gloss = region
    if gloss is not None:
        doubled: Any = [t.double() if isinstance(t, Tensor) and t.is_floating_point() else t for t in gloss]
        gloss = LitLobes(*doubled)
    colour = None if points.colour is None else points.colour.double()
    points = points._replace(position=points.position.double(), frame=points.frame.double(), colour=colour)
    return ViewedRegion(points, eye.double(), sent._replace(unit=sent.unit.double()).whole(), gloss)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each call of the plain function by `native.view`."""
    made: list[int] = []
    original = plain.view

    def counted(*args: object) -> Tensor:
        made.append(1)
        return original(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(plain, "view", counted)
    return made


def agree(x: Inputs, calls: list[int]) -> None:
    got = native.view(*x)
    assert not calls  # by the kernel
    expected = plain.view(*double(x))  # tables of noise: float32 rounds where they are looked up
    calls.clear()
    assert got.shape == expected.shape and got.dtype == torch.float32
    assert torch.allclose(got.double(), expected, rtol=2e-5, atol=2e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("s", [0, 16])
@pytest.mark.parametrize("k", range(5))
def test_agrees_for_all_lobes(built: None, calls: list[int], k: int, s: int, distant: bool) -> None:
    agree(inputs(k, s, distant=distant, white=distant), calls)


@pytest.mark.parametrize("b", [1, 7])
@pytest.mark.parametrize("o", [1, 8, 16, 24])
def test_agrees_for_all_sizes(built: None, calls: list[int], o: int, b: int) -> None:
    agree(inputs(o=o, b=b), calls)


def test_agrees_where_directions_are_special(built: None, calls: list[int]) -> None:
    (region,), outgoing = inputs(k=4, distant=True)
    tangent, bitangent, normal = region.points.frame
    for eye in (normal, -normal, tangent, bitangent, -tangent, -bitangent):  # head-on, facing away, at the horizon
        agree(([region._replace(eye=eye.contiguous())], outgoing), calls)


def test_agrees_for_several_regions(built: None, calls: list[int]) -> None:
    regions = [region for k, b in ((4, 2), (0, 5), (2, 1)) for region in inputs(k, 16 if k else 0, b=b)[0]]
    agree((regions, inputs()[1]), calls)


def test_a_point_at_the_eye_is_finite(built: None) -> None:
    (region,), outgoing = inputs(k=4)
    region = region._replace(eye=region.points.position[:, 5].contiguous())
    assert native.view([region], outgoing).isfinite().all()


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x._replace(sent=x.sent._replace(unit=x.sent.unit.clone().requires_grad_())),
        lambda x: x._replace(points=x.points._replace(frame=x.points.frame.transpose(0, 1))),
        lambda x: inputs(turns=2)[0][0],
    ],
    ids=["gradient", "strided", "anisotropic"],
)
def test_what_the_kernel_is_not_for_goes_the_plain_way(
    calls: list[int], change: Callable[[ViewedRegion], ViewedRegion]
) -> None:
    (region,), outgoing = inputs()
    x = [region, change(region)], outgoing
    got = native.view(*x)
    assert calls == [1] and torch.equal(got, plain.view(*x))


def test_float64_goes_the_plain_way(calls: list[int]) -> None:
    x = double(inputs())
    got = native.view(*x)
    assert calls == [1] and torch.equal(got, plain.view(*x))


def test_without_lobes_there_is_no_light_about_them() -> None:
    assert light_about(torch.zeros(0, 12 * 12, 4), torch.zeros(5, 0, 3)).shape == (5, 0, 3)


def test_gradients_pass() -> None:
    (region,), outgoing = inputs()
    values = region.sent.values.float().requires_grad_()
    native.view([region._replace(sent=region.sent._replace(values=values))], outgoing).sum().backward()
    assert values.grad is not None and values.grad.isfinite().all()


def test_without_gradients_a_parameter_goes_by_the_kernel(built: None, calls: list[int]) -> None:
    x = inputs()
    x[1].requires_grad_()
    with torch.no_grad():
        agree(x, calls)


# The light step and the BRDF step


@pytest.fixture
def alone(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain functions are not there for those of `native` to call."""
    for name in ("lighting", "light_eigens", "exitants"):
        monkeypatch.setattr(relight, name, None)


PLAIN = relight.lighting, relight.light_eigen


def close(got: Tensor, expected: Tensor, tolerance: float = 2e-6) -> None:
    assert got.shape == expected.shape and got.dtype == torch.float32
    largest = float(expected.abs().max()) if expected.numel() else 0.0
    assert torch.allclose(got.double(), expected.double(), rtol=0, atol=tolerance * largest)


@pytest.mark.parametrize("n", [4, 16, 32])
def test_lighting_agrees(alone: None, n: int) -> None:
    g = torch.Generator().manual_seed(n)
    grid = Cube(n)
    fine = torch.rand(32 * 32, 4, generator=g)
    turned = (turn(1, 40.0) @ turn(0, 25.0)).float()
    directions, shares = samples(grid)
    strided = directions.transpose(0, 2).contiguous().transpose(0, 2)
    arguments = fine, turned.T.contiguous().T, strided, shares, grid.shape
    close(native.lighting(*arguments), PLAIN[0](*arguments), 1e-5)


@pytest.mark.parametrize("stored", TRANSFER)
@pytest.mark.parametrize(("k", "rows", "x"), [(1, 1, 1), (3, 7, 37), (2, 20, 128), (2, 5, 300), (0, 4, 8), (2, 0, 8)])
def test_light_eigen_agrees(alone: None, stored: torch.dtype, k: int, rows: int, x: int) -> None:
    g = torch.Generator().manual_seed(x)
    transfer = torch.randn(k, rows, x, generator=g).to(stored)
    columns = torch.randint(0, 50, (k, rows), generator=g)
    exact = transfer.double()
    for lighting in (torch.randn(k, 3, rows, generator=g), torch.randn(3, rows, generator=g)):
        expected = lighting.double() @ exact
        close(native.light_eigens([transfer], [lighting], [None])[0], expected.expand(k, 3, x))
    lighting = torch.randn(3, 50, generator=g)
    close(native.light_eigens([transfer], [lighting], [columns])[0], PLAIN[1](exact, lighting.double(), columns))


def arriving(
    k: int, e: int, i: int, q: int, p: int, size: float = 1.0
) -> tuple[ArrivingLight, Tensor, Tensor, Tensor, Responses]:
    g = torch.Generator().manual_seed(k + e + i + q + p)
    shapes = ((k, 3, e, i), (k, 3, q, e, 16), (k, 3, p, e), (q, 3), (p, 3), (3, i + 2, i), (16, i), (16, 16))
    *three, h, pairs, coupling, a, b = (torch.randn(shape, generator=g) for shape in shapes)
    return ArrivingLight(*(size * x for x in three)), h, pairs, coupling, Responses(a, b)


def eigen_of(function: Callable[[Tensor], Tensor], arguments: Any, glossy: bool) -> Tensor:
    """`eigen` of a function of every tensor."""
    taken: list[Any] = [type(t)(*map(function, t)) if isinstance(t, tuple) else function(t) for t in arguments]
    return relight.eigen(*taken, *[glossy])


@pytest.mark.parametrize("glossy", [True, False])
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize(
    ("sizes", "b"),
    [
        ((1, 1, 1, 1, 0), 1),
        ((2, 7, 9, 4, 6), 3),
        ((3, 32, 17, 10, 75), 70),
        ((2, 5, 9, 0, 3), 4),
        ((2, 5, 9, 0, 0), 2),
        ((1, 2, 3, 1, 1), 0),
    ],
)
def test_exitant_agrees(alone: None, sizes: tuple[int, int, int, int, int], b: int, size: float, glossy: bool) -> None:
    x = arriving(*sizes, size)
    k, e, *_ = sizes
    g = torch.Generator().manual_seed(b)
    weights = torch.randn(b, e, 128, generator=g)
    cluster = torch.randint(0, k, (b,), generator=g)  # in no order
    (sent,) = native.exitants([LitRegion(*x[:4], weights, cluster, glossy)], x[4])
    expected = relight.expand(eigen_of(Tensor.double, x, glossy), weights.double(), cluster).values
    assert sent.values.dtype == torch.int16 and sent.values.shape[2] == expected.shape[2] + 1
    values = sent._replace(unit=sent.unit.double()).whole().values
    assert values.isfinite().all()
    values = values.unflatten(0, (b, 8)).permute(0, 2, 3, 1, 4).flatten(3)
    # half a unit, a 32,767th of the largest sum of a row, the first aside; and float32's rounding of all that is summed
    most = expected.abs().amax(3, keepdim=True)
    summed = eigen_of(lambda t: t.double().abs(), x, glossy)
    summed = torch.einsum("bcex,bew->bcxw", summed[cluster], weights.double().abs())
    most[:, :, 0] = 0
    assert bool(((values - expected).abs() <= 0.51 / 32767 * most + 1e-6 * summed).all())


def test_exitant_of_no_light_is_nothing(alone: None) -> None:
    dark, h, pairs, coupling, responses = arriving(1, 4, 5, 2, 1)
    nothing = ArrivingLight(*map(torch.zeros_like, dark))
    blocks = torch.ones(1, 4, 128), torch.zeros(1, dtype=torch.int64)
    (sent,) = native.exitants([LitRegion(nothing, h, pairs, coupling, *blocks, True)], responses)
    assert sent.values.count_nonzero() == 0 and sent.unit.isfinite().all()


def test_gradients_go_the_plain_way() -> None:
    leaves = []

    def leaf(x: Tensor) -> Tensor:
        leaves.append(x.requires_grad_())
        return x

    x = arriving(2, 3, 5, 2, 1)
    region = LitRegion(x[0], leaf(x[1]), *x[2:4], torch.ones(2, 3, 128), torch.tensor([0, 1]), True)
    (spread,) = native.exitants([region], x[4])
    lit = native.light_eigens([torch.ones(1, 3, 2)], [leaf(torch.ones(3, 3))], [None])[0]
    light = native.lighting(leaf(torch.ones(64, 4)), torch.eye(3), *samples(Cube(4)), Cube(4).shape)
    (spread.values.sum() + lit.sum() + light.sum()).backward()
    assert all(t.grad is not None and t.grad.isfinite().all() for t in leaves)
