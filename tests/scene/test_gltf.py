"""glTF files in the forms that the specification has: right, or refused by the feature's name."""

from __future__ import annotations

import base64
import io
import json
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

import ptt
from ptt.ops import mesh

Array = NDArray[Any]
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUAD = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], "<f4")  # looks up
FACES = np.array([0, 1, 2, 0, 2, 3], "<u2")
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")  # v down


class Asset:
    """A glTF tree that grows by arrays, with one quad."""

    def __init__(self, **attributes: Array) -> None:
        self.blob = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        attributes = {"POSITION": QUAD, "NORMAL": np.array([[0, 1, 0]] * 4, "<f4"), **attributes}
        self.primitive: dict[str, Any] = {"attributes": {k: self.array(v) for k, v in attributes.items()}}
        self.primitive["indices"] = self.array(FACES)
        self.mesh: dict[str, Any] = {"name": "quad", "primitives": [self.primitive]}
        self.tree |= {"meshes": [self.mesh], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}

    def view(self, data: bytes, **more: Any) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **more}
        self.blob += data
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Array, **more: Any) -> int:
        rows = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self.view(rows.tobytes()),
            "componentType": KINDS[values.dtype.str[1:]],
            "count": len(rows),
            "type": TYPES[rows.shape[1]],
            **more,
        }
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def image(self, pixels: Array, **texture: Any) -> dict[str, Any]:
        """The textureInfo of an image."""
        buffer = io.BytesIO()
        Image.fromarray(pixels.astype(np.uint8)).save(buffer, "PNG")
        images = self.tree.setdefault("images", [])
        images.append({"bufferView": self.view(buffer.getvalue()), "mimeType": "image/png"})
        textures = self.tree.setdefault("textures", [])
        textures.append({"source": len(images) - 1, **texture})
        return {"index": len(textures) - 1}

    def material(self, **material: Any) -> None:
        self.tree["materials"] = [material]
        self.primitive["material"] = 0

    def save(self, path: Path) -> Path:
        self.tree["buffers"] = [{"byteLength": len(self.blob)}]
        if path.suffix == ".gltf":
            self.tree["buffers"][0]["uri"] = (
                "data:application/gltf-buffer;base64," + base64.b64encode(self.blob).decode()
            )
            path.write_text(json.dumps(self.tree))
            return path
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def load(asset: Asset, folder: Path, name: str = "a.glb") -> ptt.Scene:
    """The scene, read without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return ptt.load_scene(asset.save(folder / name))


def area(scene: ptt.Scene) -> float:
    return float(mesh.face_crosses(scene.vertices, scene.faces).norm(dim=1).sum() / 2)


def half() -> Array:
    """The left half black, the right half white."""
    return np.repeat(np.array([[[0], [0], [255], [255]]] * 4), 3, -1)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_a_quad(tmp_path: Path, name: str) -> None:
    scene = load(Asset(TEXCOORD_0=UV), tmp_path, name)
    assert torch.equal(scene.vertices, torch.from_numpy(QUAD)) and scene.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert scene.uv is not None and scene.uv.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]  # v up
    assert torch.equal(scene.normals, torch.tensor([[0.0, 1, 0]] * 4))
    assert [region.name for region in scene.regions] == ["quad"]


@pytest.mark.parametrize("kind", ["i1", "i2", "u1", "u2"])
def test_normalised_integers_are_fractions(tmp_path: Path, kind: str) -> None:
    """Positions and coordinates as KHR_mesh_quantization has them: c / most, and at least -1 (3.6.2.1)."""
    most = np.iinfo(kind).max
    least = 0 if kind[0] == "u" else -1
    asset = Asset()
    corners = np.clip(QUAD, least, 1)
    attributes = asset.primitive["attributes"]
    attributes["POSITION"] = asset.array((corners * most).astype("<" + kind), normalized=True)
    attributes["TEXCOORD_0"] = asset.array((UV * most).astype("<" + kind), normalized=True)
    asset.tree["extensionsRequired"] = asset.tree["extensionsUsed"] = ["KHR_mesh_quantization"]
    scene = load(asset, tmp_path)
    torch.testing.assert_close(scene.vertices, torch.from_numpy(corners))
    assert scene.uv is not None and scene.uv[0].tolist() == [0, 0] and scene.uv[2].tolist() == [1, 1]
    # the least integer of all is -1 too
    if least:
        lowest = np.where(QUAD < 0, np.iinfo(kind).min, (QUAD * most)).astype("<" + kind)
        attributes["POSITION"] = asset.array(lowest, normalized=True)
        torch.testing.assert_close(load(asset, tmp_path).vertices, torch.from_numpy(QUAD))


def test_integers_that_are_not_normalised_are_numbers(tmp_path: Path) -> None:
    asset = Asset()
    asset.primitive["attributes"]["POSITION"] = asset.array((QUAD * 100).astype("<i2"))
    asset.tree["nodes"][0]["scale"] = [0.01] * 3
    torch.testing.assert_close(load(asset, tmp_path).vertices, torch.from_numpy(QUAD))


def test_sparse_strided_and_blank_accessors(tmp_path: Path) -> None:
    """A vertex is replaced; positions and normals share a view; and zeros are replaced one by one."""
    asset = Asset()
    between = np.concatenate((QUAD, np.array([[0, 1, 0]] * 4, "<f4")), 1)
    view = asset.view(between.tobytes(), byteStride=24)
    common = {"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"}
    rows = asset.view(np.array([0, 2], "<u1").tobytes())
    values = asset.view(np.array([[-2, 0, 1], [3, 0, -1]], "<f4").tobytes())
    sparse = {"count": 2, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}}
    blank = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    first = len(asset.tree["accessors"])
    asset.tree["accessors"] += [common | {"sparse": sparse}, common | {"byteOffset": 12}, blank]
    asset.primitive["attributes"] = {"POSITION": first, "NORMAL": first + 1}
    scene = load(asset, tmp_path)
    assert scene.vertices[:, 0].tolist() == [-2, 1, 3, -1] and scene.normals[:, 1].tolist() == [1] * 4
    asset.primitive["attributes"] = {"POSITION": first + 2}
    with pytest.warns(UserWarning, match="mesh repaired"):
        scene = ptt.load_scene(asset.save(tmp_path / "b.glb"))
    assert scene.vertices.tolist() == [[-2, 0, 1], [0, 0, 0], [3, 0, -1], [0, 0, 0]]


@pytest.mark.parametrize(("mode", "order"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
@pytest.mark.parametrize("indexed", [True, False])
def test_triangles_strips_and_fans_look_up(tmp_path: Path, mode: int, order: list[int], indexed: bool) -> None:
    asset = Asset()
    asset.primitive["mode"] = mode
    if indexed:
        asset.primitive["indices"] = asset.array(np.array(order, "<u4"))
    else:
        del asset.primitive["indices"]
        asset.primitive["attributes"] = {"POSITION": asset.array(QUAD[order])}
    scene = load(asset, tmp_path)
    assert area(scene) == pytest.approx(4)
    assert bool((mesh.face_crosses(scene.vertices, scene.faces)[:, 1] > 0).all())


def test_points_and_lines_are_left_out_by_name(tmp_path: Path) -> None:
    asset = Asset()
    asset.mesh["primitives"] += [{"attributes": asset.primitive["attributes"], "mode": mode} for mode in (0, 1)]
    with pytest.warns(UserWarning, match=r"a\.glb was read without 2 x points or lines"):
        assert area(ptt.load_scene(asset.save(tmp_path / "a.glb"))) == pytest.approx(4)


def test_morph_targets_have_their_default_weights(tmp_path: Path) -> None:
    """Those of the mesh, or of the node where it has its own (3.7.2.2)."""
    asset = Asset()
    up = asset.array(np.array([[0, 1, 0]] * 4, "<f4"))
    wide = asset.array(QUAD)
    asset.primitive["targets"] = [{"POSITION": up}, {"POSITION": wide}]
    asset.mesh["weights"] = [0.5, 0]
    asset.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "weights": [0, 1]}]
    asset.tree["scenes"] = [{"nodes": [0, 1]}]
    scene = load(asset, tmp_path)
    assert torch.equal(scene.vertices[:4], torch.from_numpy(QUAD) + torch.tensor([0, 0.5, 0]))
    assert torch.equal(scene.vertices[4:], 2 * torch.from_numpy(QUAD))


def test_morph_targets_of_colours_and_coordinates(tmp_path: Path) -> None:
    """Colours stay within 0..1, coordinates are morphed before v is turned up (3.7.2.2)."""
    asset = Asset(COLOR_0=np.array([[0.5, 0.5, 0.5]] * 4, "<f4"), TEXCOORD_0=UV)
    darker = np.array([[-0.5, 0.5, 2]] * 4, "<f4")
    asset.primitive["targets"] = [{"COLOR_0": asset.array(darker), "TEXCOORD_0": asset.array(UV)}]
    asset.mesh["weights"] = [0.5]
    scene = load(asset, tmp_path)
    assert scene.colours.tolist() == [[0.25, 0.75, 1]] * 4
    assert scene.uv is not None and scene.uv.tolist() == [[0, -0.5], [1.5, -0.5], [1.5, 1], [0, 1]]


def test_nodes_of_any_kind(tmp_path: Path) -> None:
    """Hidden ones, flat ones, mirrored ones, and children of turned ones; quaternions of any length."""
    asset = Asset()
    turned = {"rotation": [0, 2 * np.sqrt(0.5), 0, 2 * np.sqrt(0.5)], "translation": [10, 0, 0], "children": [4]}
    asset.tree["nodes"] = [
        {"mesh": 0, "scale": [0, 0, 0]},
        {"mesh": 0, "scale": [1, 0, 1]},
        {"mesh": 0, "scale": [-1, 1, 1], "translation": [5, 0, 0]},
        turned,
        {"mesh": 0, "translation": [0, 0, 2]},
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}},
    ]
    asset.tree["extensionsUsed"] = ["KHR_node_visibility"]
    asset.tree["scenes"] = [{"nodes": [0, 1, 2, 3, 5]}]
    scene = load(asset, tmp_path)
    assert len(scene.faces) == 6 and torch.equal(scene.normals, torch.tensor([[0.0, 1, 0]] * 12))
    assert bool((mesh.face_crosses(scene.vertices, scene.faces)[:, 1] > 0).all())
    # a quarter turn about y takes +z to +x: the child lies at (12, 0, 0)
    torch.testing.assert_close(scene.vertices[8:].mean(0), torch.tensor([12.0, 0, 0]))


def test_instances_of_a_mesh(tmp_path: Path) -> None:
    asset = Asset()
    moved = asset.array(np.array([[0, 0, 0], [4, 0, 0]], "<f4"))
    scaled = asset.array(np.array([[1, 1, 1], [0.5, 1, 1]], "<f4"))
    instancing = {"attributes": {"TRANSLATION": moved, "SCALE": scaled}}
    asset.tree["nodes"][0] |= {"translation": [0, 7, 0], "extensions": {"EXT_mesh_gpu_instancing": instancing}}
    asset.tree["extensionsRequired"] = asset.tree["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    scene = load(asset, tmp_path)
    assert area(scene) == pytest.approx(6) and set(scene.vertices[:, 1].tolist()) == {7.0}


def test_a_skin_poses_its_mesh(tmp_path: Path) -> None:
    """Two joints: the left vertices follow one that stays, the right ones one that is lifted by 3; a node's own place
    does not count (3.7.3.3)."""
    joints = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], "<u1")
    weights = np.array([[1, 0, 0, 0]] * 4, "<f4")
    asset = Asset(JOINTS_0=joints, WEIGHTS_0=weights)
    bind = np.stack([np.eye(4), np.eye(4)])
    bind[1, 3, 1] = -1.0  # columns: moves by -1 along y, and the joint by 4
    asset.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": asset.array(bind.astype("<f4").reshape(2, 16))}]
    asset.tree["nodes"] = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {}, {"translation": [0, 4, 0]}]
    asset.tree["scenes"] = [{"nodes": [0, 1, 2]}]
    scene = load(asset, tmp_path)
    assert scene.vertices[:, 1].tolist() == [0, 3, 3, 0] and scene.vertices[:, 0].tolist() == [-1, 1, 1, -1]


def test_colours_multiply(tmp_path: Path) -> None:
    """Vertex colour times texture times factor, all linear (3.9.2): 0.25 x 1 x 0.5 on the white half."""
    asset = Asset(
        TEXCOORD_0=UV, COLOR_0=np.array([[1, 1, 1, 1], [0.25, 1, 1, 1], [0.25, 1, 1, 1], [1, 1, 1, 1]], "<f4")
    )
    base = asset.image(half())
    asset.material(
        pbrMetallicRoughness={"metallicFactor": 0, "baseColorTexture": base, "baseColorFactor": [0.5, 1, 1, 1]}
    )
    scene = load(asset, tmp_path)
    hit = scene.albedo(torch.tensor([0, 0]), torch.tensor([[0.25, 0.75, 0.0], [0.75, 0.25, 0.0]]))
    assert hit[0].tolist() == pytest.approx([0.25 * 1 + 0.75 * 0.25, 1, 1]) and hit[1].tolist() == pytest.approx(
        [0, 0, 0]
    )
    assert float(scene.materials["quad"].diffuse[0]) == pytest.approx(0.96 * 0.5)


def test_a_texture_is_transformed(tmp_path: Path) -> None:
    """The extension's own example: the lower left quadrant, turned clockwise by a quarter."""
    quadrants = np.zeros((8, 8, 3))
    quadrants[4:, :4, 0] = 255  # lower left: red
    asset = Asset(TEXCOORD_0=UV * 0.5 + 0.25)
    base = asset.image(quadrants)
    transform = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    asset.material(pbrMetallicRoughness={
        "metallicFactor": 0, "baseColorTexture": base | {"extensions": {"KHR_texture_transform": transform}}
    })  # fmt: skip
    asset.tree["extensionsRequired"] = asset.tree["extensionsUsed"] = ["KHR_texture_transform"]
    assert load(asset, tmp_path).colours.tolist() == [[1, 0, 0]] * 4
    transform["texCoord"] = 1
    asset.primitive["attributes"]["TEXCOORD_1"] = asset.array(np.array([[1.2, 0.5]] * 4, "<f4"))
    # (u, v) -> (v / 2, 1 - u / 2) = (0.25, 0.4), the upper left: black
    assert load(asset, tmp_path).colours.tolist() == [[0, 0, 0]] * 4


