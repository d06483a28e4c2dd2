"""Geometry before it is a scene: parts, each of which becomes a region, are checked, repaired, placed and joined."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ptt.materials.material import blinn_phong
from ptt.materials.textures import Texture
from ptt.materials.varying import SurfaceMaterial, same, same_map
from ptt.ops import mesh
from ptt.scene.bumps import BumpMap

FAR = 1000.0  # sizes from the origin, where float32 rounds positions to 6e-5 of the size


@dataclass(frozen=True, eq=False)
class Part:
    """One region as a file or a user gives it; `Scene.from_mesh` explains the fields, `Region` the last three."""

    name: str
    vertices: Tensor
    faces: Tensor
    normals: Tensor | None = None
    uv: Tensor | None = None
    colours: Tensor | None = None
    texture: Texture | Tensor | None = None
    material: SurfaceMaterial | None = None
    editable: bool = True
    bumps: BumpMap | None = None
    glow: Texture | None = None


@dataclass(frozen=True, eq=False)
class PreparedPart:
    """A part that is sound: float32 and int64, unit normals and tangents, no triangle without area.

    colours: the base colour, that of the texture included; tints: what multiplies the texture, None for white
    dropped: triangles without area that it lost; renewed: vertices whose normal was repaired
    inward: says whether it is closed and looks inwards
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    tangents: Tensor
    colours: Tensor
    tints: Tensor | None
    uv: Tensor | None
    texture: Texture | None
    material: SurfaceMaterial
    dropped: int
    renewed: int
    inward: bool


def default_material(coloured: bool = False) -> SurfaceMaterial:
    """The material of a region that has none: a little gloss over grey, or over its own base colour."""
    return blinn_phong(0.96 if coloured else 0.6, 0.04, 20.0)


def near_origin(parts: Sequence[Part]) -> tuple[Sequence[Part], Tensor]:
    """Parts, moved to the origin where they lie further away than FAR times their size; and their old centre (3,)."""
    nowhere = torch.zeros(3, dtype=torch.float64)
    points = [torch.as_tensor(part.vertices).double() for part in parts]
    if not all(p.ndim == 2 and p.shape[1:] == (3,) and len(p) and bool(p.isfinite().all()) for p in points):
        return parts, nowhere  # which is refused where each is prepared
    low = torch.stack([p.amin(0) for p in points]).amin(0)
    high = torch.stack([p.amax(0) for p in points]).amax(0)
    centre = (low + high) / 2
    if float(centre.abs().max()) <= FAR * float((high - low).max()):
        return parts, nowhere
    message = (
        f"positions were moved by {(-centre).tolist()}, to the origin: float32 has too little precision for their own"
    )
    warnings.warn(message, UserWarning, stacklevel=4)
    return [replace(part, vertices=p - centre) for part, p in zip(parts, points, strict=True)], centre


def prepare(parts: Sequence[Part]) -> list[PreparedPart]:
    """Check and repair parts as `Scene.from_parts` says, with one warning that counts the repairs."""
    prepared = []
    for part in parts:
        try:
            prepared.append(_prepare(part))
        except ValueError as error:
            raise ValueError(f"region {part.name!r}: {error}") from None
    dropped = sum(p.dropped for p in prepared)
    renewed = sum(p.renewed for p in prepared)
    if dropped or renewed:
        counts = f"{dropped} triangles without area dropped, {renewed} vertices without a normal given one"
        warnings.warn(f"mesh repaired: {counts}", UserWarning, stacklevel=4)
    if inward := [part.name for part, ready in zip(parts, prepared, strict=True) if ready.inward]:
        names = ", ".join(inward)
        warnings.warn(
            f"closed, and wound inside out: {names}: from outside they are black; flip their faces", stacklevel=4
        )
    return prepared


