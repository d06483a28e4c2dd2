"""PLY files as others write them."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import pytest
import torch
from PIL import Image

import ptt
from ptt.ops import mesh

QUAD = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]


def load(path: Path) -> ptt.Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return ptt.load_scene(path)


def area(scene: ptt.Scene) -> float:
    return float(mesh.face_crosses(scene.vertices, scene.faces).norm(dim=1).sum() / 2)


@pytest.mark.parametrize(("order", "name"), [("<", "binary_little_endian"), (">", "binary_big_endian"), ("", "ascii")])
def test_mixed_polygons_in_every_format(tmp_path: Path, order: str, name: str) -> None:
    """A triangle, a quad and a pentagon, with numbers before and after the list, and an element that nobody needs."""
    points = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 1.5), (2, 0), (2, 1)]
    polygons = [(1, 5, 2), (5, 6, 2), (0, 1, 2, 4, 3)]
    header = (
        f"ply\nformat {name} 1.0\ncomment made by hand\nelement camera 1\nproperty float fov\nelement vertex 7\n"
        "property double x\nproperty double y\nproperty double z\nelement face 3\nproperty uchar flag\n"
        "property list uint8 int32 vertex_index\nproperty float quality\nend_header\n"
    )
    path = tmp_path / "a.ply"
    if order:
        body = struct.pack(order + "f", 1) + b"".join(struct.pack(order + "3d", x, 0, -y) for x, y in points)
        for face in polygons:
            body += struct.pack(order + f"BB{len(face)}if", 7, len(face), *face, 0.5)
        path.write_bytes(header.encode() + body)
    else:
        body_text = "1\n" + "".join(f"{x} 0 {-y}\n" for x, y in points)
        body_text += "".join(f"7 {len(face)} {' '.join(map(str, face))} 0.5\n" for face in polygons)
        path.write_text(header + body_text)
    scene = load(path)
    assert len(scene.vertices) == 7 and area(scene) == pytest.approx(1 + 1.25)
    assert bool((mesh.face_crosses(scene.vertices, scene.faces)[:, 1] > 0).all())


def test_a_texture_over_vertices_and_over_corners(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "red.png")
    vertices = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    begin = "ply\nformat ascii 1.0\ncomment TextureFile red.png\n"
    rows = [f"{x} {y} {z}" for x, y, z in QUAD]
    of_vertices = f"{begin}{vertices}property float s\nproperty float t\n{faces}end_header\n"
    of_vertices += "".join(f"{row} {k % 2} {k // 2}\n" for k, row in enumerate(rows)) + "3 0 1 2\n3 0 2 3\n"
    (tmp_path / "a.ply").write_text(of_vertices)
    scene = load(tmp_path / "a.ply")
    assert scene.colours.tolist() == [[1, 0, 0]] * 4 and scene.uv is not None
    assert scene.uv.tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]
    of_corners = f"{begin}{vertices}{faces}property list uchar float texcoord\nend_header\n" + "\n".join(rows)
    of_corners += "\n3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0.5 0 1 1 0 1\n"
    (tmp_path / "b.ply").write_text(of_corners)
    scene = load(tmp_path / "b.ply")
    assert len(scene.vertices) == 5 and scene.colours.tolist() == [[1, 0, 0]] * 5 and scene.uv is not None
    first, second = scene.uv[scene.faces].tolist()
    assert first == [[0, 0], [1, 0], [1, 1]] and second == [[0.5, 0], [1, 1], [0, 1]]


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_texture_has_a_name_of_any_letters(tmp_path: Path, encoding: str) -> None:
    """In UTF-8, the letter has a byte that ends lines of Latin-1."""
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "\u00c5.png")
    text = "ply\nformat ascii 1.0\ncomment TextureFile \u00c5.png\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in "xyzst")
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text += "0 0 0 0 0\n1 0 0 0 0\n0 1 0 0 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_bytes(text.encode(encoding))
    assert load(tmp_path / "a.ply").colours.tolist() == [[1, 0, 0]] * 3


def test_strips(tmp_path: Path) -> None:
    """Two strips in a list, as scans of laser have them: -1 ends a strip, and every second triangle turns."""
    header = (
        "ply\nformat binary_big_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    )
    header += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    body = b"".join(struct.pack(">3f", *p) for p in QUAD) + struct.pack(">10i", 9, 0, 1, 3, 2, -1, 0, 1, 2, -1)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    scene = load(tmp_path / "a.ply")
    assert len(scene.faces) == 3 and area(scene) == pytest.approx(6)
    assert bool((mesh.face_crosses(scene.vertices, scene.faces)[:, 1] > 0).all())


@pytest.mark.parametrize(("kind", "white"), [("uchar", 255), ("float", 1), ("ushort", 255)])
def test_colours_by_their_type(tmp_path: Path, kind: str, white: float) -> None:
    columns = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n" + columns
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text += "".join(f"{x} {y} {z} {white} 0 0\n" for x, y, z in QUAD[:3]) + "3 0 1 2\n"
    (tmp_path / "a.ply").write_text(text)
    assert load(tmp_path / "a.ply").colours.tolist() == [[1, 0, 0]] * 3


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("end_header", "end"), "has no header"),
        (("format ascii", "format utf8"), "header is damaged at 'format utf8 1.0'"),
        (("property float x", "property half x"), "header is damaged at 'property half x'"),
        (("element vertex 3", "element vertex many"), "header is damaged"),
        (("element vertex 3", "element vertex 4"), "damaged, or cut short"),
        (("3 0 1 2", "3 0 1 9"), r"faces must index 3 vertices, got 0\.\.9"),
        (("3 0 1 2", "3 0 1"), "damaged, or cut short"),
        (("3 0 1 2", "3 0 1 1.5"), "whole numbers"),
        (("1 0 0", "nan 0 0"), "must be finite"),
        (("1 0 0\n0 1 0", "1e30 0 0\n0 1e30 0"), "must lie within"),
        (("0 1 0", "2 0 0"), "no triangle with an area"),
        (("property float z", "property float w"), "vertices with x, y and z"),
        (("element face 1", "element face 0"), "has no faces"),
    ],
)
def test_damage_is_refused(tmp_path: Path, change: tuple[str, str], reason: str) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(text.replace(*change))
    with pytest.raises(ValueError, match=rf"a\.ply.*{reason}"):
        ptt.load_scene(tmp_path / "a.ply")


def test_a_header_may_speak_of_its_end(tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\ncomment until end_header\nelement vertex 3\nproperty float x\nproperty float y\n"
    text += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text += "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "a.ply").write_bytes(text.replace("\n", end).encode())
        assert load(tmp_path / "a.ply").faces.tolist() == [[0, 1, 2]]


def test_what_follows_the_last_element_is_named(tmp_path: Path) -> None:
    """A count that is too low leaves a face out; blanks and zeros at the end are nothing."""
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(text + "\n \n")
    load(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_text(text + "3 2 1 0\n")
    with pytest.warns(UserWarning, match=r"a\.ply was read without 4 bytes or words after its last element"):
        assert len(ptt.load_scene(tmp_path / "a.ply").faces) == 1


def test_positions_far_away_lose_nothing(tmp_path: Path) -> None:
    """A ball of 5 m in a map's coordinates: its normals are the ball's, but for 0.3 degrees by its own facets, and a
    camera in the file's coordinates sees it."""
    v, f = mesh.sphere_mesh(3, 5.0)
    v = v.double() + torch.tensor([5e5, 100.0, 5e6], dtype=torch.float64)
    text = f"ply\nformat ascii 1.0\nelement vertex {len(v)}\n" + "".join(f"property double {a}\n" for a in "xyz")
    text += f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n"
    text += "".join("{!r} {!r} {!r}\n".format(*p) for p in v.tolist()) + "".join(
        "3 {} {} {}\n".format(*p) for p in f.tolist()
    )
    (tmp_path / "far.ply").write_text(text)
    with pytest.warns(UserWarning, match="positions were moved by .* to the origin"):
        scene = ptt.load_scene(tmp_path / "far.ply")
    torch.testing.assert_close(scene.vertices.double() + scene.offset, v, atol=1e-5, rtol=0)
    outward = torch.nn.functional.normalize(scene.vertices - scene.vertices.mean(0), dim=1)
    assert float(torch.rad2deg(torch.acos((scene.normals * outward).sum(1).clamp(-1, 1))).max()) < 0.5
    camera = ptt.Camera((5e5, 100.0, 5e6 + 20), (5e5, 100.0, 5e6))
    with pytest.warns(UserWarning, match="moved"):
        seen = ptt.Scene.from_parts([ptt.scene.parts.Part("ball", v, f)], camera=camera)
    assert seen.camera.eye == pytest.approx((0, 0, 20), abs=1e-5)


def test_a_ball_wound_inside_out_is_named() -> None:
    v, f = mesh.sphere_mesh(2)
    with pytest.warns(UserWarning, match="closed, and wound inside out: ball"):
        ptt.Scene.from_mesh(v, f.flip(1), "ball")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ptt.Scene.from_mesh(v, f)
        ptt.Scene.from_mesh(v, f.flip(1)[:-1])  # a bowl has no inside


def test_both_sides_of_a_sheet_have_their_own_normals() -> None:
    """A table of paper, each face twice, once each way, over shared vertices."""
    v, f = mesh.plane_mesh(1.0, 3)
    scene = ptt.Scene.from_mesh(v, torch.cat((f, f.flip(1))))
    up = mesh.face_crosses(scene.vertices, scene.faces)[:, 1] > 0
    assert int(up.sum()) == len(f) and len(scene.vertices) == 2 * len(v)
    assert torch.equal(scene.normals[scene.faces[up]][..., 1], torch.ones(len(f), 3))
    assert torch.equal(scene.normals[scene.faces[~up]][..., 1], -torch.ones(len(f), 3))