@pytest.mark.parametrize(("wrap", "expected"), [(10497, 0.0), (33071, 1.0), (33648, 1.0)])
def test_samplers_say_what_lies_beyond(tmp_path: Path, wrap: int, expected: float) -> None:
    """At u = 1.25 the half that is white repeats as black, and goes on as white where it is mirrored or clamped."""
    asset = Asset(TEXCOORD_0=np.array([[1.25, 0.5]] * 4, "<f4"))
    asset.tree["samplers"] = [{"wrapS": wrap, "wrapT": wrap}]
    asset.material(pbrMetallicRoughness={"metallicFactor": 0, "baseColorTexture": asset.image(half(), sampler=0)})
    scene = load(asset, tmp_path)
    assert scene.colours[0].tolist() == [expected] * 3


def test_textures_of_metallic_and_roughness(tmp_path: Path) -> None:
    """Green is roughness, blue metallic, both linear, each times its factor; red means nothing (3.9.2)."""
    asset = Asset(TEXCOORD_0=UV)
    texels = np.zeros((4, 4, 3))
    texels[..., 0], texels[..., 1], texels[..., 2] = 255, 51, 102
    asset.material(
        pbrMetallicRoughness={
            "baseColorFactor": [1, 0.5, 0.25, 1],
            "metallicFactor": 0.5,
            "roughnessFactor": 0.75,
            "metallicRoughnessTexture": asset.image(texels),
        }
    )
    scene = load(asset, tmp_path)
    material = scene.materials["quad"]
    assert isinstance(material, ptt.MetalRough)
    values = scene.map_values(material.maps, torch.tensor([0]), torch.tensor([[0.2, 0.3, 0.5]]))[:, 0]
    assert values.tolist() == pytest.approx([0.4, 0.2])
    wi, wo = torch.nn.functional.normalize(torch.rand(2, 50, 3) + 0.01, dim=2)
    found = material.evaluate(wi, wo, torch.ones(50, 3), values[:, None].expand(2, 50))
    expected = ptt.metal_rough((1, 0.5, 0.25), 0.5 * 0.4, 0.75 * 0.2).evaluate(wi, wo)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_a_texture_tints_a_metal(tmp_path: Path) -> None:
    """Base colour is what a metal reflects straight on: of the texture, and of vertices, too."""
    asset = Asset(TEXCOORD_0=UV)
    asset.material(pbrMetallicRoughness={"baseColorTexture": asset.image(half()), "roughnessFactor": 0.5})
    assert isinstance(load(asset, tmp_path).materials["quad"], ptt.MetalRough)
    asset = Asset(COLOR_0=np.array([[1, 0.5, 0.25, 1]] * 4, "<f4"))
    asset.material(pbrMetallicRoughness={"roughnessFactor": 0.5})
    scene = load(asset, tmp_path)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    found = scene.materials["quad"].evaluate(up, up, scene.colours[:1], torch.ones(2, 1))
    assert (found / found[0, 0]).tolist()[0] == pytest.approx([1, 0.5, 0.25])