def _prepare(part: Part) -> PreparedPart:
    vertices = torch.as_tensor(part.vertices)
    faces = torch.as_tensor(part.faces)
    vertices = vertices.float() if vertices.is_floating_point() else vertices
    mesh.check_mesh(vertices, faces)
    sound = mesh.sound_faces(vertices, faces)
    faces = faces.long()[sound]
    dropped = int((~sound).sum())
    if not len(faces):
        raise ValueError(f"faces (f, 3) must hold a triangle with an area: all {dropped} have none")
    count = len(vertices)
    uv = None if part.uv is None else _rows("uv", part.uv, (count, 2))
    texture = None if part.texture is None else _checked_texture(part.texture, uv)
    tints = None if part.colours is None else _rows("colours", part.colours, (count, 3))
    given = None if part.normals is None else _rows("normals", part.normals, (count, 3), finite=False).double()
    faces, rows = mesh.apart(faces, count)
    vertices = vertices[rows]
    uv, tints, given = (None if x is None else x[rows] for x in (uv, tints, given))
    if given is not None:
        given[count:] = 0  # of backs, whose normals are none of the file's
    normals, renewed = _normals(given, vertices, faces)
    colours = torch.ones(len(vertices), 3, dtype=torch.float32) if tints is None else tints
    if texture is not None and uv is not None:
        colours = colours * texture.at(uv)
    return PreparedPart(
        vertices=vertices,
        faces=faces,
        normals=normals.float(),
        tangents=mesh.tangents(vertices, faces, normals, uv).float(),
        colours=colours,
        tints=None if texture is None else tints,
        uv=uv,
        texture=texture,
        material=part.material or default_material(texture is not None or part.colours is not None),
        dropped=dropped,
        renewed=renewed,
        inward=mesh.looks_inwards(vertices, faces),
    )


def _normals(given: Tensor | None, vertices: Tensor, faces: Tensor) -> tuple[Tensor, int]:
    """Unit normals (v, 3), float64, the given ones where they have a length, and how many had to be repaired."""
    normals = mesh.vertex_normals(vertices, faces)
    known = (normals != 0).any(1)
    if given is not None:
        length = given.norm(dim=1)
        known = length.isfinite() & (length > 0)
        normals = torch.where(known[:, None], given / length[:, None], normals)
    return mesh.fill_normals(vertices, normals), int((~known).sum())


def _checked_texture(texture: Texture | Tensor, uv: Tensor | None) -> Texture:
    if uv is None:
        raise ValueError("texture needs uv (v, 2), got None")
    texture = texture if isinstance(texture, Texture) else Texture(texture)
    if texture.pixels.shape[2] != 3:
        raise ValueError(f"texture must be linear RGB (h, w, 3), got {tuple(texture.pixels.shape)}")
    return texture


def _rows(name: str, value: Tensor, shape: tuple[int, int], finite: bool = True) -> Tensor:
    """An attribute of the vertices as float32, checked."""
    value = torch.as_tensor(value).float()
    if value.shape != shape:
        raise ValueError(f"{name} must be {shape}, one row a vertex, got {tuple(value.shape)}")
    bad = int((~value.isfinite()).any(1).sum())
    if finite and bad:
        raise ValueError(f"{name} must be finite: {bad} of {shape[0]} rows are not")
    return value


def join(name: str, parts: Sequence[Part]) -> Part:
    """The union of parts that look alike; attributes that only some have are dropped.

    Raises:
        ValueError: their materials or textures differ.
    """
    first = parts[0]
    if not all(
        same_map(p.texture, first.texture)
        and same_map(p.glow, first.glow)
        and p.bumps is first.bumps
        and _same_material(p.material, first.material)
        for p in parts
    ):
        raise ValueError("parts must share one material and texture; they differ: give the region a material")
    counts = torch.tensor([len(p.vertices) for p in parts])
    starts = (counts.cumsum(0) - counts).tolist()
    return replace(
        first,
        name=name,
        vertices=torch.cat([p.vertices for p in parts]),
        faces=torch.cat([p.faces + start for p, start in zip(parts, starts, strict=True)]),
        normals=_joined([p.normals for p in parts]),
        uv=_joined([p.uv for p in parts]),
        colours=_joined([p.colours for p in parts]),
    )


def _joined(values: Sequence[Tensor | None]) -> Tensor | None:
    """The rows of all parts, None where one of them has none."""
    given = [value for value in values if value is not None]
    return torch.cat(given) if len(given) == len(values) else None


def transformed(part: Part, matrix: Tensor) -> Part:
    """The part under an affine transform (4, 4) float64; where that mirrors, faces are turned so that fronts stay."""
    linear = matrix[:3, :3]
    mirror = bool(torch.linalg.det(linear) < 0)
    a, b, c = linear.T  # of the inverse's transpose, times the determinant: there is one of flat parts too
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)])
    normals = None if part.normals is None else part.normals.double() @ (-cofactors if mirror else cofactors)
    return replace(
        part,
        vertices=part.vertices.double() @ linear.T + matrix[:3, 3],
        faces=part.faces.flip(1) if mirror else part.faces,
        normals=normals,
    )


def _same_material(a: SurfaceMaterial | None, b: SurfaceMaterial | None) -> bool:
    return a is b if a is None or b is None else same(a, b)
