"""The path tracer against laws, analytic cases and quadrature; `test_mitsuba.py` holds it against Mitsuba."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.light.environment import Environment
from ptt.materials.material import Material, blinn_phong, cook_torrance, lambert, metal_rough
from ptt.materials.shapes import Named
from ptt.materials.textures import Texture
from ptt.materials.varying import MetalRough, SurfaceMaterial
from ptt.ops import mesh
from ptt.ops.sphere import LatLong
from ptt.reference import Estimate, Points, along_rays, at_vertices, image, path_tracer, radiance
from ptt.reference.sampling import Mixture
from ptt.scene.bumps import BumpMap
from ptt.scene.camera import Camera
from ptt.scene.parts import Part
from ptt.scene.scene import Scene

UP = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # frame of a floor: the normal is +y


def plane(size: float = 2.0, turn: Tensor | None = None, shift: tuple[float, float, float] = (0, 0, 0)) -> Part:
    vertices, faces = mesh.plane_mesh(size)
    moved = vertices if turn is None else vertices @ turn.T
    return Part("plane", moved + torch.tensor(shift), faces)


def scene_of(*parts: Part) -> Scene:
    named = [replace(part, name=f"{part.name}{i}", material=lambert(1.0)) for i, part in enumerate(parts)]
    return Scene.from_parts(named)


def floor_point(x: float = 0.0, z: float = 0.0, n: int = 1) -> Points:
    position = torch.tensor([[x, 0.0, z]]).expand(n, 3)
    return Points(position, UP.expand(n, 3, 3), torch.zeros(n, dtype=torch.long), torch.ones(n, 3))


def same(materials: SurfaceMaterial, scene: Scene) -> dict[str, SurfaceMaterial]:
    return {region.name: materials for region in scene.regions}


def toward(degrees: float, turn: float = 30.0) -> Tensor:
    a = math.radians(degrees)
    b = math.radians(turn)
    return torch.tensor([[math.sin(a) * math.cos(b), math.cos(a), math.sin(a) * math.sin(b)]])


def agrees(estimate: Estimate, expected: Tensor | float, sigmas: float = 4.0, floor: float = 1e-6) -> bool:
    """Within `sigmas` standard errors; `floor` is what float32 rounding costs where the error vanishes."""
    expected = torch.as_tensor(expected, dtype=torch.float64)
    bound = sigmas * estimate.standard_error + floor * expected.abs()
    return bool(((estimate.mean - expected).abs() <= bound).all())


def over_points(estimate: Estimate) -> Estimate:
    """The mean of independent estimates."""
    error = estimate.standard_error.square().sum(0).sqrt() / len(estimate.mean)
    return Estimate(estimate.mean.mean(0), error)


def smooth_sky() -> Environment:
    """Radiance that is a polynomial of low order in the direction, different for each colour."""
    x, y, z = LatLong(128, 256).directions().unbind(-1)
    return Environment(torch.stack([1 + 0.6 * y + 0.3 * x, 1 + x * z, 0.5 + y * y], -1).float())


def quadrature(material: Material, environment: Environment, wo: Tensor, rings: int = 500, turns: int = 128) -> Tensor:
    """The integral of f L cos over the hemisphere around +y, in float64; rings are denser near the mirror."""
    local_wo = UP.double() @ wo[0].double()
    mirror = local_wo * local_wo.new_tensor([-1.0, -1.0, 1.0])
    s, w = (torch.tensor(v) for v in np.polynomial.legendre.leggauss(rings))
    top = math.log1p(math.pi / 0.01)
    t = 0.01 * torch.expm1((s + 1) / 2 * top)
    dt = 0.01 * torch.exp((s + 1) / 2 * top) * w * top / 2
    phi = (torch.arange(turns, dtype=torch.float64) + 0.5) * (2 * math.pi / turns)
    side = torch.linalg.cross(mirror, mirror.new_tensor([0.0, 1.0, 0.0]))
    side = side / side.norm()
    axes = torch.stack([side, torch.linalg.cross(mirror, side), mirror])
    ring = torch.stack([phi.cos(), phi.sin(), torch.zeros_like(phi)], -1) * t.sin()[:, None, None]
    wi = (ring + t.cos()[:, None, None] * mirror.new_tensor([0.0, 0.0, 1.0])) @ axes
    weight = (t.sin() * dt * (2 * math.pi / turns))[:, None] * wi[..., 2].clamp(min=0)
    light = environment.radiance((wi @ UP.double()).float()).double()
    return (material.evaluate(wi, local_wo.expand_as(wi)) * light * weight[..., None]).sum((0, 1))


# Laws


def test_white_furnace_of_a_convex_surface() -> None:
    """Albedo 1 under constant 1: every vertex sends out exactly 1, however often light may bounce.

    The plane through a vertex, along its normal's horizon, leaves a convex mesh below: nothing is blocked.
    """
    scene = Scene.from_mesh(*mesh.sphere_mesh(3))
    for bounces in (0, 2):
        estimate = radiance(
            scene,
            Environment.constant(),
            same(lambert(1.0), scene),
            reference.vertex_points(scene),
            scene.normals,
            bounces=bounces,
            samples=512,
        )
        assert (estimate.standard_error < 0.06).all()
        assert agrees(estimate, 1.0, sigmas=5)  # of 1926 numbers
        assert agrees(over_points(estimate), 1.0)


def test_lambert_on_a_floor_is_exact() -> None:
    """Albedo a under constant L: a L. Gradient sky h + (z - h) y: integral of cos (h + (z - h) cos) / pi
    = h + (z - h) 2/3. The estimate must be within four standard errors, and these below 1 %."""
    scene = scene_of(plane())
    materials = {"plane0": lambert((0.2, 0.5, 0.9))}
    points = floor_point(n=50)
    wo = toward(40.0).expand(50, 3)
    for environment, expected in (
        (Environment.constant((3.0, 2.0, 1.0)), [0.6, 1.0, 0.9]),
        (Environment.gradient_sky(4.0, 1.0, 50.0), [0.2 * 3, 0.5 * 3, 0.9 * 3]),
    ):
        estimate = radiance(scene, environment, materials, points, wo, samples=4096)
        assert (estimate.standard_error < 0.02 * estimate.mean).all()
        # the gradient is interpolated between texels: 0.2 % at the horizon's edge
        assert agrees(estimate, torch.tensor(expected, dtype=torch.float64), floor=2e-3)
        assert agrees(over_points(estimate), torch.tensor(expected, dtype=torch.float64), floor=2e-3)


@pytest.mark.parametrize("material", [
    blinn_phong((0.3, 0.2, 0.1), (0.5, 0.7, 0.9), 1.0),
    blinn_phong(0.2, 0.6, 20.0),
    blinn_phong(0.0, 1.0, 1000.0),
    cook_torrance(0.2, (0.5, 0.7, 0.9), 0.3, 0.4),
    cook_torrance(0.0, 1.0, 0.05, 0.1),
    cook_torrance(0.1, 1.0, 0.9, 0.03),
], ids=lambda m: repr(m.shape))  # fmt: skip
@pytest.mark.parametrize("tilt", [0.5, 45.0, 75.0])
def test_glossy_direct_light_is_the_integral(material: Material, tilt: float) -> None:
    scene = scene_of(plane())
    environment = smooth_sky()
    wo = toward(tilt)
    estimate = radiance(scene, environment, same(material, scene), floor_point(), wo, samples=1 << 15)
    expected = quadrature(material, environment, wo)
    assert (estimate.standard_error < 0.01 * estimate.mean).all()
    assert agrees(estimate, expected, floor=5e-4)


def turned(degrees: float) -> Tensor:
    """Rotation about z: takes a plane's normal, +y, towards -x."""
    a = math.radians(degrees)
    return torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1.0]])


