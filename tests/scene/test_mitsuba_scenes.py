"""Mitsuba scenes: what Mitsuba itself renders, evaluates and hits is the oracle; the rest is named or refused."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install mitsuba")

import drjit as dr  # noqa: E402 (comes with mitsuba)

from bench import mitsuba_check  # noqa: E402 (imports mitsuba)
from ptt.materials.varying import MetalRough, Mixed  # noqa: E402
from ptt.reference import along_rays  # noqa: E402
from ptt.scene.mitsuba_scenes import from_mitsuba  # noqa: E402
from ptt.scene.scene import Scene  # noqa: E402

mi.set_variant("scalar_rgb")
Dict = dict[str, Any]
Array = NDArray[Any]
ROUNDING = 2e-5  # relative, of float32 on both sides


def turn() -> Any:
    """A rotation, anew each time: Mitsuba's transforms are changed in place, and its axes have to be unit."""
    return mi.ScalarTransform4f().rotate([2 / 7, 3 / 7, 6 / 7], 50)


def rgb(*value: float) -> Dict:
    return {"type": "rgb", "value": list(value)}


def bitmap(pixels: Array, **more: Any) -> Dict:
    """A texture of an array; float32 is linear, bytes follow the sRGB curve."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), **more}


def smooth(height: int, width: int, seed: int = 0) -> Array:
    """An image (height, width, 3), 0.1 to 0.9, of waves a few texels long that go on across its edges."""
    random = np.random.default_rng(seed)
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    phases = random.uniform(0, 2 * np.pi, (3, 2))
    waves = [np.sin(2 * np.pi * u + a) * np.cos(2 * np.pi * v + b) for a, b in phases]
    return (0.5 + 0.4 * np.stack(waves, -1)).astype(np.float32)


def sky(**more: Any) -> Dict:
    """An environment map of 33 x 64 texels without sharp edges, and with no pole of two colours."""
    theta = np.linspace(0, np.pi, 33)[:, None, None]
    phi = ((np.arange(64) + 0.5) * (2 * np.pi / 64))[None, :, None]
    direction = np.concatenate(
        np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), 2
    )
    towards = direction @ np.array([[0.8, -0.6, 0], [0.6, 0.64, 0.48], [0, 0.48, -0.8]])
    texels = 0.3 + 2 * np.exp(3 * (towards - 1)).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), **more}


def camera(eye: list[float], **more: Any) -> Dict:
    film = {"type": "hdrfilm", "width": 64, "height": 48}
    look = mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 0, 1])
    return {"type": "perspective", "fov": 40, "film": film, "to_world": look, **more}


def read(**things: Any) -> Scene:
    """The scene of a dictionary, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return from_mitsuba({"type": "scene", **things})


def sphere(bsdf: Dict) -> Scene:
    return read(ball={"type": "sphere", "bsdf": bsdf})


BSDFS: dict[str, Dict] = {
    "diffuse": {"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.7)},
    "gold": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "copper": {
        "type": "roughconductor",
        "material": "Cu",
        "alpha": 0.3,
        "distribution": "ggx",
        "specular_reflectance": rgb(0.9, 0.8, 0.7),
    },
    "brushed": {"type": "roughconductor", "material": "Al", "alpha_u": 0.1, "alpha_v": 0.4, "distribution": "ggx"},
    "all reflected": {"type": "roughconductor", "material": "none", "alpha": 0.5},
    "plastic": {"type": "roughplastic", "diffuse_reflectance": rgb(0.6, 0.1, 0.9), "alpha": 0.15},
    "nonlinear plastic": {
        "type": "roughplastic",
        "diffuse_reflectance": rgb(0.6, 0.1, 0.9),
        "alpha": 0.3,
        "nonlinear": True,
        "distribution": "ggx",
        "int_ior": 1.9,
    },
    "principled": {"type": "principled", "base_color": rgb(0.8, 0.4, 0.1), "roughness": 0.4},
    "all of principled": {
        "type": "principled",
        "base_color": rgb(0.8, 0.4, 0.1),
        "roughness": 0.3,
        "metallic": 0.6,
        "spec_tint": 0.5,
        "clearcoat": 0.8,
        "clearcoat_gloss": 0.3,
        "sheen": 0.4,
        "sheen_tint": 0.6,
        "flatness": 0.5,
        "anisotropic": 0.7,
        "specular": 0.8,
    },
    "principled metal": {"type": "principled", "base_color": rgb(0.8, 0.4, 0.1), "metallic": 1.0, "eta": 1.33},
    "blend": {
        "type": "blendbsdf",
        "weight": 0.3,
        "first": {"type": "diffuse", "reflectance": rgb(0.9, 0.1, 0.1)},
        "second": {"type": "roughconductor", "alpha": 0.3},
    },
    "twosided": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.2, 0.1)}},
}


