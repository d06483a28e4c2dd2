"""Materials of scene files that image files vary: what they are at a point, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

import ptt
from ptt.io.colour import from_srgb
from ptt.materials.varying import same

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
PLACES = torch.tensor([[0.75, 0.125, 0.125], [0.25, 0.375, 0.375]])
"""Barycentric in the quad's first triangle, whose uv are (0, 0), (1, 0), (1, 1): u = b1 + b2 = 1/4 and 3/4, the
middles of the texels of an image of two."""
ROUGH = 51, 204  # of 255: 0.2 and 0.8
METAL = 102, 255  # 0.4 and 1
RED = '{ model = "lambert", diffuse = [0.5, 0, 0] }'
GLOSS = '{ model = "ggx", diffuse = 0, f0 = [1, 0.7, 0.3], roughness = 0.3 }'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Meshes with and without uv; images of two texels, side by side."""
    (tmp_path / "quad.obj").write_text(QUAD + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (tmp_path / "bare.obj").write_text(QUAD + "f 1 2 3\nf 1 3 4\n")
    images = {
        "rough": ROUGH,
        "metal": METAL,
        "packed": [(7, rough, metal) for rough, metal in zip(ROUGH, METAL, strict=True)],
        "paint": [(255, 128, 64), (64, 255, 128)],
    }
    for name, texels in images.items():
        Image.fromarray(np.array([texels], np.uint8)).save(tmp_path / f"{name}.png")
    Image.fromarray(np.array([METAL], np.uint16)).save(tmp_path / "deep.png")
    return tmp_path


def load(folder: Path, material: str, *more: str, mesh: str = 'mesh = "quad.obj"') -> ptt.Scene:
    """A scene of one region, with keys of its material and of itself."""
    lines = ["[[region]]", 'name = "a"', mesh, *more, "[region.material]", material]
    (folder / "scene.toml").write_text("\n".join(lines))
    return ptt.load_scene(folder / "scene.toml")


def reflected(scene: ptt.Scene, wi: Tensor, wo: Tensor) -> Tensor:
    """The BRDF (2, n, 3) at the two places."""
    material = scene.materials["a"]
    triangle = torch.zeros(2, dtype=torch.int64)
    values = scene.map_values(material.maps, triangle, PLACES)
    colours = scene.albedo(triangle, PLACES)
    n = len(wi)
    return torch.stack(
        [material.evaluate(wi, wo, colours[k].expand(n, 3), values[:, k : k + 1].expand(-1, n)) for k in range(2)]
    )


def directions() -> Tensor:
    """Directions (2, 50, 3) above the horizon."""
    return normalize(torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0)) + 0.01, dim=2)


@pytest.mark.parametrize(
    "maps",
    ['metallic_roughness_map = "packed.png"', 'metallic_map = "metal.png"\nroughness_map = "rough.png"'],
    ids=["packed", "apart"],
)
def test_metallic_and_roughness_by_images(folder: Path, maps: str) -> None:
    """At each texel it is `metal_rough` of the factors times the images' linear values; base times the texture."""
    factors = 'model = "metal-rough"\nbase = [1, 0.5, 0.25]\nmetallic = 0.5\nroughness = 0.75\nreflectance = 0.05\n'
    scene = load(folder, factors + maps, 'texture = "paint.png"')
    wi, wo = directions()
    paint = from_srgb(torch.tensor([[255, 128, 64], [64, 255, 128]]) / 255) * torch.tensor([1, 0.5, 0.25])
    for k, found in enumerate(reflected(scene, wi, wo)):
        metallic, roughness = (factor * image[k] / 255 for factor, image in ((0.5, METAL), (0.75, ROUGH)))
        expected = ptt.metal_rough(paint[k], metallic, roughness, 0.05).evaluate(wi, wo)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_one_map_alone(folder: Path) -> None:
    """What is left out is 1: a metal that is as rough as its image, over white."""
    scene = load(folder, 'model = "metal-rough"\nroughness_map = "rough.png"')
    wi, wo = directions()
    for found, rough in zip(reflected(scene, wi, wo), (0.2, 0.8), strict=True):
        torch.testing.assert_close(found, ptt.metal_rough(1.0, 1.0, rough).evaluate(wi, wo), rtol=1e-4, atol=1e-6)