def ceiling_form_factor(side: float, height: float) -> float:
    """From a small patch to a parallel square centred above it: four times that to a corner (Howell, B-4)."""
    x = side / 2 / height
    return 4 / (2 * math.pi) * 2 * x / math.sqrt(1 + x * x) * math.atan(x / math.sqrt(1 + x * x))


@pytest.mark.parametrize(("bounces", "faces_down"), [(0, True), (1, True), (3, True), (3, False)])
def test_light_reflected_by_a_ceiling(bounces: int, faces_down: bool) -> None:
    """A patch of albedo b below a square ceiling of albedo a, form factor F, under constant light 1.

    The ceiling sees nothing but the environment below, so its radiance is a; the patch sends out b (1 - F) of direct
    light and b F a after one bounce, and nothing more after further ones. A back face reflects nothing.
    """
    albedo = 0.5
    a = torch.tensor([0.8, 0.4, 0.1], dtype=torch.float64)
    scene = scene_of(plane(2.0, turned(180.0 if faces_down else 0.0), (0.0, 1.0, 0.0)), plane(1e-3, shift=(0, -5, 0)))
    materials = {"plane0": lambert(a.float()), "plane1": lambert(albedo)}
    f = ceiling_form_factor(2.0, 1.0)
    points = floor_point(n=16)._replace(region=torch.ones(16, dtype=torch.long))
    estimate = over_points(radiance(
        scene, Environment.constant(), materials, points, toward(20.0).expand(16, 3), bounces=bounces, samples=4096
    ))  # fmt: skip
    reflected = a * f if bounces and faces_down else 0 * a
    assert (estimate.standard_error < 0.005).all()
    assert agrees(estimate, albedo * (1 - f + reflected))


