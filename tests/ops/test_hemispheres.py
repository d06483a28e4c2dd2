"""Hemispheres: what places see, and points between them, of a wall whose edge is known; lamps; rays at edges."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

import ptt
from ptt.ops import cells, hemispheres, rotation, transfer
from ptt.ops.constants import BITS
from ptt.ops.hemispheres import SHARES, Between
from ptt.ops.octahedral import HemiOctahedral

WALL = normalize(torch.tensor([1.0, 0.3, 0.2]), dim=0)  # half of all directions are free
LEVELS = torch.tensor([0.0, 1.0, 3.0, 5.0, 7.0])


def random(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def leaning(count: int, by: float) -> Tensor:
    """Frames whose normals lean from z by so much, turned at random."""
    normals = normalize(torch.tensor([0.0, 0.0, 1.0]) + by * torch.randn(count, 3, generator=random(1)), dim=1)
    return rotation.frames_of(normals.double()).float()


def behind_a_wall(frames: Tensor, side: int = BITS) -> Tensor:
    """What places with such frames see (places, words): the directions on one side of the wall."""
    local = HemiOctahedral(side).directions().reshape(-1, 3).float()
    free = (local @ frames) @ WALL > 0
    return transfer._packed(free, side, SHARES)


@pytest.mark.parametrize("side", [32, 64, 128])
def test_the_side_of_the_map_is_told_by_its_words(side: int) -> None:
    seen = behind_a_wall(leaning(2, 0.3), side)
    assert seen.shape[1] == hemispheres.words_of(side) and hemispheres.side_of(seen) == side


def test_one_place_sees_what_it_sees() -> None:
    frames = leaning(7, 0.3)
    seen = behind_a_wall(frames)
    local = normalize(torch.rand(7, 5, 3, generator=random()) + 0.2, dim=2)
    between = Between(torch.arange(7)[:, None].int(), torch.ones(7, 1), frames)
    got = hemispheres.split_between(seen, between, local @ frames, LEVELS.expand(7, 5))
    expected = hemispheres.split(seen, local, LEVELS.expand(7, 5))
    torch.testing.assert_close(got.share, expected.share, rtol=0, atol=1e-5)
    torch.testing.assert_close(got.seen, expected.seen @ frames, rtol=0, atol=1e-5)
    torch.testing.assert_close(got.hidden, expected.hidden @ frames, rtol=0, atol=1e-5)


@pytest.mark.parametrize("level", [5.0, 7.0])
def test_the_parts_of_a_lobe_that_a_wall_cuts(level: float) -> None:
    """Of a Gaussian whose middle is t standard deviations s before the edge, what is seen lies s n(t) / N(t) further
    from it, and what is hidden s n(t) / N(-t) behind, with n and N the normal density and distribution (means of the
    two parts of a Gaussian); within 0.3 s, for maps of cells of 10 and 20 degrees. A whole lobe stays."""
    s = math.radians(cells.width(level)) / 3
    along = normalize(torch.tensor([-0.3, 1.0, 0.0]), dim=0)  # the edge, at the horizon
    middle = torch.linalg.cross(WALL, along)
    t = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0, 4.0])
    axes = (torch.cos(s * t)[:, None] * middle + torch.sin(s * t)[:, None] * WALL)[None]
    frame = torch.eye(3)[None]
    got = hemispheres.split(behind_a_wall(frame, 128), axes, torch.full((1, 6), level))
    moved = [((part - axes) @ WALL)[0] / s for part in (got.seen, got.hidden)]
    density = torch.exp(-t * t / 2) / math.sqrt(2 * math.pi)
    assert float((moved[0] - density / torch.special.ndtr(t)).abs().max()) < 0.3
    assert float((moved[1] + density / torch.special.ndtr(-t))[:5].abs().max()) < 0.3
    assert float((got.seen - axes)[0, 5].norm()) < 0.02 * s


def test_sharp_lobes_stay_where_they_are() -> None:
    """The maps of wide lobes know nothing of them."""
    axes = normalize(torch.randn(3, 40, 3, generator=random()) + torch.tensor([0.0, 0.0, 1.0]), dim=2)
    got = hemispheres.split(behind_a_wall(leaning(3, 0.2)), axes, torch.ones(3, 40))
    assert torch.equal(got.seen, axes) and torch.equal(got.hidden, axes)


def test_places_that_lean_apart_agree_about_the_world() -> None:
    """Between three places a point sees the wall where it is, not where it stands in their frames."""
    frames = leaning(30, 0.5)
    seen = behind_a_wall(frames, 128)
    rows = torch.randint(30, (200, 3), generator=random()).int()
    weights = torch.rand(200, 3, generator=random(2))
    axes = normalize(torch.randn(200, 8, 3, generator=random(3)) + torch.tensor([0.0, 0.0, 1.5]), dim=2)
    between = Between(rows, weights / weights.sum(1, keepdim=True), frames)
    got = hemispheres.split_between(seen, between, axes, torch.ones(200, 8)).share
    height = (axes[:, None] @ frames[rows][:, :, 2, :, None])[..., 0].amax(1)
    clear = (axes @ WALL).abs() > math.radians(3)
    certain = clear & (height > hemispheres.RISEN)
    assert int(certain.sum()) > 1000
    torch.testing.assert_close(got[certain], (axes @ WALL > 0).float()[certain], rtol=0, atol=1e-5)


def test_a_place_knows_nothing_of_what_lies_below_its_horizon() -> None:
    """An axis that one place has above and the other below is seen as by the first; below both it is hidden."""
    up, side = torch.eye(3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    open_sky = torch.full((1, hemispheres.words_of(BITS)), -1, dtype=torch.int32)
    seen = torch.cat((open_sky, torch.zeros_like(open_sky)))  # the second sees nothing
    between = Between(torch.tensor([[0, 1]]).int(), torch.tensor([[0.5, 0.5]]), torch.stack((up, side)))
    axes = normalize(torch.tensor([[[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.6, 0.0, -0.8]]]), dim=2)
    got = hemispheres.split_between(seen, between, axes, torch.ones(1, 3)).share
    torch.testing.assert_close(got, torch.tensor([[1.0, 0.5, 0.0]]))


def test_lamps_are_seen_by_their_areas() -> None:
    """A lamp that the edge of the wall cuts in two is seen by half, from places however they lean."""
    frames = leaning(40, 0.4)
    seen = behind_a_wall(frames, 128)
    edge = normalize(torch.linalg.cross(WALL, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    edge = edge if edge[2] > 0 else -edge
    areas = normalize(torch.stack([edge + d * WALL for d in torch.linspace(-0.05, 0.05, 20)]), dim=1)
    areas = torch.stack((areas, torch.cat((normalize(edge + WALL, dim=0)[None], torch.zeros(19, 3)))))
    shares = torch.stack((torch.full((20,), 0.05), torch.eye(20)[0]))  # the second lies in one direction
    got = hemispheres.lamps_seen(seen, frames, areas, shares)
    up = (areas[:, 0] @ frames[:, 2].T) > 0.2
    assert int(up.sum()) > 40
    wanted = torch.tensor([[0.5], [1.0]]).expand(-1, 40)
    assert float((got - wanted)[up].abs().max()) < 0.2 and abs(float((got - wanted)[up].mean())) < 0.02
    rows = torch.arange(40)[:, None].int()
    between = Between(rows, torch.ones(40, 1), frames)
    high = (torch.stack((edge, areas[1, 0])) @ frames[:, 2].T) > 0
    found = hemispheres.lamps_between(got, between, torch.stack((edge, areas[1, 0])))
    torch.testing.assert_close(found, torch.where(high, got, 0.0))


def test_rays_follow_edges(small_scene: ptt.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four times as many cells as there are rays, nearly all are as a ray for each has them."""
    shot: list[int] = []
    surface = small_scene.surface
    occluded = surface.occluded

    def counted(origins: Tensor, directions: Tensor) -> Tensor:
        shot.append(len(origins))
        return occluded(origins, directions)

    monkeypatch.setattr(surface, "occluded", counted)
    places = small_scene.points[::7], small_scene.frames[::7]
    got = transfer.traced_hemispheres(surface, *places, 64, SHARES)
    assert sum(shot) < 0.5 * 64 * 64 * len(places[0])
    local = HemiOctahedral(64).directions().reshape(-1, 3).float()
    origins = surface.offset(places[0], places[1][:, 2]).repeat_interleave(len(local), 0)
    every = ~occluded(origins, (local @ places[1]).flatten(0, 1)).reshape(len(places[0]), -1)
    bits = hemispheres.bits_at(got, local.expand(len(got), -1, -1)) > 0.5
    assert 0.02 < float((~every).float().mean()) < 0.9
    assert float((bits != every).float().mean()) < 2e-3
