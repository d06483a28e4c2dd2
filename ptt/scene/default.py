"""The scene that comes with the package: a knot, a ball and a leaning slab on a floor, made in code."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ptt.light.environment import Environment
from ptt.materials.material import blinn_phong
from ptt.ops import mesh
from ptt.ops.directions import turn
from ptt.scene.camera import Camera
from ptt.scene.parts import Part, transformed
from ptt.scene.scene import Scene

GAP = 0.004  # distance between the floor and what stands on it, so that no triangles touch


def default_scene() -> Scene:
    """About 8,000 vertices in four regions, all editable: floor, knot, ball, slab; under a sun and a sky."""
    floor = Part("floor", *_floor(5.0, 64), material=blinn_phong((0.55, 0.53, 0.5), 0.06, 8.0))
    knot = Part("knot", *_knot(), material=blinn_phong((0.45, 0.16, 0.06), (0.4, 0.25, 0.12), 30.0))
    ball = Part("ball", *mesh.sphere_mesh(3, 0.36), material=blinn_phong((0.08, 0.22, 0.42), 0.25, 60.0))
    slab = Part("slab", *mesh.box_mesh((0.9, 1.6, 0.16), 8), material=blinn_phong(0.42, 0.08, 12.0))
    placed = [
        floor,
        _standing(knot, 0.0, 20.0, (-0.25, 0.1)),
        _standing(ball, 0.0, 0.0, (0.75, 0.75)),
        _standing(slab, -16.0, -32.0, (0.95, -0.7)),
    ]
    sky = Environment.sun_sky(direction=(0.5, 1.0, 0.35), radius=6.0)
    return Scene.from_parts(placed, sky, Camera(eye=(0.7, 1.8, 4.2), target=(0.15, 0.62, 0.0), fov=35.0))


def _floor(size: float, cells: int) -> tuple[Tensor, Tensor]:
    """A square grid, finest in the middle, where shadows fall: 0.45 of the even spacing there, 2.1 of it at the rim."""
    vertices, faces = mesh.plane_mesh(2.0, cells)
    return (0.45 * vertices + 0.55 * vertices**3) * (size / 2), faces


def _knot() -> tuple[Tensor, Tensor]:
    """An upright trefoil knot."""
    t = torch.arange(180, dtype=torch.float64) * (2 * math.pi / 180)
    reach = 0.52 + 0.24 * torch.cos(3 * t)
    path = torch.stack([reach * torch.cos(2 * t), reach * torch.sin(2 * t), -0.26 * torch.sin(3 * t)], 1)
    return mesh.tube_mesh(path, 0.15, 14)


def _standing(part: Part, lean: float, around: float, place: tuple[float, float]) -> Part:
    """The part leant about x and turned about y [degrees], standing on the floor at (x, z)."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = turn(1, around) @ turn(0, lean)
    lowest = float((part.vertices.double() @ matrix[:3, :3].T)[:, 1].min())
    matrix[:3, 3] = torch.tensor([place[0], GAP - lowest, place[1]])
    return transformed(part, matrix)
