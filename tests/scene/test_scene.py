"""Scenes: what files and tensors become, what is refused and repaired, and where the camera looks."""

from __future__ import annotations

import dataclasses
import json
import math
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch import Tensor

import ptt
from ptt.io.colour import from_srgb
from ptt.io.images import write_image
from ptt.materials.material import lambert
from ptt.materials.shapes import BlinnPhong, CookTorrance
from ptt.ops import mesh
from ptt.ops.transfer import unpack
from ptt.scene.camera import Camera
from ptt.scene.parts import Part
from ptt.scene.scene import Scene
from ptt.transfer.raw import precompute


def sound(scene: Scene) -> None:
    """What holds for every scene."""
    v = len(scene.vertices)
    assert (scene.vertices.dtype, scene.faces.dtype) == (torch.float32, torch.int64)
    identity = torch.eye(3, dtype=torch.float64).expand(v, 3, 3)
    frames = scene.frames.double()
    assert (frames @ frames.transpose(1, 2) - identity).abs().max() < 1e-6
    assert (torch.linalg.det(frames) - 1).abs().max() < 1e-6  # right-handed
    assert torch.equal(scene.frames[:, 2], scene.normals)
    regions = scene.vertex_region[scene.faces]
    assert torch.equal(regions, scene.face_region[:, None].expand(-1, 3))  # no vertex is shared
    assert list(scene.materials) == [r.name for r in scene.regions]
    assert scene.colours.shape == (v, 3) and scene.colours.isfinite().all()


