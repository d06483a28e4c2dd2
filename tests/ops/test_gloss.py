"""Narrow lobes: what they reflect is what f does, by quadrature of its own; visibility and lamps cut and add."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.materials.shapes import GGX, Analytic, BlinnPhong, CookTorrance, Ward
from ptt.ops import cells, gloss, hemispheres, transfer
from ptt.ops.around import Around
from ptt.ops.constants import BITS, LEVELS, MEETS, RECORD, ROW, SENT, TILTS
from ptt.ops.octahedral import HemiOctahedral, Octahedral, bordered
from ptt.ops.sphere import Cube
from ptt.ops.view import SurfaceBlocks

SHAPES: list[Analytic] = [
    GGX(1.0, 0.03),
    GGX(1.0, 0.1),
    GGX(1.0, 0.5),
    GGX(1.0, 1.0),
    GGX(0.04, 0.3),
    BlinnPhong(10.0),
    CookTorrance(0.4, 0.2),
]


def grey(shape: Analytic) -> cells.Reflects:
    return lambda wi, wo: shape.evaluate(wi, wo)[..., None].expand(*wi.shape[:-1], 3)


def tilted(degrees: float, turn: float = 0.0, count: int = 1) -> Tensor:
    """Directions (3, count), all the same."""
    t, p = math.radians(degrees), math.radians(turn)
    d = torch.tensor([math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)])
    return d[:, None].repeat(1, count)


def points(count: int, seen: Callable[[Tensor], Tensor] | None = None) -> tuple[SurfaceBlocks, Tensor]:
    """Points whose frames are the world's, and what they see; seen: of directions (n, 3), whether they are free."""
    fine = HemiOctahedral(BITS).directions().reshape(-1, 3).float()
    free = torch.ones(len(fine), dtype=torch.bool) if seen is None else seen(fine)
    words = (free.reshape(-1, 32).long() << torch.arange(32)).sum(1)
    bits = (words - (words >= 2**31).long() * 2**32).int()
    solid = HemiOctahedral(BITS).solid_angles().reshape(-1).float()
    shares = []
    for angle, side in hemispheres.SHARES.items():
        cosine = (HemiOctahedral(side).directions().reshape(-1, 3).float() @ fine.T).clamp(-1, 1)
        weight = torch.exp(-(cosine.acos() ** 2) / (2 * (math.radians(angle) / 3) ** 2)) * solid * fine[:, 2]
        shares.append((255 * (weight @ free.float()) / weight.sum(1)).round().to(torch.uint8))
    blocks = SurfaceBlocks(
        torch.zeros(3, count),
        torch.eye(3)[:, :, None].repeat(1, 1, count),
        torch.zeros(count),
        None,
        torch.empty(0),
        torch.arange(count),
        torch.arange(count, dtype=torch.int32),
    )
    return blocks, torch.cat((bits, torch.cat(shares).view(torch.int32))).repeat(count, 1)


def light_of(radiance: Callable[[Tensor], Tensor], lamps: Tensor | None = None) -> gloss.GlossLight:
    """A light that is smooth: the same at all levels."""
    cells = Octahedral(128).directions().reshape(-1, 3).float()
    texels = bordered(radiance(cells)[:, None].expand(-1, 3))
    maps = torch.nn.functional.pad(texels, (0, 1)).expand(LEVELS, -1, -1).contiguous()
    lamps = torch.zeros(0, 3) if lamps is None else lamps
    return gloss.GlossLight(maps, torch.eye(3), lamps, torch.ones(len(lamps), 3), torch.ones(len(lamps), 16))


