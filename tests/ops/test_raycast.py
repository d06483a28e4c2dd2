"""Rays: hits that can be worked out by hand, offsets, and closed bodies that do not shadow themselves."""

from __future__ import annotations

import builtins
import sys
from typing import Any

import pytest
import torch

from ptt.ops import mesh
from ptt.ops.raycast import Surface

FLOOR = mesh.plane_mesh(2.0, 1)  # in the plane y = 0, seen from above
UP = torch.tensor([[0.0, 1.0, 0.0]])
DOWN = torch.tensor([[0.0, -1.0, 0.0]])


def test_a_hit_has_the_distance_side_and_place_of_the_plane() -> None:
    surface = Surface(*FLOOR)
    origin = torch.tensor([[0.3, 2.5, -0.4], [0.3, -2.5, -0.4], [5.0, 1.0, 0.0]])
    hits = surface.first_hit(origin, torch.cat((DOWN, UP, DOWN)))
    assert torch.allclose(hits.distance[:2], torch.tensor([2.5, 2.5]), rtol=1e-5)
    assert hits.front.tolist() == [True, False, False]
    assert hits.triangle[2] == -1 and hits.distance[2] == torch.inf and (hits.barycentric[2] == 0).all()
    corners = FLOOR[0][FLOOR[1][hits.triangle[:2]]]
    place = (corners * hits.barycentric[:2, :, None]).sum(1)
    assert torch.allclose(place, torch.tensor([0.3, 0.0, -0.4]).expand(2, 3), atol=1e-5)
    assert surface.occluded(origin, torch.cat((DOWN, UP, DOWN))).tolist() == [True, True, False]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_a_sphere_does_not_shadow_itself(scale: float, shift: float) -> None:
    """From every vertex towards its upper hemisphere: a convex body hides nothing, whatever its size and place."""
    vertices, faces = mesh.sphere_mesh(4, 1.0)
    normals = torch.nn.functional.normalize(vertices, dim=1)
    placed = (vertices + shift) * scale
    surface = Surface(placed, faces)
    d = torch.nn.functional.normalize(torch.randn(len(vertices), 3, generator=torch.Generator().manual_seed(0)), dim=1)
    d = d * (d * normals).sum(1, keepdim=True).sign()
    d = torch.nn.functional.normalize(d + 0.05 * normals, dim=1)
    assert not surface.occluded(surface.offset(placed, normals), d).any()


def test_many_rays_give_what_few_give() -> None:
    """Over several chunks and threads, in order."""
    vertices, faces = mesh.sphere_mesh(3, 1.0)
    surface = Surface(vertices, faces)
    d = torch.nn.functional.normalize(torch.randn(300_000, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    hits = surface.first_hit(-3 * d, d)
    assert (hits.triangle >= 0).all() and hits.front.all()
    tail = surface.first_hit(-3 * d[-1000:], d[-1000:])
    assert torch.equal(hits.triangle[-1000:], tail.triangle)
    assert (hits.distance - 2).abs().max() < 0.02


def test_no_rays() -> None:
    none = torch.zeros(0, 3)
    assert Surface(*FLOOR).occluded(none, none).shape == (0,)
    assert Surface(*FLOOR).first_hit(none, none).barycentric.shape == (0, 3)


def test_without_embree_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("embreex"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    for name in [n for n in sys.modules if n.startswith("embreex")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match="pip install embreex"):
        Surface(*FLOOR)
