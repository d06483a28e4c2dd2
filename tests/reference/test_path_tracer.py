"""The path tracer on Ward and GGX materials, against the quadrature over half vectors of `ops.albedo`."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import ptt
from ptt import Environment, Material, Scene
from ptt.ops import mesh
from ptt.ops.albedo import albedo, nodes
from ptt.ops.sphere import LatLong
from ptt.reference import Estimate, Points, radiance, vertex_points
from ptt.scene.parts import Part

FLOOR = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # frame of a floor: the normal is +y
SHAPES = [
    ptt.Ward(0.15),
    ptt.Ward(0.6),
    ptt.Ward(0.4, 0.1),
    ptt.Ward(0.08, 0.3),
    ptt.GGX(0.04, 0.5),
    ptt.GGX(0.9, 0.25),
    ptt.GGX(1.0, 1.0),
]
BLENDS = [
    ptt.Named("mine", ptt.BlinnPhong(8.0).evaluate),
    ptt.Blend((ptt.Ward(0.5), ptt.GGX(0.5, 0.6)), (0.5, 0.25)),
]


def smooth_sky() -> Environment:
    """Of low order in the direction, without a symmetry that would hide a turned or mirrored frame."""
    x, y, z = LatLong(128, 256).directions().unbind(-1)
    return Environment(torch.stack([1 + 0.6 * y + 0.3 * x, 1 + x * z + 0.5 * x, 0.5 + y * y + 0.4 * z], -1).float())


def toward(degrees: float, turn: float = 30.0) -> Tensor:
    """World direction (1, 3) at an angle to +y."""
    a = math.radians(degrees)
    b = math.radians(turn)
    return torch.tensor([[math.sin(a) * math.cos(b), math.cos(a), math.sin(a) * math.sin(b)]])


def floor() -> tuple[Scene, Points]:
    scene = Scene.from_parts([Part("floor", *mesh.plane_mesh(2.0), material=ptt.lambert(1.0))])
    return scene, Points(torch.zeros(1, 3), FLOOR[None], torch.zeros(1, dtype=torch.long), torch.ones(1, 3))


def quadrature(material: Material, environment: Environment, frame: Tensor, wo: Tensor) -> Tensor:
    """The integral (3,) of f L cos over the hemisphere, in float64."""
    frame = frame.double()
    local = torch.nn.functional.normalize(frame @ wo[0].double(), dim=0)
    wi, weights = nodes(local, 1e-4, 160, 160)
    light = environment.radiance((wi @ frame).float()).double()
    return (material.evaluate(wi, local.expand_as(wi)) * light * weights[:, None]).sum(0)


def agrees(estimate: Estimate, expected: Tensor) -> bool:
    """Within four standard errors, and what the sky's texels cost."""
    return bool(((estimate.mean - expected).abs() <= 4 * estimate.standard_error + 5e-4 * expected.abs()).all())


@pytest.mark.parametrize("shape", SHAPES + BLENDS, ids=repr)
@pytest.mark.parametrize(("tilt", "turn"), [(5.0, 30.0), (60.0, 200.0)])
def test_radiance_is_the_integral(shape: ptt.materials.shapes.Shape, tilt: float, turn: float) -> None:
    (scene, points) = floor()
    wo = toward(tilt, turn)
    material = ptt.Material((0.2, 0.1, 0.3), (0.5, 0.7, 0.9), shape)
    estimate = radiance(scene, smooth_sky(), {"floor": material}, points, wo, samples=1 << 14)
    assert bool((estimate.standard_error < 0.02 * estimate.mean).all())
    assert agrees(estimate, quadrature(material, smooth_sky(), FLOOR, wo))


@pytest.mark.parametrize("shape", [ptt.Ward(0.4, 0.1), ptt.GGX(0.5, 0.4)], ids=repr)
def test_on_a_sphere_the_lobe_follows_the_frame(shape: ptt.materials.shapes.Shape) -> None:
    scene = Scene.from_mesh(*mesh.sphere_mesh(3))
    everywhere = vertex_points(scene)
    material = ptt.Material(0.1, 0.8, shape)
    for vertex in (40, 300):
        points = everywhere.take(slice(vertex, vertex + 1))
        frame = points.frame[0]
        wo = torch.nn.functional.normalize(frame[2] + 0.8 * frame[0] - 0.3 * frame[1], dim=0)[None]
        materials = {region.name: material for region in scene.regions}
        estimate = radiance(scene, smooth_sky(), materials, points, wo, samples=1 << 14)
        colour = ptt.Material(material.diffuse * points.colour[0], material.specular, shape)
        assert agrees(estimate, quadrature(colour, smooth_sky(), frame, wo))


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_a_constant_sky_gives_the_albedo(shape: ptt.materials.shapes.Shape) -> None:
    (scene, points) = floor()
    wo = toward(45.0)
    material = ptt.Material((0.0, 0.1, 0.2), (1.0, 0.5, 0.25), shape)
    estimate = radiance(scene, Environment.constant(), {"floor": material}, points, wo, samples=1 << 14)
    size = float(albedo(shape.evaluate, (FLOOR @ wo[0])[None], turns=160))
    assert agrees(estimate, material.diffuse.double() + material.specular.double() * size)


def test_parameters_that_require_gradients_are_traced_without_a_warning(recwarn: pytest.WarningsRecorder) -> None:
    (scene, points) = floor()
    roughness = torch.tensor(0.4, requires_grad=True)
    material = ptt.ggx(0.1, torch.tensor([0.5, 0.5, 0.5], requires_grad=True), 0.5, roughness)
    estimate = radiance(scene, smooth_sky(), {"floor": material}, points, toward(20.0), samples=256)
    assert not estimate.mean.requires_grad and bool((estimate.mean > 0).all())
    assert not [str(w.message) for w in recwarn if "requires_grad" in str(w.message)]