def dense(shape: Analytic, wo: Tensor, weight: Callable[[Tensor], Tensor]) -> float:
    """The integral of f cos times a weight, by half vectors 50 times as dense as the nodes, in float64."""
    u = torch.linspace(-36, 14, 1201, dtype=torch.float64)
    square, step = torch.exp2((u[1:] + u[:-1]) / 2), u[1] - u[0]
    phi = (torch.arange(180, dtype=torch.float64) + 0.5) * (2 * math.pi / 180)
    z = (1 + square).rsqrt()[:, None]
    s = square.sqrt()[:, None] * z
    around = math.atan2(float(wo[1]), float(wo[0]))
    h = torch.stack((s * (phi + around).cos(), s * (phi + around).sin(), z.expand(-1, 180)), -1).flatten(0, 1)
    share = (square * math.log(2) * step / 2)[:, None] * z**3 * (2 * math.pi / 180)
    along = h @ wo.double()
    wi = 2 * along[:, None] * h - wo.double()
    keep = (wi[:, 2] > 0) & (along > 0)
    wi, measure = wi[keep], (4 * along * share.expand(-1, 180).flatten())[keep]
    value = shape.evaluate(wi, wo.double().expand_as(wi)) * wi[:, 2] * measure
    return float((value * weight(wi)).sum())


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_constant_light_is_reflected_as_the_albedo(shape: Analytic) -> None:
    """To 1 % from 0 to 80 degrees, 3 % to 87: the weights are sums of f cos over cells that hold every node."""
    tables = [cells.gloss_of(grey(shape), True, n) for n in (1, 16, 40)]
    even = light_of(lambda d: torch.ones(len(d)))
    for degrees in (0.0, 20.0, 45.0, 60.0, 75.0, 80.0, 84.0, 87.0):
        wo = tilted(degrees, 30.0, 16)
        expected = dense(shape, wo[:, 0], lambda d: torch.ones(len(d)))
        got = [float(gloss.shine(*_at(wo), table, even)[0, 0]) for table in tables]
        assert got == pytest.approx([expected] * 3, rel=0.01 if degrees <= 80 else 0.03), degrees


@pytest.mark.parametrize("shape", [GGX(1.0, 0.2), GGX(1.0, 0.5), GGX(0.04, 0.4), BlinnPhong(30.0)], ids=str)
@pytest.mark.parametrize("degrees", [10.0, 45.0, 75.0])
def test_a_sky_over_a_wall(shape: Analytic, degrees: float) -> None:
    """A light that grows towards one side, half of it hidden by a wall whose edge crosses the lobe."""
    wo = tilted(degrees, 200.0, 16)
    mirror = wo[:, 0] * wo.new_tensor([-1.0, -1.0, 1.0])
    wall = normalize(torch.linalg.cross(mirror, torch.tensor([0.3, 0.5, 1.0])), dim=0)

    def seen(d: Tensor) -> Tensor:
        return d @ wall.to(d) > -0.05

    def sky(d: Tensor) -> Tensor:
        return 1 + 0.7 * d[:, 0] + 0.5 * d[:, 1] * d[:, 2]

    got = gloss.shine(
        points(16, seen)[0], wo, points(16, seen)[1], cells.gloss_of(grey(shape), True, 16), light_of(sky)
    )
    expected = dense(shape, wo[:, 0], lambda d: sky(d) * seen(d))
    assert float(got[0, 0]) == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("shape", [GGX(1.0, 0.1), GGX(0.04, 0.3), CookTorrance(0.4, 0.2), Ward(0.3, 0.15)], ids=str)
def test_a_lamp_is_reflected_by_f_itself(shape: Analytic) -> None:
    tables = cells.gloss_of(grey(shape), shape.isotropic, 8)
    off = torch.tensor([[0.0, 0.0], [0.01, 0.005], [-0.03, 0.04], [0.2, -0.1], [0.4, 0.3]])
    black = light_of(lambda d: torch.zeros(len(d)))
    for degrees in (0.0, 30.0, 60.0, 78.0):
        bound = 0.06 if shape.isotropic else 0.15  # of its azimuths there are 24
        wo = tilted(degrees, 77.0, 16)
        mirror = wo[:, 0] * wo.new_tensor([-1.0, -1.0, 1.0])
        lamps = normalize(mirror + torch.nn.functional.pad(off, (0, 1)), dim=1)
        for lamp in lamps:
            given = black._replace(lamps=lamp[None], powers=torch.tensor([[1.0, 2.0, 3.0]]), through=torch.ones(1, 16))
            got = gloss.shine(points(16)[0], wo, points(16)[1], tables, given)[0]
            expected = float(shape.evaluate(lamp[None].double(), wo[:, :1].T.double())) * float(lamp[2].clamp(min=0))
            assert got.tolist() == pytest.approx([expected, 2 * expected, 3 * expected], rel=bound, abs=1e-3), degrees
            half = gloss.shine(
                points(16)[0], wo, points(16)[1], tables, given._replace(through=torch.full((1, 16), 0.5))
            )
            assert torch.allclose(half[0], got / 2)


