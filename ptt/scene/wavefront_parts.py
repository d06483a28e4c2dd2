"""The parts of a Wavefront .obj file: each material is a region, where there are several.

MTL's Kd becomes the diffuse colour, Ks and Ns a Blinn-Phong highlight, Ns within 1..200; Pr and Pm, where a file has
them, make it metallic-roughness. Textures and colours of vertices are sRGB, and a texture stands in place of those.
"""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.io import wavefront
from ptt.io.colour import from_srgb
from ptt.materials.material import Material, blinn_phong, metal_rough
from ptt.materials.textures import Texture
from ptt.ops import mesh, polygons
from ptt.scene.parts import Part
from ptt.scene.textures import read_texture

EXPONENTS = (1.0, 200.0)  # the range of `BRDFSpace.blinn_phong`, in which exponents from files are kept
OPTIONS = {"-blendu": 1, "-blendv": 1, "-bm": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2,
           "-texres": 1, "-type": 1}  # fmt: skip
"""Options of a texture, with the number of their values; -o, -s and -t have one to three."""
LEFT_OUT = {
    "ke": "emission",
    "map_ke": "an emissive texture",
    "map_ks": "a texture of highlights",
    "map_ns": "a texture of exponents",
    "map_d": "a texture of transparency",
    "map_pr": "a roughness texture",
    "map_pm": "a metallic texture",
    "bump": "a bump map",
    "map_bump": "a bump map",
    "norm": "a normal map",
    "disp": "a displacement",
}


class Look(NamedTuple):
    """A material, its texture or None, and what texture coordinates are multiplied by and moved by."""

    material: Material | None
    texture: Texture | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def read_parts(path: Path) -> list[Part]:
    """The parts of an .obj file. One without normals gets smooth ones across the seams of its texture coordinates.

    Raises:
        ValueError: the file is damaged, or has no faces.
    """
    geometry = wavefront.read_obj(path)
    losses = Counter({f"{keyword} (not supported)": count for keyword, count in geometry.ignored.items()})
    losses += Counter({"a face of fewer than three corners": sum(int((f.counts < 3).sum()) for f in geometry.faces)})
    looks = _looks(path, geometry.libraries, losses)
    parts = [_part(path, geometry, faces, looks, losses) for faces in geometry.faces]
    parts = [part for part in parts if len(part.faces)]
    if losses:
        lost = ", ".join(what if count == 1 else f"{count} x {what}" for what, count in sorted(losses.items()))
        warnings.warn(f"{path.name} was read without {lost}", UserWarning, stacklevel=4)
    if not parts:
        raise ValueError(f"path must hold triangles: {path} has no faces")
    return parts


def _part(
    path: Path,
    geometry: wavefront.Geometry,
    faces: wavefront.Faces,
    looks: dict[str, Look],
    losses: Counter[str],
) -> Part:
    cut, _ = polygons.triangulate(geometry.positions[faces.corners[:, 0]], faces.counts)
    corners = faces.corners[cut.reshape(-1)]
    if faces.material and faces.material not in looks:
        losses[f"the material {faces.material}"] += 1
    look = looks.get(faces.material, Look(None))
    uv = _all_or_none(geometry.uv, corners[:, 1])
    normals = _all_or_none(geometry.normals, corners[:, 2])
    rows, index = _joined(corners, uv is not None, normals is not None)
    positions = torch.from_numpy(geometry.positions[rows[:, 0]])
    triangles = torch.from_numpy(index.reshape(-1, 3))
    if normals is None:
        places, welded, place = mesh.weld(positions, triangles)
        smooth = mesh.vertex_normals(places, welded)[place]
    textured = look.texture is not None and uv is not None
    colours = None
    if geometry.colours is not None and not textured:
        colours = from_srgb(torch.from_numpy(geometry.colours[rows[:, 0]])).float()
    coordinates = None
    if uv is not None:
        coordinates = torch.from_numpy(uv[rows[:, 1]] * look.scale + look.offset)
    return Part(
        faces.material or path.stem,
        positions,
        triangles,
        normals=smooth if normals is None else torch.from_numpy(normals[rows[:, 2]]),
        uv=coordinates,
        colours=colours,
        texture=look.texture if textured else None,
        material=look.material,
    )


