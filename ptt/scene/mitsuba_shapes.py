"""The shapes of a loaded Mitsuba scene as parts: meshes as they are, spheres, disks and cylinders as triangles.

Rectangles and cubes get more triangles than Mitsuba gives them, since light is kept at vertices. Mitsuba takes the side
of a surface from its normals, ptt from the order of its corners, which is made to agree with these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ptt.materials.textures import Texture
from ptt.ops import mesh
from ptt.scene.bumps import BumpMap
from ptt.scene.mitsuba_materials import Look
from ptt.scene.mitsuba_probes import Array, numbers
from ptt.scene.mitsuba_textures import Value, transformed, upwards
from ptt.scene.parts import Part

HALVINGS = {"Rectangle": 5, "Cube": 4}  # of the edges of Mitsuba's few triangles
AROUND = 96  # vertices around a sphere, a disk or a cylinder
ALIKE = 12  # decimals to which the points of a pole are rounded, so that they are the same
UNEVEN = 0.02  # relative spread of the lengths of steps along uv that a bump map may have


def read_mesh(shape: Any, base: Value | None) -> Part:
    """The triangles of a mesh in world space, each with corners of its own where it has no vertex normals.

    base: its base colour, which may be an attribute of its vertices

    Raises:
        ValueError: it has no such attribute.
    """
    colours = None
    if base is not None and base.attribute is not None:
        if not shape.has_attribute(base.attribute):
            raise ValueError(f"has no attribute {base.attribute}, which its bsdf asks for: give its mesh one")
        colours = base.mean * _rows(shape.attribute_buffer(base.attribute), 3)
    vertices = _rows(shape.vertex_positions_buffer(), 3)
    faces = _rows(shape.faces_buffer(), 3).long()
    uv = _rows(shape.vertex_texcoords_buffer(), 2) if shape.has_vertex_texcoords() else None
    sign = -1 if shape.has_flipped_normals() else 1
    if shape.has_vertex_normals() and not shape.has_face_normals():
        part = Part("", vertices, faces, sign * _rows(shape.vertex_normals_buffer(), 3), uv, colours)
    else:
        corners = faces.flatten()
        a, b, c = vertices[faces].unbind(1)
        normals = sign * torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0)
        uv, colours = (None if x is None else x[corners] for x in (uv, colours))
        part = Part("", vertices[corners], torch.arange(len(corners)).reshape(-1, 3), normals, uv, colours)
    return _facing(_finer(part, HALVINGS.get(shape.class_name(), 0)))


def _rows(values: Any, columns: int) -> Tensor:
    """A buffer of Mitsuba's as rows (n, columns)."""
    return torch.from_numpy(numbers(values).reshape(-1, columns))


def read_grid(shape: Any) -> Part:
    """A sphere, disk or cylinder as triangles over its uv, in world space."""
    import mitsuba as mi

    columns, rows, place = GRIDS[shape.class_name()]
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    points, normals = (torch.from_numpy(x.reshape(-1, 3)) for x in place(u, v))
    corner = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).flatten()
    a, b, c, d = corner, corner + 1, corner + columns + 2, corner + columns + 1
    faces = torch.stack((a, b, c, a, c, d), 1).reshape(-1, 3)
    faces = faces[mesh.sound_faces(points, faces)]
    matrix = torch.from_numpy(numbers(mi.traverse(shape)["to_world"].matrix).reshape(4, 4))
    sign = -1 if shape.has_flipped_normals() else 1
    uv = torch.from_numpy(np.stack((u, v), -1).reshape(-1, 2))
    turned = sign * normals @ torch.linalg.inv(matrix[:3, :3])
    return _facing(Part("", points @ matrix[:3, :3].T + matrix[:3, 3], faces, turned, uv))


def _sphere(u: Array, v: Array) -> tuple[Array, Array]:
    x, y = _circle(u)
    theta = np.pi * v
    points = np.stack((np.sin(theta) * x, np.sin(theta) * y, np.cos(theta)), -1).round(ALIKE)
    return points, points


def _disk(u: Array, v: Array) -> tuple[Array, Array]:
    x, y = _circle(v)
    points = np.stack((u * x, u * y, 0 * u), -1)
    return points, np.broadcast_to((0.0, 0.0, 1.0), points.shape).copy()


def _cylinder(u: Array, v: Array) -> tuple[Array, Array]:
    x, y = _circle(u)
    return np.stack((x, y, v), -1), np.stack((x, y, 0 * v), -1)


def _circle(turns: Array) -> tuple[Array, Array]:
    """Cosine and sine of a share of a turn; those of 1 are those of 0."""
    phi = 2 * np.pi * (turns % 1)
    return np.cos(phi), np.sin(phi)