def test_normals_and_emission(tmp_path: Path) -> None:
    """Normals 2 rgb - 1, x and y times the scale (3.9.3); emission is sRGB times factor times strength (3.9.4)."""
    asset = Asset(TEXCOORD_0=UV)
    bent, lit = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    bent[:] = 204, 127.5, 229.5
    lit[:] = 188
    asset.material(
        normalTexture=asset.image(bent) | {"scale": 0.5},
        emissiveTexture=asset.image(lit),
        emissiveFactor=[1, 0.5, 0],
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
    )
    with pytest.warns(UserWarning, match="without 1 x the light that glowing surfaces cast on others"):
        region = ptt.load_scene(asset.save(tmp_path / "a.glb")).regions[0]
    assert region.bumps is not None and region.glow is not None
    assert region.bumps.normals[0, 0].tolist() == pytest.approx([0.351, 0.0, 0.936], abs=0.01)
    assert region.glow.pixels[0, 0].tolist() == pytest.approx([2.01, 1.005, 0.0], abs=0.01)


def test_textures_of_other_coordinates_are_left_out_by_name(tmp_path: Path) -> None:
    asset = Asset(TEXCOORD_0=UV)
    asset.material(
        pbrMetallicRoughness={"metallicFactor": 0, "baseColorTexture": asset.image(half())},
        normalTexture=asset.image(half() + 1) | {"texCoord": 1},
    )
    with pytest.warns(UserWarning, match="1 x the normal texture, whose coordinates are not those of the base colour"):
        assert ptt.load_scene(asset.save(tmp_path / "a.glb")).regions[0].bumps is None


