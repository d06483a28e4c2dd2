"""Environment maps on any mesh, without precomputation of the scene (Wang et al. 2006): light, view, materials and
geometry change; the shadows of the scene are ambient occlusion, or none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ptt.imaging.gbuffer import GBuffer
from ptt.light.environment import Environment
from ptt.light.lamps import Lamps
from ptt.materials.material import Material
from ptt.materials.shapes import Shape, is_mirror_symmetric
from ptt.materials.varying import SurfaceMaterial
from ptt.models.cache import Cache, watched
from ptt.models.light_rotation import LightRotation
from ptt.ops import cells, haar, kinds, slices
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.octahedral import Octahedral, mix
from ptt.ops.slices import Slices
from ptt.relight.glosses import CELL, lamps_for
from ptt.relight.light_step import LightStep
from ptt.relight.operations import operations
from ptt.relight.relighter import Relighter
from ptt.relight.shape_tables import ShapeTables
from ptt.relight.sorted_points import LayeredPoints, SortedPoints, by_layers, whole
from ptt.relight.surface_points import SurfacePoints
from ptt.relight.viewpoint import View, from_anywhere, glow_of
from ptt.scene.scene import Scene

SIDE, NORMALS, TERMS = 128, 24, 128
"""Cells along an edge of the light's map, and normals along one of theirs, of the rotation by default; coefficients
kept of a slice, the largest number of the paper's 64, 96 and 128.