def test_rays_leave_where_they_hit() -> None:
    """Seen through a hit on the floor, off its middle and under that of a ceiling: albedo (1 - F), as above."""
    floor = plane(6.0)
    ceiling = plane(1.0, turned(180.0), (1.2, 0.5, -0.7))
    scene = scene_of(floor, ceiling)
    origins = torch.tensor([[1.2, 0.1, -0.7]]).expand(16, 3)
    down = torch.tensor([[0.0, -1.0, 0.0]]).expand(16, 3)
    estimate = over_points(
        along_rays(scene, Environment.constant(), same(lambert(0.5), scene), origins, down, samples=4096)
    )
    assert (estimate.standard_error < 0.005).all()
    assert agrees(estimate, 0.5 * (1 - ceiling_form_factor(1.0, 0.5)))


def test_the_face_decides_which_side_is_the_front() -> None:
    """Vertex normals that look sideways and a little down, so that half of their hemisphere is in front of the face.

    From the front the eye is below their horizon; from the back it is above, but a back face reflects nothing.
    """
    vertices, faces = mesh.plane_mesh(2.0)
    scene = Scene.from_mesh(vertices, faces, normals=torch.tensor([[1.0, -0.2, 0.0]]).expand(4, 3))
    origins = torch.tensor([[0.1, 1.0, 0.2], [0.1, -1.0, 0.2]])
    directions = torch.tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    estimate = along_rays(scene, Environment.constant(), same(lambert(0.5), scene), origins, directions)
    assert not estimate.mean.any()


def test_open_white_box_fills_up_to_one() -> None:
    """Light enters through the missing lid and, by reciprocity, all of it comes out again: B = 1 everywhere.

    After k bounces what is missing is the light that would still be inside: B grows with k and stays below 1.
    """
    vertices, faces = mesh.box_mesh(cells=2)
    sides = [i for i in range(6) if i != 2]  # nine vertices and eight triangles each; 2 is the lid
    vertices = torch.cat([vertices[9 * i : 9 * i + 9] for i in sides])
    inside = torch.cat([faces.flip(1)[8 * i : 8 * i + 8] - 9 * (i - k) for k, i in enumerate(sides)])
    scene = Scene.from_mesh(vertices, inside)
    points = reference.vertex_points(scene)
    means = []
    for bounces in (0, 1, 3, 8, 60):
        low = points.take(scene.vertices[:, 1] < 0)
        low = low._replace(position=low.position * 0.9)  # off the edges
        estimate = over_points(radiance(
            scene, Environment.constant(), same(lambert(1.0), scene), low, low.frame[:, 2], bounces=bounces
        ))  # fmt: skip
        means.append(float(estimate.mean.mean()))
        assert float(estimate.mean.max()) < 1 + 4 * float(estimate.standard_error.max())
    assert means == sorted(means) and means[1] - means[0] > 0.05
    assert means[-1] == pytest.approx(1, abs=4 * float(estimate.standard_error.max()) + 1e-3)


def test_black_light_gives_exactly_nothing() -> None:
    scene = ptt.default_scene()
    estimate = at_vertices(scene, Environment.constant(0.0), scene.materials, scene.camera, bounces=2, samples=4)
    assert not estimate.mean.any() and not estimate.standard_error.any()


def test_closed_box_is_black_inside() -> None:
    vertices, faces = mesh.box_mesh()
    scene = Scene.from_mesh(vertices, faces.flip(1))
    estimate = radiance(
        scene, Environment.constant(), same(lambert(0.9), scene), floor_point(), toward(10.0), bounces=4
    )
    assert not estimate.mean.any()


