"""The materials of a glTF file: metallic-roughness as GGX, with the base colour's texture.

    f = base (1 - metallic) (1 - 0.04) / pi + GGX, whose reflectance is f0 (1 - metallic) + base metallic

f0 is 0.04, or as KHR_materials_ior and KHR_materials_specular say. Base colours are linear, textures sRGB.

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
from ptt.materials.material import Material, ggx, metal_rough
from ptt.scene.textures import Texture, Wrap, from_image

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
    """A material, its base colour texture or None, and the coordinates of that: which set, and a matrix (2, 3)."""

    material: Material | None
    texture: Texture | None = None
    uv_set: int = 0
    uv_matrix: NDArray[np.float64] = np.eye(2, 3)


class Materials:
    """The materials of a file, each read once; losses: what is left out is counted there."""

    def __init__(self, file: gltf.File, losses: Counter[str]) -> None:
        self.file = file
        self.losses = losses
        self._looks: dict[int, Look] = {}
        self._pixels: dict[int, Tensor] = {}

    def of(self, index: int | None) -> Look:
        """The material of a primitive; glTF's default for None (3.7.2.1)."""
        if index is None:
            return Look(ggx(0.0, 1.0, 1.0, 1.0))
        if index not in self._looks:
            self._looks[index] = self._look(self.file.item("materials", index))
        return self._looks[index]

    def _look(self, material: dict[str, Any]) -> Look:
        pbr = material.get("pbrMetallicRoughness", {})
        base = torch.tensor(pbr.get("baseColorFactor", (1.0,) * 4)[:3]).clamp(0, 1)
        metallic = float(pbr.get("metallicFactor", 1.0))
        roughness = float(pbr.get("roughnessFactor", 1.0))
        self._count_losses(material)
        if "metallicRoughnessTexture" in pbr:
            mean = self._texture(pbr["metallicRoughnessTexture"], srgb=False).pixels.mean((0, 1))
            roughness *= float(mean[1])
            metallic *= float(mean[2])
            self.losses["a metallic-roughness texture, taken as its mean"] += 1
        reflectance = self._reflectance(material)
        metallic, roughness = (min(max(x, 0.0), 1.0) for x in (metallic, roughness))
        look = metal_rough(base, metallic, roughness, reflectance)
        if "baseColorTexture" not in pbr:
            return Look(look)
        info = pbr["baseColorTexture"]
        texture = self._texture(info, srgb=True)
        if metallic > 0:  # the texture multiplies diffuse parts alone: of a metal's highlight its mean does
            seen = metal_rough(base * texture.pixels.mean((0, 1)), metallic, roughness, reflectance)
            first, *more = seen.highlights
            look = Material(look.diffuse, first.colour, first.shape, *more)
            self.losses["a metal's texture, taken as its mean in highlights"] += 1
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        return Look(look, texture, transform.get("texCoord", info.get("texCoord", 0)), _uv_matrix(transform))

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
        if "normalTexture" in material:
            self.losses["a normal texture (give it to GBuffer.of as a BumpMap)"] += 1
        if "emissiveTexture" in material or any(x > 0 for x in material.get("emissiveFactor", ())):
            self.losses["emission"] += 1
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
        if source not in self._pixels:
            self._pixels[source] = from_image(gltf.image(self.file, source), srgb)
        sampler = self.file.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
        return Texture(self._pixels[source], wrap)


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