def hits(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Triangle (height * width,), barycentric, and colour where something is hit."""
    assert scene.camera is not None
    origin, directions = scene.camera.rays()
    rays = directions.reshape(-1, 3)
    hit = scene.surface.first_hit(origin.expand_as(rays), rays)
    return hit.triangle, hit.barycentric, hit.front


# --- the scene itself


def test_default_scene_is_what_it_says() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = ptt.default_scene()
    sound(scene)
    assert 6000 <= len(scene.vertices) <= 9000
    assert [r.name for r in scene.regions] == ["floor", "knot", "ball", "slab"]
    shape = scene.materials["knot"].shape
    assert isinstance(shape, BlinnPhong) and 20 <= float(shape.exponent) <= 40


def test_default_scene_stands_on_its_floor_casts_shadows_and_faces_the_camera() -> None:
    scene = ptt.default_scene()
    y = scene.vertices[:, 1]
    assert y[scene.vertex_region == 0].abs().max() == 0
    for region in (1, 2, 3):
        assert 0 < y[scene.vertex_region == region].min() < 0.01
    triangle, _, front = hits(scene)
    seen = scene.face_region[triangle[triangle >= 0]]
    assert front[triangle >= 0].all()
    assert (torch.bincount(seen, minlength=4) > 0.02 * len(triangle)).all()
    floor = scene.vertex_region == 0
    origins = scene.surface.offset(scene.vertices[floor], scene.normals[floor])
    sun = torch.nn.functional.normalize(torch.tensor([0.5, 1.0, 0.35]), dim=0).expand(len(origins), 3)
    assert 0.05 < scene.surface.occluded(origins, sun).float().mean() < 0.5


def test_default_scene_has_no_vertex_inside_another_object() -> None:
    """A ray from inside a closed body meets a back face first."""
    scene = ptt.default_scene()
    direction = torch.tensor([0.31, 0.83, 0.46])
    for region in (1, 2, 3):
        own = scene.faces[scene.face_region == region]
        body = Scene.from_mesh(*_compact(scene.vertices, own)).surface
        others = scene.vertices[scene.vertex_region != region]
        hit = body.first_hit(others, direction.expand_as(others))
        assert not ((hit.triangle >= 0) & ~hit.front).any()


def _compact(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    used, index = torch.unique(faces, return_inverse=True)
    return vertices[used], index


def test_region_index_lists_the_names() -> None:
    scene = ptt.default_scene()
    assert scene.region_index("ball") == 2
    with pytest.raises(ValueError, match=r"no region 'bal'; the scene has floor, knot, ball, slab"):
        scene.region_index("bal")


def test_scene_is_frozen_and_its_materials_combine() -> None:
    scene = ptt.default_scene()
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.environment = None  # type: ignore[misc]
    red = lambert((1.0, 0.0, 0.0))
    edited = scene.materials | {"knot": red}
    assert edited["knot"] is red and scene.materials["knot"] is not red and len(edited) == 4


def test_bounds_hold_every_vertex() -> None:
    scene = Scene.from_mesh(mesh.sphere_mesh(3)[0] * 2 + torch.tensor([1.0, 2, 3]), mesh.sphere_mesh(3)[1])
    centre, radius = scene.bounds
    torch.testing.assert_close(centre, torch.tensor([1.0, 2, 3]), atol=1e-2, rtol=0)
    assert radius == pytest.approx(2.0, abs=1e-2)
    assert (scene.vertices - centre).norm(dim=1).max() <= radius


# --- the camera


def test_camera_axes_are_not_mirrored() -> None:
    """Looking along -z with y up: +x is on the right, +y on top, as seen from a right-handed world."""
    camera = Camera((0, 0, 5), (0, 0, 0), width=6, height=4, fov=90)
    origin, d = camera.rays()
    assert origin.tolist() == [0, 0, 5] and d.shape == (4, 6, 3)
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(4, 6))
    assert (d[..., 2] < 0).all()
    assert (d[:, 3:, 0] > 0).all() and (d[:, :3, 0] < 0).all()
    assert (d[:2, :, 1] > 0).all() and (d[2:, :, 1] < 0).all()


def test_camera_field_of_view_is_vertical_and_through_pixel_centres() -> None:
    """At fov 90 the image plane at distance 1 spans -1..1 upwards: row r of 4 is at 1 - (r + 1/2) / 2."""
    _, d = Camera((0, 0, 0), (0, 0, -1), width=8, height=4, fov=90).rays()
    plane = d / -d[..., 2:]
    torch.testing.assert_close(plane[:, 0, 1], torch.tensor([0.75, 0.25, -0.25, -0.75]))
    torch.testing.assert_close(plane[0, :, 0], (torch.arange(8) + 0.5) / 2 - 2)


def test_toward_is_the_direction_to_the_eye() -> None:
    camera = Camera((1, 2, 3), (0, 0, 0))
    points = torch.tensor([[1.0, 2, 0], [0, 2, 3]])
    assert camera.toward(points).tolist() == [[0, 0, 1], [1, 0, 0]]


def test_framing_camera_sees_the_whole_sphere() -> None:
    """The cone of view touches the sphere: a ray at the edge of the image's height passes at the radius."""
    centre = torch.tensor([10.0, -5, 3])
    camera = Camera.framing(centre, 2.0)
    _, d = camera.rays()
    away = centre - torch.tensor(camera.eye)
    middle = (d[0, 319] + d[0, 320]) / 2
    distance = torch.linalg.cross(away, middle / middle.norm()).norm()
    assert float(distance) == pytest.approx(2.0, rel=0.02)
    assert camera.eye[1] > -5 and camera.eye[2] > 3


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("span a view", {"eye": (0, 0, 0)}),
        ("span a view", {"eye": (0, 3, 0)}),
        ("fov must lie between", {"fov": 180.0}),
        ("at least 1 pixel", {"width": 0}),
        ("eye must be three finite numbers", {"eye": (0, 1)}),
        ("up must be three finite numbers", {"up": (0, math.nan, 0)}),
    ],
)
def test_bad_cameras_are_refused(message: str, options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=message):
        Camera(**({"eye": (0, 0, 5), "target": (0, 0, 0)} | options))  # type: ignore[arg-type]


# --- tensors


def test_from_mesh_checks_what_it_is_given() -> None:
    v, f = mesh.plane_mesh(1.0, 1)
    for message, options in {
        r"region 'mesh': normals must be \(4, 3\)": {"normals": v[:2]},
        r"uv must be \(4, 2\)": {"uv": v},
        r"uv must be finite: 4 of 4": {"uv": torch.full((4, 2), torch.nan)},
        r"colours must be \(4, 3\)": {"colours": v[:, :2]},
        r"texture needs uv": {"texture": torch.ones(2, 2, 3)},
        r"texture must be linear \(h, w, c\)": {"texture": torch.ones(2, 2), "uv": v[:, :2]},
    }.items():
        with pytest.raises(ValueError, match=message):
            Scene.from_mesh(v, f, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="max index 3 >= 3"):
        Scene.from_mesh(v[:3], f)
    with pytest.raises(ValueError, match="with an area: all 2 have none"):
        Scene.from_mesh(v * torch.tensor([1.0, 1, 0]), f)
    with pytest.raises(ValueError, match=r"distinct names, got \['a', 'a'\]"):
        Scene.from_parts([Part("a", v, f), Part("a", v, f)])
    with pytest.raises(ValueError, match=r"at least one.*got \[\]"):
        Scene.from_parts([])