def test_metallic_roughness_is_ggx(tmp_path: Path) -> None:
    asset = Asset()
    asset.material(
        pbrMetallicRoughness={"baseColorFactor": [1, 0.5, 0.25, 1], "metallicFactor": 1, "roughnessFactor": 0.4}
    )
    gold = load(asset, tmp_path).materials["quad"]
    wi, wo = torch.nn.functional.normalize(torch.rand(2, 100, 3, dtype=torch.float64) + 0.01, dim=2)
    for channel, f0 in enumerate((1.0, 0.5, 0.25)):
        torch.testing.assert_close(
            gold.evaluate(wi, wo)[:, channel], ptt.GGX(f0, 0.4).evaluate(wi, wo), rtol=1e-5, atol=1e-9
        )
    extensions = {"KHR_materials_ior": {"ior": 2.0}, "KHR_materials_specular": {"specularFactor": 0.5}}
    asset.material(pbrMetallicRoughness={"metallicFactor": 0, "roughnessFactor": 0.4}, extensions=extensions)
    asset.tree["extensionsUsed"] = list(extensions)
    clear = load(asset, tmp_path).materials["quad"]
    assert isinstance(clear.shape, ptt.GGX) and clear.shape.f0 == pytest.approx(0.5 / 9)
    assert clear.diffuse.tolist() == pytest.approx([1 - 0.5 / 9] * 3)


