"""Triangles that see no way out are dropped, and no others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import ptt
from ptt.ops import mesh
from ptt.scene.parts import Part, join


def box(size: float) -> Part:
    return Part("box", *mesh.box_mesh((size, size, size), 4), material=ptt.lambert(0.5))


def ball(radius: float, name: str = "ball") -> Part:
    return Part(name, *mesh.sphere_mesh(2, radius), material=ptt.lambert(0.5))


def test_what_is_inside_goes_and_what_is_outside_stays() -> None:
    ground, squares = mesh.plane_mesh(3.0, 6)
    floor = Part("floor", ground - torch.tensor([0.0, 0.7, 0.0]), squares, material=ptt.lambert(0.3))
    alone = ptt.Scene.from_parts([box(1.0), floor])
    filled = ptt.Scene.from_parts([join("box", [box(1.0), ball(0.3)]), floor])
    found = ptt.without_hidden(filled)
    assert len(found.faces) == len(alone.faces) and torch.equal(found.vertices, alone.vertices)
    assert torch.equal(found.vertices[found.faces], alone.vertices[alone.faces])
    for name in ("normals", "tangents", "colours", "vertex_region"):
        assert torch.equal(getattr(found, name), getattr(alone, name))
    assert found.regions == filled.regions and found.camera == filled.camera


def test_maps_of_vertices_go_along() -> None:
    filled = ptt.Scene.from_parts([join("box", [ball(0.3), box(1.0)])])
    mask = filled.vertices[:, 0] + 0.5
    painted = replace(filled, materials={"box": ptt.Mixed(ptt.lambert(0.2), ptt.blinn_phong(), mask)})
    found = ptt.without_hidden(painted)
    assert len(found.vertices) < len(filled.vertices)
    assert torch.equal(found.materials["box"].maps[0], found.vertices[:, 0] + 0.5)


def test_nothing_goes_where_all_is_seen() -> None:
    scene = ptt.default_scene()
    assert torch.equal(ptt.without_hidden(scene).faces.unique(), scene.faces.unique())


def test_one_sided_sheets_stay_whichever_way_they_face() -> None:
    vertices, faces = mesh.plane_mesh(1.0, 2)
    down = ptt.Scene.from_parts([Part("sheet", vertices, faces.flip(1)), Part("floor", vertices - 0.5, faces)])
    assert len(ptt.without_hidden(down).faces) == len(down.faces)


def test_a_triangle_stays_where_its_middle_alone_sees_out() -> None:
    """Its corners are covered by little caps."""
    large = torch.tensor([[-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [0.0, 0.0, 3.0]])
    caps = [
        Part(f"cap {k}", mesh.sphere_mesh(2, 0.3)[0] + corner, mesh.sphere_mesh(2)[1]) for k, corner in enumerate(large)
    ]
    scene = ptt.Scene.from_parts([Part("sheet", large, torch.tensor([[0, 2, 1]])), *caps])
    assert int((ptt.without_hidden(scene).face_region == 0).sum()) == 1


def test_a_hidden_region_is_refused() -> None:
    scene = ptt.Scene.from_parts([box(1.0), ball(0.3)])
    with pytest.raises(ValueError, match="region 'ball' is hidden"):
        ptt.without_hidden(scene)


def test_a_scene_file_asks_for_it(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    inner = '[[region]]\nname = "{}"\nbox = {{ size = [{}, {}, {}] }}\n'
    text = inner.format("outer", 2, 2, 2) + inner.format("inner", 1, 1, 1)
    path.write_text(text)
    assert len(ptt.load_scene(path).regions) == 2
    path.write_text("hidden = false\n" + text)
    with pytest.raises(ValueError, match="region 'inner' is hidden"):
        ptt.load_scene(path)