def pairs(count: int) -> tuple[Tensor, Tensor]:
    """Directions wi, wo (count, 3) above the horizon, half of them near each other's mirror direction."""
    random = np.random.default_rng(0)
    wo, wi = random.normal(size=(2, count, 3))
    wi[::2] = wo[::2] * (-1, -1, 1) + 0.2 * wi[::2]
    both = torch.from_numpy(np.stack((wi, wo)))
    both[..., 2].abs_()
    wi, wo = torch.nn.functional.normalize(both, dim=2)
    return wi, wo


def reflected(bsdf: Any, wi: Tensor, wo: Tensor) -> Tensor:
    """What Mitsuba reflects [1/sr] (n, 3) from wi to wo (n, 3)."""
    at = dr.zeros(mi.SurfaceInteraction3f)
    context = mi.BSDFContext()
    values = []
    for i, o in zip(wi.tolist(), wo.tolist(), strict=True):
        at.wi = mi.Vector3f(o)
        values.append(np.array(bsdf.eval(context, at, mi.Vector3f(i))) / i[2])
    return torch.tensor(np.array(values), dtype=torch.float64)


@pytest.mark.parametrize("name", BSDFS)
def test_materials_reflect_as_mitsuba_does(name: str) -> None:
    """Every pair of directions, to float32's rounding."""
    wi, wo = pairs(200)
    expected = reflected(mi.load_dict(BSDFS[name]), wi, wo)
    found = sphere(BSDFS[name]).materials["ball"].evaluate(wi, wo)
    torch.testing.assert_close(found, expected, rtol=ROUNDING, atol=ROUNDING * float(expected.max()))


def test_smooth_plastic_is_exact_beneath_its_mirror() -> None:
    """Its diffuse part is one highlight, the mirror the other."""
    plastic = {"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.1, 0.9), "nonlinear": True}
    with pytest.warns(UserWarning, match="1 x a mirror, which is GGX of roughness 0.03"):
        scene = from_mitsuba({"type": "scene", "ball": {"type": "sphere", "bsdf": plastic}})
    wi, wo = pairs(100)
    mirror, matt = scene.materials["ball"].highlights
    found = matt.shape.evaluate(wi, wo)[:, None] * matt.colour
    torch.testing.assert_close(found, reflected(mi.load_dict(plastic), wi, wo), rtol=1e-4, atol=1e-6)
    assert mirror.shape.f0 == pytest.approx((0.4896 / 2.4896) ** 2, rel=1e-3)


def test_shapes_of_equal_functions_are_equal_and_others_have_other_names() -> None:
    first, again, other = (
        read(ball={"type": "sphere", "bsdf": {"type": "roughconductor", "material": "none", "alpha": alpha}})
        .materials["ball"]
        .shape
        for alpha in (0.2, 0.2, 0.3)
    )
    assert first == again and first.function == again.function
    assert first.name != other.name


SHAPES: dict[str, Dict] = {
    "sphere": {"type": "sphere", "center": [0.2, 0.1, 0], "radius": 0.8},
    "sphere inside out": {"type": "sphere", "flip_normals": True},
    "mirrored sphere": {"type": "sphere", "to_world": turn().scale([-1, 1, 1])},
    "rectangle": {"type": "rectangle"},
    "flipped rectangle": {"type": "rectangle", "flip_normals": True},
    "disk": {"type": "disk"},
    "mirrored disk": {"type": "disk", "to_world": turn().scale([1, 1, -1])},
    "cylinder": {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0.5, 1], "radius": 0.7},
    "flipped cylinder": {"type": "cylinder", "flip_normals": True},
    "cube": {"type": "cube"},
    "flipped cube": {"type": "cube", "flip_normals": True},
    "flat cube": {"type": "cube", "face_normals": True},
    "mirrored cube": {"type": "cube", "to_world": turn().scale([-1, 1, 2])},
}