def test_a_turn_about_the_normal_exchanges_slopes() -> None:
    """Ward's slopes along tangent and bitangent, exchanged, are the shape a quarter turn on."""
    wo = tilted(50.0, 20.0, 16)
    sky = light_of(lambda d: (4 * d[:, 0]).exp())
    turned = light_of(lambda d: (4 * d[:, 1]).exp())
    one = gloss.shine(*_at(wo), cells.gloss_of(grey(Ward(0.1, 0.4)), False, 16), sky)
    other = gloss.shine(*_at(tilted(50.0, 110.0, 16)), cells.gloss_of(grey(Ward(0.4, 0.1)), False, 16), turned)
    assert torch.allclose(one, other, rtol=0.02)
    assert not torch.allclose(
        one, gloss.shine(*_at(wo), cells.gloss_of(grey(Ward(0.4, 0.1)), False, 16), sky), rtol=0.05
    )


def _at(wo: Tensor) -> tuple[SurfaceBlocks, Tensor, Tensor]:
    blocks, bits = points(wo.shape[1])
    return blocks, wo, bits


def test_an_eye_and_directions_to_it_are_the_same() -> None:
    blocks, bits = points(16)
    blocks = blocks._replace(position=torch.rand(3, 16))
    eye = torch.tensor([0.3, 2.0, 4.0])
    tables, sky = cells.gloss_of(grey(GGX(1.0, 0.3)), True, 16), light_of(lambda d: 1 + d[:, 0])
    wo = normalize(eye[:, None] - blocks.position, dim=0)
    assert torch.allclose(gloss.shine(blocks, eye, bits, tables, sky), gloss.shine(blocks, wo, bits, tables, sky))


def test_derivatives_reach_colour_and_shape() -> None:
    """Against differences of the albedo by quadrature."""
    roughness = torch.tensor(0.4, requires_grad=True)
    shape = GGX(1.0, roughness)
    lit = gloss.shine(
        *_at(tilted(50.0, 0.0, 16)), cells.gloss_of(grey(shape), True, 16), light_of(lambda d: torch.ones(len(d)))
    )
    (got,) = torch.autograd.grad(lit[0, 0], roughness)
    high, low = (dense(GGX(1.0, r), tilted(50.0)[:, 0], lambda d: torch.ones(len(d))) for r in (0.41, 0.39))
    assert float(got) == pytest.approx((high - low) / 0.02, rel=0.03)


def test_octaves_are_linear_between_powers_of_two() -> None:
    x = torch.tensor([1.0, 1.5, 2.0, 3.0, 0.25, 1e-6], dtype=torch.float64)
    assert cells.octaves(x)[:5].tolist() == [0.0, 0.5, 1.0, 1.5, -2.0]
    assert torch.allclose(cells.octaves_back(cells.octaves(x)), x)


def test_lamps_are_seen_through_the_cells_that_they_lie_in() -> None:
    """By bits as `transfer.visibility` packs them: a lamp of three cells, a small one, and one that is hidden."""
    grid = Cube(8)
    free = torch.rand(32, grid.cells, generator=torch.Generator().manual_seed(1)) < 0.5
    visible = torch.from_numpy(np.packbits(free.numpy(), axis=1)).view(torch.int32).T.contiguous()
    cells_of = torch.tensor([[3, 40, 217], [383, 0, 0], [100, 101, 0]])
    shares = torch.tensor([[0.5, 0.3, 0.2], [1.0, 0.0, 0.0], [0.25, 0.75, 0.0]])
    expected = (free[:, cells_of].float() * shares).sum(2).T
    assert 0 < float(expected.mean()) < 1
    assert torch.allclose(gloss.lamp_visibility(visible, cells_of, shares), expected)


def ceiling(sent: Tensor, table: Tensor, seen: Tensor) -> Around:
    """One point that looks down, and that 16 points see wherever the sky is hidden."""
    record = torch.zeros(1, RECORD)
    record[0, :9] = torch.tensor([1.0, 0, 0, 0, -1, 0, 0, 0, -1])
    sky = light_of(lambda d: torch.where(d[:, 2] < 0, 2.0, 0.0))  # from below
    tables = table.repeat(TILTS, 1)
    return Around(
        torch.zeros(3, 16),
        looks_down(),
        record,
        sent[None],
        seen[:1],
        None,
        tables,
        cells.in_parts(tables),
        sky.maps,
        *no_lamps(),
    )


def looks_down() -> Tensor:
    """What points meet (16, MET) that see the ceiling everywhere."""
    nothing = torch.zeros(16, MEETS * MEETS, dtype=torch.int32)
    return transfer.meets_packed(nothing, torch.tensor([0.0, 0.0, -1.0]).expand(*nothing.shape, 3))


def no_lamps() -> tuple[Tensor, Tensor, Tensor]:
    return torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(1, 0)


