"""Scene files: a few lines of TOML that place meshes and simple shapes, and give them materials.

    environment = "hdri/uffizi.hdr"           # or { file = "probe.hdr", layout = "angular", layer = "sky" }
    hidden = false                            # drop triangles that see no way out, as those inside of a machine
    gaps = 0.05                               # add vertices where surfaces almost touch, for light that bounces there
                                              # (`ptt.finer_in_gaps`); default: none
    [camera]                                  # optional; as `Camera`
    eye = [0.3, 0.3, 0.9]
    target = [0, 0.1, 0]
    fov = 40                                  # also up, width, height
    [[region]]
    name = "bunny"
    mesh = "meshes/bunny.ply"                 # or one of plane, sphere, box, torus
    parts = ["ear"]                           # of the file; default: all that it holds
    regions = true                            # each part a region of its own, "bunny/ear", with its own material
    scale = 10.0                              # then
    rotate = [0, 30, 0]                       # degrees about the world's x, then y, then z axis, then
    translate = [0, 0, 0]
    subdivide = 0                             # times: each triangle in four, without smoothing
    edge = 0.1                                # after placing: longer edges are halved, the longest of a triangle
                                              # first; light is kept at vertices
    editable = true
    texture = "spot_texture.png"              # sRGB image over the mesh's own uv
    material = { model = "blinn-phong", diffuse = [0.5, 0.5, 0.5], specular = 0.1, exponent = 20 }
                                              # others, and those of image files: `ptt.scene.toml_materials`
    [[region]]
    name = "floor"
    plane = { size = 4.0, cells = 64 }

Files are looked for beside the TOML file, then in the folder that the environment variable PTT_DATA names. A
mesh keeps its own material where `material` is left out; a region of parts whose materials differ needs one.
"""

from __future__ import annotations

import inspect
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from ptt.light.environment import Environment
from ptt.ops import mesh, refine
from ptt.ops.directions import turn
from ptt.scene.camera import Camera
from ptt.scene.gaps import finer_in_gaps
from ptt.scene.hidden import without_hidden
from ptt.scene.mesh_files import read_parts
from ptt.scene.parts import Part, join, transformed
from ptt.scene.scene import Scene
from ptt.scene.textures import read_texture
from ptt.scene.toml_materials import IMAGES, read_material
from ptt.scene.toml_tables import check_keys, find, value_of

T = TypeVar("T")
SHAPES: dict[str, Callable[..., tuple[Tensor, Tensor]]] = {
    "plane": mesh.plane_mesh,
    "sphere": mesh.sphere_mesh,
    "box": mesh.box_mesh,
    "torus": mesh.torus_mesh,
}
FLOOR_CELLS = 64  # along an edge of `load_scene`'s floor
MOST_TRIANGLES = 10_000_000  # `edge` may make in one region: more is taken for a mistake
PLACING = ("scale", "rotate", "translate")  # keys that place a region, in the order in which they act
REGION = ("name", "mesh", *SHAPES, "parts", "regions", *PLACING, "subdivide", "edge", "editable", "texture", "material")


def load_scene(path: str | PathLike[str], *, floor: float | None = None) -> Scene:
    """The scene in a mesh file (.ply, .obj, .stl, .gltf, .glb; `ptt.scene.mesh_files`) or in a .toml file.

    floor: the side of a square under a mesh file, as the region "floor", in diameters of the mesh; None for none

    Raises:
        ValueError: the file is missing, of another kind, unreadable, or what it holds is not a scene; a TOML file has
            an unknown key: the message lists the valid ones.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        if floor is not None:
            raise ValueError(f"floor is for mesh files; in {path.name} it is a [[region]] with a plane")
        return _load_toml(path)
    parts = read_parts(path)
    return Scene.from_parts(parts if floor is None else [*parts, _floor(parts, floor)])


def _floor(parts: list[Part], size: float) -> Part:
    """A level square under parts, `size` of their diameters wide."""
    if not size > 0:
        raise ValueError(f"floor must be > 0, got {size}")
    points = torch.cat([part.vertices.double() for part in parts])
    centre = (points.amin(0) + points.amax(0)) / 2
    diameter = 2 * float((points - centre).norm(dim=1).max())
    centre[1] = points[:, 1].min()
    name = "floor"
    while name in [part.name for part in parts]:
        name += "_"
    vertices, faces = mesh.plane_mesh(size * diameter, FLOOR_CELLS)
    return Part(name, vertices + centre, faces)


def _load_toml(path: Path) -> Scene:
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"path must be a TOML file: {path}: {error}") from error
    check_keys(path.name, table, ("environment", "hidden", "gaps", "camera", "region"))
    if not isinstance(table.get("region"), list):
        raise ValueError(f"{path.name} must hold at least one [[region]]")
    environment = None
    camera = None
    if "environment" in table:
        environment = _environment(table["environment"], path.parent)
    if "camera" in table:
        camera = _call("camera", Camera, table["camera"])
    parts = [part for t in table["region"] for part in _regions(t, path)]
    scene = Scene.from_parts(parts, environment, camera)
    if not value_of(table, "hidden", bool, True):
        scene = without_hidden(scene)
    return finer_in_gaps(scene, float(table["gaps"])) if "gaps" in table else scene


def _environment(given: Any, folder: Path) -> Environment:
    """The light of a file's name, or of a table with the arguments of `Environment.load`."""
    table = {"file": given} if isinstance(given, str) else given
    if not isinstance(table, dict) or not isinstance(table.get("file"), str):
        raise ValueError(f"environment must be a file, or a table with a file, got {given!r}")
    check_keys("environment", table, ("file", "layout", "layer"))
    options = {key: value for key, value in table.items() if key != "file"}
    return Environment.load(find(table["file"], folder), **options)