def hits(target: Any, count: int = 300) -> tuple[Tensor, Tensor, list[Any]]:
    """Origins and directions (n, 3) of random rays that hit a Mitsuba scene of about 1, and its interactions."""
    random = np.random.default_rng(1)
    origins = random.normal(size=(count, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = random.uniform(-0.8, 0.8, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = [target.ray_intersect(mi.Ray3f(o, d)) for o, d in zip(origins.tolist(), directions.tolist(), strict=True)]
    rows = [row for row, at in enumerate(found) if at.is_valid()]
    return torch.from_numpy(origins[rows]), torch.from_numpy(directions[rows]), [found[row] for row in rows]


@pytest.mark.parametrize("name", SHAPES)
def test_rays_hit_the_same_places(name: str) -> None:
    """Places, sides, normals, texture coordinates and tangents; curves of 96 steps bend by 3.3e-2 radians a step.

    A chord is 5e-4 from its arc, and a ray that grazes may miss it, or hit further on: 97 % have to agree.
    """
    shape = SHAPES[name] | {"to_world": SHAPES[name].get("to_world", turn())}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "closed, and wound inside out")  # which some are
        scene = from_mitsuba({"type": "scene", "shape": shape})
    target = mi.load_dict({"type": "scene", "shape": shape})
    origins, directions, expected = hits(target)
    found = scene.surface.first_hit(origins, directions)
    frames = scene.frames_at(found.triangle.clamp(min=0), found.barycentric)
    assert scene.uv is not None
    uv = scene.interpolated(scene.uv, found.triangle.clamp(min=0), found.barycentric)
    good = 0
    for row, at in enumerate(expected):
        turned = np.array(at.uv) * (1, -1) + (0, 1) - uv[row].numpy()
        far = abs(float(found.distance[row]) - at.t)
        front = bool(found.front[row]) == (np.array(at.sh_frame.n) @ directions[row].numpy() < 0)
        normal = float(frames[row, 2].numpy() @ np.array(at.sh_frame.n))
        tangent = float(frames[row, 0].numpy() @ np.array(at.sh_frame.s))
        around = abs(turned - turned.round()).max()  # u = 0 is u = 1
        good += far < 1e-2 and front and normal > 0.9999 and tangent > 0.999 and around < 2e-3
    assert len(expected) > 50
    assert good > 0.97 * len(expected)


TEXTURES: dict[str, Dict] = {
    "linear": bitmap(smooth(6, 8), raw=True),
    "sRGB bytes": bitmap((smooth(6, 8) * 255).astype(np.uint8)),
    "raw bytes": bitmap((smooth(6, 8) * 255).astype(np.uint8), raw=True),
    "grey": bitmap(smooth(6, 8)[..., :1].copy(), raw=True),
    "to_uv": bitmap(smooth(6, 8), raw=True, to_uv=mi.ScalarTransform4f().translate([0.3, 0.2, 0]).scale([2, -3, 1])),
    "turned": bitmap(smooth(6, 8), raw=True, to_uv=mi.ScalarTransform4f().rotate([0, 0, 1], 30)),
    "mirror": bitmap(smooth(5, 5), raw=True, wrap_mode="mirror", to_uv=mi.ScalarTransform4f().scale([3, 3, 1])),
    "clamp": bitmap(smooth(5, 5), raw=True, wrap_mode="clamp", to_uv=mi.ScalarTransform4f().scale([3, 3, 1])),
    "checkerboard": {"type": "checkerboard", "color0": rgb(0.9, 0.1, 0.2), "color1": rgb(0.1, 0.5, 0.6)}
    | {"to_uv": mi.ScalarTransform4f().scale([4, 3, 1])},
}


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_have_the_same_colours(name: str) -> None:
    """At random places of a rectangle; a checkerboard's edges are 1/512 of a period wide: 2 % of places may differ."""
    shape = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": TEXTURES[name]}}
    scene = read(sheet=shape)
    target = mi.load_dict({"type": "scene", "sheet": shape})
    origins, directions, expected = hits(target)
    found = scene.surface.first_hit(origins, directions)
    colours = scene.albedo(found.triangle, found.barycentric)
    theirs = torch.tensor([list(at.bsdf().eval_diffuse_reflectance(at)) for at in expected])
    worst = (colours - theirs).abs().amax(1)
    assert float((worst < 2e-3).double().mean()) > (0.98 if name == "checkerboard" else 0.999)


def test_the_row_on_top_of_a_bitmap_is_at_v_0() -> None:
    """Red on top, v = 0: the lower edge, y = -1, of Mitsuba's rectangle."""
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0, :, 0] = 1
    scene = read(sheet={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": bitmap(pixels, raw=True)}})
    y = scene.vertices[:, 1]
    low = (y > -0.9) & (y < -0.1)  # without the edges, across which it repeats
    high = (y > 0.1) & (y < 0.9)
    assert bool((scene.colours[low, 0] > 0.5).all()) and bool((scene.colours[high, 0] < 0.5).all())


@pytest.mark.parametrize("more", [{}, {"fov_axis": "y"}, {"fov_axis": "larger"}, {"fov_axis": "diagonal"}])
@pytest.mark.parametrize("size", [(64, 48), (30, 50)])
def test_cameras_have_the_same_rays(more: Dict, size: tuple[int, int]) -> None:
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    description = camera([3, 1, 2], film=film, **more)
    sensor = mi.load_dict(description)
    eye, directions = read(ball={"type": "sphere"}, camera=description).camera.rays()
    assert directions.shape[:2] == size[::-1]
    assert eye.tolist() == pytest.approx([3, 1, 2])
    for row, column in ((0, 0), (size[1] - 1, 3), (7, size[0] - 1)):
        place = [(column + 0.5) / size[0], (row + 0.5) / size[1]]
        ray, _ = sensor.sample_ray(0, 0, place, [0, 0])
        assert directions[row, column].tolist() == pytest.approx(list(ray.d), abs=1e-5)


@pytest.mark.parametrize(
    "light",
    [
        sky(),
        sky(scale=2.5, to_world=turn()),
        sky(to_world=turn().scale([-1, 1, 1])),
        {"type": "constant", "radiance": rgb(1, 2, 0.5)},
    ],
    ids=["plain", "turned and scaled", "mirrored", "constant"],
)
def test_environments_send_the_same_light(light: Dict) -> None:
    """In all directions; rows are interpolated eight times as finely, which cuts the map's peaks by 1/16 of a curve."""
    environment = read(ball={"type": "sphere"}, light=light).environment
    emitter = mi.load_dict(light)
    assert environment is not None
    directions = torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    at = dr.zeros(mi.SurfaceInteraction3f)
    for direction, found in zip(directions, environment.radiance(directions), strict=True):
        at.wi = -mi.Vector3f(direction.tolist())
        assert found.tolist() == pytest.approx(list(emitter.eval(at)), rel=2e-3)


def obj(path: Path, normals: bool) -> str:
    """A tent of two squares, with texture coordinates, and with normals or without."""
    corners = ["v -1 -1 0", "v 0 -1 0.7", "v 0 1 0.7", "v -1 1 0", "v 1 -1 0", "v 1 1 0"]
    corners += ["vt 0 0", "vt 0.5 0", "vt 0.5 1", "vt 0 1", "vt 1 0", "vt 1 1"]
    corners += ["vn -0.5 0 1", "vn 0 0 1", "vn 0 0 1", "vn -0.5 0 1", "vn 0.5 0 1", "vn 0.5 0 1"] * normals
    form = "{0}/{0}/{0}" if normals else "{0}/{0}"
    faces = ["f " + " ".join(form.format(k) for k in face) for face in ((1, 2, 3, 4), (2, 5, 6, 3))]
    path.write_text("\n".join(corners + faces))
    return str(path)


def coloured_mesh() -> Any:
    """A square whose vertices have colours."""
    properties = mi.Properties()
    reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    made = mi.Mesh("square", 4, 2, props=properties)
    made.add_attribute("vertex_color", 3, [0.9, 0.1, 0.1, 0.1, 0.9, 0.1, 0.1, 0.1, 0.9, 0.5, 0.5, 0.5])
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.array([-2, -2, -1.2, 2, -2, -1.2, 2, 2, -1.2, -2, 2, -1.2], np.float32)
    parameters["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    parameters.update()
    return made


def tilted(size: int, seed: int = 0) -> Dict:
    """A normal map whose normals lean by up to 32 degrees."""
    normals = (smooth(size, size, seed) + 0.5) / 2
    normals[..., 2] = 0.95
    return bitmap(normals, raw=True)


def bumpy(normals: Dict, bsdf: Dict) -> Dict:
    """A normal map that does nothing but bend the frame."""
    only = {"use_shadowing_function": False, "flip_invalid_normals": False}
    return {"type": "normalmap", "normalmap": normals, "bsdf": bsdf, **only}


def floor(bsdf: Dict) -> Dict:
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale([3, 3, 1]),
        "bsdf": bsdf,
    }


def textures_scene(_: Path) -> Dict:
    """Textures on flat and round shapes, and two that hide each other's light."""
    return {
        "light": {"type": "constant", "radiance": rgb(1, 1.5, 0.7)},
        "camera": camera([4, 2, 3]),
        "floor": floor({"type": "diffuse", "reflectance": TEXTURES["to_uv"]}),
        "ball": {"type": "sphere", "radius": 0.8, "bsdf": {"type": "diffuse", "reflectance": TEXTURES["sRGB bytes"]}},
        "box": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([-1, 1.6, -0.5]).rotate([0, 0, 1], 20).scale(0.5),
            "bsdf": {"type": "diffuse", "reflectance": TEXTURES["grey"]},
        },
    }


def metals_scene(_: Path) -> Dict:
    """Metals under a turned map, one of them brushed along its tangents."""
    return {
        "light": sky(scale=1.5, to_world=turn()),
        "camera": camera([3, -3, 2], fov_axis="y"),
        "floor": floor(BSDFS["copper"]),
        "ball": {"type": "sphere", "radius": 0.9, "bsdf": BSDFS["gold"]},
        "tube": {"type": "cylinder", "p0": [1.5, 1, -1], "p1": [1.5, 1, 1], "radius": 0.5, "bsdf": BSDFS["brushed"]},
    }


def plastics_scene(_: Path) -> Dict:
    """Rough plastics, and a disk."""
    return {
        "light": sky(to_world=mi.ScalarTransform4f().rotate([1, 0, 0], 90)),
        "camera": camera([0, -4, 3]),
        "floor": floor(BSDFS["plastic"]),
        "ball": {"type": "sphere", "bsdf": BSDFS["nonlinear plastic"]},
        "plate": {
            "type": "disk",
            "to_world": mi.ScalarTransform4f().translate([-1.6, 0, 0]).rotate([0, 1, 0], 60),
            "bsdf": BSDFS["plastic"],
        },
    }


def principled_scene(_: Path) -> Dict:
    """All lobes of principled."""
    return {
        "light": sky(scale=0.7, to_world=turn()),
        "camera": camera([2, 4, 2]),
        "floor": floor(BSDFS["principled"]),
        "ball": {"type": "sphere", "radius": 0.9, "bsdf": BSDFS["all of principled"]},
        "box": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([1.7, 0, -0.5]).scale(0.5),
            "bsdf": {"type": "twosided", "bsdf": BSDFS["principled metal"]},
        },
    }


def bumps_scene(_: Path) -> Dict:
    """Normal maps over matt and metal, and a blend by a texture."""
    normals = tilted(32, seed=3)
    weight = bitmap(smooth(6, 6)[..., :1].copy(), raw=True)
    blend = {"type": "blendbsdf", "weight": weight, "first": BSDFS["plastic"], "second": BSDFS["copper"]}
    return {
        "light": sky(to_world=turn()),
        "camera": camera([3, 3, 3]),
        "floor": floor(bumpy(normals, {"type": "diffuse", "reflectance": TEXTURES["linear"]})),
        "ball": {"type": "sphere", "radius": 0.9, "bsdf": bumpy(normals, BSDFS["gold"])},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([-1, 2, 0]).scale(0.5), "bsdf": blend},
    }


