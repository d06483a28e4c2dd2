"""Environment maps on any mesh, without precomputation of the scene (Wang et al. 2006): light, view, materials and
geometry change; the shadows of the scene are ambient occlusion, or none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.imaging.gbuffer import GBuffer
from ptt.light import prefiltered as light_maps
from ptt.light.environment import Environment
from ptt.light.prefiltered import LightMaps
from ptt.materials.material import Material, materials_of_regions
from ptt.materials.shapes import Shape
from ptt.models.cache import Cache, watched
from ptt.models.light_rotation import LightRotation
from ptt.ops import haar, native, relight, slices
from ptt.ops.octahedral import Octahedral, mix
from ptt.ops.slices import ALIGNED, Located, Slices
from ptt.relight.shape_tables import ShapeTables
from ptt.relight.viewpoint import View, toward
from ptt.scene.scene import Scene

TERMS = 96
CHANNELS = 4  # of local light: colours and a zero, which aligns them


class Lit(NamedTuple):
    """Under one light: local light (f, M, 4), and the irradiance (f, 4) of every sampled normal."""

    local: Tensor
    irradiance: Tensor


class Surface(NamedTuple):
    """Points of any kind: positions (v, 3), frames (v, 3, 3), colours (v, 3), occlusion (v,)."""

    positions: Tensor
    frames: Tensor
    colours: Tensor
    occlusion: Tensor


class Sent(NamedTuple):
    """Of one region: local light as its slices take it, these (none for a dull one), and diffuse radiance (v, 3)."""

    light: Tensor
    cut: Slices | None
    diffuse: Tensor
    specular: Tensor


class Placed(nn.Module):
    """The points of one region, sorted by the normal that is nearest, so that the local light stays in the cache.

    rows (v,): which they are; beyond the count of points the last one again, until v is a multiple of `ALIGNED`
    colour (v, 3), occlusion (v, 1): of the surface
    """

    rows: Tensor
    colour: Tensor
    occlusion: Tensor

    def __init__(self, count: int, rows: Tensor, at: Located, colour: Tensor, occlusion: Tensor) -> None:
        super().__init__()
        self.count = count
        for name, tensor in {"rows": rows, "colour": colour, "occlusion": occlusion, **at._asdict()}.items():
            self.register_buffer(name, tensor, persistent=False)
        self.first = Cache()

    @classmethod
    def of(cls, rows: Tensor, surface: Surface, sampled: Tensor) -> Placed:
        """Those rows of a surface among sampled frames (f, 3, 3)."""
        nearest = Octahedral(math.isqrt(len(sampled))).cell(surface.frames[rows, 2])
        rows, count = rows[nearest.argsort(stable=True)], len(rows)
        rows = torch.cat((rows, rows[-1:].expand(-len(rows) % ALIGNED)))
        positions, frames, colour, occlusion = (x[rows] for x in surface)
        return cls(count, rows, slices.located(positions, frames, sampled), colour, occlusion[:, None])

    @property
    def at(self) -> Located:
        """Among the sampled normals."""
        return Located(*(self.get_buffer(name) for name in Located._fields))


class EnvMapRelighter(nn.Module):
    """relighter(environment, materials, view) -> radiance (v, 3), linear RGB, in the map's units.

    scene: whose vertices are relit; per pixel, give a `GBuffer` as the view
    rotation: of light into local frames, for normals; None for `LightRotation.build()`
    terms: coefficients that are kept of every slice of a BRDF, None for `TERMS` of them
    rank: in their place, products that approximate all slices together: good for dull shapes, and fast
    views: along the edge of the grid of view directions, for which there are slices
    twists: of a tangent against the sampled frames, for anisotropic shapes
    keep: coefficients of the light that are kept, of each channel; None for all
    occlusion (v,): what radiance is multiplied by, 0..1 (`ambient_occlusion`); None for no shadows

    Steps in C++ where the rotation is compiled. Results are kept for as long as what they were made from is unchanged;
    a new shape costs a second once. Differentiable in the map and in the weights of the materials.

    Example:
        >>> relighter = EnvMapRelighter(scene, LightRotation.build(compiled=True))
        >>> radiance = relighter(light.rotated(y=30), {"mesh": ptt.fitted("nickel")}, camera)
        >>> pixels = GBuffer.of(scene, camera)
        >>> pixels.image(relighter(light, {}, pixels), light).save("mesh.png")
    """

    cosine: Tensor
    directions: Tensor
    shares: Tensor
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
    ) -> None:
        super().__init__()
        rotation = LightRotation.build() if rotation is None else rotation
        terms = min(TERMS, rotation.m**2) if terms is None else terms
        _check(scene, rotation, terms, rank, views, twists, keep, occlusion)
        self.scene = scene
        self.rotation = rotation
        self.terms = terms
        self.rank = rank
        self.views = views
        self.twists = twists
        self.keep = keep
        for name, samples in zip(("directions", "shares"), light_maps.samples(Octahedral(rotation.n)), strict=True):
            self.register_buffer(name, samples, persistent=False)
        self.register_buffer("cosine", slices.cosine(rotation.m).float(), persistent=False)
        shade = torch.ones(len(scene.vertices)) if occlusion is None else occlusion.float()
        self.register_buffer("occlusion", shade, persistent=False)
        surface = Surface(scene.points, scene.frames, scene.colours, shade)
        self.vertices = nn.ModuleList(self._placed(surface, scene.vertex_region))
        self._fine = Cache()
        self._incident = Cache()
        self._exitant = Cache()
        self._pixels = Cache()
        self._cut = ShapeTables(self._slices)

    def forward(self, environment: Environment, materials: Mapping[str, Material], view: View | GBuffer) -> Tensor:
        """Radiance (v, 3) of every vertex, or (p, 3) of every pixel of a `GBuffer`, toward the viewer.

        materials: by region; a region that is left out has the scene's own
        view: a Camera, an eye (3,), directions (v, 3) from the vertices to the viewer, or a GBuffer

        Vertices that face away have the radiance of the mirrored direction, so that silhouettes interpolate well.

        Raises:
            ValueError: an unknown region, or a view of another shape.
        """
        own = materials_of_regions(self.scene.materials, materials)
        if isinstance(view, GBuffer):
            placed: list[Placed] = self._pixels(view, lambda: self._of_pixels(view))
            points = len(view.pixel)
            eye = torch.tensor(view.camera.eye).to(self.cosine)
        else:
            placed = self.placed
            points = len(self.scene.vertices)
            eye = toward(view, self.scene.points.to(self.cosine))
        out = self.cosine.new_zeros(points, 3)
        for part, sent in zip(placed, self.exitant(environment, own, placed), strict=True):
            out = out.index_copy(0, part.rows[: part.count], self._radiance(part, sent, eye)[: part.count])
        return out

    @property
    def placed(self) -> list[Placed]:
        """The vertices of every region."""
        return [part for part in self.vertices if isinstance(part, Placed)]

    def incident(self, environment: Environment) -> Lit:
        """Light step: what depends on the light alone."""
        maps: LightMaps = self._fine(environment.map, lambda: light_maps.light_maps(environment, ()))
        inputs = environment, watched(self, self.rotation)
        lit: Lit = self._incident(inputs, lambda: self._lit(maps.fine.to(self.cosine), environment))
        return lit

    def exitant(self, environment: Environment, materials: Mapping[str, Material], placed: list[Placed]) -> list[Sent]:
        """BRDF step: what depends on the light and on the materials (of every region, in their order)."""
        lit = self.incident(environment)
        inputs = lit, dict(materials), watched(*placed)
        pairs = zip(placed, materials.values(), strict=True)
        sent: list[Sent] = self._exitant(inputs, lambda: [self._sent(lit, *pair) for pair in pairs])
        return sent

    def _placed(self, surface: Surface, region: Tensor) -> list[Placed]:
        """A surface's points (v,), region by region."""
        rows = [(region == r).nonzero()[:, 0] for r in range(len(self.scene.regions))]
        return [Placed.of(some, surface, self.rotation.frames) for some in rows]

    def _of_pixels(self, pixels: GBuffer) -> list[Placed]:
        occlusion = pixels.interpolated(self.scene, self.occlusion.cpu())
        surface = Surface(pixels.positions, pixels.frames, pixels.colours, occlusion)
        return [part.to(self.cosine.device) for part in self._placed(surface, pixels.region)]

    def _lit(self, fine: Tensor, environment: Environment) -> Lit:
        lighting = (native if self.rotation.compiled else relight).lighting
        n = self.rotation.n
        turn = environment.rotation.to(fine)
        light = lighting(fine, turn, self.directions, self.shares, (n, n))
        if self.keep is not None:
            light = haar.truncate(light.flatten(1), self.keep).to_dense(n * n).reshape(light.shape)
        local = self.rotation(nn.functional.pad(light, (0, 0, 0, 0, 0, CHANNELS - len(light))))
        return Lit(local, self.cosine @ local)

    def _sent(self, lit: Lit, part: Placed, material: Material) -> Sent:
        at = part.at
        irradiance = mix(lit.irradiance, at.near.T.long(), at.weights.T)[:, :3]
        diffuse = material.diffuse.to(irradiance) / math.pi * part.colour * part.occlusion * irradiance
        cut = self._cut(material.shape, self.cosine.device)
        light = lit.local if cut is None else slices.project(lit.local, cut)
        return Sent(light, cut, diffuse, material.specular.to(diffuse) * part.occlusion)

    def _radiance(self, part: Placed, sent: Sent, eye: Tensor) -> Tensor:
        """View step, of one region (v, 3)."""
        cut = sent.cut
        at = part.at
        if cut is None:
            return sent.diffuse
        first: Tensor = part.first((at.twist, cut.terms), lambda: slices.first_slice(cut, at.twist))
        eye = eye if eye.ndim == 1 else eye[part.rows].T
        reflected = (native if self.rotation.compiled else slices).reflected(
            sent.light, cut, first, self.rotation.frames, at, eye
        )
        return torch.addcmul(sent.diffuse, sent.specular, reflected[:, :3])

    def _slices(self, shape: Shape | None) -> Slices | None:
        if shape is None:
            return None
        m = self.rotation.m
        twists = 1 if shape.isotropic else self.twists
        make = slices.tabulate if self.rank is None else slices.factorise
        kept = self.terms if self.rank is None else self.rank
        return make(shape.evaluate, m, self.views, kept, twists).to(self.cosine.device)


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