LOSSES: list[tuple[str, dict[str, Any]]] = [
    ("a clear coat", {"extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1}}}),
    ("transmission", {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}}),
    ("KHR_materials_unheard_of", {"extensions": {"KHR_materials_unheard_of": {}}}),
    ("the light that glowing surfaces cast on others", {"emissiveFactor": [1, 1, 1]}),
    ("transparency", {"alphaMode": "MASK"}),
    ("a back that is seen", {"doubleSided": True}),
]


@pytest.mark.parametrize(("name", "material"), LOSSES, ids=[name for name, _ in LOSSES])
def test_what_has_no_counterpart_is_named_once(tmp_path: Path, name: str, material: dict[str, Any]) -> None:
    asset = Asset()
    asset.material(**material)
    with pytest.warns(UserWarning, match=rf"a\.glb was read without 1 x {name}") as caught:
        ptt.load_scene(asset.save(tmp_path / "a.glb"))
    assert len(caught) == 1


def refused(asset: Asset, folder: Path, reason: str) -> None:
    with pytest.raises(ValueError, match=rf"(?s)bad\.gl.*{reason}"):
        ptt.load_scene(asset.save(folder / "bad.glb"))


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"])
def test_what_a_file_needs_and_ptt_lacks_is_refused_by_name(tmp_path: Path, name: str) -> None:
    asset = Asset()
    asset.tree["extensionsRequired"] = [name]
    refused(asset, tmp_path, f"needs {name}.*gltf-transform")


def test_damage_is_refused(tmp_path: Path) -> None:
    asset = Asset()
    asset.primitive["indices"] = asset.array(np.array([0, 1, 9], "<u2"))
    refused(asset, tmp_path, "an index of 9 for 4 vertices")
    asset = Asset()
    asset.tree["accessors"][0]["count"] = 400
    refused(asset, tmp_path, r"accessors\[0\] reads .* bytes of a view that has 48")
    asset = Asset()
    asset.tree["nodes"] = [{"mesh": 0, "children": [0]}]
    refused(asset, tmp_path, "two parents")
    asset = Asset()
    asset.tree["nodes"] = [{"mesh": 3}]
    refused(asset, tmp_path, r"meshes\[3\] of 1")
    asset = Asset()
    asset.tree["asset"] = {"version": "1.0"}
    refused(asset, tmp_path, "must be glTF 2.0, got version 1.0")
    asset = Asset()
    del asset.tree["accessors"][0]["type"]
    refused(asset, tmp_path, r"accessors\[0\] is damaged")
    asset = Asset(TEXCOORD_0=UV)
    image = asset.image(half())
    asset.tree["images"][0]["mimeType"] = "image/ktx2"
    asset.blob = asset.blob.replace(b"PNG", b"KTX")
    asset.material(pbrMetallicRoughness={"baseColorTexture": image})
    refused(asset, tmp_path, "cannot be read")
    path = Asset().save(tmp_path / "bad.glb")
    whole = path.read_bytes()
    for length in (0, 11, 40, len(whole) - 8):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"bad\.glb"):
            ptt.load_scene(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda asset: asset.tree["accessors"][0].update(type="VEC2"), r"accessors\[0\] must be VEC3, got VEC2"),
        (lambda asset: asset.tree["accessors"][2].update(componentType=5122), "must hold unsigned integers"),
        (lambda asset: asset.tree["nodes"][0].update(rotation=[0, 0, 1]), "not enough values"),
        (lambda asset: asset.tree["nodes"][0].update(translation=[1e999, 0, 0]), "node 0 has no finite place"),
        (lambda asset: asset.tree["accessors"][0].update(sparse={
            "count": -1, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 0},
        }), r"accessors\[0\] reads"),
        (lambda asset: setattr(asset, "blob", b"\0\0\x80\x7f" + asset.blob[4:]), "must be finite"),
        (lambda asset: setattr(asset, "blob", bytes(48) + asset.blob[48:]), "no triangle with an area"),
        (lambda asset: asset.tree.update(nodes=["all"]), "is damaged"),
    ],
)  # fmt: skip
def test_numbers_that_are_none_of_the_specification_are_refused(
    tmp_path: Path, change: Callable[[Asset], object], reason: str
) -> None:
    asset = Asset()
    change(asset)
    refused(asset, tmp_path, reason)


def test_nothing_is_fetched(tmp_path: Path) -> None:
    tree = {"asset": {"version": "2.0"}, "buffers": [{"uri": "https://example.org/a.bin", "byteLength": 4}]}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match="nothing is fetched from elsewhere"):
        ptt.load_scene(tmp_path / "a.gltf")


def test_names_are_those_of_meshes(tmp_path: Path) -> None:
    asset = Asset()
    nameless = {"primitives": [asset.primitive, asset.primitive]}
    asset.tree["meshes"] = [asset.mesh, nameless, {"name": "quad", "primitives": [asset.primitive]}]
    asset.tree["meshes"].append({"name": "leg_1", "primitives": [asset.primitive, asset.primitive]})
    asset.tree["nodes"] = [{"mesh": k} for k in range(4)]
    asset.tree["scenes"] = [{"nodes": [3, 2, 1, 0]}]
    names = [region.name for region in load(asset, tmp_path).regions]
    assert names == ["quad", "a", "a_1", "quad_1", "leg_1", "leg_2"]