def test_how_directions_are_drawn_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment's sampler, or a uniform one; the BRDF's mixture, or the cosine alone: one result."""
    scene = ptt.default_scene()
    environment = Environment.area_light((0.4, 0.8, 0.3), 15.0, 20.0)
    environment = Environment(environment.map + smooth_sky_like(environment))
    rows = torch.arange(0, len(scene.vertices), 40)
    points = reference.vertex_points(scene).take(rows)
    wo = scene.camera.toward(points.position)
    materials = scene.materials | {scene.regions[0].name: ptt.blinn_phong(0.3, 0.5, 100.0)}

    def run(seed: int) -> Estimate:
        return radiance(scene, environment, materials, points, wo, bounces=1, samples=2048, seed=seed)

    both = run(0)
    uniform = Environment.constant().sampler()
    with monkeypatch.context() as patch:
        patch.setattr(path_tracer, "_mixture", lambda material: Mixture())
        cosine_only = run(1)
    with monkeypatch.context() as patch:
        patch.setattr(Environment, "sampler", lambda self: uniform)
        brdf_only = run(2)
    for other in (cosine_only, brdf_only):
        z = (both.mean - other.mean) / (both.standard_error.square() + other.standard_error.square()).sqrt()
        z = z[z.isfinite()]
        assert float((z.abs() < 3).double().mean()) > 0.985  # skewed where a light is rarely hit
        assert float(z.square().mean()) < 1.15
        assert other.standard_error.mean() > both.standard_error.mean()


def smooth_sky_like(environment: Environment) -> Tensor:
    return Environment.gradient_sky().map[: environment.map.shape[0]] * 0.3


# The standard error


@pytest.mark.parametrize("samples", [16, 100, 512])
def test_standard_error_is_the_spread_of_seeds(samples: int) -> None:
    """Variance over 24 seeds over the mean square of the stated errors, averaged over points.

    Points are independent, each adds a relative variance of 2 / 23: over 247 points, four sigmas are 7 %.
    """
    scene = ptt.default_scene()
    environment = smooth_sky()
    points = reference.vertex_points(scene).take(slice(None, None, 32))
    wo = points.frame[:, 2]
    runs = [radiance(scene, environment, scene.materials, points, wo, samples=samples, seed=seed) for seed in range(24)]
    means = torch.stack([run.mean for run in runs])
    stated = torch.stack([run.standard_error.square() for run in runs]).mean(0)
    ratio = float((means.var(0) / stated).mean())
    assert 0.9 < ratio < 1.1


def test_well_spread_batches_beat_independent_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(plane())
    points = floor_point(n=64)
    wo = toward(30.0).expand(64, 3)

    def error() -> float:
        return float(radiance(
            scene, smooth_sky(), same(lambert(0.5), scene), points, wo, samples=4096
        ).standard_error.square().mean().sqrt())  # fmt: skip

    spread = error()
    monkeypatch.setattr(path_tracer, "BATCHES", 4096)
    assert spread < 0.5 * error()


# Repeatability


def test_same_seed_same_bits_and_no_global_state() -> None:
    scene = ptt.default_scene()
    state = torch.get_rng_state()
    runs = [
        at_vertices(scene, smooth_sky(), scene.materials, scene.camera, bounces=1, samples=4, seed=seed)
        for seed in (5, 5, 6)
    ]
    assert torch.equal(runs[0].mean, runs[1].mean)
    assert torch.equal(runs[0].standard_error, runs[1].standard_error)
    assert not torch.equal(runs[0].mean, runs[2].mean)
    assert torch.equal(state, torch.get_rng_state())


def test_any_number_of_threads_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """And torch is left with as many threads as it had."""
    scene = ptt.default_scene()
    before = torch.get_num_threads()
    runs = []
    torch.set_num_threads(2)
    monkeypatch.setattr(path_tracer, "RAYS", 1000)
    for threads in (1, 3):
        monkeypatch.setattr(scene.surface, "threads", threads)
        runs.append(at_vertices(scene, smooth_sky(), scene.materials, scene.camera, bounces=1, samples=2))
    assert torch.equal(runs[0].mean, runs[1].mean)
    assert torch.equal(runs[0].standard_error, runs[1].standard_error)
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def test_blocks_do_not_change_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks smaller than the points, and than a point's samples, estimate the same thing."""
    scene = ptt.default_scene()
    points = reference.vertex_points(scene).take(slice(None, None, 400))

    def run(seed: int) -> Estimate:
        return radiance(scene, smooth_sky(), scene.materials, points, points.frame[:, 2], samples=500, seed=seed)

    whole = run(0)
    for rays in (30, 700):
        monkeypatch.setattr(path_tracer, "RAYS", rays)
        blocks = run(1)
        error = (whole.standard_error.square() + blocks.standard_error.square()).sqrt()
        assert ((whole.mean - blocks.mean).abs() <= 5 * error).all()
        assert float(whole.standard_error.mean()) == pytest.approx(float(blocks.standard_error.mean()), rel=0.05)


