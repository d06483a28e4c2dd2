"""Scene: geometry in named regions, each with one material."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ptt.light.environment import Environment
from ptt.materials.textures import Texture
from ptt.materials.varying import Map, SurfaceMaterial, describe, looked_up
from ptt.ops import mesh
from ptt.ops.octahedral import mix
from ptt.ops.raycast import Surface
from ptt.scene.bumps import BumpMap
from ptt.scene.camera import Camera
from ptt.scene.parts import Part, near_origin, prepare

INSET = 0.01  # share of the way from a vertex to the middle of its triangles at which it is lit (`Scene.points`)


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the scene that has one material.

    editable: says whether the material may change after precomputation
    texture: linear base colour over uv, or None
    bumps: normals over uv, or None; they are seen per pixel
    glow: radiance over uv that it sends out by itself, or None
    """

    name: str
    editable: bool = True
    texture: Texture | None = None
    bumps: BumpMap | None = None
    glow: Texture | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles in named regions: made by `from_mesh`, `from_parts` or `ptt.load_scene`, which check them.

    vertices (v, 3) float32, faces (f, 3) int64: no vertex is shared between regions
    normals, tangents (v, 3): unit, orthogonal to 1e-6
    vertex_region (v,): index into `regions`
    colours (v, 3): linear base colour that multiplies the material's diffuse: the given colours, or 1, times the
        texture at the vertex where the region has one
    tints (v, 3): what multiplies the texture in regions that have both, 1 in others; None where no region has both
    uv (v, 2): texture coordinates, v = 1 on top; 0 in regions that have none; None where no region has any
    regions: their names, textures, and whether they may be edited
    materials: default material of each region, by name: a `Material`, or one that varies over it (`SurfaceMaterial`)
    camera: the one given, or one that frames all parts
    environment: the one given, or None
    offset (3,) float64: what was subtracted from positions that lie far from the origin for their size, else 0
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    tangents: Tensor
    vertex_region: Tensor
    colours: Tensor
    uv: Tensor | None
    regions: tuple[Region, ...]
    materials: dict[str, Any]
    camera: Camera
    environment: Environment | None = None
    tints: Tensor | None = None
    offset: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def __getstate__(self) -> dict[str, Any]:
        """The fields: what is made of them, rays' tree among it, is made anew where a copy needs it."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def __repr__(self) -> str:
        """A line, and one for each region."""
        radius = self.bounds[1]
        counts = torch.bincount(self.face_region, minlength=len(self.regions)).tolist()
        lines = [f"Scene of {len(self.vertices)} vertices, {len(self.faces)} triangles, radius {radius:.3g}"]
        for region, count in zip(self.regions, counts, strict=True):
            kind = describe(self.materials[region.name])
            own = {"textured": region.texture, "bumpy": region.bumps, "glowing": region.glow}
            notes = [kind, *(word for word, given in own.items() if given is not None)]
            notes += ["fixed"] * (not region.editable)
            lines.append(f"  {region.name}: {count} triangles, {', '.join(notes)}")
        return "\n".join(lines)

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
        texture: Texture | Tensor | None = None,
        material: SurfaceMaterial | None = None,
    ) -> Scene:
        """A scene of one region.

        vertices (v, 3), faces (f, 3): counter-clockwise seen from the front
        normals (v, 3): any length; rows that are zero or not finite, or all for None, are computed from the faces
        uv (v, 2): texture coordinates
        colours (v, 3): linear base colour; texture: one over uv, a `Texture` or linear (h, w, 3) that repeats. Both
            multiply
        material: None for `ptt.scene.parts.default_material`

        Raises:
            ValueError: for the reasons of `from_parts`.
        """
        return cls.from_parts([Part(name, vertices, faces, normals, uv, colours, texture, material)])

    @classmethod
    def from_parts(
        cls, parts: Sequence[Part], environment: Environment | None = None, camera: Camera | None = None
    ) -> Scene:
        """Check, repair and join parts, one region each. The default camera frames them all.

        Parts further from the origin than a thousand times their size are moved there, the given camera too, before
        anything is rounded to float32: `offset` says how far, and a warning. Triangles without area are dropped. The
        back of a sheet whose two sides share vertices gets its own. A vertex whose given normal is zero or not finite
        takes the normal of its triangles; a vertex without triangles, or amid triangles that cancel, takes that of the
        nearest vertex that has one. One warning counts these repairs over all parts, and one names parts that are
        closed and wound inside out.

        Raises:
            ValueError: no parts; a name twice; vertices that are not finite; faces that are missing or out of
                range; an attribute of the wrong shape; a texture without uv.
        """
        names = [part.name for part in parts]
        if not parts or len(set(names)) < len(names):
            raise ValueError(f"parts must be at least one, with distinct names, got {names}")
        parts, offset = near_origin(parts)
        if camera is not None:
            camera = camera.moved(-offset)
        ready = prepare(parts)
        counts = torch.tensor([len(r.vertices) for r in ready])
        starts = (counts.cumsum(0) - counts).tolist()
        uv = [r.vertices.new_zeros(len(r.vertices), 2) if r.uv is None else r.uv for r in ready]
        tints = [torch.ones_like(r.colours) if r.tints is None else r.tints for r in ready]
        vertices = torch.cat([r.vertices for r in ready])
        return cls(
            vertices=vertices,
            faces=torch.cat([r.faces + start for r, start in zip(ready, starts, strict=True)]),
            normals=torch.cat([r.normals for r in ready]),
            tangents=torch.cat([r.tangents for r in ready]),
            vertex_region=torch.repeat_interleave(torch.arange(len(parts)), counts),
            colours=torch.cat([r.colours for r in ready]),
            uv=None if all(r.uv is None for r in ready) else torch.cat(uv),
            regions=tuple(
                Region(p.name, p.editable, r.texture, p.bumps, p.glow) for p, r in zip(parts, ready, strict=True)
            ),
            materials={p.name: r.material for p, r in zip(parts, ready, strict=True)},
            environment=environment,
            camera=camera or Camera.framing(*_bounds(vertices)),
            tints=None if all(r.tints is None for r in ready) else torch.cat(tints),
            offset=offset,
        )

    @cached_property
    def frames(self) -> Tensor:
        """Frames (v, 3, 3): rows tangent, bitangent = normal x tangent, normal; local = frames @ world."""
        bitangents = torch.cross(self.normals, self.tangents, dim=1)
        return torch.stack([self.tangents, bitangents, self.normals], 1)

    @cached_property
    def points(self) -> Tensor:
        """Points (v, 3) where the vertices are lit, a hundredth of the way into their triangles along the surface.

        A vertex in the very plane of another surface, as where a floor ends at a wall, would see nothing: on a dragon
        in a corner that alone made the indirect part 17 % wrong (docs/transfer.md).
        """
        return mesh.inset(self.vertices, self.faces, self.normals, INSET)

    @cached_property
    def dips(self) -> Tensor:
        """How far below its horizon each vertex (v,) is seen at most, a sine (`ptt.ops.mesh.dips`)."""
        return mesh.dips(self.vertices, self.faces, self.normals)

    @cached_property
    def face_region(self) -> Tensor:
        """The region (f,) of each face, an index into `regions`."""
        return self.vertex_region[self.faces[:, 0]]

    @cached_property
    def surface(self) -> Surface:
        """The triangles, ready for rays."""
        return Surface(self.vertices, self.faces)

    @cached_property
    def bounds(self) -> tuple[Tensor, float]:
        """Centre (3,) of the bounding box, and the radius about it that holds every vertex."""
        return _bounds(self.vertices)

    def region_index(self, name: str) -> int:
        """The index into `regions` of the region of that name; raises ValueError where there is none."""
        names = [region.name for region in self.regions]
        if name not in names:
            raise ValueError(f"no region {name!r}; the scene has {', '.join(names)}")
        return names.index(name)

    def interpolated(self, values: Tensor, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Values (n, ...) inside triangles (n,), at barycentric (n, 3), from those at the vertices (v, ...)."""
        rows = values.flatten(1) if values.ndim > 1 else values[:, None]
        found = mix(rows, self.faces[triangle], barycentric.to(values))
        return found.reshape(len(triangle), *values.shape[1:])

    def frames_at(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Orthonormal frames (n, 3, 3) inside triangles (n,), at barycentric (n, 3).

        Where interpolation leaves no frame, the triangle's normal or another tangent stands in; a warning counts these.
        """

        def triangle_normals(rows: Tensor) -> Tensor:
            a, b, c = self.vertices[self.faces[triangle[rows]]].unbind(1)
            return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)

        normals = self.interpolated(self.normals, triangle, barycentric)
        tangents = self.interpolated(self.tangents, triangle, barycentric)
        frames, repaired = mesh.frames(normals, tangents, triangle_normals)
        if repaired:
            warnings.warn(f"{repaired} of {len(frames)} frames between vertices that disagree repaired", stacklevel=3)
        return frames

    @cached_property
    def vertex_places(self) -> tuple[Tensor, Tensor]:
        """A triangle (v,) that each vertex belongs to, and barycentric (v, 3), all of the vertex."""
        corner = torch.zeros(len(self.vertices), dtype=torch.int64)
        corner[self.faces.flatten()] = torch.arange(self.faces.numel())
        return corner // 3, torch.nn.functional.one_hot(corner % 3, 3).float()

    def bent_frames(self, triangle: Tensor, barycentric: Tensor, bumps: Mapping[str, BumpMap] | None = None) -> Tensor:
        """`frames_at`, turned by the bump maps of the regions: the given ones by name, else their own.

        Raises:
            ValueError: a region is unknown, or the scene has no uv.
        """
        return self.bent(self.frames_at(triangle, barycentric), triangle, barycentric, bumps)

    def bent(
        self, frames: Tensor, triangle: Tensor, barycentric: Tensor, bumps: Mapping[str, BumpMap] | None = None
    ) -> Tensor:
        """Frames (n, 3, 3) inside triangles (n,), at barycentric (n, 3), turned as by `bent_frames`."""
        chosen = {region.name: region.bumps for region in self.regions if region.bumps is not None} | dict(bumps or {})
        for name, bump in chosen.items():
            if self.uv is None:
                raise ValueError(
                    f"the bump map of {name!r} needs uv: give its part uv (v, 2), or a mesh file that has them"
                )
            rows = torch.nonzero(self.face_region[triangle] == self.region_index(name))[:, 0]
            at = self.interpolated(self.uv, triangle[rows], barycentric[rows])
            turned = bump.bend(frames[rows], at, self._mirrored[triangle[rows]])
            frames = frames.index_copy(0, rows, turned)
        return frames

    @cached_property
    def _mirrored(self) -> Tensor:
        assert self.uv is not None
        return mesh.mirrored(self.uv, self.faces)

    @cached_property
    def vertex_glow(self) -> Tensor | None:
        """`glow` (v, 3) of the vertices."""
        return self.glow(*self.vertex_places)

    def glow(self, triangle: Tensor, barycentric: Tensor) -> Tensor | None:
        """Radiance (n, 3) that points inside triangles (n,) send out by themselves; None of a scene that has none."""
        glowing = [(index, region.glow) for index, region in enumerate(self.regions) if region.glow is not None]
        if not glowing:
            return None
        out = torch.zeros(len(triangle), 3, dtype=torch.float32)
        for index, texture in glowing:
            rows = torch.nonzero(self.face_region[triangle] == index)[:, 0]
            uv = self.vertices.new_zeros(len(self.vertices), 2) if self.uv is None else self.uv
            out[rows] = texture.at(self.interpolated(uv, triangle[rows], barycentric[rows]))
        return out

    def map_values(self, maps: Sequence[Map | None], triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Values (m, n) of a material's maps inside triangles (n,), at barycentric (n, 3); 1 for None.

        Raises:
            ValueError: a texture for a scene without uv, or values of another number of vertices.
        """
        values = [self._map_value(given, triangle, barycentric) for given in maps]
        return torch.stack(values) if values else torch.zeros(0, len(triangle), dtype=torch.float32)

    def _map_value(self, given: Map | None, triangle: Tensor, barycentric: Tensor) -> Tensor:
        if given is None:
            return torch.ones(len(triangle), dtype=torch.float32)
        if isinstance(given, Tensor) and given.ndim == 1:
            if len(given) != len(self.vertices):
                raise ValueError(f"a map must have {len(self.vertices)} values, the scene's vertices, got {len(given)}")
            return self.interpolated(given, triangle, barycentric)
        return looked_up(given, None if self.uv is None else self.interpolated(self.uv, triangle, barycentric))

    def albedo(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Linear base colour (n, 3) at hits: triangle (n,) index into faces, barycentric (n, 3).

        It is the texture at the interpolated uv, times the interpolated tints, where the region has one, else the
        interpolated colours.

        Raises:
            ValueError: a triangle is not a face of the scene (a miss, for one).
        """
        if bad := int(((triangle < 0) | (triangle >= len(self.faces))).sum()):
            raise ValueError(f"triangle (n,) must index {len(self.faces)} faces: {bad} do not")
        colour = self.interpolated(self.colours, triangle, barycentric)
        region = self.face_region[triangle]
        for index, own in enumerate(self.regions):
            rows = torch.nonzero(region == index)[:, 0]
            if own.texture is not None and self.uv is not None and len(rows):
                at = self.interpolated(self.uv, triangle[rows], barycentric[rows])
                texels = own.texture.at(at)
                if self.tints is not None:
                    texels = texels * self.interpolated(self.tints, triangle[rows], barycentric[rows])
                colour = colour.index_copy(0, rows, texels)
        return colour


def _bounds(vertices: Tensor) -> tuple[Tensor, float]:
    """Centre (3,) of the bounding box, and the radius about it that holds every vertex."""
    centre = (vertices.amin(0) + vertices.amax(0)) / 2
    return centre, float((vertices - centre).norm(dim=1).max())