def test_without_maps_it_varies_with_a_base_colour_alone(folder: Path) -> None:
    """A white surface has a plain material, and so has a dielectric, whose matt part alone shows the base colour."""
    metal = 'model = "metal-rough"\nbase = [0.9, 0.5, 0.3]\nroughness = 0.4'
    assert same(load(folder, metal).materials["a"], ptt.metal_rough((0.9, 0.5, 0.3), 1.0, 0.4))
    painted = load(folder, metal, 'texture = "paint.png"')
    assert same(painted.materials["a"], ptt.MetalRough((0.9, 0.5, 0.3), 1.0, 0.4))
    plastic = load(folder, metal + "\nmetallic = 0", 'texture = "paint.png"')
    assert same(plastic.materials["a"], ptt.metal_rough((0.9, 0.5, 0.3), 0.0, 0.4))


def test_two_materials_by_a_mask(folder: Path) -> None:
    """At the texels of share 0.2 and 0.8 it is so much of the second."""
    scene = load(folder, f'model = "mixed"\nfirst = {GLOSS}\nsecond = {RED}\nshare = "rough.png"')
    wi, wo = directions()
    first = ptt.ggx(0.0, f0=(1.0, 0.7, 0.3), roughness=0.3).evaluate(wi, wo)
    second = ptt.lambert((0.5, 0.0, 0.0)).evaluate(wi, wo)
    for found, share in zip(reflected(scene, wi, wo), (0.2, 0.8), strict=True):
        torch.testing.assert_close(found, torch.lerp(first, second, share), rtol=1e-4, atol=1e-6)


PLANE = "plane = { size = 1 }"
BARE = 'mesh = "bare.obj"'
QUADS = 'mesh = "quad.obj"'


@pytest.mark.parametrize(
    ("mesh", "material", "message"),
    [
        (QUADS, 'roughness_map = "gone.png"', r"roughness_map: no file 'gone.png', beside the TOML file"),
        (QUADS, 'roughness_map = "quad.obj"', r"roughness_map: texture must be a readable 8-bit image: .*quad.obj"),
        (QUADS, 'roughness_map = "deep.png"', r"roughness_map: .*8-bit .*deep.png: .*got mode I;16"),
        (QUADS, "roughness_map = 0.5", r"roughness_map must name an image file, got 0.5"),
        (
            QUADS,
            'metallic_map = "packed.png"',
            r"metallic_map must be a grey image: the channels of packed.png differ \(glTF's go in metallic_",
        ),
        (
            QUADS,
            'metallic_roughness_map = "packed.png"\nroughness_map = "rough.png"',
            r"metallic_roughness_map stands for metallic_map and roughness_map: leave out roughness_map, or it",
        ),
        (
            QUADS,
            'gloss_map = "a.png"',
            r"material: unknown 'gloss_map'; valid are model, base, .*metallic_roughness_map",
        ),
        (QUADS, "roughness = 2", r"roughness must be finite and in \[0, 1\]"),
        (
            BARE,
            'roughness_map = "rough.png"',
            r"bare.obj has no texture coordinates for roughness_map: give a mesh that has uv",
        ),
        (
            PLANE,
            'metallic_roughness_map = "packed.png"',
            r"a plane has no texture coordinates for metallic_roughness_map",
        ),
    ],
)
def test_refusals(folder: Path, mesh: str, material: str, message: str) -> None:
    """A line that names the scene file, the region, what is wrong, and what would be right."""
    with pytest.raises(ValueError, match=rf"^scene.toml: region 'a': {message}") as refused:
        load(folder, 'model = "metal-rough"\n' + material, mesh=mesh)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (f'model = "mixed"\nfirst = {GLOSS}', r"must have first, second and share: there is no second, share"),
        (f'model = "mixed"\nfirst = {GLOSS}\nsecond = {RED}\nshare = 0.5', r"share must name an image file, got 0.5"),
        (f'model = "mixed"\nthird = {RED}', r"material: unknown 'third'; valid are model, first, second, share"),
        ('model = "metal"', r"one of lambert, blinn-phong, .*ggx, metal-rough, mixed, got 'metal'"),
        ("", r"got None"),
    ],
)
def test_refusals_of_other_models(folder: Path, material: str, message: str) -> None:
    with pytest.raises(ValueError, match=rf"^scene.toml: region 'a': .*{message}"):
        load(folder, material)


def test_a_texture_that_is_missing(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"^scene.toml: region 'a': no file 'gone.png', beside"):
        load(folder, 'model = "metal-rough"', 'texture = "gone.png"')


def test_a_material_is_a_table(folder: Path) -> None:
    (folder / "scene.toml").write_text('[[region]]\nname = "a"\nplane = { size = 1 }\nmaterial = "gold"')
    with pytest.raises(ValueError, match="material must be a table with a model, got 'gold'"):
        ptt.load_scene(folder / "scene.toml")
