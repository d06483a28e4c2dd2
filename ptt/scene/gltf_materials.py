"""The materials of a glTF file: metallic-roughness as GGX, with textures, normals and emission.

    f = base (1 - metallic) (1 - 0.04) / pi + GGX, whose reflectance is f0 (1 - metallic) + base metallic

f0 is 0.04, or as KHR_materials_ior and KHR_materials_specular say. Factors are linear; of textures base colour and
emission are sRGB, the others linear.

Khronos, glTF 2.0 specification; numbers of sections are its own.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.io import gltf
from ptt.materials.material import ggx
from ptt.materials.textures import Texture, Wrap
from ptt.materials.varying import MetalRough, SurfaceMaterial, simplified
from ptt.scene.bumps import BumpMap
from ptt.scene.textures import from_image

IOR = 1.5
WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
LOST = {
    "KHR_materials_anisotropy": "anisotropy",
    "KHR_materials_clearcoat": "a clear coat",
    "KHR_materials_diffuse_transmission": "light through a surface",
    "KHR_materials_dispersion": "dispersion",
    "KHR_materials_iridescence": "iridescence",
    "KHR_materials_pbrSpecularGlossiness": "specular-glossiness",
    "KHR_materials_sheen": "sheen",
    "KHR_materials_transmission": "transmission",
    "KHR_materials_unlit": "unlit",
    "KHR_materials_volume": "a volume",
}


class Look(NamedTuple):
    """How a primitive looks: its material, what else it has over texture coordinates, whether it needs any, and which
    these are: the number of their set, and a matrix (2, 3)."""

    material: SurfaceMaterial
    texture: Texture | None = None
    bumps: BumpMap | None = None
    glow: Texture | None = None
    textured: bool = False
    uv_set: int = 0
    uv_matrix: NDArray[np.float64] = np.eye(2, 3)


class Materials:
    """The materials of a file, each read once; losses: what is left out is counted there."""

    def __init__(self, file: gltf.File, losses: Counter[str]) -> None:
        self.file = file
        self.losses = losses
        self._looks: dict[tuple[int, bool], Look] = {}
        self._pixels: dict[tuple[int, bool], Tensor] = {}

    def of(self, index: int | None, coloured: bool) -> Look:
        """The material of a primitive; glTF's default for None (3.7.2.1); coloured: says whether its vertices are."""
        if index is None:
            return Look(MetalRough() if coloured else ggx(0.0, 1.0, 1.0, 1.0))
        if (index, coloured) not in self._looks:
            self._looks[index, coloured] = self._look(self.file.item("materials", index), coloured)
        return self._looks[index, coloured]

    def _look(self, material: dict[str, Any], coloured: bool) -> Look:
        self._count_losses(material)
        pbr = material.get("pbrMetallicRoughness", {})
        found = {
            "base colour": pbr.get("baseColorTexture"),
            "metallic-roughness": pbr.get("metallicRoughnessTexture"),
            "normal": material.get("normalTexture"),
            "emissive": material.get("emissiveTexture"),
        }
        given = {name: info for name, info in found.items() if info is not None}
        uv_set, matrix = _coordinates(next(iter(given.values()), {}))
        for name, info in list(given.items()):
            other, turned = _coordinates(info)
            if other != uv_set or not np.allclose(turned, matrix):
                self.losses[
                    f"the {name} texture, whose coordinates are not those of the {next(iter(given))} texture"
                ] += 1
                del given[name]
        texture = self._texture(given["base colour"], srgb=True) if "base colour" in given else None
        values = self._metal_rough(pbr, given.get("metallic-roughness"))
        values["reflectance"] = self._reflectance(material)
        own = simplified(MetalRough(**values), coloured or texture is not None)
        bumps = self._bumps(given["normal"]) if "normal" in given else None
        return Look(own, texture, bumps, self._glow(material, given.get("emissive")), bool(given), uv_set, matrix)

    def _metal_rough(self, pbr: dict[str, Any], info: dict[str, Any] | None) -> dict[str, Any]:
        """The arguments of a metallic-roughness material (3.9.2): roughness is green, metallic blue."""
        values: dict[str, Any] = {
            "base": torch.tensor(pbr.get("baseColorFactor", (1.0,) * 4)[:3]).clamp(0, 1),
            "metallic": min(max(float(pbr.get("metallicFactor", 1.0)), 0.0), 1.0),
            "roughness": min(max(float(pbr.get("roughnessFactor", 1.0)), 0.0), 1.0),
        }
        if info is not None:
            texture = self._texture(info, srgb=False)
            for name, channel in (("roughness_map", 1), ("metallic_map", 2)):
                values[name] = texture.channel(channel)
        return values

    def _bumps(self, info: dict[str, Any]) -> BumpMap:
        """The normals of a normalTextureInfo (3.9.3)."""
        texture = self._texture(info, srgb=False)
        scale = float(info.get("scale", 1.0))
        normals = 2 * texture.pixels - 1
        return BumpMap(normals * normals.new_tensor((scale, scale, 1.0)), texture.wrap)

    def _glow(self, material: dict[str, Any], info: dict[str, Any] | None) -> Texture | None:
        """What is emitted, by its texture or alike everywhere; None for nothing (3.9.4)."""
        factor = torch.tensor(material.get("emissiveFactor", (0.0, 0.0, 0.0)), dtype=torch.float32)
        strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        factor = factor * float(strength.get("emissiveStrength", 1.0))
        if not bool((factor > 0).any()):
            return None
        self.losses["the light that glowing surfaces cast on others (they do glow)"] += 1
        if info is None:
            return Texture(factor.expand(1, 1, 3))
        texture = self._texture(info, srgb=True)
        return Texture(texture.pixels * factor, texture.wrap)

    def _reflectance(self, material: dict[str, Any]) -> Tensor:
        """What a dielectric reflects straight on (3,), by its index of refraction and specular colour."""
        extensions = material.get("extensions", {})
        ior = float(extensions.get("KHR_materials_ior", {}).get("ior", IOR))
        specular = extensions.get("KHR_materials_specular", {})
        if "specularTexture" in specular or "specularColorTexture" in specular:
            self.losses["a texture of KHR_materials_specular"] += 1
        f0 = ((ior - 1) / (ior + 1)) ** 2 if ior else 1.0
        colour = torch.tensor(specular.get("specularColorFactor", (1.0, 1.0, 1.0)))
        return (f0 * colour).clamp(max=1) * float(specular.get("specularFactor", 1.0))

    def _count_losses(self, material: dict[str, Any]) -> None:
        extensions = material.get("extensions", {})
        for name in extensions:
            if name in LOST:
                self.losses[f"{LOST[name]} ({name})"] += 1
            elif name not in gltf.SUPPORTED:
                self.losses[name] += 1
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            self.losses[f"transparency ({material['alphaMode']})"] += 1
        if material.get("doubleSided", False):
            self.losses["a back that is seen (doubleSided)"] += 1

    def _texture(self, info: dict[str, Any], srgb: bool) -> Texture:
        """The texture of a textureInfo (3.8)."""
        texture = self.file.item("textures", info["index"])
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.get("source"))
        if source is None:
            raise ValueError(f"{self.file.path}: textures[{info['index']}] has no image that is supported")
        if (source, srgb) not in self._pixels:
            self._pixels[source, srgb] = from_image(gltf.image(self.file, source), srgb)
        sampler = self.file.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
        return Texture(self._pixels[source, srgb], wrap)


def _coordinates(info: dict[str, Any]) -> tuple[int, NDArray[np.float64]]:
    """The set of texture coordinates of a textureInfo, and the matrix (2, 3) that they are taken through."""
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    return transform.get("texCoord", info.get("texCoord", 0)), _uv_matrix(transform)


def _uv_matrix(transform: dict[str, Any]) -> NDArray[np.float64]:
    """The matrix (2, 3) of KHR_texture_transform, translation x rotation x scale, in v down.

    Its rotation is counter-clockwise as seen with v down, which the extension's own example and the viewers agree on.
    """
    angle = float(transform.get("rotation", 0.0))
    c = math.cos(angle)
    s = math.sin(angle)
    turn = np.array(((c, s), (-s, c))) * np.array(transform.get("scale", (1.0, 1.0)), dtype=np.float64)
    offset = np.array(transform.get("offset", (0.0, 0.0)), dtype=np.float64)
    return np.concatenate((turn, offset[:, None]), 1)