In a trial on a statue under four maps, GGX of roughness 0.2 to 0.7 erred by 4.7 % at most, with 64, 32 and 96 of these
by 7.8 (0.2), with 128, 16 and 128 by 5.5; a view of 104,000 vertices took 26, 24 and 30 ms, a light 30, 22 and 25.
"""

CHANNELS = 4  # Local light has three colours and a zero, which aligns them.


class LocalLight(NamedTuple):
    """Under one light without its lamps: local light (f, M, 4), and the irradiance (f, 4) of every sampled normal; the
    lamps, and what gives local light with them."""

    local: Tensor
    irradiance: Tensor
    lamps: Lamps
    whole: Callable[[], Tensor]


class Highlighted(NamedTuple):
    """A shape: its slices; the root of f as lamps take it (`ops.gloss.reflected_lamps`); how wide it is
    (`ops.cells.spread`)."""

    slices: Slices
    roots: Tensor
    spread: float

    @property
    def on_map(self) -> bool:
        """Whether it is so sharp that slices show lamps better."""
        return self.spread < CELL


class Reflected(NamedTuple):
    """A highlight in one region: local light as its slices take it, these and the first of each point, the root of f
    and the lamps apart (`glosses.lamps_for`), its weight."""

    light: Tensor
    slices: Slices
    first: Tensor
    roots: Tensor
    lamps: tuple[Tensor, Tensor, Tensor] | None
    weight: Tensor


class RegionExitant(NamedTuple):
    """With a material, in one region: diffuse radiance (v, 3), and what its highlights reflect."""

    diffuse: Tensor
    highlights: list[Reflected]


@in_python
class EnvMapRelighter(Relighter):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view
    rotation: of light into local frames, for normals; None for that of 128 x 128 cells and 24 x 24 normals
    terms: coefficients that are kept of every slice of a BRDF, None for 128 of them
    rank: in their place, products that approximate all slices together: good for dull shapes, and fast
    views: along the edge of the grid of view directions, for which there are slices
    twists: of a tangent against the sampled frames, for anisotropic shapes
    keep: coefficients of the light that are kept, of each channel; None for all
    occlusion (v,): what radiance is multiplied by, 0..1 (`ambient_occlusion`); None for no shadows
    lamps: says whether what is small and bright in the light is kept apart, and reflected by the BRDF itself, as if it
        came from one direction; else it is as wide as the cells of the map, as in the paper
    compiled: by kernels in C++, built on first use

    A new shape costs a second once, a brushed one half a minute. Differentiable in the map and in the weights of the
    materials.

    Example:
        >>> relighter = EnvMapRelighter(scene)
        >>> radiance = relighter(light.rotated(y=30), {"mesh": ptt.fitted("nickel")}, camera)
        >>> pixels = GBuffer.of(scene, camera)
        >>> pixels.image(relighter(light, {}, pixels), light).save("mesh.png")
    """

    sources_in_c = ("maps", "light", "rotation", "gloss")
    cosine: Tensor
    occlusion: Tensor

    def __init__(
        self,
        scene: Scene,
        rotation: LightRotation | None = None,
        *,
        terms: int | None = None,
        rank: int | None = None,
        views: int = 128,
        twists: int = 32,
        keep: int | None = None,
        occlusion: Tensor | None = None,
        lamps: bool = True,
        compiled: bool = True,
    ) -> None:
        kinds.check("scene", scene, Scene)
        super().__init__(compiled)
        rotation = LightRotation.build(SIDE, NORMALS, compiled=compiled) if rotation is None else rotation
        terms = min(TERMS, rotation.m**2) if terms is None else terms
        _check(scene, rotation, terms, rank, views, twists, keep, occlusion)
        self.scene = scene
        self.rotation = rotation
        self.terms = terms
        self.rank = rank
        self.views = views
        self.twists = twists
        self.keep = keep
        self.light = LightStep(Octahedral(rotation.n), (), compiled, lamps)
        self.register_buffer("cosine", slices.cosine(rotation.m).float(), persistent=False)
        shade = torch.ones(len(scene.vertices), dtype=torch.float32) if occlusion is None else occlusion.float()
        self.register_buffer("occlusion", shade, persistent=False)
        self.vertices = nn.ModuleList(self._sorted(scene.points))
        self._pixels = Cache()
        self._layered = Cache()
        self._tables: ShapeTables[Highlighted] = ShapeTables(self._highlighted)
        self._operations = operations(compiled)

    @property
    def materials(self) -> Mapping[str, SurfaceMaterial]:
        """The scene's own materials, by region."""
        return self.scene.materials

    @property
    def positions(self) -> Tensor:
        """The scene's vertices (v, 3), where they are lit."""
        return self.scene.points.to(self.cosine)

    def sources(self) -> list[nn.Module]:
        """The rotation, and what points there are."""
        return [self, self.rotation, *self.vertices]

    def glow(self, view: View) -> Tensor | None:
        """What vertices or pixels send out by themselves."""
        return glow_of(self.scene, view)

    def points(self, view: View, eye: Tensor, materials: Mapping[str, Any]) -> list[list[LayeredPoints]]:
        """The points of every region, vertices or pixels, by the layers that they have."""
        device = self.cosine.device
        parts = [part for part in self.vertices if isinstance(part, SortedPoints)]
        if isinstance(view, GBuffer):
            inputs = from_anywhere(view), watched(self)
            parts = self._pixels(inputs, lambda: [part.to(device) for part in self._sorted(view)])
        varying = [None if isinstance(m, Material) else m for m in materials.values()]
        if not any(varying):
            return [[whole(part, m)] for part, m in zip(parts, materials.values(), strict=True)]
        found: list[list[LayeredPoints]] = self._layered(
            (parts, varying, [len(m.layers) for m in materials.values()]),
            lambda: self._by_layers(view, parts, list(materials.values())),
        )
        return found

    def _by_layers(
        self, view: View, parts: list[SortedPoints], materials: list[SurfaceMaterial]
    ) -> list[list[LayeredPoints]]:
        surface = self._surface_of(view)
        frames = self.rotation.frames
        return [by_layers(part, m, self.scene, *surface, frames) for part, m in zip(parts, materials, strict=True)]

    def _surface_of(self, view: View) -> tuple[SurfacePoints, Tensor]:
        """The points that a view shows, and their occlusion (v,)."""
        occlusion = self.occlusion.cpu()
        if isinstance(view, GBuffer):
            return SurfacePoints.of_pixels(view), view.interpolated(self.scene, occlusion)
        return SurfacePoints.of_vertices(self.scene), occlusion

    def _sorted(self, view: View) -> list[SortedPoints]:
        """The points of every region."""
        surface, occlusion = self._surface_of(view)
        rows = [(surface.region == r).nonzero()[:, 0] for r in range(len(self.scene.regions))]
        return [SortedPoints.of(some, surface, occlusion, self.rotation.frames) for some in rows]

    @uncompiled
    def light_step(self, environment: Environment) -> LocalLight:
        """Light in the local frames of the sampled normals: R L."""
        light, lamps = self.light.without_lamps(environment)
        local = self._rotated(light)
        whole = cache(lambda: self._rotated(self.light(environment)) if len(lamps.directions) else local)
        return LocalLight(local, self.cosine @ local, lamps, whole)

    def _rotated(self, light: Tensor) -> Tensor:
        """Local light (f, M, 4) of L (3, n, n)."""
        if self.keep is not None:
            light = haar.truncate(light.flatten(1), self.keep).to_dense(light[0].numel()).reshape(light.shape)
        local: Tensor = self.rotation(nn.functional.pad(light, (0, 0, 0, 0, 0, CHANNELS - len(light))))
        return local

    @opaque
    def brdf_step(
        self, incident: LocalLight, materials: list[SurfaceMaterial], points: list[list[LayeredPoints]]
    ) -> list[RegionExitant]:
        """What the slices of each region's shapes are multiplied by, and what its diffuse part sends out."""
        # One shape may be a layer of several groups
        projected = cache(lambda of: slices.project(incident.whole() if of.on_map else incident.local, of.slices))
        return [
            self._exitant_of(incident, part, [material.layers[k] for k in part.layers], projected)
            for parts, material in zip(points, materials, strict=True)
            for part in parts
        ]

    def _exitant_of(
        self,
        incident: LocalLight,
        part: LayeredPoints,
        layers: Sequence[Material],
        projected: Callable[[Highlighted], Tensor],
    ) -> RegionExitant:
        points = part.points
        lookup = points.lookup
        irradiance = mix(incident.irradiance, lookup.near.T.long(), lookup.weights.T)[:, :3]
        irradiance = irradiance + incident.lamps.irradiance(lookup.normal)
        shares = [irradiance.new_ones(1)] * len(layers) if part.shares is None else list(part.shares)
        albedo = torch.stack(
            [layer.diffuse.to(irradiance) * share for layer, share in zip(layers, shares, strict=True)]
        )
        diffuse = albedo.sum(0) / math.pi * part.colour * points.occlusion * irradiance
        highlights = []
        for layer, share in zip(layers, shares, strict=True):
            for highlight in layer.highlights:
                made = self._tables(highlight.shape, self.cosine.device)
                first = slices.first_slice(made.slices, lookup.twist)
                lamps = None if made.on_map else lamps_for(made.spread, incident.lamps)
                weight = highlight.colour.to(diffuse) * share * points.occlusion
                highlights.append(Reflected(projected(made), made.slices, first, made.roots, lamps, weight))
        return RegionExitant(diffuse, highlights)

    def view_step(self, exitant: list[RegionExitant], points: list[list[LayeredPoints]], eye: Tensor) -> Tensor:
        """Each point's slice of its view direction times the local light, between four normals."""
        parts = [part.points for own in points for part in own]
        out = self.cosine.new_zeros(sum(part.count for part in parts), 3)
        for part, sent in zip(parts, exitant, strict=True):
            weights = [highlight.weight for highlight in sent.highlights]
            reflected = [self._reflected(part, highlight, eye) for highlight in sent.highlights]
            out = with_region(out, part.rows[: part.count], sent.diffuse, weights, reflected)
        return out

    def _reflected(self, points: SortedPoints, sent: Reflected, eye: Tensor) -> Tensor:
        """What a highlight reflects (v, 3)."""
        toward = eye if eye.ndim == 1 else eye[points.rows].T
        by_slices: Tensor = self._operations.reflected(
            sent.light, sent.slices, sent.first, self.rotation.frames, points.lookup, toward
        )[:, :3]
        if sent.lamps is None or not len(sent.lamps[0]):
            return by_slices
        directions, powers, _ = sent.lamps
        of_lamps: Tensor = self._operations.reflected_lamps(
            points.position, points.frames, points.dip, toward, sent.roots, directions, powers
        )
        return by_slices + of_lamps

    def _highlighted(self, shape: Shape) -> Highlighted:
        sampled = cells.sampled(lambda wi, wo: shape.evaluate(wi, wo)[..., None].expand(wi.shape), shape.isotropic)
        roots = cells.roots(sampled).contiguous().to(self.cosine.device)
        return Highlighted(self.slices_of(shape), roots, cells.spread(sampled))

    def slices_of(self, shape: Shape) -> Slices:
        """The slices of a shape; a subclass may return others (`Slices.with_tensorly`)."""
        twists = 1 if shape.isotropic else self.twists
        make = slices.tabulate if self.rank is None else slices.factorise
        kept = self.terms if self.rank is None else self.rank
        return make(shape.evaluate, self.rotation.m, self.views, kept, twists, is_mirror_symmetric(shape)).to(
            self.cosine.device
        )


