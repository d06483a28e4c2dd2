"""Triple products in local frames (Ma et al. 2006): shadows of all frequencies, any material, per pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ptt.atlas import Atlas
from ptt.environment import Environment
from ptt.gbuffer import GBuffer
from ptt.materials import Material, dressed
from ptt.models import light_maps
from ptt.models.cache import Cache, watched
from ptt.models.light_maps import LightMaps
from ptt.models.shape_tables import ShapeTables
from ptt.models.viewing import View, toward
from ptt.ops import haar, local, native, relight, rotation, shade, slices
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.rotation import Resampling
from ptt.ops.shade import Points, Tables
from ptt.path_tracer import orthonormal
from ptt.scene import Scene
from ptt.shapes import Shape

BLOCK = 2048  # points whose visibility is traced at once


class Rotated(NamedTuple):
    """Light (f, c, n) in every frame, times 1 / unit."""

    light: Tensor
    unit: float


class Shaded(NamedTuple):
    """Points that are shaded: their frames of light, their rows of visibility, and their surface.

    near (4, p) int32, weights (4, p); seen (j, p) int32, shares (j, p)
    positions (p, 3), frames (p, 3, 3), colours (p, 3), region (p,)
    """

    near: Tensor
    weights: Tensor
    seen: Tensor
    shares: Tensor
    positions: Tensor
    frames: Tensor
    colours: Tensor
    region: Tensor


class TripleProductRelighter(nn.Module):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view: visibility is mixed from the vertices'
    level: of the triangles that the three functions are given on: 1 for 80 of them, 2 for 320, 3 for 1280
    normals, twists: frames that light is rotated into: those of an octahedral map of normals, each turned about it
    source: cells along the edge of the light's octahedral map
    views: along the edge of the hemi-octahedral map of view directions; 90 x 90 are as many as the paper's 128 x 64
    rays: along the edge of a triangle, for visibility, a power of two
    compiled: by kernels in C++
    atlas: texels that hold visibility, for meshes too coarse for shadows; None for that of the vertices
    progress: a bar while visibility is traced

    Light, materials and view change apart from each other; results are kept for as long as what they were made from is
    unchanged. Differentiable in the map and in the weights of the materials.

    Departures from the paper: normals lie on an octahedral map, 22 x 22 for its 32 x 16, so that poles are no
    exception, and the tangent's angle is that to a normal's own frame; light is rotated on the fly, from about 6 or 12
    cells a triangle, in place of tables that take minutes.

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
        source: int = 32,
        views: int = 90,
        rays: int = 2,
        compiled: bool = True,
        atlas: Atlas | None = None,
        progress: bool = False,
    ) -> None:
        super().__init__()
        for name, value, least, most in (("level", level, 0, 4), ("twists", twists, 1, 256), ("views", views, 1, 512)):
            if not least <= value <= most:
                raise ValueError(f"{name} must be in {least}..{most}, got {value}")
        self.scene, self.atlas, self.grid, self.compiled = scene, atlas, Geodesic(level), compiled
        self.normals, self.twists, self.source, self.views = normals, twists, source, views
        own = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
        s = rotation.resampling(Octahedral(source), self.grid, turned(own, twists))
        traced = _traced(scene, atlas, self.grid, rays, progress)
        tables = {"frames": own.float(), "starts": s.starts, "reads": s.reads, "visibility": traced}
        tables |= {"dull": local.cosine(self.grid)}
        tables |= dict(zip(("directions", "shares"), light_maps.samples(Octahedral(source)), strict=True))
        for name, tensor in tables.items():
            self.register_buffer(name, tensor)
        self._fine, self._light, self._placed, self._pixels, self._points = (Cache() for _ in range(5))
        self._tables, self._glossy = ShapeTables(self._table), Cache()

    def forward(self, environment: Environment, materials: Mapping[str, Material], view: View | GBuffer) -> Tensor:
        """Radiance (v, 3) of every vertex, or (p, 3) of every pixel of a `GBuffer`, toward the viewer.

        materials: by region; a region that is left out has the scene's own
        view: a Camera, an eye (3,), directions (v, 3) from the vertices to the viewer, or a GBuffer

        Raises:
            ValueError: an unknown region, a view of another shape, or a shape whose parameters carry gradients.
        """
        own = list(dressed(self.scene.materials, materials).values())
        if isinstance(view, GBuffer):
            at: Shaded = self._pixels(view, lambda: self._of_pixels(view))
            eye = torch.tensor(view.camera.eye).to(at.positions)
        else:
            at = self._placed(watched(self), self._of_vertices)
            eye = toward(view, at.positions)
        rotated = self.incident(environment)
        tables = [self._tables(m.shape, self.dull.device) for m in own]
        glossy: Tensor = self._glossy(tables, lambda: torch.cat(tables))
        points: Points = self._points((at, eye, own), lambda: self._dressed(at, eye, own))
        functions = Tables(rotated.light, rotated.unit, self.visibility, self.dull, glossy)
        radiance: Tensor = (native if self.compiled else shade).shade(functions, points)
        return radiance

    def incident(self, environment: Environment) -> Rotated:
        """Light step: the light in every frame."""
        maps: LightMaps = self._fine(environment.map, lambda: light_maps.light_maps(environment, ()))
        inputs = environment, watched(self)
        rotated: Rotated = self._light(inputs, lambda: self._rotated(maps.fine.to(self.dull), environment))
        return rotated

    def _rotated(self, fine: Tensor, environment: Environment) -> Rotated:
        n, turn = self.source, environment.rotation.to(fine)
        lighting = (native if self.compiled else relight).lighting
        values = haar.synthesise(lighting(fine, turn, self.directions, self.shares, (n, n))).flatten(1).T
        s = Resampling(self.starts, self.reads, rotation.SAMPLES)
        ops = native if self.compiled else rotation
        return Rotated(*ops.resampled_values(values.contiguous(), s, self.grid.cells))

    def _of_vertices(self) -> Shaded:
        scene, v = self.scene, len(self.scene.vertices)
        seen, shares = torch.arange(v, dtype=torch.int32)[None], torch.ones(1, v)
        if self.atlas is not None:
            corner = torch.zeros(v, dtype=torch.int64)
            corner[scene.faces.flatten()] = torch.arange(scene.faces.numel())
            seen, shares = self.atlas.corners(corner // 3, nn.functional.one_hot(corner % 3, 3).float())
        return self._shaded(scene.points, scene.frames, scene.colours, scene.vertex_region, seen, shares)

    def _of_pixels(self, pixels: GBuffer) -> Shaded:
        if self.atlas is None:
            seen, shares = self.scene.faces[pixels.triangle].T.int().contiguous(), pixels.barycentric.T.contiguous()
        else:
            seen, shares = self.atlas.corners(pixels.triangle, pixels.barycentric)
        return self._shaded(pixels.positions, pixels.frames, pixels.colours, pixels.region, seen, shares)

    def _shaded(
        self, positions: Tensor, frames: Tensor, colours: Tensor, region: Tensor, seen: Tensor, shares: Tensor
    ) -> Shaded:
        at = slices.located(positions, frames, self.frames.cpu())
        twist = (at.twist * (self.twists / (2 * math.pi))).round().int() % self.twists
        near = at.near * self.twists + twist
        parts = near, at.weights, seen, shares, positions, frames, colours, region
        return Shaded(*(x.to(self.dull.device) for x in parts))

    def _dressed(self, at: Shaded, eye: Tensor, materials: list[Material]) -> Points:
        """What depends on the view and on the materials' colours."""
        away = (eye - at.positions) if eye.ndim == 1 else eye
        wo = torch.einsum("pax,px->pa", at.frames, nn.functional.normalize(away, dim=1))
        cell = HemiOctahedral(self.views).cell(torch.where((wo == 0).all(1, keepdim=True), 1.0, wo))
        view = (at.region * self.views**2 + cell).int()[None]
        diffuse = torch.stack([m.diffuse for m in materials]).to(self.dull)[at.region]
        specular = torch.stack([m.specular for m in materials]).to(self.dull)[at.region]
        return Points(at.near, at.weights, at.seen, at.shares, view, specular[None], diffuse * at.colours)

    def _table(self, shape: Shape | None) -> Tensor:
        """F (o, n) of a shape in float16."""
        wo = HemiOctahedral(self.views).directions().reshape(-1, 3)
        black = torch.zeros(len(wo), self.grid.cells)
        table = black if shape is None else local.brdf(shape.evaluate, self.grid, wo)
        return table.half().to(self.dull.device)