def test_repairs_are_counted_once_over_all_regions() -> None:
    """Two regions, each with one collapsed triangle, one vertex outside every triangle, one zero normal."""
    v, f = mesh.plane_mesh(1.0, 1)
    v = torch.cat([v, torch.tensor([[5.0, 0, 0]])])
    f = torch.cat([f, torch.tensor([[0, 1, 1]])])
    normals = torch.tensor([[0.0, 2, 0], [0, 0, 0], [math.nan, 0, 0], [0, 1, 0], [0, 0, 0]])
    parts = [Part("a", v, f), Part("b", v, f, normals=normals)]
    with pytest.warns(UserWarning) as caught:
        scene = Scene.from_parts(parts)
    assert [str(w.message) for w in caught] == [
        "mesh repaired: 2 triangles without area dropped, 4 vertices without a normal given one"
    ]
    sound(scene)
    assert len(scene.vertices) == 10 and len(scene.faces) == 4
    torch.testing.assert_close(scene.normals, torch.tensor([0.0, 1, 0]).expand(10, 3))


def test_given_normals_are_kept_and_made_unit() -> None:
    v, f = mesh.plane_mesh(1.0, 1)
    tilted = torch.tensor([3.0, 4, 0]).expand(4, 3)
    scene = Scene.from_mesh(v, f, normals=tilted)
    torch.testing.assert_close(scene.normals, tilted / 5)
    sound(scene)


def test_albedo_interpolates_colours_and_samples_textures_inside_a_triangle() -> None:
    """The texture's black and white columns lie inside one triangle, whose corners know nothing of them."""
    v, f = mesh.plane_mesh(2.0, 1)
    uv = torch.stack([v[:, 0], v[:, 2]], 1)
    texture = torch.zeros(1, 4, 3)
    texture[0, ::2] = 1.0
    colours = torch.rand(4, 3)
    parts = [Part("plain", v, f, colours=colours), Part("stripes", v + 5, f, uv=uv, texture=texture)]
    scene = Scene.from_parts(parts)
    barycentric = torch.tensor([[0.2, 0.3, 0.5], [0.6, 0.3, 0.1]])
    got = scene.albedo(torch.tensor([1, 1]), barycentric)
    torch.testing.assert_close(got, (colours[f[1]] * barycentric[..., None]).sum(1))
    at = barycentric @ uv[f[0]]
    got = scene.albedo(torch.tensor([2, 2]), barycentric)
    torch.testing.assert_close(got, mesh.sample_texture(texture, at))
    assert not torch.allclose(got, (scene.colours[scene.faces[2]] * barycentric[..., None]).sum(1), atol=0.05)
    with pytest.raises(ValueError, match="must index 4 faces: 1 do not"):
        scene.albedo(torch.tensor([0, -1]), barycentric)


# --- files


def test_bad_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="existing file"):
        ptt.load_scene(tmp_path / "none.ply")
    with pytest.raises(ValueError, match=r"must end in .ply, .obj, .stl, .gltf, .glb or .toml"):
        ptt.load_scene(tmp_path / "none.fbx")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(ValueError, match=r"broken\.ply"):
        ptt.load_scene(tmp_path / "broken.ply")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(ValueError, match=r"points\.obj has no faces"):
        ptt.load_scene(tmp_path / "points.obj")
    (tmp_path / "broken.glb").write_bytes(b"glTF" + b"\0" * 30)
    with pytest.raises(ValueError, match=r"broken\.glb"):
        ptt.load_scene(tmp_path / "broken.glb")


def _ply(path: Path, vertices: str, faces: str) -> Path:
    v = vertices.splitlines()
    f = faces.splitlines()
    header = f"ply\nformat ascii 1.0\nelement vertex {len(v)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(header + "\n".join(v + f) + "\n")
    return path


def test_bad_contents_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"faces must index 3 vertices, got 0\.\.7"):
        ptt.load_scene(_ply(tmp_path / "a.ply", "0 0 0\n1 0 0\n0 0 1", "3 0 1 7"))
    with pytest.raises(ValueError, match=r"must be finite.*1 of 3"):
        ptt.load_scene(_ply(tmp_path / "b.ply", "0 0 0\n1 nan 0\n0 0 1", "3 0 1 2"))