@pytest.mark.parametrize("shape", [GGX(1.0, 0.1), GGX(1.0, 0.6), GGX(0.04, 0.3)], ids=str)
@pytest.mark.parametrize("degrees", [0.0, 50.0, 78.0])
def test_a_ceiling_is_reflected(shape: Analytic, degrees: float) -> None:
    """By the albedo: what it sends diffusely; of a mirror in it half of the light from below; where the ceiling sees
    nothing but surfaces, half of their mean."""
    wo = tilted(degrees, 40.0, 16)
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    everything = points(16)[1]
    tables = cells.gloss_of(grey(shape), True, 16)
    dark = light_of(lambda d: torch.zeros(len(d)))
    albedo = dense(shape, wo[:, 0], lambda d: torch.ones(len(d)))
    dull = torch.tensor([1.0, 2.0, 3.0] + [0.0] * 9)
    mean = torch.tensor([0.0, 0.0, 0.0, 0.3, 0.2, 0.1] + [0.0] * 6)
    half = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.0])
    for sent, table, seen, expected in (
        (dull, torch.nn.functional.pad(half[:3], (0, 5)), everything, [albedo, 2 * albedo, 3 * albedo]),
        (0 * dull, half, everything, [albedo, albedo, albedo]),
        (mean, half, nothing, [0.15 * albedo, 0.1 * albedo, 0.05 * albedo]),
        (dull + mean, half, everything, [2 * albedo, 3 * albedo, 4 * albedo]),
    ):
        around = ceiling(sent, table, seen)._replace(mean=(torch.tensor(expected) / albedo)[:, None].expand(3, 16))
        got = gloss.shine(blocks, wo, nothing, tables, dark, around)[0]
        assert got.tolist() == pytest.approx(expected, rel=0.02)


def test_what_a_ceiling_sees_is_reflected_twice() -> None:
    """A mirror in a ceiling that is a mirror for half of the light and sees nothing but a floor: what that sends of
    light that did not bounce before, and half of what it reflects itself of the sky above it."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    everything = points(16)[1]
    tables, dark = cells.gloss_of(grey(GGX(1.0, 0.1)), True, 1), light_of(lambda d: torch.zeros(len(d)))
    wo = tilted(30.0, 40.0, 16)
    albedo = dense(GGX(1.0, 0.1), wo[:, 0], lambda d: torch.ones(len(d)))
    half = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.0])
    floor = torch.zeros(1, RECORD)
    floor[0, :10] = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 1])
    up = torch.tensor([0.0, 0.0, 1.0]).expand(2, MEETS * MEETS, 3)
    meets = transfer.meets_packed(torch.ones(2, MEETS * MEETS, dtype=torch.int32), up)
    alone = ceiling(torch.tensor([9.0] * 3 + [7.0] * 3 + [5.0] * 3 + [0.0] * 3), half, nothing)
    sent = torch.cat((torch.zeros(1, SENT), torch.tensor([[9.0] * 6 + [1.0, 2.0, 3.0] + [0.0] * 3])))
    both = alone._replace(points=torch.cat((alone.points, floor)), sent=sent, others=meets)
    seen = torch.cat((nothing[:1], everything[:1]))
    for maps, reflected in ((dark.maps, 0.0), (light_of(lambda d: torch.full((len(d),), 4.0)).maps, 2.0)):
        around = both._replace(seen=seen, maps=maps, through=torch.zeros(2, 0))
        got = gloss.shine(blocks, wo, nothing, tables, dark, around)[0]
        expected = [albedo / 2 * (each + reflected) for each in (1.0, 2.0, 3.0)]
        assert got.tolist() == pytest.approx(expected, rel=0.02)


def test_a_ceiling_reflects_by_several_lobes_where_much_of_it_is_seen() -> None:
    """As the mean of the sky about each of them, along, across and about the mirror direction."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    tables, dark = cells.gloss_of(grey(GGX(1.0, 0.1)), True, 1), light_of(lambda d: torch.zeros(len(d)))
    wo = tilted(30.0, 0.0, 16)
    albedo = dense(GGX(1.0, 0.1), wo[:, 0], lambda d: torch.ones(len(d)))
    sky = light_of(lambda d: 2 + d[:, 0] + 0.5 * d[:, 1])
    around = ceiling(torch.zeros(SENT), torch.tensor([0.0, 0, 1, 1, 0, 0, 0, 0]), points(16)[1])
    axes = torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    parts = torch.cat((axes, torch.tensor([[1.0, 0.25, 0.25, 0.25, 0.0]]).expand(4, -1)), 1)
    lit = around._replace(parts=parts.repeat(TILTS, 1, 1), others=torch.full_like(around.meets[:1], -1), maps=sky.maps)
    got = float(gloss.shine(blocks, wo, nothing, tables, dark, lit)[0, 0])
    # Seen from the right, the points look left, and so does the ceiling, down; what is along leans back, to its normal
    degrees = math.radians(30.0)
    mirror = torch.tensor([-math.sin(degrees), 0.0, -math.cos(degrees)])
    along = torch.tensor([math.cos(degrees), 0.0, -math.sin(degrees)])
    means = [2 + float(d[0] + 0.5 * d[1]) for d in (mirror, 0.8 * mirror + 0.6 * along, 0.8 * mirror)]
    expected = (means[0] + means[1] + 2 * means[2]) / 4
    assert got == pytest.approx(expected * albedo, rel=0.03)


