"""Lookups of points: laws, and the kernels against the plain functions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.ops import native, near, rotation
from ptt.ops.near import Near
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.table import Table
from ptt.relight.triple_tables import turned

POINTS = 3001  # no multiple of sixteen


def frames_of(count: int) -> Tensor:
    g = torch.Generator().manual_seed(0)
    axes = rotation.frames_of(torch.randn(count, 3, generator=g))
    angle = torch.rand(count, generator=g) * 2 * math.pi
    c = angle.cos()
    s = angle.sin()
    o = torch.zeros_like(angle)
    return torch.stack((c, s, o, -s, c, o, o, o, o + 1), 1).reshape(-1, 3, 3) @ axes


def own(n: int) -> Tensor:
    return rotation.frames_of(Octahedral(n).directions().reshape(-1, 3)).float()


def sums_to_one(found: Near) -> None:
    assert bool((found.weights >= -1e-6).all())
    torch.testing.assert_close(found.weights.sum(1), torch.ones(len(found.weights)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("ops", [near, native])
def test_frames_find_themselves(ops: object, built: None) -> None:
    """A sampled frame, turned as often as one likes, is found with all weight on it."""
    sampled = turned(own(6), 8).float()
    found = ops.of_frames(sampled, own(6), 8)  # type: ignore[attr-defined]
    sums_to_one(found)
    first = found.weights.argmax(1)
    assert torch.equal(found.rows.gather(1, first[:, None])[:, 0].long(), torch.arange(len(sampled)))
    assert float(found.weights.amax(1).min()) > 0.999


def test_frames_of_neighbours_are_near() -> None:
    """The frames found are those around: within two cells of the normal's map, and half a turn's step."""
    frames = frames_of(500)
    n = 16
    twists = 32
    found = near.of_frames(frames, own(n), twists)
    sums_to_one(found)
    around = turned(own(n).double(), twists).float()[found.rows.long()]
    cosine = (around[:, :, 2] * frames[:, None, 2]).sum(2)
    assert float(cosine.min()) > math.cos(2 * math.sqrt(2) * math.pi / n)
    tangent = (around[:, :, 0] * frames[:, None, 0]).sum(2)
    assert float(tangent.min()) > math.cos(math.pi / twists + 2 * math.sqrt(2) * math.pi / n)


def test_between_two_turns() -> None:
    """A tangent between two turns has the mean of them: their angle is its own; the normals are weighed as ever."""
    normal = own(8)[10]
    angle = torch.tensor([0.0, 0.3, 3.1, 6.2])
    frames = rotation.frames_of(normal[2]) @ torch.eye(3)
    turned_frames = torch.stack([turned_by(float(a)) @ frames for a in angle])
    found = near.of_frames(turned_frames, own(8), 16, between=True)
    sums_to_one(found)
    assert found.rows.shape == (4, 8)
    turns = ((found.rows % 16).unflatten(1, (4, 2)) * found.weights.unflatten(1, (4, 2))).sum(2)
    pair = found.weights.unflatten(1, (4, 2)).sum(2).argmax(1)
    got = turns.gather(1, pair[:, None])[:, 0] * (2 * math.pi / 16)
    torch.testing.assert_close(got[:3], angle[:3], rtol=0, atol=1e-4)
    torch.testing.assert_close(
        near.of_frames(turned_frames, own(8), 16).weights, found.weights.unflatten(1, (4, 2)).sum(2)
    )


def turned_by(angle: float) -> Tensor:
    c = math.cos(angle)
    s = math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def test_kernels(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the plain functions but for turns that are nearly between two."""
    frames = frames_of(POINTS)
    g = torch.Generator().manual_seed(1)
    positions = torch.randn(POINTS, 3, generator=g)
    eye = torch.tensor([0.3, 2.0, 1.0])
    away = torch.randn(POINTS, 3, generator=g)
    away[7] = 0
    uv = torch.rand(40, 3, 2, generator=g)
    triangle = torch.randint(40, (POINTS,), generator=g)
    barycentric = normalize(torch.rand(POINTS, 3, generator=g), p=1)
    texels = torch.randint(999, (32 * 32,), generator=g).int()
    cases = [
        ("of_frames", (frames, own(10), 32)),
        ("of_frames", (frames, own(10), 32, True)),
        ("of_views", (frames, positions, eye, 24)),
        ("of_views", (frames, positions, away, 24)),
        ("of_texels", (uv, triangle, barycentric, texels)),
    ]
    wanted = [getattr(near, name)(*arguments) for name, arguments in cases]
    for name, _ in cases:
        monkeypatch.setattr(near, name, None)  # so that it cannot have been the plain one
    for (name, arguments), expected in zip(cases, wanted, strict=True):
        got = getattr(native, name)(*arguments)
        # corners that swap at a cell's edge have no weight
        same = (got.rows == expected.rows).all(1)
        assert float(same.float().mean()) > 0.997, name
        torch.testing.assert_close(got.weights[same], expected.weights[same], rtol=0, atol=2e-4)


def test_views_interpolate_a_smooth_function() -> None:
    cells = HemiOctahedral(32)
    height = cells.directions()[..., 2].flatten().float()
    frames = frames_of(POINTS)
    away = torch.randn(POINTS, 3, generator=torch.Generator().manual_seed(2))
    local = torch.einsum("pax,px->pa", frames, normalize(away, dim=1))
    found = near.of_views(frames, torch.zeros(POINTS, 3), away, 32)
    sums_to_one(found)
    got = found.mix(Table(height, torch.ones(len(height))))
    assert float((got - local[:, 2].abs()).abs().max()) < 0.05
    one = found.one()
    assert one.rows.shape == (POINTS, 1) and torch.equal(one.weights, torch.ones(POINTS, 1))
    assert float((height[one.rows[:, 0].long()] - local[:, 2].abs()).abs().max()) < 0.1


def test_few_points_are_found_plainly(built: None) -> None:
    frames = frames_of(5)
    assert torch.equal(native.of_frames(frames, own(6), 4).rows, near.of_frames(frames, own(6), 4).rows)
    assert native.of_views(frames[:0], torch.zeros(0, 3), torch.ones(3), 4).rows.shape == (0, 4)