def with_region(
    out: Tensor, rows: Tensor, diffuse: Tensor, weights: Sequence[Tensor], reflected: Sequence[Tensor]
) -> Tensor:
    """Radiance (v, 3) with that of the rows of one region, whose points come first in the other tensors."""
    for weight, light in zip(weights, reflected, strict=True):
        diffuse = torch.addcmul(diffuse, weight, light)
    return out.index_copy(0, rows, diffuse[: len(rows)])


def _check(
    scene: Scene,
    rotation: LightRotation,
    terms: int,
    rank: int | None,
    views: int,
    twists: int,
    keep: int | None,
    occlusion: Tensor | None,
) -> None:
    if rotation.normals is None:
        raise ValueError("rotation must be for normals: LightRotation.build(n, normals=32), not for given frames")
    if rotation.m > 128:
        raise ValueError(f"rotation.m must be at most 128, got {rotation.m}: slices count their terms in 16 bits")
    bounds = {"terms": (terms, rotation.m**2), "views": (views, 1024), "twists": (twists, 1024)}
    given = {"rank": (rank, rotation.m**2), "keep": (keep, rotation.n**2)}
    bounds |= {name: (value, most) for name, (value, most) in given.items() if value is not None}
    for name, (value, most) in bounds.items():
        if not 1 <= value <= most:
            raise ValueError(f"{name} must be in 1..{most}, got {value}")
    if occlusion is None:
        return
    fits = occlusion.shape == (len(scene.vertices),)
    if not fits or not bool(((occlusion >= 0) & (occlusion <= 1)).all()):
        raise ValueError(f"occlusion must be ({len(scene.vertices)},) in 0..1, got {tuple(occlusion.shape)}")
