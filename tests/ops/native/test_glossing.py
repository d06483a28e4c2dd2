"""The kernel of glossy reflection against the plain function."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from ptt.materials.shapes import GGX, Analytic, Ward
from ptt.ops import cells, native
from ptt.ops import gloss as plain
from ptt.ops.around import Around
from ptt.ops.cells import Gloss, Lobes
from ptt.ops.constants import BITS, LEVELS, MEETS, PARTS, RECORD, RINGS, ROW, SECTORS, SENT, TILTS
from ptt.ops.gloss import GlossLight
from ptt.ops.hemispheres import SHARES, Between, words_of
from ptt.ops.transfer import meets_packed
from ptt.ops.view import SurfaceBlocks, points_at


class Inputs(NamedTuple):
    points: SurfaceBlocks
    eye: Tensor
    seen: Tensor
    gloss: Gloss
    light: GlossLight
    around: Around | None = None
    share: Tensor | None = None
    between: Between | None = None


def inputs(
    lobes: int = 16,
    lamps: int = 3,
    n: int = 96,
    distant: bool = False,
    side: int = 12,
    turns: int = 1,
    levels: tuple[float, float] = (-1.0, LEVELS),
) -> Inputs:
    """Tables and maps of noise, f smooth enough for float32."""
    g = torch.Generator().manual_seed(1000 * lobes + 100 * lamps + n)
    frame = rotations(n, g).permute(1, 2, 0).contiguous()
    place = torch.randperm(n, generator=g)[: n - 5]
    dip = torch.rand(n, generator=torch.Generator().manual_seed(lobes))
    points = SurfaceBlocks(torch.randn(3, n, generator=g), frame, dip, None, torch.empty(0), place, points_at(place, n))
    axes = torch.randn(1, lobes, 3, generator=g) + 0.2 * torch.randn(turns * TILTS, lobes, 3, generator=g)
    level = torch.empty(turns * TILTS, lobes, 1).uniform_(*levels, generator=g).clamp(0, LEVELS - 1)
    table = torch.cat((axes, level, torch.rand(turns * TILTS, lobes, 3, generator=g)), 2)
    sectors = SECTORS if turns == 1 else 2 * SECTORS
    values = torch.rand(turns * TILTS, RINGS, sectors, 3, generator=g)
    maps = torch.rand(LEVELS, side * side, 4, generator=g)
    maps[..., 3] = 0
    of_lamps = (
        directions(lamps, g),
        torch.rand(lamps, 3, generator=g),
        torch.rand(lamps, n, generator=g).round(decimals=1),
    )
    light = GlossLight(maps, rotations(1, g)[0].contiguous(), *of_lamps)
    eye = directions(n, g).T.contiguous() if distant else torch.ones(3)
    return Inputs(
        points,
        eye,
        hemispheres(n, g),
        Gloss(Lobes(table, turns), values, table[:0], table[:0], spread=90.0),
        light,
    )


def words(n: int, count: int, g: torch.Generator) -> Tensor:
    return torch.randint(-(2**31), 2**31, (n, count), generator=g).int()


def hemispheres(n: int, g: torch.Generator) -> Tensor:
    """Bits of noise, and shares that change evenly, so that rounding chooses no slope: their slopes jump otherwise."""
    noise = words(n, BITS * BITS // 32, g)
    steps = torch.rand(n, 2, 1, 1, generator=g)
    parts = []
    for side in SHARES.values():
        row, column = torch.meshgrid(*[torch.arange(side) / side] * 2, indexing="ij")
        parts.append((60 + 60 * (steps[:, 0] * row + steps[:, 1] * column)).flatten(1).round())
    return torch.cat((noise, torch.cat(parts, 1).to(torch.uint8).view(torch.int32)), 1)


def directions(n: int, g: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)


def rotations(n: int, g: torch.Generator) -> Tensor:
    rotation: Tensor = torch.linalg.qr(torch.randn(n, 3, 3, generator=g))[0]
    return rotation


def in_double(x: Inputs) -> Inputs:
    points = x.points._replace(position=x.points.position.double(), frame=x.points.frame.double())
    gloss = x.gloss._replace(
        lobes=x.gloss.lobes._replace(table=x.gloss.lobes.table.double()), values=x.gloss.values.double()
    )
    around = x.around and x.around._replace(
        **{name: t.double() for name, t in x.around._asdict().items() if t.is_floating_point()}
    )
    between = x.between and Between(x.between.rows, x.between.weights.double(), x.between.frames.double())
    light = GlossLight(*(t.double() for t in x.light))
    return Inputs(points, x.eye.double(), x.seen, gloss, light, around, x.share, between)


def surroundings(n: int, p: int, g: torch.Generator) -> Around:
    """Of noise, but for the rows of a region's table, which are alike, so that rounding chooses none of them."""
    bent = torch.where(torch.arange(n)[:, None, None] < n // 2, 0.2, 3.0)  # half of the surroundings are smooth
    normals = torch.randn(n, 1, 3, generator=g) + bent * torch.randn(n, MEETS * MEETS, 3, generator=g)
    meets = meets_packed(torch.randint(-1, p, (n, MEETS * MEETS), generator=g).int(), normals)
    one_met = meets_packed(  # by each row: rounding chooses no cell
        torch.randint(-1, p, (7, 1), generator=g).int().expand(-1, MEETS * MEETS),
        torch.randn(7, 1, 3, generator=g).expand(-1, MEETS * MEETS, -1),
    )
    numbers = torch.stack((torch.randint(7, (p,), generator=g), TILTS * torch.randint(3, (p,), generator=g)), 1)
    records = torch.cat((rotations(p, g).flatten(1), numbers.float(), torch.zeros(p, RECORD - 11)), 1)
    tables = rows(3, g).repeat_interleave(TILTS, 0)
    parts = rows(3 * PARTS, g).reshape(3, PARTS, ROW).repeat_interleave(TILTS, 0)
    maps = torch.rand(LEVELS, 144, 4, generator=g)
    lamps = 5
    return Around(
        torch.rand(3, n, generator=g),
        meets,
        records,
        torch.rand(p, SENT, generator=g),
        hemispheres(7, g),
        one_met,
        tables,
        parts,
        maps,
        directions(lamps, g),
        torch.rand(lamps, 3, generator=g),
        torch.rand(7, lamps, generator=g),
    )


def rows(n: int, g: torch.Generator) -> Tensor:
    """Lobes of noise (n, ROW), of whole levels."""
    level = torch.tensor([0.0, 4.0, 7.0]).repeat(n // 3)[:, None]
    return torch.cat((directions(n, g), level, torch.rand(n, 4, generator=g)), 1)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each call of the plain function by `native.shine`."""
    made: list[int] = []
    original = plain.shine

    def counted(*args: object) -> Tensor:
        made.append(1)
        return original(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(plain, "shine", counted)
    return made


def agree(x: Inputs, calls: list[int]) -> None:
    """By the kernel, and as right as float32: tables of noise make much of how it rounds where they are looked up."""
    got = native.shine(*x)
    assert not calls
    expected = plain.shine(*in_double(x))
    rounding = float((plain.shine(*x).double() - expected).abs().max())
    calls.clear()
    assert got.shape == expected.shape and got.dtype == torch.float32
    error = (got.double() - expected).abs()
    assert float(error.mean()) < 1e-5 * float(expected.abs().max())
    assert float(error.max()) < 2e-4 * float(expected.abs().max()) + 2 * rounding


@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("lamps", [0, 1, 8])
@pytest.mark.parametrize("lobes", [1, 4, 7, 16, 64])
def test_agrees_for_all_lobes(built: None, calls: list[int], lobes: int, lamps: int, distant: bool) -> None:
    agree(inputs(lobes, lamps, distant=distant), calls)


@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("lamps", [0, 3])
@pytest.mark.parametrize("turns", [2, cells.TURNS])
def test_agrees_for_anisotropic_materials(built: None, calls: list[int], turns: int, lamps: int, distant: bool) -> None:
    agree(inputs(5, lamps, turns=turns, distant=distant), calls)


@pytest.mark.parametrize("bits", [32, 128])
@pytest.mark.parametrize("corners", [1, 3, 4])
def test_agrees_between_places(built: None, calls: list[int], corners: int, bits: int) -> None:
    """Of places that see all or nothing, so that rounding of axes chooses no cell."""
    g = torch.Generator().manual_seed(corners)
    n, places = 96, 23
    whole = torch.where(torch.rand(places, 1, generator=g) < 0.5, 0, -1).int().expand(-1, words_of(bits))
    rows = torch.randint(places, (n, corners), generator=g).int()
    between = Between(rows, torch.rand(n, corners, generator=g), rotations(places, g).contiguous())
    agree(inputs()._replace(seen=whole.contiguous(), between=between), calls)


@pytest.mark.parametrize(("n", "side"), [(16, 4), (112, 130)])
def test_agrees_for_all_sizes(built: None, calls: list[int], n: int, side: int) -> None:
    agree(inputs(n=n, side=side), calls)


@pytest.mark.parametrize("levels", [(0.0, 1.0), (1.0, 3.0), (3.0, 5.0), (5.0, 7.0), (7.0, 9.0)])
def test_agrees_for_all_widths(built: None, calls: list[int], levels: tuple[float, float]) -> None:
    agree(inputs(levels=levels), calls)


def test_agrees_at_the_horizon(built: None, calls: list[int]) -> None:
    x = inputs(distant=True)
    tangent, bitangent, _ = x.points.frame
    for eye in (tangent, bitangent, -tangent, -bitangent):
        agree(x._replace(eye=eye.contiguous()), calls)


def test_agrees_head_on_and_facing_away(built: None, calls: list[int]) -> None:
    """Frames without rounding: there a direction above the normal has no azimuth, and is taken to lie over x."""
    x = inputs(distant=True)
    frame = torch.eye(3)[:, :, None].repeat(1, 1, x.eye.shape[1])
    for eye in (frame[2], -frame[2]):
        agree(x._replace(points=x.points._replace(frame=frame), eye=eye.contiguous()), calls)


@pytest.mark.parametrize("lamps", [0, 3])
@pytest.mark.parametrize("lobes", [1, 16, 40])
def test_agrees_for_what_lies_around(built: None, calls: list[int], lobes: int, lamps: int) -> None:
    x = inputs(lobes, lamps)
    agree(x._replace(around=surroundings(x.points.position.shape[1], 50, torch.Generator().manual_seed(lobes))), calls)


def test_agrees_where_the_material_is_a_part(built: None, calls: list[int]) -> None:
    """Groups without any of it are left out."""
    x = inputs()
    share = torch.rand(3, 96, generator=torch.Generator().manual_seed(2))
    share[:, 32:64] = 0
    share[:2, 70] = 0
    agree(x._replace(share=share), calls)


def test_what_is_hidden_is_dark(built: None) -> None:
    x = inputs()
    light = x.light._replace(through=torch.zeros_like(x.light.through))
    assert native.shine(*x._replace(seen=torch.zeros_like(x.seen), light=light)).count_nonzero() == 0


def test_a_point_at_the_eye_is_as_head_on(built: None, calls: list[int]) -> None:
    x = inputs()
    agree(x._replace(eye=x.points.position[:, 5].contiguous()), calls)


def test_of_no_points_comes_nothing(built: None) -> None:
    assert native.shine(*inputs(n=16)._replace(points=inputs(n=16).points._replace(place=torch.arange(0)))).shape == (
        0,
        3,
    )


def with_gradient(x: Inputs) -> Inputs:
    return x._replace(eye=x.eye.clone().requires_grad_())


def strided(x: Inputs) -> Inputs:
    return x._replace(points=x.points._replace(frame=x.points.frame.transpose(0, 1)))


def between_and_around(x: Inputs) -> Inputs:
    g = torch.Generator().manual_seed(1)
    n = x.points.position.shape[1]
    between = Between(torch.arange(n)[:, None].int(), torch.ones(n, 1), rotations(n, g).contiguous())
    return x._replace(around=surroundings(n, 50, g), between=between)


@pytest.mark.parametrize("change", [with_gradient, in_double, strided, between_and_around])
def test_what_the_kernel_is_not_for_goes_the_plain_way(calls: list[int], change: Callable[[Inputs], Inputs]) -> None:
    x = change(inputs())
    got = native.shine(*x)
    assert calls == [1] and torch.equal(got, plain.shine(*x))


def test_gradients_pass() -> None:
    x = inputs(lobes=4)
    table = x.gloss.lobes.table.clone().requires_grad_()
    native.shine(*x._replace(gloss=x.gloss._replace(lobes=Lobes(table, 1)))).sum().backward()
    assert table.grad is not None and table.grad.isfinite().all()


@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("lamps", [0, 1, 9])
def test_reflected_lamps_agree(built: None, lamps: int, hidden: bool, distant: bool) -> None:
    x = inputs(1, lamps, distant=distant)
    given = [x.points.position, x.points.frame, x.points.dip, x.eye, x.gloss.values, x.light.lamps, x.light.powers]
    given += [x.light.through] if hidden else []
    with native.refusals() as found:
        got = native.reflected_lamps(*given)
    assert not found
    expected = plain.reflected_lamps(*(t.double() for t in given))
    assert got.shape == expected.shape
    torch.testing.assert_close(got.double(), expected, rtol=1e-3, atol=1e-3)  # values of noise


@pytest.mark.parametrize("turns", [2, cells.TURNS])
def test_lamps_reflected_by_anisotropic_materials_agree(built: None, turns: int) -> None:
    x = inputs(1, 4, turns=turns)
    given = [x.points.position, x.points.frame, x.points.dip, x.eye, x.gloss.values, x.light.lamps, x.light.powers]
    with native.refusals() as found:
        got = native.reflected_lamps(*given)
    assert not found
    expected = plain.reflected_lamps(*(t.double() for t in given))
    torch.testing.assert_close(got.double(), expected, rtol=1e-3, atol=1e-3)  # values of noise


@pytest.mark.parametrize(("lamps", "each"), [(0, 0), (1, 1), (9, 13)])
def test_lamp_visibility_agrees(built: None, lamps: int, each: int) -> None:
    g = torch.Generator().manual_seed(lamps)
    given = words(12, 96, g), torch.randint(12 * 32, (lamps, each), generator=g), torch.rand(lamps, each, generator=g)
    with native.refusals() as found:
        got = native.lamp_visibility(*given)
    assert not found
    torch.testing.assert_close(got, plain.lamp_visibility(*given), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shape", [GGX(1.0, 0.03), GGX(1.0, 0.5), Ward(0.1, 0.3)], ids=str)
@pytest.mark.parametrize("counts", [(1,), (16, 4), (3, 40, 1)], ids=str)
def test_cells_agree(built: None, shape: Analytic, counts: tuple[int, ...]) -> None:
    """To rounding: cells are of whole numbers, and so the same."""
    samples = cells.sampled(lambda wi, wo: shape.evaluate(wi, wo)[..., None].expand(*wi.shape[:-1], 3), shape.isotropic)
    given = cells.nodes(1).mirrored, samples.reflected, counts
    with native.refusals() as found:
        got = native.cell_sums(*given)
    assert not found
    expected = cells.cell_sums(*given)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-6)
    alone = [native.cell_sums(*given[:2], (n,)) for n in counts]
    assert torch.equal(got, torch.cat(alone, 1))


def test_a_material_that_reflects_nothing_has_cells_without_light(built: None) -> None:
    mirrored = cells.nodes(1).mirrored
    assert native.cell_sums(mirrored, torch.zeros(TILTS, mirrored.shape[2], 3), (4,)).count_nonzero() == 0
