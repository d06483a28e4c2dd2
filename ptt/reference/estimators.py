"""Ground truth: path-traced radiance with its standard error, the judge of every relighter.

    B(x, wo) = integral of  I(wi) f(wi, wo) (wi . n)  over the hemisphere; other surfaces reflect part of I

A path starts at a point, not in the lens. At each vertex two directions are drawn: one where the environment is
bright, one where the BRDF is large; both see the environment, weighted by the balance heuristic (Veach and Guibas
1995), and the path goes on along the second. No light is clamped, no path is cut at random.

- `bounces` counts reflections before the last one at the point: 0 is direct light, k adds paths of up to k more.
- Surfaces are one-sided: a back face blocks light and reflects none. Vertex normals shade: nothing is reflected
  from or to where they see the horizon, as Mitsuba's `diffuse` has it.
- Rays leave a given point at `Surface.offset(position, normal)`, and a hit at its offset along the face's normal.

Samples come in batches that are independent of each other and well spread within (Sobol's points, shifted as by
Cranley and Patterson): the spread between the batches' means gives the standard error. Sums are float64; light is
float32.

Example:
    >>> estimate = at_vertices(scene, Environment.load("uffizi.hdr"), scene.materials, scene.camera, bounces=2)
    >>> estimate.mean, estimate.standard_error       # (v, 3), (v, 3), float64
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypedDict, Unpack

import torch
from torch import Tensor

from ptt.light.environment import Environment
from ptt.materials.varying import SurfaceMaterial
from ptt.ops import kinds
from ptt.reference.path_tracer import Estimate, PathTracer, PathVertices, to_local
from ptt.scene.camera import Camera
from ptt.scene.parts import Part
from ptt.scene.scene import Scene


class Points(NamedTuple):
    """The points at which radiance is wanted.

    position (n, 3): world space, on the surface
    frame (n, 3, 3): rows tangent, bitangent, normal
    region (n,): index into `Scene.regions`
    colour (n, 3): linear base colour
    triangle (n,), barycentric (n, 3): where on the mesh; None will do where no material has maps and nothing glows
    """

    position: Tensor
    frame: Tensor
    region: Tensor
    colour: Tensor
    triangle: Tensor | None = None
    barycentric: Tensor | None = None

    def take(self, rows: Tensor | slice) -> Points:
        """Some of the points, by their numbers (k,) or a slice of them."""
        places = (None if field is None else field[rows] for field in (self.triangle, self.barycentric))
        return Points(*(field[rows] for field in self[:4]), *places)


class Settings(TypedDict, total=False):
    """The keywords that every function here takes, with their defaults.

    bounces: reflections before the last one, at the point (0)
    samples: paths a point, rounded up to whole batches (256)
    seed: the same seed gives the same result to the bit, on any number of threads (0)
    progress: says whether to show a bar (False)
    """

    bounces: int
    samples: int
    seed: int
    progress: bool


def vertex_points(scene: Scene) -> Points:
    """The scene's vertices as points, where they are lit (`Scene.points`)."""
    return Points(scene.points, scene.frames, scene.vertex_region, scene.colours, *scene.vertex_places)


@torch.no_grad()
def radiance(
    scene: Scene,
    environment: Environment,
    materials: Mapping[str, SurfaceMaterial],
    points: Points,
    wo: Tensor,
    **settings: Unpack[Settings],
) -> Estimate:
    """Radiance (n, 3) that leaves points towards unit directions wo (n, 3); materials: those of all regions, by name.

    Raises:
        ValueError: a region has no material, a tensor has another shape, bounces < 0, or samples < 2.
    """
    _check(points, wo, len(scene.regions))
    tracer = PathTracer(scene, environment, materials, **settings)
    return tracer.estimate(_starts(tracer, points, wo))