@pytest.mark.parametrize(
    ("kind", "message"), [("stl", r"cut short: 3334 of 4084 bytes"), ("stl_ascii", "cut short: its last")]
)
def test_an_stl_that_is_cut_short_is_refused(tmp_path: Path, kind: str, message: str) -> None:
    """A ball of 80 triangles has 84 + 80 * 50 bytes in binary; 15 triangles less, or half the text, is no mesh."""
    data = trimesh.creation.icosphere(subdivisions=1).export(file_type=kind)
    cut = data[:3334] if isinstance(data, bytes) else data[: len(data) // 2].encode()
    path = tmp_path / "ball.stl"
    path.write_bytes(cut)
    with pytest.raises(ValueError, match=message):
        ptt.load_scene(path)


def test_stl_vertices_are_joined_and_smooth(tmp_path: Path) -> None:
    v, f = mesh.sphere_mesh(2)
    trimesh.Trimesh(v.numpy(), f.numpy(), process=False).export(tmp_path / "ball.stl")
    scene = ptt.load_scene(tmp_path / "ball.stl")
    sound(scene)
    assert len(scene.vertices) == 162 and scene.regions[0].name == "ball"
    assert (scene.normals - scene.vertices).norm(dim=1).max() < 0.03


def test_obj_materials_become_regions_with_their_texture(tmp_path: Path) -> None:
    """A 2 x 2 sRGB image: 0, 10, 128, 255 decode to 0, 10 / 255 / 12.92, 0.21586, 1 (IEC 61966-2-1)."""
    texels = np.array([[0, 10], [128, 255]], np.uint8)
    Image.fromarray(np.repeat(texels[..., None], 3, -1)).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd t.png\nnewmtl b\nKd 0.1 0.2 0.3\nKs 0.4 0.4 0.4\nNs 50\n")
    quad = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    faces = "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n"
    (tmp_path / "quad.obj").write_text("mtllib m.mtl\n" + quad + faces)
    scene = ptt.load_scene(tmp_path / "quad.obj")
    sound(scene)
    assert {r.name for r in scene.regions} == {"a", "b"}
    a = scene.region_index("a")
    texture = scene.regions[a].texture
    assert texture is not None
    expected = torch.tensor([[0, 10 / 255 / 12.92], [0.2158605, 1.0]])
    torch.testing.assert_close(texture.pixels[..., 0], expected, atol=1e-6, rtol=0)
    assert scene.materials["a"].diffuse.tolist() == [1, 1, 1]
    torch.testing.assert_close(scene.materials["b"].diffuse, torch.tensor([0.1, 0.2, 0.3]))
    assert scene.materials["b"].shape == BlinnPhong(50.0)
    assert scene.tangents[scene.vertex_region == a].tolist() == [[1, 0, 0]] * 3
    (tmp_path / "t.png").unlink()
    with pytest.warns(UserWarning, match=r"quad\.obj was read without t\.png"):
        ptt.load_scene(tmp_path / "quad.obj")


@pytest.mark.parametrize(("ending", "expected"), [(".ply", 0.2158605), (".glb", 128 / 255)])
def test_vertex_colours_are_srgb_in_ply_and_linear_in_gltf(tmp_path: Path, ending: str, expected: float) -> None:
    """128 of 255 decodes to 0.21586 (IEC 61966-2-1); COLOR_0 is linear (glTF 2.0)."""
    v, f = mesh.plane_mesh(1.0, 1)
    grey = np.tile(np.array([128, 0, 255, 255], np.uint8), (4, 1))
    path = tmp_path / f"grey{ending}"
    trimesh.Trimesh(v.numpy(), f.numpy(), vertex_colors=grey, process=False).export(path)
    colours = ptt.load_scene(path).colours
    torch.testing.assert_close(colours, torch.tensor([expected, 0.0, 1.0]).expand(4, 3), atol=1e-6, rtol=0)


def _glb(path: Path, node: dict[str, object]) -> Path:
    """One triangle with a red metal, placed twice: by `node`, and as it is."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    normals = np.array([[0, 0, 1]] * 3, "<f4").tobytes()
    views = [{"buffer": 0, "byteOffset": i * 36, "byteLength": 36} for i in range(2)]
    accessor = {"componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, **node}, {"mesh": 0}],
        "meshes": [{"name": "tri", "primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1, 0, 0, 1],
                    "metallicFactor": 1,
                    "roughnessFactor": 0.5,
                }
            }
        ],
        "accessors": [{"bufferView": 0, **accessor}, {"bufferView": 1, **accessor}],
        "bufferViews": views,
        "buffers": [{"byteLength": 72}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", 72, 0x004E4942) + points + normals
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def test_glb_instances_are_placed_and_mirrors_keep_their_front(tmp_path: Path) -> None:
    """Mirrored in x and stretched 1:2, then moved: the face still looks the way its normal does."""
    scene = ptt.load_scene(_glb(tmp_path / "t.glb", {"scale": [-1, 2, 1], "translation": [0, 0, 5]}))
    sound(scene)
    assert [r.name for r in scene.regions] == ["tri"] and scene.faces.shape == (2, 3)
    assert {tuple(p) for p in scene.vertices.tolist()} >= {(-1, 0, 5), (0, 2, 5), (1, 0, 0), (0, 1, 0)}
    crosses = mesh.face_crosses(scene.vertices, scene.faces)
    assert torch.equal(crosses[:, 2].sign(), torch.ones(2, dtype=torch.float64))
    assert torch.equal(scene.normals, torch.tensor([0.0, 0, 1]).expand(6, 3))
    material = scene.materials["tri"]
    assert material.diffuse.tolist() == [0, 0, 0]
    assert [h.colour.tolist() for h in material.highlights] == [[1, 0, 0], [0, 1, 1]]
    assert [h.shape for h in material.highlights] == [ptt.GGX(1.0, 0.5), ptt.GGX(0.0, 0.5)]


def test_normals_turn_with_the_inverse_transpose(tmp_path: Path) -> None:
    """A node's matrix shears by z += x: the normal (0, 0, 1) becomes (-1, 0, 1)."""
    matrix = [1, 0, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]  # columns
    scene = ptt.load_scene(_glb(tmp_path / "t.glb", {"matrix": matrix}))
    geometric = torch.nn.functional.normalize(mesh.face_crosses(scene.vertices, scene.faces), dim=1)
    torch.testing.assert_close(scene.normals[scene.faces[:, 0]].double(), geometric, atol=1e-6, rtol=0)
    assert scene.normals[:, 0].min() == pytest.approx(-math.sqrt(0.5))


def test_bunny_keeps_its_vertices(data_dir: Path) -> None:
    path = data_dir / "meshes" / "bunny.ply"
    with pytest.warns(UserWarning, match="0 triangles without area dropped, 1113 vertices without a normal"):
        scene = ptt.load_scene(path)
    sound(scene)
    raw = path.read_bytes()
    start = raw.index(b"end_header\n") + 11
    stored = np.frombuffer(raw, "<f4", 35947 * 3, start).reshape(-1, 3)
    assert np.array_equal(scene.vertices.numpy(), stored) and scene.faces.shape == (69451, 3)
    assert scene.regions[0].name == "bunny" and scene.uv is None


@pytest.mark.filterwarnings("ignore:mesh repaired")
def test_bunny_is_framed_upright_and_turned_the_right_way(data_dir: Path) -> None:
    """What is higher has a smaller row, and what is further along +x a larger column, as seen from +z."""
    scene = ptt.load_scene(data_dir / "meshes" / "bunny_lowres.ply")
    triangle, barycentric, _ = hits(scene)
    seen = triangle >= 0
    rows, columns = torch.nonzero(seen.reshape(480, 640), as_tuple=True)
    assert rows.min() > 20 and rows.max() < 460 and seen.float().mean() > 0.1
    points = (scene.vertices[scene.faces[triangle[seen]]] * barycentric[seen][..., None]).sum(1)
    assert torch.corrcoef(torch.stack([rows.float(), points[:, 1]]))[0, 1] < -0.9
    assert torch.corrcoef(torch.stack([columns.float(), points[:, 0]]))[0, 1] > 0.9


def test_engine_has_its_parts_and_instances(data_dir: Path) -> None:
    with pytest.warns(UserWarning, match="11160 triangles without area"):
        scene = ptt.load_scene(data_dir / "meshes" / "2CylinderEngine.glb")
    sound(scene)
    assert len(scene.regions) == 34 and len(scene.faces) + 11160 == 121496
    low = scene.vertices.amin(0)
    high = scene.vertices.amax(0)
    torch.testing.assert_close(low, torch.tensor([-371.692, -180.972, -140.0]), atol=1e-2, rtol=0)
    torch.testing.assert_close(high, torch.tensor([371.692, 92.0416, 128.0]), atol=1e-2, rtol=0)
    orange = scene.materials["body_24"].diffuse
    torch.testing.assert_close(orange, 0.96 * torch.tensor([0.85, 0.561, 0.0]), atol=1 / 255, rtol=0)


def test_spot_is_smooth_across_its_texture_seams(data_dir: Path) -> None:
    scene = ptt.load_scene(data_dir / "meshes" / "spot" / "spot_triangulated.obj")
    sound(scene)
    assert len(scene.vertices) == 3225 and scene.uv is not None
    places, index = torch.unique(scene.vertices, dim=0, return_inverse=True)
    assert len(places) == 2930
    first = torch.zeros(2930, 3).index_copy(0, index, scene.normals)
    torch.testing.assert_close(first[index], scene.normals)


@pytest.mark.parametrize("name", ["teapot_uv_normals.obj", "suzanne_7k.ply", "igea.ply", "dragon_vrip_res3.ply"])
@pytest.mark.filterwarnings("ignore:mesh repaired")
def test_real_meshes_load(data_dir: Path, name: str) -> None:
    sound(ptt.load_scene(data_dir / "meshes" / name))


# --- scene files

BOX = '[[region]]\nname = "box"\nbox = { size = [1.0, 2.0, 3.0], cells = 2 }\n'


def _toml(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def test_scene_file_places_shapes_and_gives_materials(tmp_path: Path) -> None:
    text = """
    [camera]
    eye = [0, 1, 5]
    target = [0, 1, 0]
    fov = 30
    [[region]]
    name = "a"
    box = { size = [1.0, 2.0, 3.0] }
    scale = 2.0
    rotate = [0, 90, 0]
    translate = [10, 0, 0]
    editable = false
    subdivide = 1
    material = { model = "cook-torrance", diffuse = [0.1, 0.2, 0.3], specular = 0.4, f0 = 0.5, m = 0.2 }
    [[region]]
    name = "b"
    plane = { size = 4.0, cells = 8 }
    """
    scene = ptt.load_scene(_toml(tmp_path, text))
    sound(scene)
    assert scene.camera == Camera((0, 1, 5), (0, 1, 0), fov=30)
    assert [(r.name, r.editable) for r in scene.regions] == [("a", False), ("b", True)]
    a = scene.vertices[scene.vertex_region == 0]
    torch.testing.assert_close(a.amin(0), torch.tensor([7.0, -2, -1]))  # 90 degrees about y: x takes z's length
    torch.testing.assert_close(a.amax(0), torch.tensor([13.0, 2, 1]))
    assert int((scene.face_region == 0).sum()) == 48 and len(a) == 54
    assert scene.materials["a"].shape == CookTorrance(0.5, 0.2)


def test_long_edges_are_halved_after_placing(tmp_path: Path) -> None:
    text = """
    [[region]]
    name = "plate"
    box = { size = [4.0, 0.1, 1.0] }
    scale = 2.0
    edge = 0.6
    """
    scene = ptt.load_scene(_toml(tmp_path, text))
    sound(scene)
    corners = scene.vertices[scene.faces]
    assert float((corners - corners.roll(-1, 1)).norm(dim=2).max()) <= 0.6
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum() / 2
    assert float(area) == pytest.approx(2 * (8 * 2 + 8 * 0.2 + 2 * 0.2), rel=1e-5)
    with pytest.raises(ValueError, match=r"region 'plate': edge must be > 0, got 0"):
        ptt.load_scene(_toml(tmp_path, text.replace("0.6", "0")))
    with pytest.raises(ValueError, match="take a longer one"):
        ptt.load_scene(_toml(tmp_path, text.replace("0.6", "1e-4")))


@pytest.mark.parametrize(
    ("rotate", "start", "end"),
    [([90, 0, 0], 1, 2), ([0, 90, 0], 2, 0), ([0, 0, 90], 0, 1), ([90, 90, 0], 1, 0)],
)
def test_rotations_are_right_handed_about_x_then_y_then_z(
    tmp_path: Path, rotate: list[float], start: int, end: int
) -> None:
    """90 degrees about x takes y to z, about y z to x, about z x to y; about x then y: y to z to x."""
    marker = np.zeros((3, 3))
    marker[0, start], marker[1, (start + 1) % 3], marker[2] = 2.0, 0.5, 0.1
    trimesh.Trimesh(marker, [[0, 1, 2]], process=False).export(tmp_path / "m.ply")
    path = _toml(tmp_path, f'[[region]]\nname = "m"\nmesh = "m.ply"\nrotate = {rotate}\n')
    expected = torch.zeros(3)
    expected[end] = 2.0
    torch.testing.assert_close(ptt.load_scene(path).vertices[0], expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (r"unknown 'regions'; valid are environment, hidden, gaps, camera, region", "regions = 1\n" + BOX),
        (r"region: unknown 'colour'; valid are name, mesh, plane, .*material", BOX + "colour = 1"),
        (
            r"camera: unknown 'fow'; valid are eye, target, up, fov, width, height",
            "[camera]\nfow = 1\n" + BOX,
        ),
        (r"camera: .*missing.*target", "[camera]\neye = [0, 0, 1]\n" + BOX),
        (r"plane: unknown 'cell'; valid are size, cells", '[[region]]\nname = "a"\nplane = { cell = 3 }'),
        (
            r"one of lambert, blinn-phong, cook-torrance, ward, ggx, metal-rough, mixed, got 'phong'",
            BOX + 'material = { model = "phong" }',
        ),
        (r"material: unknown 'shininess'", BOX + 'material = { model = "lambert", shininess = 1 }'),
        (r"diffuse must be finite and in \[0, 1\]", BOX + 'material = { model = "lambert", diffuse = 2 }'),
        (r"one of mesh, plane, sphere, box, torus, got none", '[[region]]\nname = "a"'),
        (r"got \['box', 'torus'\]", BOX + "torus = {}"),
        (r"region must have a name, got None", "[[region]]\nbox = {}"),
        (r"at least one \[\[region\]\]", ""),
        (r"must be a TOML file", "region = ["),
        (r"region 'box': a box has no texture coordinates for texture", BOX + 'texture = "a.png"'),
        (r"region 'box': parts and regions need a mesh, got box", BOX + 'parts = ["a"]'),
        (r"scale must be one positive number, got -1", BOX + "scale = -1"),
        (r"rotate must be three numbers", BOX + "rotate = [1, 2]"),
        (r"editable must be of type bool, got 'no'", BOX + 'editable = "no"'),
        (r"distinct names, got \['box', 'box'\]", BOX + BOX),
    ],
)
def test_bad_scene_files_are_refused(tmp_path: Path, message: str, text: str) -> None:
    with pytest.raises(ValueError, match=message):
        ptt.load_scene(_toml(tmp_path, text))


def test_files_are_found_beside_the_scene_file_then_in_ptt_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    there = tmp_path / "there"
    for folder, size in ((here, 1.0), (there, 2.0)):
        folder.mkdir()
        v, f = mesh.plane_mesh(size, 1)
        trimesh.Trimesh(v.numpy(), f.numpy(), process=False).export(folder / "p.ply")
    path = _toml(here, '[[region]]\nname = "p"\nmesh = "p.ply"\n')
    monkeypatch.setenv("PTT_DATA", str(there))
    assert float(ptt.load_scene(path).vertices.max()) == 0.5
    (here / "p.ply").unlink()
    assert float(ptt.load_scene(path).vertices.max()) == 1.0
    monkeypatch.delenv("PTT_DATA")
    with pytest.raises(ValueError, match=r"no file 'p\.ply'"):
        ptt.load_scene(path)


def test_scene_file_picks_parts_and_textures(data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PTT_DATA", str(data_dir))
    text = """
    [[region]]
    name = "fins"
    mesh = "meshes/2CylinderEngine.glb"
    parts = ["body_9", "body_10"]
    material = { model = "lambert", diffuse = 0.3 }
    [[region]]
    name = "spot"
    mesh = "meshes/spot/spot_triangulated.obj"
    texture = "meshes/spot/spot_texture.png"
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="mesh repaired")
        scene = ptt.load_scene(_toml(tmp_path, text))
        whole = ptt.load_scene(data_dir / "meshes" / "2CylinderEngine.glb")
        wanted = [whole.region_index(name) for name in ("body_9", "body_10")]
        count = sum(int((whole.face_region == r).sum()) for r in wanted)
        assert int((scene.face_region == 0).sum()) == count > 0
        spot = scene.vertex_region == 1
        pixels = np.asarray(Image.open(data_dir / "meshes/spot/spot_texture.png").convert("RGB")) / 255.0
        assert scene.regions[1].texture is not None
        texture = scene.regions[1].texture.pixels
        torch.testing.assert_close(texture, from_srgb(torch.from_numpy(pixels)).float())
        muzzle = (scene.vertices[:, 2] == scene.vertices[spot][:, 2].min()) & spot
        pink = scene.colours[muzzle].mean(0)
        assert pink[0] > 1.3 * pink[1]  # the foremost point of the cow is its pink muzzle
        differing = text.replace("material", "#")
        with pytest.raises(ValueError, match="region 'fins': parts must share one material"):
            ptt.load_scene(_toml(tmp_path, differing.replace("body_9", "Piston_123-844_0_Parts_2")))
        with pytest.raises(ValueError, match="unknown 'body_99'; valid are Piston"):
            ptt.load_scene(_toml(tmp_path, text.replace("body_9", "body_99")))


def test_a_scene_file_says_how_its_map_is_laid_out(tmp_path: Path) -> None:
    write_image(tmp_path / "probe.exr", torch.ones(8, 8, 3))
    for layout in ("angular", "octahedral"):
        scene = ptt.load_scene(_toml(tmp_path, f'environment = {{ file = "probe.exr", layout = "{layout}" }}\n' + BOX))
        assert scene.environment is not None
    for given, reason in (("3", "a table with a file"), ("{ map = 1 }", "a file")):
        with pytest.raises(ValueError, match=reason):
            ptt.load_scene(_toml(tmp_path, f"environment = {given}\n" + BOX))


@pytest.mark.filterwarnings("ignore:mesh repaired")
def test_example_config_loads(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PTT_DATA", str(data_dir))
    scene = ptt.load_scene(Path(__file__).parents[2] / "scripts" / "configs" / "bunny.toml")
    sound(scene)
    assert scene.environment is not None
    bunny = scene.vertices[scene.vertex_region == scene.region_index("bunny")]
    assert 0 < bunny[:, 1].min() < 0.01


def test_points_are_lit_where_surfaces_meet() -> None:
    """A floor that ends at a wall: in the middle of the shared edge both see half of what the floor's middle sees.

    Points lie a hundredth of the way into the triangles, on the surface, and where triangles surround a vertex stay.
    """
    flat, faces = mesh.plane_mesh(1.0, 8)
    wall = torch.stack((torch.full_like(flat[:, 0], -0.5), flat[:, 0] + 0.5, -flat[:, 2]), 1)
    scene = Scene.from_parts([Part("floor", flat, faces), Part("wall", wall, faces)])
    moved = scene.points - scene.vertices
    inner = (flat[:, [0, 2]].abs() < 0.49).all(1)
    assert (moved[: len(flat)][inner].norm(dim=1) < 1e-6).all() and (
        moved[: len(flat)][~inner].norm(dim=1) > 1e-5
    ).all()
    assert (moved.norm(dim=1) < 0.01 * 0.125).all() and ((moved * scene.normals).sum(1).abs() < 1e-7).all()
    seen = unpack(precompute(scene, resolution=16).visible, 6 * 16**2).sum(1)
    edge = torch.nonzero((scene.vertices[:, 0] < -0.49) & (scene.vertices[:, 1:].abs() < 1e-6).all(1))[:, 0]
    assert len(edge) == 2 and (seen[edge] > 0.4 * seen.max()).all() and (seen[edge] < 0.6 * seen.max()).all()


def test_a_file_of_many_materials_stands_on_a_floor(tmp_path: Path) -> None:
    """By one line of Python, or of TOML, each part keeps its name and material."""
    (tmp_path / "m.mtl").write_text("newmtl seat\nKd 0.1 0.2 0.3\nnewmtl legs\nKd 0.5 0.5 0.5\n")
    rows = "mtllib m.mtl\nv 0 1 0\nv 1 1 0\nv 0 1 -1\nv 0 2 0\n"
    (tmp_path / "chair.obj").write_text(rows + "usemtl seat\nf 1 2 3\nusemtl legs\nf 1 2 4\n")
    scene = ptt.load_scene(tmp_path / "chair.obj", floor=3.0)
    assert [region.name for region in scene.regions] == ["seat", "legs", "floor"]
    floor = scene.vertices[scene.vertex_region == 2]
    assert set(floor[:, 1].tolist()) == {1.0} and float(floor[:, 0].max() - floor[:, 0].min()) > 3
    text = '[[region]]\nname = "chair"\nmesh = "chair.obj"\nregions = true\ntranslate = [0, 1, 0]\n' + BOX
    scene = ptt.load_scene(_toml(tmp_path, text))
    assert [region.name for region in scene.regions] == ["chair/seat", "chair/legs", "box"]
    torch.testing.assert_close(scene.materials["chair/seat"].diffuse, torch.tensor([0.1, 0.2, 0.3]))
    assert float(scene.vertices[scene.vertex_region == 0][:, 1].min()) == 2
    with pytest.raises(ValueError, match="parts and regions need a mesh, got box"):
        ptt.load_scene(_toml(tmp_path, BOX + "regions = true\n"))
    with pytest.raises(ValueError, match="floor is for mesh files"):
        ptt.load_scene(_toml(tmp_path, BOX), floor=2.0)


def test_printing_gives_a_few_lines(
    small_scene: Scene, small_raw: ptt.RawTransfer, small_model: ptt.TransferModel
) -> None:
    light = ptt.Environment.sun_sky().rotated(y=20).scaled(2.0)
    picture = ptt.render(small_scene, small_scene.camera, torch.ones_like(small_scene.vertices))
    for thing in (small_scene, light, picture, small_raw, small_model, light + light, small_raw.receivers):
        text = repr(thing)
        assert len(text.splitlines()) <= 6 and len(text) < 600 and "tensor(" not in text
    assert "floor: " in repr(small_scene) and "turned" in repr(light)
    assert picture._repr_png_()[:4] == b"\x89PNG"