def test_a_ceiling_that_looks_away_sends_nothing_and_where_none_is_the_mean_of_all_does() -> None:
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    tables = cells.gloss_of(grey(GGX(1.0, 0.1)), True, 16)
    dark = light_of(lambda d: torch.zeros(len(d)))
    wo = tilted(30.0, 0.0, 16)
    albedo = dense(GGX(1.0, 0.1), wo[:, 0], lambda d: torch.ones(len(d)))
    around = ceiling(torch.ones(SENT), torch.ones(ROW), points(16)[1])._replace(mean=torch.full((3, 16), 0.5))
    upward = torch.tensor([0.0, 0.0, 1.0]).expand(16, MEETS * MEETS, 3)
    for met, expected in ((0, 0.0), (-1, 0.5 * albedo)):
        numbers = torch.full((16, MEETS * MEETS), met, dtype=torch.int32)
        others = around.meets[:1] if met == 0 else torch.full_like(around.meets[:1], -1)
        for beyond in (None, others):
            given = around._replace(meets=transfer.meets_packed(numbers, upward), others=beyond)
            got = gloss.shine(blocks, wo, nothing, tables, dark, given)
            assert got.flatten().tolist() == pytest.approx([expected] * 48, rel=0.02, abs=0.003)


def test_normals_are_mixed_where_a_ceiling_bends_and_not_across_a_fold() -> None:
    """Seen beside the line where the normals of two halves meet: of halves that lean apart by 8 degrees something in
    between is reflected, of such by 30 degrees what the nearer half alone reflects."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    tables, dark = cells.gloss_of(grey(GGX(1.0, 0.1)), True, 1), light_of(lambda d: torch.zeros(len(d)))
    sky = light_of(lambda d: 1 + d[:, 0])
    mirror = torch.tensor([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    around = ceiling(torch.zeros(SENT), mirror, points(16)[1])._replace(maps=sky.maps)
    around = around._replace(others=torch.full_like(around.meets[:1], -1))
    numbers = torch.zeros(16, MEETS * MEETS, dtype=torch.int32)
    beyond = (torch.arange(MEETS * MEETS) % MEETS >= MEETS // 2)[:, None]

    def reflected(near: float, far: float) -> float:
        normals = torch.where(beyond, tilted(far)[:, 0], tilted(near)[:, 0]) * torch.tensor([1.0, -1.0, -1.0])
        leaning = around._replace(meets=transfer.meets_packed(numbers, normals.expand(16, -1, 3)))
        return float(gloss.shine(blocks, tilted(1.5, 0.0, 16), nothing, tables, dark, leaning)[0, 0])

    bent = reflected(4.0, -4.0)
    assert sorted((bent, reflected(4.0, 4.0), reflected(-4.0, -4.0)))[1] == bent
    assert abs(bent - reflected(4.0, 4.0)) > 0.01
    assert reflected(15.0, -15.0) == pytest.approx(reflected(15.0, 15.0), rel=1e-5)
    assert abs(reflected(15.0, 15.0) - reflected(-15.0, -15.0)) > 0.5


def test_a_ceiling_reflects_by_its_normals_and_not_by_those_of_its_vertices() -> None:
    """A mirror whose normals lean by ten degrees shows the sky at twenty degrees; by fifty, what lies below the horizon
    of the vertex, which is hidden."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    shape = GGX(1.0, 0.1)
    tables, sky = cells.gloss_of(grey(shape), True, 16), light_of(lambda d: 1 + d[:, 0])
    mirror = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    wo = tilted(0.0, 0.0, 16)
    albedo = dense(shape, wo[:, 0], lambda d: torch.ones(len(d)))
    around = ceiling(torch.zeros(SENT), mirror, points(16)[1])._replace(maps=sky.maps)
    for lean in (0.0, 10.0, -10.0, 50.0):
        cells_of = torch.zeros(16, MEETS * MEETS, dtype=torch.int32)
        normal = tilted(lean)[:, 0] * torch.tensor([1.0, -1.0, -1.0])  # the ceiling looks down
        leaning = around._replace(meets=transfer.meets_packed(cells_of, normal.expand(*cells_of.shape, 3)))
        got = gloss.shine(blocks, wo, nothing, tables, light_of(lambda d: torch.zeros(len(d))), leaning)
        expected = 1 + math.sin(math.radians(2 * lean)) if lean < 45 else 0
        assert float(got[0, 0]) == pytest.approx(expected * albedo, rel=0.03, abs=0.05)