def _regions(table: Mapping[str, Any], file: Path) -> list[Part]:
    """The regions of a table of a scene file: one, or one for each part of its mesh."""
    check_keys(f"{file.name}: region", table, REGION)
    if not isinstance(table.get("name"), str):
        raise ValueError(f"{file.name}: region must have a name, got {table.get('name')!r}")
    name: str = table["name"]
    try:
        editable = value_of(table, "editable", bool, True)
        own = value_of(table, "regions", bool, False)
        parts = _parts(table, file.parent)
        if own:
            parts = [replace(part, name=f"{name}/{part.name}", editable=editable) for part in parts]
        else:
            parts = [replace(join(name, parts), editable=editable)]
        _check_uv(parts, table)
        return [_placed(part, table, file.parent) for part in parts]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file.name}: region {name!r}: {error}") from error


def _check_uv(parts: list[Part], table: Mapping[str, Any]) -> None:
    """Refuse image files over parts that have no texture coordinates."""
    images = [key for key in ("texture", *IMAGES) if key in table or key in table.get("material", ())]
    if images and any(part.uv is None for part in parts):
        source = _source(table)
        bare = table["mesh"] if source == "mesh" else f"a {source}"
        raise ValueError(f"{bare} has no texture coordinates for {', '.join(images)}: give a mesh that has uv")


def _placed(part: Part, table: Mapping[str, Any], folder: Path) -> Part:
    """A part with the texture, the triangles and the place that a table gives it."""
    if "texture" in table:
        part = replace(part, texture=read_texture(find(table["texture"], folder)))
    for _ in range(value_of(table, "subdivide", int, 0)):
        part = _subdivided(part)
    part = transformed(part, _matrix(**{k: table[k] for k in PLACING if k in table}))
    return _with_edges_up_to(part, float(table["edge"])) if "edge" in table else part


def _parts(table: Mapping[str, Any], folder: Path) -> list[Part]:
    """The parts that a table names, in their own space, with its material where it gives one."""
    source = _source(table)
    if source != "mesh" and ("parts" in table or "regions" in table):
        raise ValueError(f"parts and regions need a mesh, got {source}")
    if source == "mesh":
        parts = _chosen(read_parts(find(table["mesh"], folder)), table.get("parts"))
    else:
        parts = [Part(source, *_call(source, SHAPES[source], table[source]))]
    if "material" not in table:
        return parts
    coloured = "texture" in table or any(part.texture is not None or part.colours is not None for part in parts)
    material = read_material(table["material"], folder, coloured)
    return [replace(part, material=material) for part in parts]


def _source(table: Mapping[str, Any]) -> str:
    """The key that says where a region's triangles come from."""
    sources = [key for key in ("mesh", *SHAPES) if key in table]
    if len(sources) != 1:
        raise ValueError(f"region must have one of mesh, {', '.join(SHAPES)}, got {sources or 'none'}")
    return sources[0]


def _chosen(parts: list[Part], names: list[str] | None) -> list[Part]:
    check_keys("parts", names or (), [part.name for part in parts])
    return parts if names is None else [part for part in parts if part.name in names]


def _matrix(scale: float = 1.0, rotate: Iterable[float] = (0, 0, 0), translate: Iterable[float] = (0, 0, 0)) -> Tensor:
    """The transform (4, 4) float64 that scales, then turns about x, y and z [degrees], then moves."""
    if not (isinstance(scale, int | float) and math.isfinite(scale) and scale > 0):
        raise ValueError(f"scale must be one positive number, got {scale}")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] *= scale
    for axis, degrees in enumerate(_three("rotate", rotate)):
        matrix[:3] = turn(axis, degrees) @ matrix[:3]
    matrix[:3, 3] = torch.tensor(_three("translate", translate), dtype=torch.float64)
    return matrix


def _three(name: str, value: Iterable[float]) -> list[float]:
    numbers = [float(x) for x in value]
    if len(numbers) != 3:
        raise ValueError(f"{name} must be three numbers, got {value}")
    return numbers


def _with_edges_up_to(part: Part, edge: float) -> Part:
    """The part with longer edges halved until none is longer (`ops.refine`)."""
    if not edge > 0:
        raise ValueError(f"edge must be > 0, got {edge}")
    mesh.check_mesh(part.vertices, part.faces)
    sound = part.faces[mesh.sound_faces(part.vertices, part.faces)]
    faces, pairs = refine.refined(part.vertices, sound, edge, MOST_TRIANGLES)
    return _with_vertices(part, faces, pairs)


def _subdivided(part: Part) -> Part:
    """The part with all edges halved."""
    mesh.check_mesh(part.vertices, part.faces)
    faces, edges = mesh.subdivide(part.faces, len(part.vertices))
    return _with_vertices(part, faces, [edges])


def _with_vertices(part: Part, faces: Tensor, pairs: list[Tensor]) -> Part:
    """The part with faces that have vertices between pairs of others, too."""
    names = ("vertices", "normals", "uv", "colours")
    given = {name: getattr(part, name) for name in names}
    finer: dict[str, Any] = {
        name: refine.interpolated(values, pairs) for name, values in given.items() if values is not None
    }
    return replace(part, faces=faces, **finer)


def _call(place: str, make: Callable[..., T], table: Mapping[str, Any]) -> T:
    """The result of make(**table); arguments that it does not have, or of the wrong kind, are refused."""
    check_keys(place, table, inspect.signature(make).parameters)
    try:
        return make(**table)
    except TypeError as error:
        raise ValueError(f"{place}: {error}") from error
