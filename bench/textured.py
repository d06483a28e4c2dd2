"""Textured glTF assets beside Mitsuba 3 by direct light, along the same rays; rows of bench/results/textured.csv.

    PTT_DATA=... python -m bench.textured [--quick] [FOLDER ...]

Of the assets in the folders, default: gltf in PTT_DATA; the rows of others stay.

Mitsuba has glTF's metallic-roughness as a BSDF of its own here, written from the specification (appendix B) in Python
alone, with the textures as its bitmaps and its own `normalmap`; its `principled` has another matt part and other
masking. No asset is shipped.
"""

from __future__ import annotations

import argparse
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

import ptt
from bench.metals_seen import excess
from bench.mitsuba_check import mitsuba_light, mitsuba_radiance, scores
from bench.table import ROOT, Table, setting
from ptt import reference
from ptt.materials.material import SMOOTHEST

IMAGES = ROOT / "runs" / "textured"  # not for the docs: assets have terms of their own
WIDTH, HEIGHT = 320, 240
RAYS, SAMPLES = 400, 128


def main() -> None:
    parser = argparse.ArgumentParser(description="Textured glTF assets beside Mitsuba 3.")
    parser.add_argument("folders", nargs="*", type=Path, help="of .glb and .gltf files; default: gltf in PTT_DATA")
    parser.add_argument("--quick", action="store_true", help="the first asset, few samples, nothing written")
    options = parser.parse_args()
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with hdri/uffizi.hdr")
    data = Path(os.environ["PTT_DATA"])
    light = ptt.Environment.load(data / "hdri" / "uffizi.hdr")
    mi.set_variant("scalar_rgb")
    mi.register_bsdf("gltf", _bsdf_class())
    found = [path for folder in options.folders or [data / "gltf"] for path in sorted(folder.glob("*.gl[bt]*"))]
    for path in found[: 1 if options.quick else None]:
        table = Table("textured")
        _rows(table, path.stem, ptt.load_scene(path), light, *((60, 16) if options.quick else (RAYS, SAMPLES)))
        if not options.quick:
            table.replace(f"asset {path.stem}")


