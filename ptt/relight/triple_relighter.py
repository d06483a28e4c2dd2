"""Triple products in local frames (Ma et al. 2006): shadows of all frequencies, any material, per pixel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ptt import threads
from ptt.imaging.atlas import Atlas
from ptt.imaging.gbuffer import GBuffer
from ptt.light.environment import Environment
from ptt.materials.material import Material
from ptt.materials.shapes import Shape, is_mirror_symmetric, reflecting_all
from ptt.materials.varying import SurfaceMaterial
from ptt.models.cache import Cache, watched
from ptt.ops import haar, kinds, local, rotation
from ptt.ops.cells import Gloss
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.geodesic import Geodesic
from ptt.ops.hemispheres import Between
from ptt.ops.memory import in_large_pages
from ptt.ops.near import Near
from ptt.ops.octahedral import Octahedral
from ptt.ops.rotation import Resampling
from ptt.ops.shade import Functions, RegionCoats, ShadedPoints
from ptt.ops.table import Table, stored
from ptt.relight.glosses import WIDTHS, Glosses
from ptt.relight.light_step import LightStep, SplitLight
from ptt.relight.operations import operations
from ptt.relight.relighter import Relighter
from ptt.relight.shape_tables import ShapeTables
from ptt.relight.shining_points import LampLight, by_groups, shining
from ptt.relight.surface_points import SurfacePoints
from ptt.relight.triple_points import CoatedPoints, PointLookups, RelitPoints, coated, located
from ptt.relight.triple_tables import (
    BITS_OF_TEXELS,
    BITS_OF_VERTICES,
    check_memory,
    hemispheres,
    places_of,
    triangles,
    turned,
)
from ptt.relight.viewpoint import View, eye_of, from_anywhere, glow_of
from ptt.scene.scene import Scene

Storage = Literal["float", "16-bit", "8-bit"]
"""How light and BRDFs are kept: as they are, or a row at a time, each with a scale of its own."""

Highlights = Literal["lobes", "triangles"]
"""How highlights are reflected: by narrow lobes, with lamps apart, or as the paper has it, on the triangles."""

STORAGE = {"float": torch.float32, "16-bit": torch.float16, "8-bit": torch.uint8}
FINEST = 7  # level
PREROTATED = 64, 8  # cells along the edge of the light's map, and samples along that of a triangle
VIEWS = 4  # directions between which the BRDF is interpolated
FRAMES = 512  # that light is rotated to at once
NO_COAT = Material(0.0)


class RotatedLight(NamedTuple):
    """Under one light: it in every frame (f, 3, n); where lobes reflect, without its lamps, and the light as these see
    it, and how much of each lamp the places see (m, places)."""

    frames: Table
    split: SplitLight | None
    through: Tensor | None


class Exitant(NamedTuple):
    """With materials: the functions that are multiplied, and what the regions are coated with; the lobes of every
    layer of every group, none where the triangles have the highlights; the light."""

    functions: Functions
    coats: RegionCoats
    glosses: list[list[Gloss | None]]
    light: RotatedLight


@in_python
class TripleProductRelighter(Relighter):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view: visibility is mixed from the vertices'
    level: of the triangles that the three functions are given on: 1 for 80 of them, 2 for 320, 3 for 1280
    normals, twists: frames that light is rotated into: those of an octahedral map of normals, each turned about it
    source: cells along the edge of the light's octahedral map; None for three or more a triangle, 32 at least
    views: along the edge of the hemi-octahedral map of view directions; 90 x 90 are as many as the paper's 128 x 64
    rays: along the edge of a triangle, for visibility, a power of two
    highlights: by narrow lobes of each material, with lamps apart (`ptt.ops.gloss`), for which every vertex has 2.4 KB
        of what it sees, from some 5,000 rays, every texel 0.8 KB from 1,500; or on the triangles, as in the paper,
        faster, and blurred to their size
    lobes: so many of each material; None for 16, and 32 of a wide metal
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
    lights = (Environment, RotatedLight)
    sources_in_c = ("maps", "light", "rotation", "near", "shading", "cells", "gloss", "hemispheres")
    frames: Tensor
    starts: Tensor
    reads: Tensor
    visibility: Tensor
    seen: Tensor
    places: Tensor
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
        highlights: Highlights = "lobes",
        lobes: int | None = None,
        storage: Storage = "16-bit",
        atlas: Atlas | None = None,
        compiled: bool = True,
        progress: bool = False,
    ) -> None:
        kinds.check("scene", scene, Scene)
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
        if highlights not in get_args(Highlights):
            raise ValueError(f"highlights must be one of {', '.join(get_args(Highlights))}, got {highlights!r}")
        self.scene = scene
        self.atlas = atlas
        self.grid = Geodesic(level)
        self.storage = STORAGE[storage]
        self.twists = twists
        self.views = views
        source = max(32, 8 << level) if source is None else source
        own = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
        self.narrow = highlights == "lobes"
        places = places_of(scene, atlas)
        bits = BITS_OF_TEXELS if atlas else BITS_OF_VERTICES
        check_memory(self.grid.cells, len(own) * twists, views**2, len(places[0]), bits if self.narrow else 0)
        self.light = self._light_step(source)
        s = rotation.resampling(Octahedral(source), self.grid, turned(own, twists))
        none = torch.empty(0, 0, dtype=torch.int32)
        tables = {
            "frames": own.float(),
            "starts": s.starts,
            "reads": s.reads,
            "visibility": triangles(scene, places, self.grid, rays, progress),
            "seen": hemispheres(scene, places, bits, progress) if self.narrow else none,
            "places": places[1].float(),
            "dull": local.cosine(self.grid),
        }
        for name, tensor in tables.items():
            self.register_buffer(name, in_large_pages(tensor))
        self._vertices = Cache()
        self._pixels = Cache()
        self._viewed = Cache()
        self._coated = Cache()
        self._shining = Cache()
        self._lamps = Cache()
        self._glossy = Cache()
        self._tables: ShapeTables[Table] = ShapeTables(self._table)
        self._operations = operations(compiled)
        self._glosses = Glosses(lobes, self._operations)

    def _light_step(self, side: int) -> LightStep:
        return LightStep(Octahedral(side), WIDTHS if self.narrow else (), self.compiled, self.narrow)

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
    def incident(self, environment: Environment | RotatedLight) -> RotatedLight:
        """The light in every frame, or what `prerotated` made, as it is.

        Raises:
            ValueError: light that another relighter rotated.
        """
        if isinstance(environment, RotatedLight):
            return self._checked(environment)
        light: RotatedLight = super().incident(environment)
        return light

    @uncompiled
    def exitant(self, environment: Any, materials: Mapping[str, Any], points: Any = None) -> Exitant:
        """The result of the BRDF step, which is the same for all points: a change of view makes nothing anew."""
        exitant: Exitant = super().exitant(environment, materials)
        return exitant

    @uncompiled
    def light_step(self, environment: Environment) -> RotatedLight:
        """The light in every frame, by the rotation operator."""
        s = Resampling(self.starts, self.reads, rotation.SAMPLES)
        return self._lit(self.light, environment, lambda lighting: self._rotated(lighting, s))

    def prerotated(self, environment: Environment, progress: bool = False) -> RotatedLight:
        """The same from a finer map with more samples, as the paper's tables are made before anything is drawn.

        It is given to the relighter in place of the environment.
        """
        light = self._light_step(PREROTATED[0]).to(self.dull.device)
        return self._lit(light, environment, lambda lighting: self._finely_rotated(lighting, progress))

    def _lit(self, light: LightStep, environment: Environment, in_frames: Callable[[Tensor], Table]) -> RotatedLight:
        if not self.narrow:
            return RotatedLight(in_frames(light(environment)), None, None)
        split = light.with_lobes(environment)
        through = self._operations.lamps_seen(self.seen, self.places, split.lamps.areas, split.lamps.shares)
        return RotatedLight(in_frames(split.rest.light), split, through)

    def _finely_rotated(self, lighting: Tensor, progress: bool) -> Table:
        side, samples = PREROTATED
        parts = []
        frames = turned(self.frames.cpu().double(), self.twists)
        with tqdm(total=len(frames), desc="rotations", unit=" frames", disable=not progress) as bar:
            for some in frames.split(FRAMES):
                threads.share()
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
    def points(self, view: View, eye: Tensor, materials: Mapping[str, SurfaceMaterial]) -> RelitPoints:
        """Where the functions of vertices or pixels are found, seen from an eye."""
        own = list(materials.values())
        brushed = not self.narrow and not all(layer.isotropic for m in own for layer in m.layers)
        at = self._located(view, brushed)
        surface = at.surface
        varying = [len(m.layers) if isinstance(m, Material) else m for m in own]
        coats: CoatedPoints = self._coated((at, varying), lambda: coated(self.scene, surface, own))
        shaded = ShadedPoints(at.light, at.seen, self._viewed_from(at, eye), coats.group, coats.colour, coats.shares)
        shining = []
        if self.narrow:
            shining = self._shining((at, coats), lambda: by_groups(shaded, surface, self.places))
        return RelitPoints(shaded, surface.frames[:, 2], shining)

    def _viewed_from(self, at: PointLookups, eye: Tensor) -> Near:
        """Where BRDFs are found; where lobes have the highlights there are none."""
        if self.narrow:
            rows, weights = (x[:, :VIEWS] for x in at.light)
            return Near(torch.zeros_like(rows), torch.zeros_like(weights))
        frames, positions = at.surface.frames, at.surface.positions
        of_views = self._operations.of_views
        found: Near = self._viewed((at, eye), lambda: of_views(frames, positions, eye, self.views))
        return found

    def _located(self, view: View, brushed: bool) -> PointLookups:
        def of(surface: SurfacePoints) -> PointLookups:
            return located(self.scene, self.atlas, surface, self.frames, self.twists, brushed, self._operations)

        own = watched(self)
        if isinstance(view, GBuffer):
            inputs = from_anywhere(view), brushed, own
            pixels: PointLookups = self._pixels(inputs, lambda: of(SurfacePoints.of_pixels(view)))
            return pixels
        vertices: PointLookups = self._vertices((brushed, own), lambda: of(SurfacePoints.of_vertices(self.scene)))
        return vertices

    @opaque
    def brdf_step(self, incident: RotatedLight, materials: list[SurfaceMaterial], points: None) -> Exitant:
        """The BRDFs of the regions' shapes, one after the other, and their weights, for every group of layers."""
        groups = [[material.layers[k] for k in group] for material in materials for group in material.groups]
        layers = list(zip_longest(*groups, fillvalue=NO_COAT))
        diffuse = torch.stack([torch.stack([m.diffuse for m in layer]) for layer in layers]).to(self.dull)
        glossy, first, specular = self._no_table(1), torch.zeros(diffuse.shape[:2], dtype=torch.int32), diffuse * 0
        glosses: list[list[Gloss | None]] = []
        if self.narrow:
            glosses = [self._lobes_of(material, group) for material in materials for group in material.groups]
        else:
            glossy, first = self._of_shapes(layers)
            specular = torch.stack([torch.stack([m.specular for m in layer]) for layer in layers]).to(self.dull)
        coats = RegionCoats(diffuse, specular, first.to(self.dull.device))
        return Exitant(Functions(incident.frames, self.visibility, self.dull, glossy), coats, glosses, incident)

    def _lobes_of(self, material: SurfaceMaterial, group: Sequence[int]) -> list[Gloss | None]:
        """The lobes of a group of layers; all highlights of a material that is the same everywhere have common ones."""
        own = [material] if isinstance(material, Material) else [material.layers[k] for k in group]
        return [self._glosses(layer, self.dull) for layer in own]

    def _of_shapes(self, layers: list[tuple[Material, ...]]) -> tuple[Table, Tensor]:
        """The tables of the shapes of layers, one after the other, and the row where that of each begins."""
        device = self.dull.device
        tables = [[None if m.shape is None else self._tables(m.shape, device) for m in layer] for layer in layers]
        distinct = list({id(table): table for layer in tables for table in layer if table is not None}.values())
        glossy: Table = self._glossy(distinct, lambda: _joined(distinct or [self._no_table(self.views**2)]))
        starts = {id(None): 0} | {id(table): self.views**2 * k for k, table in enumerate(distinct)}
        return glossy, torch.tensor([[starts[id(table)] for table in layer] for layer in tables], dtype=torch.int32)

    def view_step(self, exitant: Exitant, points: RelitPoints, eye: Tensor) -> Tensor:
        """The triple product of light, visibility and BRDF at every point, and what comes of lamps and of lobes."""
        functions, coats, glosses, light = exitant
        if light.split is None:
            radiance: Tensor = self._operations.shade(functions, coats, points.shaded)
            return radiance
        lamps: LampLight = self._lamps((light, points), lambda: self._lamps_at(light, points))
        radiance = self._operations.shade(functions, coats, points.shaded, lamps.matt)
        return shining(points.shining, glosses, lamps, self.seen, eye, radiance, self._operations)

    def _lamps_at(self, light: RotatedLight, points: RelitPoints) -> LampLight:
        assert light.split is not None
        seen, lamps = points.shaded.seen, light.split.lamps
        between = Between(seen.rows, seen.weights, self.places)
        through = self._operations.lamps_between(light.through, between, lamps.directions)
        return LampLight(light.split, through, lamps.irradiance(points.normals.T, through) / math.pi)

    @uncompiled
    def prepared(
        self, environment: Environment | RotatedLight, materials: Mapping[str, SurfaceMaterial], view: View
    ) -> tuple[Functions, RegionCoats, ShadedPoints]:
        """What `ops.shade.shade` multiplies; the radiance, but for lamps and lobes, is that function of these."""
        chosen = self.chosen(materials)
        points = self.points(view, eye_of(view, self.positions), chosen)
        exitant = self.exitant(environment, chosen, points)
        return exitant.functions, exitant.coats, points.shaded

    def _table(self, shape: Shape) -> Table:
        """F (o, n) of a shape."""
        narrow = local.is_narrow(reflecting_all(shape).evaluate, self.grid)  # alike for all f0, in which F is linear
        table = local.brdf_table(shape.evaluate, self.grid, self.views, is_mirror_symmetric(shape), narrow)
        return Table(*(x.to(self.dull.device) for x in stored(table, self.storage)))

    def _no_table(self, rows: int) -> Table:
        """Rows that materials without highlights point at, where none has them."""
        return Table(self.dull.new_zeros(rows, self.grid.cells, dtype=self.storage), self.dull.new_zeros(rows))

    def _checked(self, light: RotatedLight) -> RotatedLight:
        expected = (len(self.frames) * self.twists, 3, self.grid.cells)
        places = len(self.places) if self.narrow else None
        got = None if light.through is None else light.through.shape[1]
        if light.frames.values.shape != expected or places != got:
            raise ValueError(
                f"light must be {expected}, rotated by this relighter, got {tuple(light.frames.values.shape)}"
            )
        return light


def _joined(tables: list[Table]) -> Table:
    """Tables one after the other."""
    return Table(*(in_large_pages(torch.cat(parts)) for parts in zip(*tables, strict=True)))