@pytest.mark.parametrize(("n", "batches", "capacity"), [(5, 7, 1), (5, 7, 3), (5, 7, 12), (5, 7, 100), (0, 7, 3)])
def test_blocks_cover_everything_once_within_their_capacity(n: int, batches: int, capacity: int) -> None:
    done = torch.zeros(n, dtype=torch.long)
    for some, count in path_tracer._passes(n, batches, capacity):
        assert 0 < (some.stop - some.start) * count <= capacity
        done[some] += count
    assert bool((done == batches).all())


def test_far_from_the_origin() -> None:
    """Moved by (300, 200, -100), a scene of radius 4 keeps positions to 3e-5: no vertex shadows itself."""
    scene = ptt.default_scene()
    shift = torch.tensor([300.0, 200.0, -100.0])
    moved = replace(scene, vertices=scene.vertices + shift)
    runs = []
    for s in (scene, moved):
        points = reference.vertex_points(s).take(slice(None, None, 16))
        light = Environment.constant()
        runs.append(radiance(s, light, s.materials, points, points.frame[:, 2], bounces=1, samples=256))
    assert float((runs[0].mean - runs[1].mean).abs().mean() / runs[0].mean.mean()) < 0.02


# Geometry and colour at hits


def test_normals_are_interpolated_at_hits() -> None:
    """A small light overhead: radiance is proportional to the cosine to the interpolated normal.

    Normals tilt by -+30 degrees at x = -+1, so at x the normal is that of tan(t) = x tan(30). The light's radius of
    3 degrees moves the mean cosine by less than 0.1 %.
    """
    vertices, faces = mesh.plane_mesh(2.0)
    tilt = vertices[:, 0] * math.radians(30)
    normals = torch.stack([tilt.sin(), tilt.cos(), torch.zeros(4)], 1)
    scene = Scene.from_mesh(vertices, faces, normals=normals)
    x = torch.tensor([-0.9, -0.5, 0.0, 0.3, 0.8])
    origins = torch.stack([x, torch.ones(5), x * 0.3], 1)
    down = torch.tensor([[0.0, -1.0, 0.0]]).expand(5, 3)
    light = Environment.area_light((0.0, 1.0, 0.0), 3.0, 100.0)
    estimate = along_rays(scene, light, same(lambert(1.0), scene), origins, down, samples=4096)
    cosine = torch.cos(torch.atan(x * math.tan(math.radians(30))))
    expected = 100 * math.sin(math.radians(3)) ** 2 * cosine.double()
    assert agrees(estimate, expected[:, None].expand(5, 3), floor=5e-3)
    assert not torch.allclose(estimate.mean[0], estimate.mean[2], rtol=0.05)


@pytest.mark.parametrize(("axis", "expected"), [(0, math.pi * 3 / 8), (1, math.pi * 7 / 24)])
def test_tangents_reach_the_material(axis: int, expected: float) -> None:
    """Light 1 + X^2 on a floor with f = x^2, x along world X or along Z, seen at a hit and at a given point.

    Integrals over the hemisphere with the cosine: x^2 pi/4, x^4 pi/8, x^2 y^2 pi/24; so 3 pi/8 and 7 pi/24.
    """
    vertices, faces = mesh.plane_mesh(2.0)
    uv = vertices[:, [0, 2]] if axis == 0 else vertices[:, [2, 0]]
    scene = Scene.from_mesh(vertices, faces, uv=uv)
    material = Material(0.0, 1.0, Named("brushed", lambda wi, _: wi[..., 0] ** 2, isotropic=False))
    x = LatLong(256, 512).directions()[..., :1]
    light = Environment((1 + x * x).float().expand(-1, -1, 3).contiguous())
    origins = torch.tensor([[0.3, 1.0, 0.1]]).expand(8, 3)
    down = torch.tensor([[0.0, -1.0, 0.0]]).expand(8, 3)
    at_hits = over_points(along_rays(scene, light, same(material, scene), origins, down, samples=8192))
    points = reference.vertex_points(scene).take(torch.zeros(8, dtype=torch.int64))
    given = over_points(radiance(scene, light, same(material, scene), points, -down, samples=8192))
    for estimate in (at_hits, given):
        assert (estimate.standard_error < 0.01).all()
        assert agrees(estimate, expected, floor=1e-4)