def meshes_scene(folder: Path) -> Dict:
    """Meshes of files, flat and smooth, and vertices' colours."""
    above = mi.ScalarTransform4f().translate([0, 0, -0.4])
    return {
        "light": sky(scale=2.0),
        "camera": camera([2, -3, 3]),
        "square": coloured_mesh(),
        "flat": {"type": "obj", "filename": obj(folder / "flat.obj", False), "face_normals": True, "to_world": above}
        | {"bsdf": BSDFS["blend"]},
        "smooth": {
            "type": "obj",
            "filename": obj(folder / "smooth.obj", True),
            "to_world": above.translate([0.5, 0, 1]).scale(0.4),
            "bsdf": {"type": "diffuse", "reflectance": TEXTURES["mirror"]},
        },
    }


SCENES: tuple[Callable[[Path], Dict], ...] = (
    textures_scene,
    metals_scene,
    plastics_scene,
    principled_scene,
    bumps_scene,
    meshes_scene,
)


@pytest.mark.parametrize("make", SCENES, ids=lambda make: make.__name__)
def test_the_reference_renders_what_mitsuba_does(make: Callable[[Path], Dict], tmp_path: Path) -> None:
    """z = difference / standard error over 150 camera rays and three colours, of light that is reflected up to twice.

    Both right: 0.3 % outside 3 (colours go together: allow 1.5 %, and 0.5 % for rays that pass an edge of a curve's
    chords), mean square 1, and the mean over all rays within 3 of its own error. The reference draws directions for
    these BRDFs by the cosine and by the light, which takes more samples of metals.
    """
    description = make(tmp_path)
    scene = read(**description)
    assert scene.environment is not None
    origins, directions = mitsuba_check.camera_rays(scene, 150, seed=3)
    light, materials = scene.environment, scene.materials
    ours = along_rays(scene, light, materials, origins, directions, bounces=1, samples=4096, seed=5)
    target = mi.load_dict({"type": "scene", **description})
    theirs = mitsuba_check.mitsuba_radiance(target, origins, directions, bounces=1, samples=512, seed=5)
    result = mitsuba_check.scores(ours, theirs)
    assert result["within_3"] > 0.98
    assert 0.8 < result["z_rms"] < 1.2
    assert result["bias_z"] < 3
    assert result["noise"] < 0.06 and abs(result["bias"]) < 0.015


