"""The path-traced reference against Mitsuba 3: the same mesh, vertex normals, light and rays, diffuse materials.

    compare(scene, environment, bounces=1, rays=2000, samples=1024)   # a dict of what the z scores say
    side_by_side("check.png", scene, environment, bounces=1)          # reference, Mitsuba, 10 x their difference

Mitsuba's `path` integrator is run sample by sample along given rays (scalar_rgb), so that both sides see the same
rays and each has a standard error. Its environment map interpolates rows at v = r / (H - 1) and columns at half
texels: 2 H + 1 rows hold our interpolant, whose knots lie at half texels, without loss.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ptt.light.environment import Environment
from ptt.materials.material import Material, lambert
from ptt.ops import latlong
from ptt.reference import Estimate, along_rays
from ptt.scene.scene import Scene

ROUNDING = 1e-4  # of the radiance: what float32 lookups cost at sharp edges of a map, where neither side has an error


def matt(scene: Scene) -> dict[str, Material]:
    """The scene's materials without their specular part."""
    return {name: lambert(material.diffuse.tolist()) for name, material in scene.materials.items()}


def mitsuba_scene(scene: Scene, environment: Environment) -> Any:
    """The scene with `matt` materials as one Mitsuba mesh whose vertices carry the albedo.

    Raises:
        ValueError: a region has a texture.
    """
    if any(region.texture is not None for region in scene.regions):
        raise ValueError("scene must have no textures: Mitsuba is given the vertices' base colours")
    mi.set_variant("scalar_rgb")
    diffuse = torch.stack([scene.materials[region.name].diffuse for region in scene.regions])
    albedo = diffuse[scene.vertex_region] * scene.colours
    properties = mi.Properties()
    reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    mesh = mi.Mesh("scene", len(scene.vertices), len(scene.faces), has_vertex_normals=True, props=properties)
    mesh.add_attribute("vertex_color", 3, albedo.reshape(-1).tolist())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.vertices.reshape(-1).numpy()
    parameters["vertex_normals"] = scene.normals.reshape(-1).numpy()
    parameters["faces"] = scene.faces.reshape(-1).numpy().astype(np.uint32)
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh, "light": mitsuba_light(environment)})


def mitsuba_light(environment: Environment) -> dict[str, Any]:
    """The same function on the sphere as an `envmap`."""
    mi.set_variant("scalar_rgb")
    height = environment.map.shape[0] * 2 + 1
    width = environment.map.shape[1]
    theta = torch.arange(height, dtype=torch.float64)[:, None] * (math.pi / (height - 1))
    theta = theta.clamp(1e-6, math.pi - 1e-6)  # at the poles themselves a direction has no column
    phi = (torch.arange(width, dtype=torch.float64) + 0.5) * (2 * math.pi / width)
    y = theta.cos().expand(-1, width)
    directions = torch.stack([theta.sin() * phi.sin(), y, -theta.sin() * phi.cos()], -1)
    texels = latlong.radiance(environment.map, directions.float())
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = environment.rotation
    to_world = mi.ScalarTransform4f(turn.numpy())
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.float().numpy()), "to_world": to_world}


def mitsuba_radiance(
    target: Any, origins: Tensor, directions: Tensor, *, bounces: int, samples: int, seed: int = 0
) -> Estimate:
    """Radiance (n, 3) along rays (n, 3), (n, 3) by Mitsuba's `path`, with its standard error."""
    path = mi.load_dict({"type": "path", "max_depth": bounces + 2, "rr_depth": 1 << 20})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    means = []
    errors = []
    for origin, direction in zip(origins.tolist(), directions.tolist(), strict=True):
        ray = mi.RayDifferential3f(mi.Point3f(origin), mi.Vector3f(direction))
        values = np.array([path.sample(target, sampler, ray)[0] for _ in range(samples)], dtype=np.float64)
        means.append(values.mean(0))
        errors.append(values.std(0, ddof=1) / math.sqrt(samples))
    return Estimate(torch.tensor(np.array(means)), torch.tensor(np.array(errors)))