# Steps along u and v of the shapes that are no meshes, and the points and normals at uv, in their own space
GRIDS: dict[str, tuple[int, int, Callable[[Array, Array], tuple[Array, Array]]]] = {
    "Sphere": (AROUND, AROUND // 2, _sphere),
    "Disk": (16, AROUND, _disk),
    "Cylinder": (AROUND, 16, _cylinder),
}


def _finer(part: Part, times: int) -> Part:
    """The part with all edges halved, some times."""
    for _ in range(times):
        faces, edges = mesh.subdivide(part.faces, len(part.vertices))
        values = {"vertices": part.vertices, "normals": part.normals, "uv": part.uv, "colours": part.colours}
        finer: dict[str, Any] = {k: torch.cat((x, x[edges].mean(1))) for k, x in values.items() if x is not None}
        part = replace(part, faces=faces, **finer)
    return part


def _facing(part: Part) -> Part:
    """The part with its faces turned to where their normals look, as Mitsuba takes the side of these."""
    assert part.normals is not None
    a, b, c = part.vertices[part.faces].unbind(1)
    away = (torch.linalg.cross(b - a, c - a) * part.normals[part.faces].sum(1)).sum(1) < 0
    return replace(part, faces=torch.where(away[:, None], part.faces.flip(1), part.faces))


def closed(part: Part) -> bool:
    """Tell whether a surface is closed."""
    return any(mesh.looks_inwards(part.vertices, faces) for faces in (part.faces, part.faces.flip(1)))


def with_look(part: Part, look: Look, losses: Counter[str]) -> Part:
    """The part with a look, and uv made for its textures.

    Raises:
        ValueError: it has textures and no uv.
    """
    part = replace(part, material=look.material)
    if part.uv is None:
        if look.matrix is not None:
            raise ValueError("has a bsdf with textures, and no texture coordinates: give its mesh uv")
        if not all(layer.isotropic for layer in look.material.layers):
            losses["the direction of brushed facets on a mesh without uv"] += 1
        return part
    matrix = np.eye(3) if look.matrix is None else look.matrix
    part = replace(part, uv=upwards(transformed(part.uv, matrix)))
    if look.base is not None:
        part = replace(part, texture=look.base.texture)
    if look.normals is not None:
        return replace(part, bumps=_normals(part, look.normals, matrix, losses))
    return part if look.heights is None else replace(part, bumps=_slopes(part, look.heights, losses))


def _normals(part: Part, normals: Texture, matrix: Array, losses: Counter[str]) -> BumpMap | None:
    """The bump map of normals in the frame of Mitsuba's u and of normal x u, for a part with its textures' uv."""
    assert part.uv is not None
    if matrix[0, 1] or matrix[1, 0]:
        losses["a normal map that to_uv turns"] += 1
        return None
    mirrored = mesh.mirrored(part.uv, part.faces)
    if bool(mirrored.any()) and not bool(mirrored.all()):
        losses["a normal map where uv run both ways around"] += 1
    along = float(np.sign(matrix[0, 0]))
    across = -along if float(mirrored.float().mean()) > 0.5 else along
    return BumpMap(normals.pixels * normals.pixels.new_tensor((along, across, 1.0)), normals.wrap)


def _slopes(part: Part, heights: Texture, losses: Counter[str]) -> BumpMap:
    """The bump map of heights, by differences over two texels and the mean lengths of a step along u and v."""
    assert part.uv is not None
    lengths = _steps(part.vertices.double(), part.uv.double(), part.faces)
    if float((lengths.std(0) / lengths.mean(0)).max()) > UNEVEN:
        losses["a bump map's depth, which its uv scale unevenly"] += 1
    rows, columns, _ = heights.pixels.shape
    v, u = torch.meshgrid(
        (rows - 0.5 - torch.arange(rows)) / rows, (torch.arange(columns) + 0.5) / columns, indexing="ij"
    )
    uv = torch.stack((u, v), -1).reshape(-1, 2)
    slopes = []
    for axis, count in enumerate((columns, rows)):
        step = torch.eye(2)[axis] / count
        rise = (heights.at(uv + step) - heights.at(uv - step)) * (count / 2)
        slopes.append(-rise / float(lengths[:, axis].mean()))
    return BumpMap(torch.cat((*slopes, torch.ones_like(uv[:, :1])), 1).reshape(rows, columns, 3), heights.wrap)


def _steps(vertices: Tensor, uv: Tensor, faces: Tensor) -> Tensor:
    """How far a step of 1 along u, and along v, leads in the world (f, 2), on each triangle that has an area in uv."""
    a, b, c = vertices[faces].unbind(1)
    s, t, r = uv[faces].unbind(1)
    places = torch.stack((t - s, r - s), 1)
    sound = torch.linalg.det(places).abs() > 1e-12
    moves: Tensor = torch.linalg.solve(places[sound], torch.stack((b - a, c - a), 1)[sound])
    lengths: Tensor = moves.norm(dim=2)
    return lengths