def _all_or_none(values: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """The values, None where a corner has none."""
    return values if len(values) and rows.size and int(rows.min()) >= 0 else None


def _joined(corners: NDArray[np.int64], uv: bool, normals: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The distinct corners (v, 3), in the order of their positions, and which of them (c,) each corner is."""
    sizes = corners.max(0, initial=0) + 2
    key = corners[:, 0]
    for axis, used in ((1, uv), (2, normals)):
        key = key * sizes[axis] + (corners[:, axis] if used else 0)
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return corners[first], index


def _looks(path: Path, libraries: list[str], losses: Counter[str]) -> dict[str, Look]:
    """The materials of an .obj file's libraries, by name."""
    looks: dict[str, Look] = {}
    for library in libraries:
        file = _beside(path, library)
        if file is None:
            losses[library] += 1
            continue
        for name, keywords in wavefront.read_mtl(file).items():
            looks[name] = _look(file, name, keywords, losses)
    return looks


def _look(file: Path, name: str, keywords: dict[str, str], losses: Counter[str]) -> Look:
    def colour(keyword: str, default: float) -> Tensor:
        return _colour(file, name, keyword, keywords.get(keyword, str(default)))

    def number(keyword: str, default: float) -> float:
        return float(colour(keyword, default)[0])

    for keyword, what in LEFT_OUT.items():
        if keyword in keywords and (
            keyword.startswith(("map_", "bump", "norm", "disp")) or bool(colour(keyword, 0).any())
        ):
            losses[f"{what} ({name})"] += 1
    if number("d", 1) < 1 or number("tr", 0) > 0:
        losses[f"transparency ({name})"] += 1
    diffuse = colour("kd", 1.0).clamp(0, 1)
    if "pr" in keywords or "pm" in keywords:
        metallic, roughness = (
            min(max(number(keyword, default), 0.0), 1.0) for keyword, default in (("pm", 0), ("pr", 1))
        )
        material = metal_rough(diffuse, metallic, roughness)
    else:
        exponent = min(max(number("ns", 20.0), EXPONENTS[0]), EXPONENTS[1])
        material = blinn_phong(diffuse, colour("ks", 0.0).clamp(min=0), exponent)
    return _with_texture(file, Look(material), keywords.get("map_kd", ""), losses)


def _colour(file: Path, name: str, keyword: str, text: str) -> Tensor:
    """The numbers after a keyword as a colour (3,); one number is grey."""
    words = text.split()
    if words and words[0].lower() in ("spectral", "xyz"):
        raise ValueError(f"{file.name}: {keyword} of {name} must be RGB, got {words[0]}: give it three numbers")
    try:
        values = torch.tensor([float(word) for word in words], dtype=torch.float64)
    except ValueError as error:
        raise ValueError(f"{file.name}: {keyword} of {name} must be numbers, got {text!r}") from error
    if len(values) < 3:
        values = values[:1].expand(3) if len(values) else torch.zeros(3).double()
    return values[:3]


def _with_texture(file: Path, look: Look, text: str, losses: Counter[str]) -> Look:
    """A look with the texture that map_Kd names, after its options."""
    words = text.split()
    scale, offset, clamp = [1.0, 1.0], [0.0, 0.0], False
    while words and words[0].startswith("-"):
        option = words.pop(0).lower()
        values: list[str] = []
        most = OPTIONS.get(option, 3)
        while words and len(values) < most and (option in OPTIONS or _is_number(words[0])):
            values.append(words.pop(0))
        if option in ("-s", "-o"):
            target = scale if option == "-s" else offset
            target[: len(values[:2])] = [float(value) for value in values[:2]]
        clamp = clamp or (option == "-clamp" and values == ["on"])
    if not words:
        return look
    name = " ".join(words)
    image = _beside(file, name)
    if image is None:
        losses[name] += 1
        return look
    texture = read_texture(image)
    texture = Texture(texture.pixels, ("clamp", "clamp")) if clamp else texture
    return Look(look.material, texture, (scale[0], scale[1]), (offset[0], offset[1]))


def _beside(file: Path, name: str) -> Path | None:
    """The file of a name that another one says, also where it stood in a folder of someone else's machine."""
    relative = Path(name.replace("\\", "/"))
    return next((found for found in (file.parent / relative, file.parent / relative.name) if found.is_file()), None)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
