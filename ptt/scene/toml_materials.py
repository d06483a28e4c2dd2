"""The materials of scene files: one that is the same everywhere, or one that image files vary over a mesh's uv.

    material = { model = "ggx", diffuse = [0.5, 0.4, 0.3], roughness = 0.3 }     # or lambert, blinn-phong, ...

    [region.material]                                 # metallic-roughness (`MetalRough`) over the region's base colour
    model = "metal-rough"
    base = [1.0, 0.9, 0.8]                            # multiplies the base colour, which `texture` of the region gives
    metallic = 1.0                                    # these multiply their maps
    roughness = 0.8
    reflectance = 0.04
    metallic_map = "metal.png"                        # grey images, whose 0..255 is 0..1
    roughness_map = "rough.png"
    metallic_roughness_map = "packed.png"             # in place of both, as in glTF: green is roughness, blue metallic

    [region.material]                                 # two materials by a mask (`Mixed`): white is the second
    model = "mixed"
    first = { model = "ggx", diffuse = 0.0, f0 = [1.0, 0.7, 0.3], roughness = 0.3 }
    second = { model = "lambert", diffuse = [0.3, 0.1, 0.05] }
    share = "rust.png"

Images have 8 bits and repeat beyond their edges; all but `texture` are linear. Factors that are left out are 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ptt.materials import material as materials
from ptt.materials.textures import Texture
from ptt.materials.varying import METAL_ROUGH, MIXED, MetalRough, Mixed, SurfaceMaterial, simplified
from ptt.scene.textures import read_texture
from ptt.scene.toml_tables import check_keys, find

MAPS = ("metallic_map", "roughness_map")
PACKED = "metallic_roughness_map"
SHARE = "share"
IMAGES = (*MAPS, PACKED, SHARE)  # keys that name image files
NUMBERS = ("base", "metallic", "roughness", "reflectance")


def read_material(table: Any, folder: Path, coloured: bool) -> SurfaceMaterial:
    """The material of a table; coloured: says whether the region has a base colour of its own.

    Raises:
        ValueError: an unknown model or key, a value out of its range, or an image that is missing or not as it
            should be.
    """
    if not isinstance(table, dict):
        raise ValueError(f"material must be a table with a model, got {table!r}")
    model = table.get("model")
    if model == METAL_ROUGH:
        return simplified(_metal_rough(table, folder), coloured)
    if model == MIXED:
        return _mixed(table, folder)
    if model not in materials.NAMES:
        valid = (*materials.MODELS, METAL_ROUGH, MIXED)
        raise ValueError(f"material.model must be one of {', '.join(valid)}, got {model!r}")
    return materials.from_config(table)


def _metal_rough(table: Mapping[str, Any], folder: Path) -> MetalRough:
    check_keys("material", table, ("model", *NUMBERS, *MAPS, PACKED))
    maps: dict[str, Any] = {key: _grey(table, key, folder) for key in MAPS if key in table}
    if PACKED in table:
        if maps:
            raise ValueError(f"{PACKED} stands for {' and '.join(MAPS)}: leave out {' and '.join(maps)}, or it")
        packed = _image(table, PACKED, folder)
        maps = {"metallic_map": packed.channel(2), "roughness_map": packed.channel(1)}
    return MetalRough(**{key: table[key] for key in NUMBERS if key in table}, **maps)


def _mixed(table: Mapping[str, Any], folder: Path) -> Mixed:
    check_keys("material", table, ("model", "first", "second", SHARE))
    if missing := [key for key in ("first", "second", SHARE) if key not in table]:
        raise ValueError(f"a mixed material must have first, second and {SHARE}: there is no {', '.join(missing)}")
    first, second = (materials.from_config(table[key]) for key in ("first", "second"))
    return Mixed(first, second, _grey(table, SHARE, folder))


def _grey(table: Mapping[str, Any], key: str, folder: Path) -> Texture:
    """The one channel of the grey image that a key names."""
    image = _image(table, key, folder)
    if not bool((image.pixels == image.pixels[..., :1]).all()):
        raise ValueError(f"{key} must be a grey image: the channels of {table[key]} differ (glTF's go in {PACKED})")
    return image.channel(0)


def _image(table: Mapping[str, Any], key: str, folder: Path) -> Texture:
    """The linear image that a key names."""
    if not isinstance(table[key], str):
        raise ValueError(f"{key} must name an image file, got {table[key]!r}")
    try:
        return read_texture(find(table[key], folder), srgb=False)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from error