def _rows(table: Table, name: str, scene: ptt.Scene, light: ptt.Environment, rays: int, samples: int) -> None:
    """An asset without what glows, seen along rays through the centres of pixels."""
    scene = replace(scene, regions=tuple(replace(region, glow=None) for region in scene.regions))
    pixels = ptt.GBuffer.of(scene, replace(scene.camera, width=WIDTH, height=HEIGHT))
    some = torch.randperm(len(pixels.pixel), generator=torch.Generator().manual_seed(0))[:rays]
    eye, directions = pixels.camera.rays()
    rows = directions.reshape(-1, 3)[pixels.pixel[some]]
    origins = eye.expand_as(rows)
    target = mitsuba_of(scene, light)
    theirs = mitsuba_radiance(target, origins, rows, bounces=0, samples=4 * samples)
    ours = reference.along_rays(scene, light, scene.materials, origins, rows, samples=256 * samples)
    found = scores(ours, theirs)
    aside = f"noise of Mitsuba {theirs.noise:.3f}, of the reference {ours.noise:.3f}"
    how = f"{rays} pixels, {4 * samples} samples of Mitsuba; {aside}; {setting()}"
    what = f"asset {name}, reference against Mitsuba"
    table.row(f"{what}: mean difference over its standard error", found["bias_z"], "", how, "<= 3")
    table.row(f"{what}: relative difference of the means", found["bias"], "", how)
    table.row(f"{what}: share within three standard errors", found["within_3"], "", how)
    relighter = ptt.TripleProductRelighter(scene, 2, atlas=ptt.Atlas.of(scene, 1024))
    whole = relighter(light, {}, pixels)
    relit = whole[some].double()
    aside = f"320 triangles, visibility in 1024 x 1024 texels; {how}"
    table.row(f"asset {name}, triple products", ptt.relative_rmse(relit, ours.mean), "relative RMSE", aside, "<= 0.05")
    to_mitsuba = excess(relit, theirs)
    about = f"noise of Mitsuba taken out; {aside}"
    table.row(f"asset {name}, triple products against Mitsuba", to_mitsuba, "relative RMSE", about, "<= 0.05")
    median = float(((relit - ours.mean).abs().sum(1) / ours.mean.sum(1)).median())
    table.row(f"asset {name}, triple products, median of the errors", median, "", aside)
    if rays == RAYS:
        directions = directions.reshape(-1, 3)[pixels.pixel]
        seen = mitsuba_radiance(target, eye.expand_as(directions), directions, bounces=0, samples=SAMPLES // 4)
        path = IMAGES / f"textured_{name}.png"
        _picture(path, scene, pixels, light, seen.mean.float(), whole)


def _picture(
    path: Path, scene: ptt.Scene, pixels: ptt.GBuffer, light: ptt.Environment, mitsuba: Tensor, relit: Tensor
) -> None:
    """Mitsuba, the reference, triple products, and the difference of the last two times two."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ours = reference.image(scene, light, scene.materials, pixels.camera, samples=256).mean.float()
    theirs, shown = (pixels.image(radiance, light).pixels for radiance in (mitsuba, relit))
    white = float(ours.flatten().quantile(0.98))
    difference = (0.5 + (shown - ours) / white).clamp(0, 1) ** 2.2
    columns = [(picture / white).clamp(0, 1) for picture in (theirs, ours, shown)]
    ptt.Image(torch.cat([*columns, difference], 1)).save(path)


def mitsuba_of(scene: ptt.Scene, light: ptt.Environment) -> Any:
    """The scene as Mitsuba's, a mesh for each region."""
    meshes = {f"region{number}": _mesh(scene, number) for number in range(len(scene.regions))}
    return mi.load_dict({"type": "scene", "light": mitsuba_light(light), **meshes})


def _mesh(scene: ptt.Scene, number: int) -> Any:
    region = scene.regions[number]
    rows = scene.vertex_region == number
    faces = scene.faces[scene.face_region == number] - int(rows.nonzero()[0])
    count = int(rows.sum())
    uv = torch.zeros(count, 2) if scene.uv is None else torch.stack((scene.uv[rows, 0], 1 - scene.uv[rows, 1]), 1)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(scene.materials[region.name], region))
    mesh = mi.Mesh(region.name, count, len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.vertices[rows].reshape(-1).numpy()
    parameters["vertex_normals"] = scene.normals[rows].reshape(-1).numpy()
    parameters["vertex_texcoords"] = uv.reshape(-1).numpy()
    parameters["faces"] = faces.reshape(-1).numpy().astype(np.uint32)
    parameters.update()
    return mesh


def _bsdf(material: Any, region: ptt.Region) -> dict[str, Any]:
    """Metallic-roughness with the region's textures."""
    if not isinstance(material, ptt.MetalRough):
        material = _metal_rough(material)
    white = ptt.Texture(torch.ones(1, 1, 3))
    one = ptt.Texture(torch.ones(1, 1, 1))
    bsdf = {
        "type": "gltf",
        "base": _bitmap(region.texture or white, material.base),
        "metallic": _bitmap(material.metallic_map or one, torch.tensor(material.metallic)),
        "roughness": _bitmap(material.roughness_map or one, torch.tensor(material.roughness)),
    }
    if region.bumps is None:
        return bsdf
    normals = _bitmap(ptt.Texture((region.bumps.normals + 1) / 2, region.bumps.wrap), torch.ones(()))
    off = {"use_shadowing_function": False, "flip_invalid_normals": False}
    return {"type": "normalmap", "normalmap": normals, "bsdf": bsdf, **off}


def _metal_rough(material: ptt.Material) -> ptt.MetalRough:
    """The metal, or the dielectric that reflects 0.04 straight on, that a material of GGX is."""
    highlight = material.highlights[0]
    assert isinstance(highlight.shape, ptt.GGX)
    roughness = float(highlight.shape.roughness)
    if bool((material.diffuse > 0).any()):
        return ptt.MetalRough((material.diffuse / 0.96).clamp(0, 1), 0.0, roughness)
    return ptt.MetalRough(highlight.colour.clamp(0, 1), 1.0, roughness)


def _bitmap(texture: Any, factor: Tensor) -> dict[str, Any]:
    pixels = (texture.pixels * factor).clamp(0, 1).numpy().astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": texture.wrap[0]}


def _facet(wi: Any, wo: Any, a2: float) -> tuple[float, float, float]:
    """The half vector's height and its cosine to wi, and D of GGX there, of slope squared a2."""
    h = [wi[k] + wo[k] for k in range(3)]
    length = math.sqrt(sum(x * x for x in h))
    height = h[2] / length
    return height, sum(wi[k] * h[k] for k in range(3)) / length, a2 / (math.pi * (height**2 * (a2 - 1) + 1) ** 2)


def _bsdf_class() -> Any:
    """glTF's metallic-roughness for Mitsuba: a class, which can be made once a variant is set."""
    m: Any = mi

    class MetallicRoughness(m.BSDF):  # type: ignore[misc]
        """Directions are drawn by the cosine, or by GGX, half each."""

        def __init__(self, properties: Any) -> None:
            m.BSDF.__init__(self, properties)
            self.base, self.metallic, self.roughness = (properties[x] for x in ("base", "metallic", "roughness"))
            self.m_components = [m.BSDFFlags.GlossyReflection | m.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def slope2(self, si: Any) -> float:
            return float(max(self.roughness.eval_1(si), SMOOTHEST) ** 4)

        def sample(self, context: Any, si: Any, one: float, two: Any, active: bool = True) -> Any:
            sample = m.BSDFSample3f()
            sample.wo = m.warp.square_to_cosine_hemisphere(two)
            if one < 0.5:
                cos = math.sqrt((1 - two.x) / (1 + (self.slope2(si) - 1) * two.x))
                sin = math.sqrt(max(0.0, 1 - cos * cos))
                h = m.Vector3f(sin * math.cos(2 * math.pi * two.y), sin * math.sin(2 * math.pi * two.y), cos)
                sample.wo = 2 * sum(h[k] * si.wi[k] for k in range(3)) * h - si.wi
            sample.pdf = self.pdf(context, si, sample.wo)
            sample.eta = 1.0
            sample.sampled_type = +m.BSDFFlags.GlossyReflection
            value = self.eval(context, si, sample.wo)
            return sample, value / sample.pdf if sample.pdf > 0 else value

        def eval(self, context: Any, si: Any, wo: Any, active: bool = True) -> Any:
            nv, nl = si.wi.z, wo.z
            if nv <= 0 or nl <= 0:
                return m.Color3f(0.0)
            a2 = self.slope2(si)
            _, vh, d = _facet(si.wi, wo, a2)
            v = 0.5 / (nl * math.sqrt(a2 + (1 - a2) * nv * nv) + nv * math.sqrt(a2 + (1 - a2) * nl * nl))
            base, metallic = self.base.eval(si), self.metallic.eval_1(si)
            values = []
            for colour in (base.x, base.y, base.z):
                f0 = 0.04 * (1 - metallic) + colour * metallic
                matt = colour * (1 - metallic) * 0.96 / math.pi
                values.append(nl * (matt + d * v * (f0 + (1 - f0) * (1 - vh) ** 5)))
            return m.Color3f(values)

        def pdf(self, context: Any, si: Any, wo: Any, active: bool = True) -> float:
            if si.wi.z <= 0 or wo.z <= 0:
                return 0.0
            height, vh, d = _facet(si.wi, wo, self.slope2(si))
            return float(0.5 * wo.z / math.pi + 0.5 * d * height / (4 * vh))

        def eval_pdf(self, context: Any, si: Any, wo: Any, active: bool = True) -> Any:
            return self.eval(context, si, wo), self.pdf(context, si, wo)

    return MetallicRoughness


if __name__ == "__main__":
    main()
