"""Scene: geometry in named regions, each with one material; and the camera that looks at it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ptt.materials import Material
from ptt.meshes import Part, prepare
from ptt.ops import mesh
from ptt.ops.octahedral import mix
from ptt.ops.raycast import Surface

if TYPE_CHECKING:
    from ptt.environment import Environment

Vector = tuple[float, float, float]
INSET = 0.01


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    eye, target, up: world space; fov: vertical angle of view [degrees]; width, height: of the image [pixels]

    Raises:
        ValueError: no direction of view, up along it, fov outside (0, 180), or an empty image.
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov: float = 40.0
    width: int = 640
    height: int = 480

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))
        if not 0 < self.fov < 180:
            raise ValueError(f"fov must lie between 0 and 180 degrees, got {self.fov}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width and height must be at least 1 pixel, got {self.width} x {self.height}")
        if not all(map(math.isfinite, self._axes()[0])):
            raise ValueError(f"eye, target and up must span a view, got {self.eye}, {self.target}, {self.up}")

    @classmethod
    def framing(cls, centre: Tensor, radius: float) -> Camera:
        """A three-quarter view from the front, right and above of the sphere (centre (3,), radius)."""
        away = torch.tensor([0.5, 0.45, 1.0], dtype=torch.float64)
        distance = radius / math.sin(math.radians(cls.fov / 2))
        eye = centre.double() + away / away.norm() * distance
        return cls(tuple(eye.tolist()), tuple(centre.tolist()))

    def orbited(self, degrees: float) -> Camera:
        """The camera turned about the vertical axis through its target; positive = right-handed."""
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        x, y, z = (e - t for e, t in zip(self.eye, self.target, strict=True))
        around = (self.target[0] + c * x + s * z, self.target[1] + y, self.target[2] - s * x + c * z)
        return replace(self, eye=around)

    def axes(self) -> Tensor:
        """(3, 3) float64: unit vectors to the right, up, and ahead in the image."""
        return torch.tensor(self._axes(), dtype=torch.float64)

    def _axes(self) -> tuple[Vector, Vector, Vector]:
        (ex, ey, ez), (tx, ty, tz) = self.eye, self.target
        ahead = _unit((tx - ex, ty - ey, tz - ez))
        right = _cross(ahead, _unit(self.up))
        right = _unit(right) if math.hypot(*right) > 1e-9 else (math.nan, math.nan, math.nan)
        return right, _cross(right, ahead), ahead

    def rays(self) -> tuple[Tensor, Tensor]:
        """Origin (3,) and unit directions (height, width, 3) through the pixels' centres, row 0 on top."""
        half = math.tan(math.radians(self.fov / 2))
        y = -_centres(self.height) * half
        x = _centres(self.width) * half * self.width / self.height
        rows, columns = torch.meshgrid(y, x, indexing="ij")
        directions = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ self.axes()
        return torch.tensor(self.eye), (directions / directions.norm(dim=-1, keepdim=True)).float()

    def toward(self, points: Tensor) -> Tensor:
        """Unit directions (v, 3) from points (v, 3) to the eye."""
        away = torch.tensor(self.eye, dtype=torch.float64, device=points.device) - points.double()
        return torch.nn.functional.normalize(away, dim=-1).to(points.dtype)


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the scene that has one material.

    editable: whether the material may change after precomputation
    texture (h, w, 3): linear base colour, or None
    """

    name: str
    editable: bool = True
    texture: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles in named regions: made by `load`, `from_mesh`, `from_parts` or `default`, which check them.

    vertices (v, 3) float32, faces (f, 3) int64: no vertex is shared between regions
    normals, tangents (v, 3): unit, orthogonal to 1e-6
    vertex_region (v,): index into `regions`
    colours (v, 3): linear base colour that multiplies the material's diffuse: 1 where there is none,
        the texture at the vertex where there is one
    uv (v, 2): texture coordinates, v = 1 on top; 0 in regions that have none; None where no region has any
    materials: default Material of each region, by name
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    tangents: Tensor
    vertex_region: Tensor
    colours: Tensor
    uv: Tensor | None
    regions: tuple[Region, ...]
    materials: dict[str, Material]
    environment: Environment | None = None
    camera: Camera | None = None

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a mesh (.ply, .obj, .stl, .gltf, .glb; `ptt.mesh_file`) or a .toml file (`ptt.scene_file`).

        Raises:
            ValueError: the file is missing, of another kind, unreadable, or what it holds is not a scene.
        """
        from ptt.scene_file import load

        return load(Path(path))

    @classmethod
    def default(cls) -> Scene:
        """A knot, a ball and a leaning slab on a floor: 8,000 vertices, made in code."""
        from ptt.default_scene import default_scene

        return default_scene()

    @classmethod
    def from_mesh(
        cls,
        vertices: Tensor,
        faces: Tensor,
        name: str = "mesh",
        *,
        normals: Tensor | None = None,
        uv: Tensor | None = None,
        colours: Tensor | None = None,
        texture: Tensor | None = None,
        material: Material | None = None,
    ) -> Scene:
        """A scene of one region.

        vertices (v, 3), faces (f, 3): counter-clockwise seen from the front
        normals (v, 3): any length; zero or non-finite rows, and None, are computed from the faces
        uv (v, 2), colours (v, 3) linear, texture (h, w, 3) linear: base colour; a texture outdoes colours
        material: None for `ptt.meshes.default_material`

        Raises:
            ValueError: as `from_parts`.
        """
        return cls.from_parts([Part(name, vertices, faces, normals, uv, colours, texture, material)])

    @classmethod
    def from_parts(
        cls, parts: Sequence[Part], environment: Environment | None = None, camera: Camera | None = None
    ) -> Scene:
        """Check, repair and join parts, one region each; without a camera, one that frames them all.

        Triangles without area are dropped. A vertex whose given normal is zero or not finite takes its
        triangles'; one without triangles, or amid triangles that cancel, stays in its place and takes that of
        the nearest vertex that has one. One warning counts these repairs over all parts.

        Raises:
            ValueError: no parts; a name twice; vertices that are not finite; faces that are missing or out of
                range; an attribute of the wrong shape; a texture without uv.
        """
        names = [part.name for part in parts]
        if not parts or len(set(names)) < len(names):
            raise ValueError(f"parts must be at least one, with distinct names, got {names}")
        ready = prepare(parts)
        counts = torch.tensor([len(r.vertices) for r in ready])
        starts = (counts.cumsum(0) - counts).tolist()
        uv = [r.vertices.new_zeros(len(r.vertices), 2) if r.uv is None else r.uv for r in ready]
        vertices = torch.cat([r.vertices for r in ready])
        return cls(
            vertices,
            torch.cat([r.faces + start for r, start in zip(ready, starts, strict=True)]),
            torch.cat([r.normals for r in ready]),
            torch.cat([r.tangents for r in ready]),
            torch.repeat_interleave(torch.arange(len(parts)), counts),
            torch.cat([r.colours for r in ready]),
            None if all(r.uv is None for r in ready) else torch.cat(uv),
            tuple(Region(p.name, p.editable, r.texture) for p, r in zip(parts, ready, strict=True)),
            {p.name: r.material for p, r in zip(parts, ready, strict=True)},
            environment,
            camera or Camera.framing(*_bounds(vertices)),
        )

    @cached_property
    def frames(self) -> Tensor:
        """(v, 3, 3): rows tangent, bitangent = normal x tangent, normal; local = frames @ world."""
        bitangents = torch.cross(self.normals, self.tangents, dim=1)
        return torch.stack([self.tangents, bitangents, self.normals], 1)

    @cached_property
    def points(self) -> Tensor:
        """(v, 3): where the vertices are lit, a hundredth of the way into their triangles along the surface.

        A vertex in the very plane of another surface, as where a floor ends at a wall, would see nothing from there.
        """
        return mesh.inset(self.vertices, self.faces, self.normals, INSET)

    @cached_property
    def face_region(self) -> Tensor:
        """(f,): index into `regions`."""
        return self.vertex_region[self.faces[:, 0]]

    @cached_property
    def surface(self) -> Surface:
        """All triangles, ready for rays."""
        return Surface(self.vertices, self.faces)

    @cached_property
    def bounds(self) -> tuple[Tensor, float]:
        """Centre (3,) of the bounding box, and the radius about it that holds every vertex."""
        return _bounds(self.vertices)

    def region_index(self, name: str) -> int:
        """The index into `regions` of the region of that name."""
        names = [region.name for region in self.regions]
        if name not in names:
            raise ValueError(f"no region {name!r}; the scene has {', '.join(names)}")
        return names.index(name)

    def interpolated(self, values: Tensor, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Values (n, ...) inside triangles (n,), at barycentric (n, 3), of those at the vertices (v, ...)."""
        mixed = mix(
            values.flatten(1) if values.ndim > 1 else values[:, None], self.faces[triangle], barycentric.to(values)
        )
        return mixed.reshape(len(triangle), *values.shape[1:])

    def frames_at(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Orthonormal frames (n, 3, 3) inside triangles (n,), at barycentric (n, 3).

        Where interpolation leaves no frame, the triangle's normal, or another tangent; a warning counts them.
        """

        def across(rows: Tensor) -> Tensor:
            a, b, c = self.vertices[self.faces[triangle[rows]]].unbind(1)
            return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)

        normals, tangents = (self.interpolated(x, triangle, barycentric) for x in (self.normals, self.tangents))
        frames, repaired = mesh.frames(normals, tangents, across)
        if repaired:
            warnings.warn(f"{repaired} of {len(frames)} frames between vertices that disagree repaired", stacklevel=3)
        return frames

    def albedo(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Linear base colour (n, 3) at hits: triangle (n,) index into faces, barycentric (n, 3).

        The texture at the interpolated uv where the region has one, else the interpolated colours.

        Raises:
            ValueError: a triangle is not a face of the scene (a miss, for one).
        """
        if bad := int(((triangle < 0) | (triangle >= len(self.faces))).sum()):
            raise ValueError(f"triangle (n,) must index {len(self.faces)} faces: {bad} do not")
        colour = self.interpolated(self.colours, triangle, barycentric)
        region = self.face_region[triangle]
        for index, texture in enumerate(r.texture for r in self.regions):
            rows = torch.nonzero(region == index)[:, 0]
            if texture is not None and self.uv is not None and len(rows):
                at = self.interpolated(self.uv, triangle[rows], barycentric[rows])
                colour = colour.index_copy(0, rows, mesh.sample_texture(texture, at))
        return colour


def _bounds(vertices: Tensor) -> tuple[Tensor, float]:
    centre = (vertices.amin(0) + vertices.amax(0)) / 2
    return centre, float((vertices - centre).norm(dim=1).max())


def _centres(count: int) -> Tensor:
    return (torch.arange(count, dtype=torch.float64) + 0.5) * (2 / count) - 1


def _unit(x: Vector) -> Vector:
    size = math.hypot(*x) or math.nan
    return (x[0] / size, x[1] / size, x[2] / size)


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _vector(name: str, value: Sequence[float]) -> Vector:
    x = tuple(float(c) for c in value)
    if len(x) != 3 or not all(map(math.isfinite, x)):
        raise ValueError(f"{name} must be three finite numbers, got {value}")
    return x