def lost(**things: Any) -> tuple[Scene, str]:
    """The scene of a dictionary, and what its one warning says."""
    with pytest.warns(UserWarning, match="was read without") as caught:
        scene = from_mitsuba({"type": "scene", **things})
    assert len(caught) == 1
    return scene, str(caught[0].message)


def ball(bsdf: Dict) -> Dict:
    return {"type": "sphere", "bsdf": bsdf}


def test_losses_are_named_once_in_one_warning() -> None:
    """Three spheres of two mirrors, an open sheet, and things that are no shapes with a BRDF."""
    mirror = {"type": "conductor", "material": "Ag"}
    _, message = lost(
        first=ball(mirror),
        second=ball(mirror),
        third=ball({"type": "dielectric"}),
        sheet={"type": "rectangle", "bsdf": BSDFS["twosided"]},
        lamp={"type": "point", "intensity": rgb(1, 1, 1)},
        other={"type": "orthographic"},
        hidden=ball({"type": "null"}),
        fur=ball({"type": "hair"}),
        holes=ball({"type": "mask", "opacity": 0.5, "bsdf": BSDFS["diffuse"]}),
    )
    assert message == (
        "the dictionary was read without 1 x a back that is seen (twosided), 1 x a bsdf, which is matt grey (Hair), "
        "1 x a light (PointLight), 3 x a mirror, which is GGX of roughness 0.03, 1 x a sensor (OrthographicCamera), "
        "1 x an invisible surface (null), 1 x light through a surface (SmoothDielectric), 1 x transparency (mask)"
    )


