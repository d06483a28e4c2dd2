"""Paths through a scene under one light, traced many at a time: the tracer behind `ptt.reference`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ptt.light.environment import Environment
from ptt.materials.shapes import GGX, BlinnPhong, CookTorrance, Shape, Ward, number
from ptt.materials.varying import SurfaceMaterial, check_materials
from ptt.ops import kinds
from ptt.ops.raycast import Hits
from ptt.reference.sampling import BeckmannLobe, GGXLobe, Lobe, Mixture, PowerLobe
from ptt.scene.scene import Scene

BATCHES = 64  # of samples, where there are enough of them: the standard error then errs by 1 / sqrt(2 x 63) = 9 %
SMALLEST = 4  # samples a batch, where there are two batches of them: fewer are spread no better than by chance
LARGEST = 256  # samples a batch
RAYS = 1 << 17  # paths that a thread traces at a time: about 80 MB
THREADS = 16  # at most so many: each holds its own paths
GRAZING = 1e-6  # a direction is above the horizon if its cosine is greater: float32 rounds unit vectors by 1e-7


class Estimate(NamedTuple):
    """Radiance and its standard error, both (..., 3), linear RGB, float64."""

    mean: Tensor
    standard_error: Tensor

    @property
    def noise(self) -> float:
        """The root mean square of the standard error over that of the radiance."""
        return float(self.standard_error.norm() / self.mean.norm())


class PathVertices(NamedTuple):
    """Vertices of n paths.

    origin (n, 3) float64: where rays start, off the surface
    frame (n, 3, 3): rows tangent, bitangent, normal
    region (n,), colour (n, 3): index into `Scene.regions`, and linear base colour
    values (n, m): those of the maps of their materials (`ptt.materials.varying`)
    glow (n, 3): radiance that they send out by themselves
    wo (n, 3): direction to where the path came from, in the local frame
    """

    origin: Tensor
    frame: Tensor
    region: Tensor
    colour: Tensor
    values: Tensor
    glow: Tensor
    wo: Tensor

    def take(self, rows: Tensor) -> PathVertices:
        """Some of the vertices, by their numbers (k,)."""
        return PathVertices(*(_pick(field, rows) for field in self))


class PathTracer:
    """A path tracer for one scene under one light, with its tables."""

    def __init__(
        self,
        scene: Scene,
        environment: Environment,
        materials: Mapping[str, SurfaceMaterial],
        *,
        bounces: int = 0,
        samples: int = 256,
        seed: int = 0,
        progress: bool = False,
    ) -> None:
        kinds.check("scene", scene, Scene)
        kinds.check("environment", environment, Environment)
        if bounces < 0 or samples < 2:
            raise ValueError(f"bounces must be at least 0 and samples at least 2, got {bounces} and {samples}")
        check_materials([region.name for region in scene.regions], materials)
        missing = [region.name for region in scene.regions if region.name not in materials]
        if missing:
            raise ValueError(f"materials must cover every region of the scene, got none for {', '.join(missing)}")
        self.scene = scene
        self.environment = environment
        self.sampler = environment.sampler()
        self.materials = [materials[region.name] for region in scene.regions]
        self.maps = max(len(material.maps) for material in self.materials)
        self.mixtures = [_mixture(material) for material in self.materials]
        self.bounces = bounces
        self.samples = samples
        self.progress = progress
        self.random = torch.Generator().manual_seed(seed)

    @cached_property
    def corners(self) -> Tensor:
        """Geometry (f, 30) of faces: first corner, two edges from it, unit normal, corners' normals and tangents."""
        scene = self.scene
        a, b, c = scene.vertices.double()[scene.faces].unbind(1)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1, eps=1e-300)
        place = torch.stack([a, b - a, c - a, normal], 1).float()
        return torch.cat([place, scene.normals[scene.faces], scene.tangents[scene.faces]], 1).flatten(1)

    def estimate(self, start: PathVertices) -> Estimate:
        """Means and standard errors (n, 3) of the light from n vertices."""
        size = min(max(self.samples // BATCHES, min(SMALLEST, self.samples // 2)), LARGEST)
        size = 1 << size.bit_length() - 1  # Sobol's points are even in powers of two
        batches = -(-self.samples // size)
        above = torch.nonzero(start.wo[:, 2] > GRAZING)[:, 0]
        sums = torch.zeros(2, len(start.wo), 3, dtype=torch.float64)
        passes = list(_passes(len(above), batches, max(1, RAYS // size)))
        seeds = torch.randint(2**32, (len(passes),), generator=self.random).tolist()

        @torch.no_grad()
        def run(block: tuple[slice, int], seed: int) -> Tensor:
            some, count = block
            return self._batch_means(start.take(above[some]), count, size, torch.Generator().manual_seed(seed))

        with (
            _side_by_side(min(self.scene.surface.threads, THREADS)) as pool,
            self._bar(len(above) * batches * size) as bar,
        ):
            for (some, _), means in zip(passes, pool.map(run, passes, seeds), strict=True):
                sums[0, above[some]] += means.sum(1)
                sums[1, above[some]] += means.square().sum(1)
                bar.update(means[..., 0].numel() * size)
        mean = sums[0] / batches
        variance = (sums[1] / batches - mean.square()).clamp(min=0) / (batches - 1)
        return Estimate(mean + start.glow, variance.sqrt())

    def _bar(self, paths: int) -> tqdm:
        return tqdm(total=paths, unit=" paths", unit_scale=True, disable=not self.progress)

    def _batch_means(self, start: PathVertices, count: int, size: int, random: torch.Generator) -> Tensor:
        """Means (n, count, 3) of `count` batches of `size` paths from each of n vertices."""
        n = len(start.wo)
        u = (_uniform(n * count, random)[:, None] + _spread(size)).frac().reshape(-1, 5)
        light = self._trace(start.take(torch.arange(n).repeat_interleave(count * size)), u, random)
        return light.reshape(n, count, size, 3).double().mean(2)

    def _trace(self, at: PathVertices, u: Tensor, random: torch.Generator) -> Tensor:
        """Light (n, 3) along one path from each vertex; u (n, 5): uniform numbers for its first step."""
        light = torch.zeros_like(at.wo)
        weight = torch.ones_like(at.wo)
        path = torch.arange(len(at.wo))
        for left in range(self.bounces, -1, -1):
            rows, value = self._towards_light(at, u[:, :2])
            light.index_add_(0, _pick(path, rows), _pick(weight, rows) * value)
            rows, world, factor, density = self._towards_brdf(at, u[:, 2:])
            path = _pick(path, rows)
            weight = _pick(weight, rows) * factor
            origin = _pick(at.origin, rows)
            if left:
                hits = self.scene.surface.first_hit(origin, world)
                missed = hits.triangle < 0
            else:  # no reflection is left, so it does not matter what is hit
                missed = ~self.scene.surface.occluded(origin, world)
            out = torch.nonzero(missed)[:, 0]
            beyond = self._beyond(_pick(world, out), _pick(density, out))
            light.index_add_(0, _pick(path, out), _pick(weight, out) * beyond)
            if left:
                rows, at = self.arrive(hits, world)
                path = _pick(path, rows)
                weight = _pick(weight, rows)
                light.index_add_(0, path, weight * at.glow)
                u = _uniform(len(rows), random)
        return light

    def _beyond(self, world: Tensor, density: Tensor) -> Tensor:
        """The environment (n, 3) in directions that BRDFs drew with this density (n,), by the balance heuristic."""
        share = density / (density + self.sampler.pdf(world))
        return share[:, None] * self.environment.radiance(world)

    def _towards_light(self, at: PathVertices, u: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers (k,) of the vertices that get light from where the environment draws it, and the light (k, 3)."""
        world, density = self.sampler.sample(u)
        rows = torch.nonzero((at.frame[:, 2] * world).sum(1) > GRAZING)[:, 0]
        free = ~self.scene.surface.occluded(_pick(at.origin, rows), _pick(world, rows))
        rows = _pick(rows, torch.nonzero(free)[:, 0])
        at = at.take(rows)
        world = _pick(world, rows)
        density = _pick(density, rows)
        response, other = self._respond(at, to_local(at.frame, world))
        return rows, response * self.environment.radiance(world) / (density + other)[:, None]

    def _towards_brdf(self, at: PathVertices, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Directions that the vertices' BRDFs draw, where they lie above the horizon.

        Returns the numbers (k,) of those vertices, the directions (k, 3) in world space, BRDF x cosine / density
        (k, 3), and the density (k,).
        """
        wi = torch.empty_like(at.wo)
        for index, rows in self._by_region(at):
            wi.index_copy_(0, rows, self.mixtures[index].sample(_pick(u, rows), _pick(at.wo, rows)))
        rows = torch.nonzero(wi[:, 2] > GRAZING)[:, 0]
        at = at.take(rows)
        wi = _pick(wi, rows)
        response, density = self._respond(at, wi)
        return rows, _to_world(at.frame, wi), response / density[:, None], density

    def _respond(self, at: PathVertices, wi: Tensor) -> tuple[Tensor, Tensor]:
        """BRDF x cosine (n, 3), and the density (n,) with which the BRDF would have drawn wi (n, 3), local."""
        response = torch.empty_like(wi)
        density = torch.empty_like(wi[:, 0])
        for index, rows in self._by_region(at):
            i = _pick(wi, rows)
            o = _pick(at.wo, rows)
            colour = _pick(at.colour, rows)
            values = _pick(at.values, rows).T
            response.index_copy_(0, rows, self.materials[index].evaluate(i, o, colour, values))
            density.index_copy_(0, rows, self.mixtures[index].density(i, o))
        return response * wi[:, 2:], density

    def _by_region(self, at: PathVertices) -> Iterator[tuple[int, Tensor]]:
        """Each region that has vertices, with their numbers."""
        for index, count in enumerate(torch.bincount(at.region, minlength=len(self.materials)).tolist()):
            if count:
                yield index, torch.nonzero(at.region == index)[:, 0]

    def arrive(self, hits: Hits, directions: Tensor) -> tuple[Tensor, PathVertices]:
        """Numbers (k,) of the rays that hit a front from above the shading horizon, and the k vertices there."""
        rows = torch.nonzero(hits.front)[:, 0]
        triangle = _pick(hits.triangle, rows)
        weights = _pick(hits.barycentric, rows)
        corners = _pick(self.corners, triangle).view(-1, 10, 3)
        position = corners[:, 0].double() + (corners[:, 1:3] * weights[:, 1:, None]).sum(1)
        frame = orthonormal(_mix(corners[:, 4:7], weights), _mix(corners[:, 7:10], weights))
        frame = self.scene.bent(frame, triangle, weights)
        wo = -to_local(frame, _pick(directions, rows))
        at = PathVertices(
            self.scene.surface.offset(position, corners[:, 3]),
            frame,
            self.scene.face_region[triangle],
            self.scene.albedo(triangle, weights),
            self.values_at(triangle, weights),
            self.glow_at(triangle, weights),
            wo,
        )
        above = torch.nonzero(wo[:, 2] > GRAZING)[:, 0]
        return _pick(rows, above), at.take(above)

    def values_at(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """The values (n, m) of the maps of the materials inside triangles (n,), at barycentric (n, 3)."""
        values = torch.ones(len(triangle), self.maps, dtype=torch.float32)
        for index, material in enumerate(self.materials):
            rows = torch.nonzero(self.scene.face_region[triangle] == index)[:, 0]
            if material.maps and len(rows):
                own = self.scene.map_values(material.maps, _pick(triangle, rows), _pick(barycentric, rows))
                values[rows, : len(own)] = own.T
        return values

    def glow_at(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """What points send out by themselves (n, 3)."""
        glow = self.scene.glow(triangle, barycentric)
        return torch.zeros(len(triangle), 3, dtype=torch.float32) if glow is None else glow


def _mixture(material: SurfaceMaterial) -> Mixture:
    """The mixture that draws directions for a material: lobes' shares are about their parts of the reflected light."""
    lobes: dict[Lobe, float] = {}
    for highlight in (h for layer in material.layers for h in layer.highlights):
        found = _lobe(highlight.shape)
        if found is not None:
            lobe, albedo = found
            lobes[lobe] = lobes.get(lobe, 0.0) + albedo * number(highlight.colour.mean())
    specular = sum(lobes.values())
    diffuse = sum(number(layer.diffuse.mean()) for layer in material.layers)
    share = min(max(specular / max(specular + diffuse, 1e-12), 0.1), 0.9)
    total = max(specular, 1e-300)
    return Mixture(
        tuple(lobes), tuple(share * part / total if specular else share / len(lobes) for part in lobes.values())
    )


def _lobe(shape: Shape) -> tuple[Lobe, float] | None:
    """The lobe that draws half vectors for a shape, and about its albedo; None for one that has none."""
    match shape:
        case BlinnPhong(exponent):
            return PowerLobe(number(exponent)), 1.0
        case CookTorrance(f0, m):
            return BeckmannLobe(number(m)), 4 / math.pi * max(number(f0), 0.1)
        case Ward(ax, ay):
            return BeckmannLobe(number(ax), number(ax if ay is None else ay)), 1.0
        case GGX(f0, roughness):
            return GGXLobe(number(roughness)), max(number(f0), 0.1)
    return None


def _passes(n: int, batches: int, capacity: int) -> Iterator[tuple[slice, int]]:
    """Blocks (points, number of batches) of at most `capacity` that together hold `batches` for each of n points."""
    for first in range(0, n, capacity):
        some = slice(first, min(first + capacity, n))
        most = capacity // (some.stop - first)
        for done in range(0, batches, most):
            yield some, min(most, batches - done)


@contextmanager
def _side_by_side(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that each run torch on one core: its own threads would wait for each other after every operation."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            yield pool
    finally:
        torch.set_num_threads(before)


def _uniform(n: int, random: torch.Generator) -> Tensor:
    """Uniform numbers (n, 5) in [0, 1): two draw from the environment, three from the BRDF."""
    return torch.rand(n, 5, generator=random, dtype=torch.float32)


def _spread(size: int) -> Tensor:
    """The first points (size, 5) of Sobol's sequence, even in every pair of axes from four points on."""
    return torch.quasirandom.SobolEngine(5).draw(size, dtype=torch.float32)


def _pick(values: Tensor, rows: Tensor) -> Tensor:
    """The same as values[rows], several times as fast."""
    return values.index_select(0, rows)


def to_local(frame: Tensor, world: Tensor) -> Tensor:
    """Vectors (n, 3) of world space in frames (n, 3, 3)."""
    return torch.einsum("nij,nj->ni", frame, world)


def _to_world(frame: Tensor, local: Tensor) -> Tensor:
    """Vectors (n, 3) of frames (n, 3, 3) in world space."""
    return torch.einsum("nij,ni->nj", frame, local)


def _mix(corners: Tensor, weights: Tensor) -> Tensor:
    """Values (n, 3) inside triangles, from those at their corners (n, 3, 3) and barycentric weights (n, 3)."""
    return torch.einsum("nkc,nk->nc", corners, weights)


def orthonormal(normal: Tensor, tangent: Tensor) -> Tensor:
    """Orthonormal frames (n, 3, 3) from interpolated normals and tangents (n, 3)."""
    normal = torch.nn.functional.normalize(normal, dim=1)
    tangent = tangent - (tangent * normal).sum(1, keepdim=True) * normal
    tangent = torch.nn.functional.normalize(tangent, dim=1)
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], 1)