def _starts(tracer: PathTracer, points: Points, wo: Tensor) -> PathVertices:
    """The points of a tracer's scene, where paths towards wo (n, 3) start.

    Raises:
        ValueError: the points do not say where they are, and a material has maps or a region glows.
    """
    scene = tracer.scene
    frame = points.frame.float()
    if points.triangle is not None and points.barycentric is not None:
        values = tracer.values_at(points.triangle, points.barycentric)
        glow = tracer.glow_at(points.triangle, points.barycentric)
    elif tracer.maps or any(region.glow is not None for region in scene.regions):
        raise ValueError("points must have triangle and barycentric: a material has maps, or a region glows")
    else:
        values = frame.new_zeros(len(frame), 0)
        glow = torch.zeros_like(frame[:, 0])
    origin = scene.surface.offset(points.position, points.frame[:, 2])
    wo = to_local(frame, wo.float())
    return PathVertices(origin, frame, points.region, points.colour.float(), values, glow, wo)


def at_vertices(
    scene: Scene,
    environment: Environment,
    materials: Mapping[str, SurfaceMaterial],
    camera: Camera,
    **settings: Unpack[Settings],
) -> Estimate:
    """`radiance` (v, 3) of every vertex of the scene towards the camera, which need not see it."""
    kinds.check("scene", scene, Scene)
    kinds.check("camera", camera, Camera)
    wo = camera.toward(scene.points)
    return radiance(scene, environment, materials, vertex_points(scene), wo, **settings)


@torch.no_grad()
def unshadowed(
    scene: Scene,
    environment: Environment,
    materials: Mapping[str, SurfaceMaterial],
    points: Points,
    wo: Tensor,
    **settings: Unpack[Settings],
) -> Estimate:
    """`radiance` (n, 3) of points from which nothing hides the light: the truth for `EnvMapRelighter`."""
    _check(points, wo, len(scene.regions))
    starts = _starts(PathTracer(scene, environment, materials, **settings), points, wo)
    centre, radius = scene.bounds
    # every region is two triangles so small and so far above and below that they hide nothing
    corners = 1e-3 * torch.eye(3, dtype=torch.float32)
    far = corners.new_tensor([0.0, 1e4, 0.0])
    specks = centre + radius * torch.cat((corners - far, corners + far))
    parts = [Part(region.name, specks, torch.tensor([[0, 1, 2], [3, 4, 5]])) for region in scene.regions]
    return PathTracer(Scene.from_parts(parts), environment, materials, **settings).estimate(starts)


@torch.no_grad()
def along_rays(
    scene: Scene,
    environment: Environment,
    materials: Mapping[str, SurfaceMaterial],
    origins: Tensor,
    directions: Tensor,
    **settings: Unpack[Settings],
) -> Estimate:
    """`radiance` (n, 3) that is seen from origins (n, 3) along unit directions (n, 3).

    A ray that hits nothing sees the environment, without an error; a ray that hits a back face sees black.
    """
    tracer = PathTracer(scene, environment, materials, **settings)
    hits = scene.surface.first_hit(origins, directions)
    seen, start = tracer.arrive(hits, directions)
    estimate = tracer.estimate(start)
    background = environment.radiance(directions).double() * (hits.triangle < 0)[:, None]
    mean = background.index_copy(0, seen, estimate.mean)
    return Estimate(mean, torch.zeros_like(mean).index_copy(0, seen, estimate.standard_error))


def image(
    scene: Scene,
    environment: Environment,
    materials: Mapping[str, SurfaceMaterial],
    camera: Camera,
    **settings: Unpack[Settings],
) -> Estimate:
    """`along_rays` (height, width, 3) through the centres of the camera's pixels."""
    kinds.check("camera", camera, Camera)
    eye, directions = camera.rays()
    rays = directions.reshape(-1, 3)
    estimate = along_rays(scene, environment, materials, eye.expand_as(rays), rays, **settings)
    return Estimate(*(values.reshape(directions.shape) for values in estimate))


def _check(points: Points, wo: Tensor, regions: int) -> None:
    n = len(points.position)
    shapes = {"position": (n, 3), "frame": (n, 3, 3), "region": (n,), "colour": (n, 3)}
    for name, expected in shapes.items():
        found = tuple(getattr(points, name).shape)
        if found != expected:
            raise ValueError(f"points.{name} must be {expected}, got {found}")
    if wo.shape != (n, 3):
        raise ValueError(f"wo must be {(n, 3)}, one direction a point, got {tuple(wo.shape)}")
    if n and not 0 <= int(points.region.min()) <= int(points.region.max()) < regions:
        low = int(points.region.min())
        high = int(points.region.max())
        raise ValueError(f"points.region must index {regions} regions, got {low}..{high}")