def test_a_mirror_is_the_narrowest_lobe() -> None:
    """Silver reflects 0.95 to 0.98 straight on."""
    scene, _ = lost(ball=ball({"type": "conductor", "material": "Ag"}))
    highlights = scene.materials["ball"].highlights
    assert {h.shape.roughness for h in highlights} == {0.03}
    straight = sum(h.colour * h.shape.f0 for h in highlights)
    assert bool((straight > 0.9).all()) and bool((straight < 1).all())


def test_glass_reflects_what_it_does_not_let_through() -> None:
    """((1.5 - 1) / (1.5 + 1))^2 = 0.04; a thin pane, both sides of which reflect, 2 r / (1 + r)."""
    glass = {"int_ior": 1.5, "ext_ior": 1.0}
    for kind, expected in (("dielectric", 0.04), ("thindielectric", 2 * 0.04 / 1.04)):
        scene, _ = lost(ball=ball({"type": kind, **glass}))
        assert scene.materials["ball"].shape.f0 == pytest.approx(expected, rel=1e-4)
    rough = {"type": "roughdielectric", "alpha": 0.3, **glass}
    scene, _ = lost(ball=ball(rough))
    wi, wo = pairs(100)
    found = scene.materials["ball"].evaluate(wi, wo)
    torch.testing.assert_close(found, reflected(mi.load_dict(rough), wi, wo), rtol=1e-4, atol=1e-5)


def test_a_backs_loss_is_none_where_nothing_sees_it() -> None:
    """A closed shape from outside; from within it is one."""
    inside = camera([0.1, 0, 0])
    read(ball=ball(BSDFS["twosided"]), camera=camera([3, 0, 0]))
    assert "1 x a back that is seen" in lost(ball=ball(BSDFS["twosided"]), camera=inside)[1]