def turned(frames: Tensor, twists: int) -> Tensor:
    """Frames (f * twists, 3, 3) of frames (f, 3, 3): their tangents turned about the normal, evenly all around."""
    angle = torch.arange(twists, dtype=torch.float64) * (2 * math.pi / twists)
    c, s, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    turns = torch.stack((c, s, o, -s, c, o, o, o, o + 1), -1).reshape(-1, 3, 3).to(frames)
    return torch.einsum("tab,fbx->ftax", turns, frames).reshape(-1, 3, 3)


def _traced(scene: Scene, atlas: Atlas | None, grid: Geodesic, rays: int, progress: bool) -> Tensor:
    """Visibility (v, n) uint8 of every vertex, or (t, n) of every texel in use."""
    if atlas is None:
        points, frames = scene.points, scene.frames
    else:
        points = atlas.mixed(scene, scene.vertices)
        frames = orthonormal(atlas.mixed(scene, scene.normals), atlas.mixed(scene, scene.tangents))
    parts = []
    with tqdm(total=len(points), desc="visibility", unit=" points", disable=not progress) as bar:
        for some, turned_to in zip(points.split(BLOCK), frames.split(BLOCK), strict=True):
            parts.append(local.visibility(scene.surface, some, turned_to, grid, rays))
            bar.update(len(some))
    return torch.cat(parts)