def test_a_glowing_box() -> None:
    """Inside of a closed box that glows with 2 and reflects 0.5, without other light: 2, 2 + 1, 2 + 1 + 0.5."""
    vertices, faces = mesh.box_mesh()
    glow = Texture(torch.full((1, 1, 3), 2.0))
    part = Part("box", vertices, faces.flip(1), material=lambert(0.5), glow=glow)
    scene = Scene.from_parts([part])
    inside = torch.zeros(8, 3)
    around = torch.nn.functional.normalize(torch.randn(8, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    for bounces, expected in enumerate((2.0, 3.0, 3.5)):
        estimate = along_rays(
            scene, Environment.constant(0.0), scene.materials, inside, around, bounces=bounces, samples=64
        )
        torch.testing.assert_close(estimate.mean, torch.full((8, 3), expected).double(), rtol=1e-4, atol=0)


def test_bumps_bend_what_is_hit() -> None:
    """A white floor whose normals all lean by t has (1 + cos t) / 2 of a light from everywhere: it hides the rest."""
    vertices, faces = mesh.plane_mesh(2000.0)
    leaned = BumpMap(torch.tensor([math.sin(0.5), 0.0, math.cos(0.5)]).expand(2, 2, 3))
    part = Part("floor", vertices, faces, uv=vertices[:, [0, 2]], material=lambert(1.0), bumps=leaned)
    scene = Scene.from_parts([part])
    origins = torch.tensor([[0.3, 1.0, 0.1]]).expand(8, 3)
    down = torch.tensor([[0.0, -1.0, 0.0]]).expand(8, 3)
    light = Environment.constant()
    estimate = over_points(along_rays(scene, light, scene.materials, origins, down, samples=4096))
    assert agrees(estimate, (1 + math.cos(0.5)) / 2, floor=1e-3)


def test_maps_are_looked_up_at_points_and_hits() -> None:
    """A map of one value is the uniform material, where light is seen by way of it, and at given points."""
    vertices, faces = mesh.plane_mesh(2.0)
    texture = Texture(torch.full((2, 2, 1), 0.4))
    scene = Scene.from_mesh(vertices, faces, uv=vertices[:, [0, 2]])
    light = Environment.sun_sky()
    origins = torch.tensor([[0.9, 0.4, 0.1]]).expand(8, 3)
    down = torch.nn.functional.normalize(torch.tensor([[-1.0, -0.7, 0.2]]), dim=1).expand(8, 3)
    points = reference.vertex_points(scene)
    estimates = []
    for material in (MetalRough(0.7, 0.6, 1.0, roughness_map=texture), metal_rough(0.7, 0.6, 0.4)):
        given = same(material, scene)
        hits = along_rays(scene, light, given, origins, down, samples=2048)
        at = radiance(scene, light, given, points, -down[:4], samples=2048)
        estimates.append((over_points(hits), over_points(at)))
    for one, two in zip(*estimates, strict=True):
        assert agrees(one, two.mean, floor=0.01)
    bare = Points(*points[:4])
    with pytest.raises(ValueError, match="must have triangle and barycentric"):
        radiance(scene, light, same(MetalRough(roughness_map=texture), scene), bare, -down[:4])


def test_base_colour_multiplies_the_diffuse_part() -> None:
    """At vertices their colours, at hits the texture: red left, green right."""
    vertices, faces = mesh.plane_mesh(2.0)
    texture = torch.zeros(4, 8, 3)
    texture[:, :4, 0], texture[:, 4:, 1] = 1.0, 1.0
    uv = (vertices[:, [0, 2]] + 1) / 2
    scene = Scene.from_mesh(vertices, faces, uv=uv, texture=texture)
    light = Environment.constant()
    materials = same(lambert((0.8, 0.6, 0.4)), scene)
    origins = torch.tensor([[-0.5, 1.0, 0.2], [0.5, 1.0, 0.2]])
    down = torch.tensor([[0.0, -1.0, 0.0]]).expand(2, 3)
    hit = along_rays(scene, light, materials, origins, down, samples=2048)
    assert agrees(hit, torch.tensor([[0.8, 0, 0], [0, 0.6, 0]]).double())
    points = floor_point()._replace(colour=torch.tensor([[0.5, 0.25, 0.0]]))
    assert agrees(radiance(scene, light, materials, points, -down[:1], samples=2048),
                  torch.tensor([[0.4, 0.15, 0.0]]).double())  # fmt: skip


def test_image_shows_the_environment_behind_and_nothing_on_backs() -> None:
    scene = scene_of(plane(1.0))
    light = Environment.gradient_sky()
    from_above = Camera((0.0, 2.0, 0.01), (0.0, 0.0, 0.0), fov=60.0, width=24, height=16)
    from_below = replace(from_above, eye=(0.0, -2.0, 0.01))
    for camera, lit in ((from_above, True), (from_below, False)):
        picture = image(scene, light, same(lambert(0.5), scene), camera, samples=64)
        directions = camera.rays()[1]
        assert picture.mean.shape == picture.standard_error.shape == (16, 24, 3)
        assert torch.equal(picture.mean[0, 0], light.radiance(directions[0, 0]).double())
        assert not picture.standard_error[0, 0].any()
        assert bool(picture.mean[8, 12].any()) is lit
    upright = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), width=8, height=8)
    picture = image(scene, light, same(lambert(0.5), scene), upright, samples=2)
    assert picture.mean[0, 0, 2] > picture.mean[-1, 0, 2] + 0.5  # sky on top, ground below