@pytest.mark.parametrize("kind", ["plastic", "roughplastic"])
def test_plastic_with_a_texture_keeps_its_albedo(kind: str) -> None:
    """What is seen straight on under even light is that of the exact plastic of the texture's mean, to 10 %."""
    plain = {"type": kind, "diffuse_reflectance": rgb(0.4, 0.5, 0.6)}
    pixels = np.full((2, 2, 3), (0.4, 0.5, 0.6), np.float32)
    textured = {"type": kind, "diffuse_reflectance": bitmap(pixels, raw=True)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exact = from_mitsuba({"type": "scene", "ball": ball(plain)}).materials["ball"]
    scene, message = lost(ball=ball(textured))
    assert "1 x the exact diffuse part of plastic with a texture, which is matt" in message
    wi, _ = pairs(4000)
    wo = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(wi)
    weight = wi[:, 2:] / wi[:, 2:].sum()
    colour = torch.tensor((0.4, 0.5, 0.6)).double()
    found = scene.materials["ball"].evaluate(wi, wo, colour)
    expected = exact.evaluate(wi, wo)
    torch.testing.assert_close((found * weight).sum(0), (expected * weight).sum(0), rtol=0.1, atol=0)


def test_principled_with_textures_is_metallic_roughness() -> None:
    roughness = bitmap(smooth(4, 4)[..., :1].copy(), raw=True)
    sheet = {"type": "principled", "base_color": TEXTURES["linear"], "roughness": roughness, "metallic": 0.5}
    scene, message = lost(sheet={"type": "rectangle", "bsdf": sheet | {"clearcoat": 0.5}})
    material = scene.materials["sheet"]
    assert isinstance(material, MetalRough)
    assert material.metallic == pytest.approx(0.5) and material.roughness_map is not None
    assert scene.regions[0].texture is not None
    assert "1 x clearcoat of principled with textures" in message
    assert "1 x the exact form of principled with textures, which is metallic-roughness" in message


def test_textures_without_a_counterpart_are_their_means() -> None:
    alpha = bitmap(np.array([[[0.1], [0.3]], [[0.1], [0.3]]], np.float32), raw=True)
    rough = {"type": "roughconductor", "material": "none", "alpha": alpha}
    scene, message = lost(ball=ball(rough))
    assert "1 x a texture of alpha, whose mean it has" in message
    exact = read(ball=ball(rough | {"alpha": 0.2})).materials["ball"]
    wi, wo = pairs(50)
    found = scene.materials["ball"].evaluate(wi, wo)
    torch.testing.assert_close(found, exact.evaluate(wi, wo), rtol=1e-5, atol=1e-6)


def test_a_blend_by_a_texture_is_a_mixture() -> None:
    weight = bitmap(smooth(6, 6)[..., :1].copy(), raw=True)
    blend = {"type": "blendbsdf", "weight": weight, "first": BSDFS["diffuse"], "second": BSDFS["gold"]}
    material = read(sheet={"type": "rectangle", "bsdf": blend}).materials["sheet"]
    assert isinstance(material, Mixed) and material.second.highlights and not material.first.highlights


def test_a_blend_has_one_base_colour() -> None:
    """That of the only matt one; two textures of two matt ones become their means."""
    matt = {"type": "diffuse", "reflectance": TEXTURES["linear"]}
    one = {"type": "blendbsdf", "weight": 0.4, "first": matt, "second": BSDFS["gold"]}
    assert read(sheet={"type": "rectangle", "bsdf": one}).regions[0].texture is not None
    two = one | {"second": {"type": "diffuse", "reflectance": TEXTURES["mirror"]}}
    scene, message = lost(sheet={"type": "rectangle", "bsdf": two})
    assert "1 x the textures of two blended materials, which have their means" in message
    expected = 0.6 * smooth(6, 8).mean((0, 1)) + 0.4 * smooth(5, 5).mean((0, 1))
    assert scene.materials["sheet"].diffuse.tolist() == pytest.approx(expected.tolist(), abs=1e-5)


def test_normals_inside_a_blend_are_named() -> None:
    blend = {"type": "blendbsdf", "weight": 0.5, "first": bumpy(tilted(8), BSDFS["gold"]), "second": BSDFS["diffuse"]}
    scene, message = lost(sheet={"type": "rectangle", "bsdf": blend})
    assert message.endswith("1 x a normal or bump map inside another, or inside a blend")
    assert scene.regions[0].bumps is None
    constant = bumpy(rgb(0.5, 0.5, 1), BSDFS["diffuse"])
    assert "1 x a normal map without a bitmap" in lost(sheet={"type": "rectangle", "bsdf": constant})[1]


@pytest.mark.parametrize("key", ["use_shadowing_function", "flip_invalid_normals"])
def test_what_mitsuba_adds_to_normal_maps_is_named(key: str) -> None:
    plain = bumpy(tilted(8), BSDFS["diffuse"])
    read(sheet={"type": "rectangle", "bsdf": plain})
    _, message = lost(sheet={"type": "rectangle", "bsdf": plain | {key: True}})
    assert "1 x a normal map's softer shadows and flips" in message


def bent_normals(found: list[Any]) -> Tensor:
    """World normals (n, 3) to which a matt BSDF of reflectance 0.5 is bent: what it reflects is their cosine."""
    sides = np.array([[0.3, 0, 1], [-0.3, 0.2, 1], [0, -0.3, 1]])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    normals = []
    for at in found:
        at.wi = mi.Vector3f(0, 0, 1)
        seen = [at.bsdf().eval(mi.BSDFContext(), at, mi.Vector3f(side)) for side in sides.tolist()]
        local = np.linalg.solve(sides, np.array(seen)[:, 0] * 2 * np.pi)
        normals.append(list(at.to_world(mi.Vector3f(local.tolist()))))
    return torch.tensor(normals, dtype=torch.float32)


@pytest.mark.parametrize("scale", [[1, 1, 1], [-2, 1, 1], [1, -1, 1], [-1, -2, 1]])
@pytest.mark.parametrize("mirror", [1, -1])
def test_normal_maps_bend_as_mitsuba_does(scale: list[float], mirror: int) -> None:
    """In the frame of u and of normal x u, however uv run, in the mesh and by to_uv."""
    normals = tilted(32) | {"to_uv": mi.ScalarTransform4f().scale(scale)}
    matrix = mi.ScalarTransform4f().scale([1, mirror, 1])
    shape = {"type": "rectangle", "to_world": matrix, "bsdf": bumpy(normals, {"type": "diffuse"})}
    scene = read(sheet=shape)
    target = mi.load_dict({"type": "scene", "sheet": shape})
    origins, directions, expected = hits(target, 100)
    found = scene.surface.first_hit(origins, directions)
    bent = scene.bent_frames(found.triangle, found.barycentric)[:, 2]
    assert float((bent - bent_normals(expected)).norm(dim=1).max()) < 0.01  # ptt interpolates unit normals
    assert float((bent - scene.normals[0]).norm(dim=1).mean()) > 0.1


def test_bump_maps_bend_as_mitsuba_does() -> None:
    """By heights in the world's units, over uv whose steps have other lengths along u and v."""
    heights = bitmap(smooth(64, 64)[..., :1].copy(), raw=True)
    bsdf = {"type": "bumpmap", "heights": heights, "scale": 0.2, "bsdf": {"type": "diffuse"}}
    bsdf |= {"use_shadowing_function": False, "flip_invalid_normals": False}
    shape = {"type": "rectangle", "to_world": turn().scale([1, 1.5, 1]), "bsdf": bsdf}
    scene, message = lost(sheet=shape)
    assert message.endswith("1 x a bump map's slopes within texels, which are interpolated")
    target = mi.load_dict({"type": "scene", "sheet": shape})
    origins, directions, expected = hits(target, 100)
    found = scene.surface.first_hit(origins, directions)
    bent = scene.bent_frames(found.triangle, found.barycentric)[:, 2]
    assert float((bent - bent_normals(expected)).norm(dim=1).max()) < 0.03
    assert float((bent - scene.normals[0]).norm(dim=1).mean()) > 0.1


def test_brushed_metal_needs_uv_for_its_direction(tmp_path: Path) -> None:
    triangle = tmp_path / "bare.obj"
    triangle.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    _, message = lost(bare={"type": "obj", "filename": str(triangle), "bsdf": BSDFS["brushed"]})
    assert message.endswith("1 x the direction of brushed facets on a mesh without uv")


def test_glow_is_an_area_lights_radiance() -> None:
    lamp = {"type": "sphere", "light": {"type": "area", "radiance": rgb(3, 2, 1)}}
    scene, message = lost(lamp=lamp)
    assert "1 x the light that glowing surfaces cast on others (they do glow)" in message
    assert scene.vertex_glow is not None and scene.vertex_glow[0].tolist() == [3, 2, 1]
    assert scene.environment is None


def test_a_thin_lens_is_a_pinhole_and_a_crop_is_named() -> None:
    film = {"type": "hdrfilm", "width": 40, "height": 20, "crop_offset_x": 5, "crop_width": 10, "crop_height": 10}
    lens = camera([3, 0, 0], film=film) | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
    scene, message = lost(ball={"type": "sphere"}, camera=lens, other=camera([0, 3, 0]))
    assert "1 x the depth of field (thinlens)" in message and "1 x a further sensor" in message
    assert "1 x a part of the film (crop, principal_point_offset)" in message
    assert (scene.camera.width, scene.camera.height, scene.camera.eye) == (40, 20, (3, 0, 0))


def test_files_and_loaded_scenes_are_read_alike(tmp_path: Path) -> None:
    """Names are the ids; the variant stays as it was."""
    path = tmp_path / "scene.xml"
    path.write_text(
        """<scene version="3.0.0">
        <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf>
        <shape type="sphere" id="first"><ref id="red"/></shape>
        <shape type="cube" id="second"><ref id="red"/></shape>
        <emitter type="constant"><rgb name="radiance" value="2, 2, 2"/></emitter></scene>"""
    )
    for given in (path, str(path), mi.load_file(str(path), optimize=False)):
        scene = from_mitsuba(given)
        assert [region.name for region in scene.regions] == ["first", "second"]
        assert scene.materials["second"].diffuse.tolist() == pytest.approx([0.8, 0.1, 0.1])
        assert scene.environment is not None
        assert scene.environment.radiance(torch.eye(3)).tolist() == [[2, 2, 2]] * 3
    assert mi.variant() == "scalar_rgb"


def test_bad_input_is_refused_in_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text('<scene version="3.0.0"><shape type="nosuch"/></scene>')
    single = tmp_path / "single.xml"
    single.write_text('<shape type="sphere" version="3.0.0"/>')
    triangle = tmp_path / "bare.obj"
    triangle.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    bare: Dict = {"type": "obj", "filename": str(triangle)}
    bare["bsdf"] = {"type": "diffuse", "reflectance": TEXTURES["linear"]}
    colourless = bare | {"bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}}
    stretched = sky(to_world=mi.ScalarTransform4f().scale([1, 2, 1]))
    cases: list[tuple[Any, str]] = [
        (tmp_path / "none.xml", "scene must be an existing XML file, got"),
        (broken, 'broken.xml: Mitsuba does not load it: .*"nosuch" not found'),
        (single, "single.xml must hold a scene, got a .*: put it into <scene>"),
        ({"type": "scene"}, "the dictionary shows no shape .*: give it a mesh, sphere or rectangle"),
        (
            {"type": "scene", "s": {"type": "sphere"}, "l": stretched},
            "envmap's to_world scales by .*: give it a rotation",
        ),
        ({"type": "scene", "bare": bare}, "shape 'bare' has a bsdf with textures.*: give its mesh uv"),
        ({"type": "scene", "bare": colourless}, "shape 'bare' has no attribute vertex_color.*: give its mesh one"),
        (3, "scene must be an XML file, a dictionary, or a mi.Scene of the variant that is set"),
    ]
    for given, message in cases:
        with pytest.raises(ValueError, match=message) as caught:
            from_mitsuba(given)
        assert "\n" not in str(caught.value)


def test_spectra_are_refused() -> None:
    mi.set_variant("scalar_spectral")
    try:
        scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
        with pytest.raises(ValueError, match="of the variant scalar_spectral: load it in an RGB variant"):
            from_mitsuba(scene)
        assert from_mitsuba({"type": "scene", "ball": {"type": "sphere"}}).regions[0].name == "ball"
        assert mi.variant() == "scalar_spectral"
    finally:
        mi.set_variant("scalar_rgb")


def test_without_mitsuba_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mi, "__version__", "3.8.0")
    with pytest.raises(ImportError, match=r"3.9 or later, got 3.8.0: pip install ptt\[mitsuba\]"):
        from_mitsuba("scene.xml")
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(ImportError, match=r"pip install ptt\[mitsuba\]"):
        from_mitsuba("scene.xml")