def camera_rays(scene: Scene, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """`count` of the camera's rays that hit the scene, at random: origins and directions (n, 3)."""
    if scene.camera is None:
        raise ValueError("scene must have a camera")
    eye, directions = scene.camera.rays()
    directions = directions.reshape(-1, 3)
    hit = scene.surface.first_hit(eye.expand_as(directions), directions).triangle >= 0
    seen = torch.nonzero(hit)[:, 0]
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(seed))
    chosen = directions[seen[order[:count]]]
    return eye.expand_as(chosen), chosen


def compare(
    scene: Scene,
    environment: Environment,
    bounces: int,
    rays: int = 2000,
    samples: int = 1024,
    seed: int = 0,
) -> dict[str, float]:
    """Compare both along `rays` of the scene's camera, with `matt` materials.

    The keys that `scores` gives, and the seconds that each side took.
    """
    origins, directions = camera_rays(scene, rays, seed)
    start = time.perf_counter()
    settings: dict[str, Any] = {"bounces": bounces, "samples": samples, "seed": seed}
    ours = along_rays(scene, environment, matt(scene), origins, directions, **settings)
    middle = time.perf_counter()
    theirs = mitsuba_radiance(mitsuba_scene(scene, environment), origins, directions, **settings)
    seconds = {"seconds_ours": middle - start, "seconds_mitsuba": time.perf_counter() - middle}
    return scores(ours, theirs) | seconds


def scores(ours: Estimate, theirs: Estimate) -> dict[str, float]:
    """How two independent estimates (n, 3) differ.

    within_3: fraction of z = (ours - theirs) / standard error within 3 (0.997 if both are right)
    z_rms: their root mean square (1), z_max: the largest
    bias_z: z of the mean over all rays, the largest of the colours; bias: that mean difference, relative
    noise: root mean square of the standard error, relative to that of the radiance
    """
    difference = ours.mean - theirs.mean
    rounding = ROUNDING * theirs.mean.abs()
    variance = ours.standard_error**2 + theirs.standard_error**2 + rounding**2
    z = (difference / variance.sqrt())[variance > 0]
    bias = difference.mean(0)
    bias_error = variance.sum(0).sqrt() / len(difference) + rounding.mean(0)
    return {
        "rays": float(len(difference)),
        "within_3": float((z.abs() <= 3).double().mean()),
        "z_rms": float(z.square().mean().sqrt()),
        "z_max": float(z.abs().max()),
        "bias_z": float((bias / bias_error).abs().max()),
        "bias": float(bias.mean() / theirs.mean.mean()),
        "noise": float((variance.mean() / theirs.mean.square().mean()).sqrt()),
    }


def side_by_side(
    path: str | Path,
    scene: Scene,
    environment: Environment,
    *,
    bounces: int = 1,
    samples: int = 64,
    gain: float = 10.0,
) -> dict[str, float]:
    """Write reference, Mitsuba, and `gain` times their difference (0 is grey) side by side; gives `scores`."""
    if scene.camera is None:
        raise ValueError("scene must have a camera")
    eye, directions = scene.camera.rays()
    rays = directions.reshape(-1, 3)
    eyes = eye.expand_as(rays)
    ours = along_rays(scene, environment, matt(scene), eyes, rays, bounces=bounces, samples=samples)
    target = mitsuba_scene(scene, environment)
    theirs = mitsuba_radiance(target, eyes, rays, bounces=bounces, samples=samples)
    white = float(torch.quantile(theirs.mean.mean(1), 0.98).clamp(min=1e-12))
    difference = 0.5 + gain * (ours.mean - theirs.mean) / white / 2
    panels = [_encoded(ours.mean / white), _encoded(theirs.mean / white), difference.clamp(0, 1)]
    picture = torch.cat([panel.reshape(directions.shape) for panel in panels], 1)
    Image.fromarray((picture * 255).round().to(torch.uint8).numpy()).save(path)
    return scores(ours, theirs)


def _encoded(linear: Tensor) -> Tensor:
    return linear.clamp(0, 1) ** (1 / 2.2)
