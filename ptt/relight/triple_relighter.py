"""Triple products in local frames (Ma et al. 2006): shadows of all frequencies, any material, per pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ptt.imaging.atlas import Atlas
from ptt.imaging.gbuffer import GBuffer
from ptt.light import prefiltered as light_maps
from ptt.light.environment import Environment
from ptt.light.prefiltered import LightMaps
from ptt.materials.material import Material, Mixed, materials_of_regions
from ptt.materials.shapes import Shape, is_mirror_symmetric
from ptt.models.cache import Cache, watched
from ptt.ops import haar, local, native, near, relight, rotation, shade
from ptt.ops.geodesic import Geodesic
from ptt.ops.memory import in_large_pages
from ptt.ops.near import Near
from ptt.ops.octahedral import Octahedral
from ptt.ops.rotation import Resampling
from ptt.ops.shade import Coats, Functions, Points
from ptt.ops.table import Table, stored
from ptt.relight.shape_tables import ShapeTables
from ptt.relight.viewpoint import View, toward
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


class Located(NamedTuple):
    """Points that are shaded: their light and visibility, and their surface.

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


class TripleProductRelighter(nn.Module):
    """relighter(light, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view: visibility is mixed from the vertices'
    level: of the triangles that the three functions are given on: 1 for 80 of them, 2 for 320, 3 for 1280
    normals, twists: frames that light is rotated into: those of an octahedral map of normals, each turned about it
    source: cells along the edge of the light's octahedral map; None for three or more a triangle, 32 at least
    views: along the edge of the hemi-octahedral map of view directions; 90 x 90 are as many as the paper's 128 x 64
    rays: along the edge of a triangle, for visibility, a power of two
    storage: of light and BRDFs (`Storage`); visibility has 8 bits
    atlas: texels that hold visibility, for meshes too coarse for shadows; None for that of the vertices
    compiled: by kernels in C++
    progress: a bar while visibility is traced

    Light, materials and view change apart from each other; results are kept for as long as what they were made from is
    unchanged. Differentiable in the map and in the weights of the materials.

    Departures from the paper: normals lie on an octahedral map, 22 x 22 for its 32 x 16, so that poles are no
    exception, and the tangent's angle is that to a normal's own frame; light is rotated on the fly, from three cells a
    triangle or more, in place of tables that take minutes (`prerotated` makes them).

    Example:
        >>> relighter = TripleProductRelighter(scene, level=1)
        >>> pixels = GBuffer.of(scene, camera)
        >>> pixels.image(relighter(light.rotated(y=30), {}, pixels), light).save("scene.png")
    """

    frames: Tensor
    starts: Tensor
    reads: Tensor
    visibility: Tensor
    dull: Tensor
    directions: Tensor
    shares: Tensor

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
        super().__init__()
        limits = ("level", level, 0, FINEST), ("twists", twists, 1, 256), ("views", views, 1, 512)
        for name, value, least, most in limits:
            if not least <= value <= most:
                raise ValueError(f"{name} must be in {least}..{most}, got {value}")
        if storage not in STORAGE:
            raise ValueError(f"storage must be one of {', '.join(STORAGE)}, got {storage!r}")
        self.scene = scene
        self.atlas = atlas
        self.grid = Geodesic(level)
        self.storage = STORAGE[storage]
        source = max(32, 8 << level) if source is None else source
        self.normals = normals
        self.twists = twists
        self.source = source
        self.views = views
        self.compiled = compiled
        own = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
        _check_memory(self.grid.cells, len(own) * twists, views**2, len(atlas.triangle if atlas else scene.vertices))
        s = rotation.resampling(Octahedral(source), self.grid, turned(own, twists))
        traced = _traced(scene, atlas, self.grid, rays, progress)
        tables = {"frames": own.float(), "starts": s.starts, "reads": s.reads, "visibility": traced}
        tables |= {"dull": local.cosine(self.grid)}
        tables |= dict(zip(("directions", "shares"), light_maps.samples(Octahedral(source)), strict=True))
        for name, tensor in tables.items():
            self.register_buffer(name, in_large_pages(tensor))
        self._fine = Cache()
        self._light = Cache()
        self._vertices = Cache()
        self._pixels = Cache()
        self._view = Cache()
        self._second = Cache()
        self._glossy = Cache()
        self._tables: ShapeTables[Table] = ShapeTables(self._table)

    def forward(
        self, light: Environment | Table, materials: Mapping[str, Material | Mixed], view: View | GBuffer
    ) -> Tensor:
        """Radiance (v, 3) of every vertex, or (p, 3) of every pixel of a `GBuffer`, toward the viewer.

        light: an environment, or what `incident` or `prerotated` made of one
        materials: by region; a region that is left out has the scene's own
        view: a Camera, an eye (3,), directions (v, 3) from the vertices to the viewer, or a GBuffer

        Raises:
            ValueError: an unknown region, a view of another shape, light of another relighter, or a shape whose
                parameters carry gradients.
        """
        radiance: Tensor = (native if self.compiled else shade).shade(*self.prepared(light, materials, view))
        return radiance

    def prepared(
        self, light: Environment | Table, materials: Mapping[str, Material | Mixed], view: View | GBuffer
    ) -> tuple[Functions, Coats, Points]:
        """What `ops.shade.shade` multiplies; `forward` is that function of these."""
        own = list(materials_of_regions(self.scene.materials, materials, mixed=True).values())
        at = self._located(view, brushed=any(map(_brushed, own)))
        eye = (
            torch.tensor(view.camera.eye).to(at.positions) if isinstance(view, GBuffer) else toward(view, at.positions)
        )
        ops = native if self.compiled else near
        seen_from: Near = self._view((at, eye), lambda: ops.of_views(at.frames, at.positions, eye, self.views))
        second: Tensor = self._second((at, own), lambda: self._shares(at, own))
        coats, glossy = self._coats(own)
        rotated = self._checked(light) if isinstance(light, Table) else self.incident(light)
        points = Points(at.light, at.seen, seen_from, at.region, at.colour, second)
        return Functions(rotated, self.visibility, self.dull, glossy), coats, points

    def incident(self, environment: Environment) -> Table:
        """Light step: the light (f, 3, n) in every frame, by the rotation operator."""
        maps: LightMaps = self._fine(environment.map, lambda: light_maps.light_maps(environment, ()))
        inputs = environment, watched(self)
        s = Resampling(self.starts, self.reads, rotation.SAMPLES)
        rotated: Table = self._light(
            inputs,
            lambda: self._rotated(maps.fine.to(self.dull), environment, self.source, s, self.directions, self.shares),
        )
        return rotated

    def prerotated(self, environment: Environment, progress: bool = False) -> Table:
        """The same from a finer map with more samples, as the paper's tables are made before anything is drawn."""
        side, samples = PREROTATED
        maps = light_maps.light_maps(environment, ())
        parts = []
        directions, shares = (x.to(self.dull) for x in light_maps.samples(Octahedral(side)))
        frames = turned(self.frames.cpu().double(), self.twists)
        with tqdm(total=len(frames), desc="rotations", unit=" frames", disable=not progress) as bar:
            for some in frames.split(FRAMES):
                s = rotation.resampling(Octahedral(side), self.grid, some, samples)
                s = Resampling(s.starts.to(self.dull.device), s.reads.to(self.dull.device), samples)
                parts.append(self._rotated(maps.fine.to(self.dull), environment, side, s, directions, shares))
                bar.update(len(some))
        return Table(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def _rotated(
        self, fine: Tensor, environment: Environment, n: int, s: Resampling, directions: Tensor, shares: Tensor
    ) -> Table:
        turn = environment.rotation.to(fine)
        lighting = (native if self.compiled else relight).lighting
        values = haar.synthesise(lighting(fine, turn, directions, shares, (n, n))).flatten(1).T.contiguous()
        ops = native if self.compiled else rotation
        table: Table = ops.resampled_values(values, s, self.grid.cells, self.storage)
        return table

    def _located(self, view: View | GBuffer, brushed: bool) -> Located:
        scene = self.scene
        if isinstance(view, GBuffer):
            surface = view.positions, view.frames, view.region.int(), view.colours, view.triangle, view.barycentric
            located: Located = self._pixels((view, brushed, watched(self)), lambda: self._of(*surface, brushed))
            return located

        def vertices() -> Located:
            corner = torch.zeros(len(scene.vertices), dtype=torch.int64)
            corner[scene.faces.flatten()] = torch.arange(scene.faces.numel())
            where = corner // 3, nn.functional.one_hot(corner % 3, 3).float()
            return self._of(scene.points, scene.frames, scene.vertex_region.int(), scene.colours, *where, brushed)

        located = self._vertices((brushed, watched(self)), vertices)
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
    ) -> Located:
        if len(triangle) and int(triangle.max()) >= len(self.scene.faces):
            raise ValueError("view must be a GBuffer of this relighter's scene: GBuffer.of(scene, camera)")
        ops = native if self.compiled else near
        device = self.dull.device
        light = ops.of_frames(frames, self.frames.cpu(), self.twists, brushed)
        if self.atlas is not None:
            seen = ops.of_texels(self.atlas.corner_uv, triangle, barycentric, self.atlas.rows)
        else:
            seen = Near(self.scene.faces[triangle].int(), barycentric)
        light, seen = (Near(*(x.to(device) for x in found)) for found in (light, seen))
        surface = positions, frames, region, colour, triangle, barycentric
        return Located(light, seen, *(x.to(device) for x in surface))

    def _shares(self, at: Located, own: list[Material | Mixed]) -> Tensor:
        """How much of its region's second material is at each point (p,)."""
        second = torch.zeros(len(at.region))
        for region, material in enumerate(own):
            if isinstance(material, Mixed):
                rows = (at.region == region).nonzero()[:, 0].cpu()
                second[rows] = self.scene.share_at(material.share, at.triangle.cpu()[rows], at.barycentric.cpu()[rows])
        return second.to(self.dull.device)

    def _coats(self, own: list[Material | Mixed]) -> tuple[Coats, Table]:
        """The materials of every region, and the BRDFs of their shapes one after the other."""
        pairs = [(m.first, m.second) if isinstance(m, Mixed) else (m, m) for m in own]
        layers = list(zip(*pairs, strict=True))[: 1 + any(isinstance(m, Mixed) for m in own)]
        tables = [[self._tables(m.shape, self.dull.device) for m in layer] for layer in layers]
        distinct = list({id(table): table for layer in tables for table in layer}.values())
        glossy: Table = self._glossy(
            distinct, lambda: Table(*(in_large_pages(torch.cat(x)) for x in zip(*distinct, strict=True)))
        )
        starts = {id(table): self.views**2 * k for k, table in enumerate(distinct)}
        first = torch.tensor([[starts[id(table)] for table in layer] for layer in tables], dtype=torch.int32)
        diffuse, specular = (
            torch.stack([torch.stack([getattr(m, name) for m in layer]) for layer in layers]).to(self.dull)
            for name in ("diffuse", "specular")
        )
        return Coats(diffuse, specular, first.to(self.dull.device)), glossy

    def _table(self, shape: Shape | None) -> Table:
        """F (o, n) of a shape."""
        if shape is None:
            table = torch.zeros(self.views**2, self.grid.cells)
        else:
            table = local.brdf_table(shape.evaluate, self.grid, self.views, is_mirror_symmetric(shape))
        return Table(*(x.to(self.dull.device) for x in stored(table, self.storage)))

    def _checked(self, light: Table) -> Table:
        expected = len(self.frames) * self.twists, 3, self.grid.cells
        if light.values.shape != expected:
            raise ValueError(f"light must be {expected}, rotated by this relighter, got {tuple(light.values.shape)}")
        return light


def _brushed(material: Material | Mixed) -> bool:
    """Whether a material looks another way when it is turned: then light is interpolated between twists too."""
    both = (material.first, material.second) if isinstance(material, Mixed) else (material,)
    return any(m.shape is not None and not m.shape.isotropic for m in both)


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
