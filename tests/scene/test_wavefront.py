"""Wavefront files as others write them: right, or refused by name."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ptt
from ptt.ops import mesh

FIRST = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def load(folder: Path, text: str, mtl: str = "", encoding: str = "utf-8") -> ptt.Scene:
    """The scene of a text, read without a warning."""
    (folder / "a.obj").write_bytes(text.encode(encoding))
    (folder / "m.mtl").write_text(mtl)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return ptt.load_scene(folder / "a.obj")


def area(scene: ptt.Scene) -> float:
    return float(mesh.face_crosses(scene.vertices, scene.faces).norm(dim=1).sum() / 2)


@pytest.mark.parametrize(
    "text",
    [
        "v\t0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\n",
        " v 0 0 0\n\tv 1 0 0\nv 0 1 0\nv 5 5 5\n f 1 2 3\n",
        "\ufeffv 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\n",
        "v 0 0 0 # first\r\nv 1 0 0#second\r\nv 0 1 0\r\nv 5 5 5\r\nf 1 2 3 # one\r\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 5 5\n",
        "v 0 0 0 1.0\nv +1.e0 -0 0e0 1.0\nv 0 1E+000 0 1.0\nv 5 5 5 1.0\nf 1 \\\n 2 3\n",
        "g f\no v\ns off\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\ng f v\nf 1// 2// 3//\n",
        "vt 0.5\nvt 0 0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1/1 2/2 3/2\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le", "utf-32"])
def test_one_triangle_in_many_forms(tmp_path: Path, text: str, encoding: str) -> None:
    scene = load(tmp_path, text, encoding=encoding)
    assert scene.vertices[scene.faces[0]].tolist() == FIRST


def test_other_encodings_of_names(tmp_path: Path) -> None:
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl h\u00f6lzern\nf 1 2 3\n"
    (tmp_path / "m.mtl").write_bytes("newmtl h\u00f6lzern\nKd 0.5 0.25 0.125\n".encode("latin-1"))
    (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
    scene = ptt.load_scene(tmp_path / "a.obj")
    assert scene.materials["h\u00f6lzern"].diffuse.tolist() == [0.5, 0.25, 0.125]


def test_concave_polygons_keep_their_area(tmp_path: Path) -> None:
    """An L of area 3, a concave quad of area 1.5 (its corners 0, 0; 2, 2; 0, 1; -2, 2 less), and a star."""
    corner = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]
    quad = [(0, 0), (2, 2), (0, 1), (-2, 2)]
    angles = np.arange(10) * np.pi / 5
    star = np.stack((np.cos(angles), np.sin(angles)), 1) * np.where(np.arange(10) % 2, 0.4, 1.0)[:, None]
    shapes = {3.0: corner, 2.0: quad, 5 * 0.4 * np.sin(np.pi / 5): star.tolist()}
    for expected, points in shapes.items():
        for turn in range(len(points)):
            rolled = points[turn:] + points[:turn]
            text = "".join(f"v {x} {y} {0.3 * x}\n" for x, y in rolled)
            text += "f " + " ".join(str(k + 1) for k in range(len(points)))
            scene = load(tmp_path, text)
            crosses = mesh.face_crosses(scene.vertices, scene.faces)
            assert float(crosses[:, 2].sum() / 2) == pytest.approx(expected, rel=1e-5)
            assert bool((crosses[:, 2] > 0).all())


def test_a_polygon_with_a_hole_by_a_bridge(tmp_path: Path) -> None:
    """A square of 4 around one of 1, joined by an edge that is walked both ways."""
    outer = [(0, 0), (2, 0), (2, 2), (0, 2)]
    inner = [(0.5, 0.5), (0.5, 1.5), (1.5, 1.5), (1.5, 0.5)]
    points = [*outer, outer[0], *inner, inner[0]]
    text = "".join(f"v {x} {y} 0\n" for x, y in points) + "f " + " ".join(str(k + 1) for k in range(len(points)))
    assert area(load(tmp_path, text)) == pytest.approx(3)


def test_materials(tmp_path: Path) -> None:
    """One number for a colour, comments after values, options of textures, and metallic-roughness."""
    Image.fromarray(np.array([[[0] * 3, [255] * 3]], np.uint8)).save(tmp_path / "half tone.png")
    mtl = """
    newmtl grey wood   # a comment
    Kd 0.5 # one number
    Ks 0.25 0.25 0.25
    NS 1000
    newmtl gold
    \tKd 1 0.5 0.25
    Pm 1
    Pr 0.4
    Tf 1 1 1
    d 1
    newmtl tiled
    map_Kd -s 2 1 1 -o 0.5 0 -clamp on C:\\textures\\half tone.png
    """
    quad = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.2 0\n"
    text = quad + "usemtl grey wood\nf 1 2 3\nusemtl gold\nf 1 2 3\nusemtl tiled\nf 1/1 2/1 3/1\n"
    scene = load(tmp_path, text, mtl)
    wood = scene.materials["grey wood"]
    assert wood.diffuse.tolist() == [0.5] * 3 and wood.shape == ptt.BlinnPhong(200.0)
    assert [h.shape for h in scene.materials["gold"].highlights] == [ptt.GGX(1.0, 0.4), ptt.GGX(0.0, 0.4)]
    tiled = scene.region_index("tiled")
    assert scene.uv is not None and scene.uv[scene.vertex_region == tiled][0].tolist() == pytest.approx([0.9, 0])
    assert scene.colours[scene.vertex_region == tiled].tolist() == [[1] * 3] * 3


@pytest.mark.parametrize(
    ("mtl", "lost"),
    [
        ("newmtl a\nd 0.5\n", r"transparency \(a\)"),
        ("newmtl a\nKe 1 0 0\n", r"emission \(a\)"),
        ("newmtl a\nmap_Bump b.png\n", r"a bump map \(a\)"),
        ("newmtl a\nmap_Kd b.png\n", r"b\.png"),
        ("newmtl b\n", "the material a"),
    ],
)
def test_what_is_left_out_is_named(tmp_path: Path, mtl: str, lost: str) -> None:
    (tmp_path / "m.mtl").write_text(mtl)
    (tmp_path / "a.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\nl 1 2\n")
    with pytest.warns(UserWarning, match=rf"a\.obj was read without .*{lost}"):
        ptt.load_scene(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v 0 0\nf 1 1 1\n", "v must have 3 numbers, got '0 0'"),
        ("v 0 0 x\nf 1 1 1\n", "v must be numbers"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a face asks for v 4 of 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "a face asks for v"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 -2 -1\n", "a face asks for v"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/5 2/5 3/5\n", "a face asks for vt 5 of 0"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf one two three\n", "f must be indices"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1.5 2.5 3.5\n", "whole numbers"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1e30\n", "whole numbers"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/-3 2/1 3/1\n", "a face asks for vt -1 of 1"),
        ("v 0 0 0\nv 1 0 0\n", "has no faces"),
        ("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "kd of a must be RGB, got spectral"),
    ],
)
def test_damage_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        load(tmp_path, text, "newmtl a\nKd spectral file.rfl\n")


def test_half_a_character_is_damage(tmp_path: Path) -> None:
    """Read as bytes, "10" in UTF-16 would become the two numbers 1 and 0."""
    (tmp_path / "a.obj").write_bytes("v 0 0 0\nv 10 0 0\nv 0 10 0\nf 1 2 3\n".encode("utf-16")[:-1])
    with pytest.raises(ValueError, match=r"a\.obj is damaged"):
        ptt.load_scene(tmp_path / "a.obj")


def test_a_face_of_two_corners_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2\n")
    with pytest.warns(UserWarning, match=r"a\.obj was read without a face of fewer than three corners"):
        assert len(ptt.load_scene(tmp_path / "a.obj").faces) == 1
