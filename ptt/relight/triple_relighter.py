"""Triple products in local frames (Ma et al. 2006): shadows of all frequencies, any material, per pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import zip_longest
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ptt.imaging.atlas import Atlas
from ptt.imaging.gbuffer import GBuffer
from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.materials.shapes import Shape, is_mirror_symmetric, reflecting_all
from ptt.materials.varying import SurfaceMaterial
from ptt.models.cache import Cache, watched
from ptt.ops import haar, local, rotation
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.geodesic import Geodesic
from ptt.ops.memory import in_large_pages
from ptt.ops.near import Near
from ptt.ops.octahedral import Octahedral
from ptt.ops.rotation import Resampling
from ptt.ops.shade import Functions, RegionCoats, ShadedPoints
from ptt.ops.table import Table, stored
from ptt.relight.light_step import LightStep
from ptt.relight.operations import operations
from ptt.relight.relighter import Relighter
from ptt.relight.shape_tables import ShapeTables
from ptt.relight.viewpoint import View, eye_of, glow_of
from ptt.scene.scene import Scene

Storage = Literal["float", "16-bit", "8-bit"]
"""How light and BRDFs are kept: as they are, or a row at a time, each with a scale of its own."""

STORAGE = {"float": torch.float32, "16-bit": torch.float16, "8-bit": torch.uint8}
BLOCK = 2048  # points whose visibility is traced at once
FINEST = 7  # level
MEMORY = 8e9  # bytes that all tables together may take
OPERATOR = 32  # of the rotation operator, for a triangle of a frame
PREROTATED = 64, 8  # cells along the edge of the light's map, and samples along that of a triangle
FRAMES = 512  # that light is rotated to at once
NO_COAT = Material(0.0)


class PointLookups(NamedTuple):
    """Points that are shaded: where their light and visibility are found, and their surface.

    light, seen: rows of the tables; positions (p, 3), frames (p, 3, 3), region (p,) int32, colour (p, 3)
    triangle (p,), barycentric (p, 3): where on the mesh
    """

    light: Near
    seen: Near
    positions: Tensor
    frames: Tensor
    region: Tensor
    colour: Tensor
    triangle: Tensor
    barycentric: Tensor


class CoatedPoints(NamedTuple):
    """What points are coated with: the group of layers (p,) int32, those of all regions one after the other; how much
    of each of its layers (i, p, 3); the base colour (p, 3)."""

    group: Tensor
    shares: Tensor
    colour: Tensor


class Exitant(NamedTuple):
    """With materials: the functions that are multiplied, and what the regions are coated with."""

    functions: Functions
    coats: RegionCoats


@in_python
class TripleProductRelighter(Relighter):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view: visibility is mixed from the vertices'
    level: of the triangles that the three functions are given on: 1 for 80 of them, 2 for 320, 3 for 1280
    normals, twists: frames that light is rotated into: those of an octahedral map of normals, each turned about it
    source: cells along the edge of the light's octahedral map; None for three or more a triangle, 32 at least
    views: along the edge of the hemi-octahedral map of view directions; 90 x 90 are as many as the paper's 128 x 64
    rays: along the edge of a triangle, for visibility, a power of two
    storage: of light and BRDFs (`Storage`); visibility has 8 bits
    atlas: texels that hold visibility, for meshes too coarse for shadows; None for that of the vertices
    compiled: by kernels in C++, built on first use
    progress: a bar while visibility is traced

    Differentiable in the map and in the weights of the materials.

    environment may also be what `prerotated` made of one.

    Departures from the paper: normals lie on an octahedral map, 22 x 22 for its 32 x 16, so that poles are no
    exception, and the tangent's angle is that to a normal's own frame; light is rotated on the fly, from three cells a
    triangle or more, in place of tables that take minutes (`prerotated` makes them).

    Example:
        >>> relighter = TripleProductRelighter(scene, level=1)
        >>> pixels = GBuffer.of(scene, camera)
        >>> pixels.image(relighter(light.rotated(y=30), {}, pixels), light).save("scene.png")
    """

    pixels = True
    lights = (Environment, Table)
    sources_in_c = ("maps", "light", "rotation", "near", "shading")
    frames: Tensor
    starts: Tensor
    reads: Tensor
    visibility: Tensor
    dull: Tensor

    def __init__(
        self,
        scene: Scene,
        level: int = 2,
        *,
        normals: int = 22,
        twists: int = 32,
        source: int | None = None,
        views: int = 90,
        rays: int = 2,
        storage: Storage = "16-bit",
        atlas: Atlas | None = None,
        compiled: bool = True,
        progress: bool = False,
    ) -> None:
        super().__init__(compiled)
        for name, value, least, most in (
            ("level", level, 0, FINEST),
            ("twists", twists, 1, 256),
            ("views", views, 1, 512),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name} must be in {least}..{most}, got {value}")
        if storage not in STORAGE:
            raise ValueError(f"storage must be one of {', '.join(STORAGE)}, got {storage!r}")
        self.scene = scene
        self.atlas = atlas
        self.grid = Geodesic(level)
        self.storage = STORAGE[storage]
        self.twists = twists
        self.views = views
        source = max(32, 8 << level) if source is None else source
        own = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
        _check_memory(self.grid.cells, len(own) * twists, views**2, len(atlas.triangle if atlas else scene.vertices))
        self.light = LightStep(Octahedral(source), (), compiled)
        s = rotation.resampling(Octahedral(source), self.grid, turned(own, twists))
        tables = {
            "frames": own.float(),
            "starts": s.starts,
            "reads": s.reads,
            "visibility": _traced(scene, atlas, self.grid, rays, progress),
            "dull": local.cosine(self.grid),
        }
        for name, tensor in tables.items():
            self.register_buffer(name, in_large_pages(tensor))
        self._vertices = Cache()
        self._pixels = Cache()
        self._viewed = Cache()
        self._coated = Cache()
        self._glossy = Cache()
        self._tables: ShapeTables[Table] = ShapeTables(self._table)
        self._operations = operations(compiled)

    @property
    def materials(self) -> Mapping[str, SurfaceMaterial]:
        """The scene's own materials, by region."""
        return self.scene.materials

    @property
    def positions(self) -> Tensor:
        """The scene's vertices (v, 3), where they are lit."""
        return self.scene.points.to(self.dull)

    def glow(self, view: View) -> Tensor | None:
        """What vertices or pixels send out by themselves."""
        return glow_of(self.scene, view)

    def sources(self) -> list[nn.Module]:
        """All tables are its own."""
        return [self]

    @uncompiled
    def incident(self, environment: Environment | Table) -> Table:
        """The light (f, 3, n) in every frame, or what `prerotated` made, as it is.

        Raises:
            ValueError: light that another relighter rotated.
        """
        if isinstance(environment, Table):
            return self._checked(environment)
        table: Table = super().incident(environment)
        return table

    @uncompiled
    def exitant(self, environment: Any, materials: Mapping[str, Any], points: Any = None) -> Exitant:
        """The result of the BRDF step, which is the same for all points: a change of view makes nothing anew."""
        exitant: Exitant = super().exitant(environment, materials)
        return exitant

    @uncompiled
    def light_step(self, environment: Environment) -> Table:
        """The light in every frame, by the rotation operator."""
        s = Resampling(self.starts, self.reads, rotation.SAMPLES)
        return self._rotated(self.light(environment), s)

    def prerotated(self, environment: Environment, progress: bool = False) -> Table:
        """The same from a finer map with more samples, as the paper's tables are made before anything is drawn.

        It is given to the relighter in place of the environment.
        """
        side, samples = PREROTATED
        lighting = LightStep(Octahedral(side), (), self.compiled).to(self.dull.device)(environment)
        parts = []
        frames = turned(self.frames.cpu().double(), self.twists)
        with tqdm(total=len(frames), desc="rotations", unit=" frames", disable=not progress) as bar:
            for some in frames.split(FRAMES):
                s = rotation.resampling(Octahedral(side), self.grid, some, samples)
                on_device = Resampling(s.starts.to(self.dull.device), s.reads.to(self.dull.device), samples)
                parts.append(self._rotated(lighting, on_device))
                bar.update(len(some))
        return Table(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def _rotated(self, lighting: Tensor, s: Resampling) -> Table:
        """Lighting (3, n, n) in the frames of S, on the triangles."""
        values = haar.synthesise(lighting).flatten(1).T.contiguous()
        table: Table = self._operations.resampled_values(values, s, self.grid.cells, self.storage)
        return table

    @opaque
    def points(self, view: View, eye: Tensor, materials: Mapping[str, SurfaceMaterial]) -> ShadedPoints:
        """Where the functions of vertices or pixels are found, seen from an eye."""
        own = list(materials.values())
        at = self._located(view, brushed=not all(layer.isotropic for m in own for layer in m.layers))
        of_views = self._operations.of_views
        viewed: Near = self._viewed((at, eye), lambda: of_views(at.frames, at.positions, eye, self.views))
        varying = [len(m.layers) if isinstance(m, Material) else m for m in own]
        coated: CoatedPoints = self._coated((at, varying), lambda: self._coats(at, own))
        return ShadedPoints(at.light, at.seen, viewed, coated.group, coated.colour, coated.shares)

    def _located(self, view: View, brushed: bool) -> PointLookups:
        scene = self.scene
        if isinstance(view, GBuffer):
            surface = (view.positions, view.frames, view.region.int(), view.colours, view.triangle, view.barycentric)
            pixels: PointLookups = self._pixels((view, brushed, watched(self)), lambda: self._of(*surface, brushed))
            return pixels

        def vertices() -> PointLookups:
            surface = (scene.points, scene.frames, scene.vertex_region.int(), scene.colours)
            return self._of(*surface, *scene.vertex_places, brushed)

        located: PointLookups = self._vertices((brushed, watched(self)), vertices)
        return located

    def _of(
        self,
        positions: Tensor,
        frames: Tensor,
        region: Tensor,
        colour: Tensor,
        triangle: Tensor,
        barycentric: Tensor,
        brushed: bool,
    ) -> PointLookups:
        if len(triangle) and int(triangle.max()) >= len(self.scene.faces):
            raise ValueError("view must be a GBuffer of this relighter's scene: GBuffer.of(scene, camera)")
        device = self.dull.device
        light = self._operations.of_frames(frames, self.frames.cpu(), self.twists, brushed)
        if self.atlas is not None:
            seen = self._operations.of_texels(self.atlas.corner_uv, triangle, barycentric, self.atlas.rows)
        else:
            seen = Near(self.scene.faces[triangle].int(), barycentric)
        light, seen = (Near(*(x.to(device) for x in found)) for found in (light, seen))
        surface = (positions, frames, region, colour, triangle, barycentric)
        return PointLookups(light, seen, *(x.to(device) for x in surface))

    def _coats(self, at: PointLookups, materials: list[SurfaceMaterial]) -> CoatedPoints:
        """What the points are coated with."""
        region, triangle, barycentric, colour = (x.cpu() for x in (at.region, at.triangle, at.barycentric, at.colour))
        most = max(len(group) for material in materials for group in material.groups)
        shares = torch.zeros(most, len(region), 3, dtype=torch.float32)
        groups = torch.zeros_like(region)
        colours = colour.clone()
        first = 0
        for number, material in enumerate(materials):
            rows = (region == number).nonzero()[:, 0]
            values = self.scene.map_values(material.maps, triangle[rows], barycentric[rows])
            found = material.at(values, colour[rows])
            groups[rows] = first + found.group.int()
            shares[: len(found.shares), rows] = found.shares
            colours[rows] = found.colour
            first += len(material.groups)
        return CoatedPoints(*(x.to(self.dull.device) for x in (groups, shares, colours)))

    @opaque
    def brdf_step(self, incident: Table, materials: list[SurfaceMaterial], points: None) -> Exitant:
        """The BRDFs of the regions' shapes, one after the other, and their weights, for every group of layers."""
        groups = [[material.layers[k] for k in group] for material in materials for group in material.groups]
        layers = list(zip_longest(*groups, fillvalue=NO_COAT))
        device = self.dull.device
        tables = [[None if m.shape is None else self._tables(m.shape, device) for m in layer] for layer in layers]
        distinct = list({id(table): table for layer in tables for table in layer if table is not None}.values())
        glossy: Table = self._glossy(distinct, lambda: _joined(distinct or [self._no_table()]))
        starts = {id(None): 0} | {id(table): self.views**2 * k for k, table in enumerate(distinct)}
        first = torch.tensor([[starts[id(table)] for table in layer] for layer in tables], dtype=torch.int32)
        diffuse = torch.stack([torch.stack([m.diffuse for m in layer]) for layer in layers]).to(self.dull)
        specular = torch.stack([torch.stack([m.specular for m in layer]) for layer in layers]).to(self.dull)
        coats = RegionCoats(diffuse, specular, first.to(device))
        return Exitant(Functions(incident, self.visibility, self.dull, glossy), coats)

    def view_step(self, exitant: Exitant, points: ShadedPoints, eye: Tensor) -> Tensor:
        """The triple product of light, visibility and BRDF at every point."""
        radiance: Tensor = self._operations.shade(*exitant, points)
        return radiance

    @uncompiled
    def prepared(
        self, environment: Environment | Table, materials: Mapping[str, SurfaceMaterial], view: View
    ) -> tuple[Functions, RegionCoats, ShadedPoints]:
        """What `ops.shade.shade` multiplies; the radiance is that function of these."""
        chosen = self.chosen(materials)
        points = self.points(view, eye_of(view, self.positions), chosen)
        return *self.exitant(environment, chosen, points), points

    def _table(self, shape: Shape) -> Table:
        """F (o, n) of a shape."""
        narrow = local.is_narrow(reflecting_all(shape).evaluate, self.grid)  # alike for all f0, in which F is linear
        table = local.brdf_table(shape.evaluate, self.grid, self.views, is_mirror_symmetric(shape), narrow)
        return Table(*(x.to(self.dull.device) for x in stored(table, self.storage)))

    def _no_table(self) -> Table:
        """Rows that a material without highlights points at."""
        return Table(self.dull.new_zeros(1, self.grid.cells, dtype=self.storage), self.dull.new_zeros(1))

    def _checked(self, light: Table) -> Table:
        expected = (len(self.frames) * self.twists, 3, self.grid.cells)
        if light.values.shape != expected:
            raise ValueError(f"light must be {expected}, rotated by this relighter, got {tuple(light.values.shape)}")
        return light


def _joined(tables: list[Table]) -> Table:
    """Tables one after the other."""
    return Table(*(in_large_pages(torch.cat(parts)) for parts in zip(*tables, strict=True)))


def turned(frames: Tensor, twists: int) -> Tensor:
    """Frames (f * twists, 3, 3) of frames (f, 3, 3): their tangents turned about the normal, evenly all around."""
    angle = torch.arange(twists, dtype=torch.float64) * (2 * math.pi / twists)
    c = angle.cos()
    s = angle.sin()
    o = torch.zeros_like(angle)
    turns = torch.stack((c, s, o, -s, c, o, o, o, o + 1), -1).reshape(-1, 3, 3).to(frames)
    return torch.einsum("tab,fbx->ftax", turns, frames).reshape(-1, 3, 3)


def _traced(scene: Scene, atlas: Atlas | None, grid: Geodesic, rays: int, progress: bool) -> Tensor:
    """Visibility (v, n) uint8 of every vertex, or (t, n) of every texel in use."""
    if atlas is None:
        points = scene.points
        frames = scene.frames
    else:
        points = atlas.interpolated(scene, scene.vertices)
        frames = scene.frames_at(atlas.triangle, atlas.barycentric)
    parts = []
    with tqdm(total=len(points), desc="visibility", unit=" points", disable=not progress) as bar:
        for some, turned_to in zip(points.split(BLOCK), frames.split(BLOCK), strict=True):
            parts.append(local.visibility(scene.surface, some, turned_to, grid, rays))
            bar.update(len(some))
    return torch.cat(parts)


def _check_memory(triangles: int, frames: int, views: int, points: int) -> None:
    need = triangles * ((6 + OPERATOR) * frames + 2 * views + points)
    if need > MEMORY:
        raise ValueError(
            f"{triangles} triangles take {need / 1e9:.1f} GB, of {MEMORY / 1e9:g}: {frames} frames of light, {views} "
            f"directions of view, {points} points; make level, normals, twists or views smaller, or the mesh or atlas"
        )