def test_nothing_is_seen_from_below_the_shading_horizon() -> None:
    scene = scene_of(plane())
    wo = torch.tensor([[0.6, 0.8, 0.0], [0.6, -0.8, 0.0], [1.0, 0.0, 0.0]])
    estimate = radiance(scene, Environment.constant(), same(lambert(0.5), scene), floor_point(n=3), wo)
    assert estimate.mean[0].all()
    assert not estimate.mean[1:].any()


@pytest.mark.parametrize("material", [
    blinn_phong(0.1, 1.0, 1e6), cook_torrance(0.0, 1.0, 1.0, 2e-4), cook_torrance(0.0, 1.0, 0.0, 1.0), lambert(0.0)
], ids=lambda m: repr(m.shape))  # fmt: skip
def test_extremes_are_finite(material: Material) -> None:
    scene = ptt.default_scene()
    light = Environment.sun_sky()
    estimate = at_vertices(scene, light, same(material, scene), scene.camera, bounces=2, samples=16)
    assert estimate.mean.isfinite().all() and estimate.standard_error.isfinite().all()
    assert (estimate.mean >= 0).all()


# Refusals


def test_wrong_arguments() -> None:
    scene = scene_of(plane(), plane(shift=(0, -1, 0)))
    light = Environment.constant()
    materials = same(lambert(0.5), scene)
    points = floor_point()
    wo = toward(10.0)
    with pytest.raises(ValueError, match=r"every region.*plane1"):
        radiance(scene, light, {"plane0": lambert(0.5)}, points, wo)
    with pytest.raises(ValueError, match=r"bounces must be at least 0.*-1"):
        radiance(scene, light, materials, points, wo, bounces=-1)
    with pytest.raises(ValueError, match=r"samples at least 2.*1"):
        radiance(scene, light, materials, points, wo, samples=1)
    with pytest.raises(ValueError, match=r"wo must be \(1, 3\).*\(2, 3\)"):
        radiance(scene, light, materials, points, wo.expand(2, 3))
    with pytest.raises(ValueError, match=r"points.colour must be \(1, 3\).*\(1, 4\)"):
        radiance(scene, light, materials, points._replace(colour=torch.ones(1, 4)), wo)
    with pytest.raises(ValueError, match=r"points.region must index 2 regions, got 2..2"):
        radiance(scene, light, materials, points._replace(region=torch.tensor([2])), wo)


def test_no_points() -> None:
    scene = scene_of(plane())
    estimate = radiance(scene, Environment.constant(), same(lambert(0.5), scene), floor_point(n=0), torch.zeros(0, 3))
    assert estimate.mean.shape == (0, 3)