@pytest.mark.parametrize("level", [5.0, 7.0, 9.0])
def test_a_ceiling_spreads_lamps_over_its_lobe(level: float) -> None:
    """A lamp below it, of which it sees a half: over all places of the lamp its lobe adds up to what it reflects."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    tables = cells.gloss_of(grey(GGX(1.0, 0.1)), True, 16)
    dark = light_of(lambda d: torch.zeros(len(d)))
    wo = tilted(0.0, 0.0, 16)
    lobe = torch.tensor([0.0, 0.0, 1.0, level, 1.0, 0.5, 0.25, 0.0])
    around = ceiling(torch.zeros(SENT), lobe, points(16)[1])._replace(maps=dark.maps)
    grid = Octahedral(48)
    lamps = grid.directions().reshape(-1, 3).float()
    solid = grid.solid_angles().reshape(-1, 1).float().expand(-1, 3)
    lit = around._replace(lamps=lamps, powers=solid.contiguous(), through=torch.full((1, len(lamps)), 0.5))
    got = gloss.shine(blocks, wo, nothing, tables, dark, lit)[0]
    albedo = dense(GGX(1.0, 0.1), wo[:, 0], lambda d: torch.ones(len(d)))
    assert got.tolist() == pytest.approx([albedo / 2, albedo / 4, albedo / 8], rel=0.03)
    beside = lamps[:, 2] > 0  # above the ceiling
    away = lit._replace(through=0.5 * beside[None].float())
    assert float(gloss.shine(blocks, wo, nothing, tables, dark, away)[0, 0]) < 0.02 * albedo


@pytest.mark.parametrize("n", [1, 16, 32])
def test_wide_lobes_see_the_mean_of_surfaces(n: int) -> None:
    """However many there are, those of roughness 1 see the mean alone, and those of 0.1 the ceiling alone."""
    blocks, nothing = points(16, lambda d: d[:, 2] > 2)
    dark = light_of(lambda d: torch.zeros(len(d)))
    up = torch.tensor([0.0, 0, 1, 0, 0, 0, 0, 0])
    around = ceiling(torch.ones(SENT), up, nothing)._replace(mean=torch.full((3, 16), 5.0))
    wo = tilted(20.0, 0.0, 16)
    for roughness, expected in ((1.0, 5.0), (0.1, 1.0)):
        shape = GGX(1.0, roughness)
        got = gloss.shine(blocks, wo, nothing, cells.gloss_of(grey(shape), True, n), dark, around)
        albedo = dense(shape, wo[:, 0], lambda d: torch.ones(len(d)))
        assert float(got[0, 0]) == pytest.approx(expected * albedo, rel=0.02)


def test_a_wide_metal_has_more_lobes_by_default() -> None:
    """What reflects little, or to few directions, has 16."""
    for f0, roughness, n in ((1.0, 0.3, 16), (0.04, 0.7, 16), (1.0, 0.4, 32), (0.6, 0.7, 32)):
        assert cells.gloss_of(grey(GGX(f0, roughness)), True).lobes.table.shape[1] == n


def test_what_sees_the_sky_sees_no_ceiling() -> None:
    blocks, everything = points(16)
    tables = cells.gloss_of(grey(GGX(1.0, 0.3)), True, 16)
    sky = light_of(lambda d: 1 + d[:, 0])
    around = ceiling(torch.ones(SENT), torch.ones(ROW), everything)
    wo = tilted(30.0, 0.0, 16)
    alone = gloss.shine(blocks, wo, everything, tables, sky)
    assert torch.allclose(gloss.shine(blocks, wo, everything, tables, sky, around), alone, atol=1e-6)
