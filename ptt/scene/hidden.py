"""Scenes without what nobody sees: the inside of a machine has as many vertices as its outside."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.ops import kinds
from ptt.ops.octahedral import Octahedral
from ptt.scene.scene import Scene
from ptt.scene.vertices import taken

TRIED_SIDE = 16  # cells along an edge of the octahedral grid of directions that are tried
DIRECTIONS_AT_ONCE = 32  # after which points that see out drop out: fewer rays, more calls


def without_hidden(scene: Scene) -> Scene:
    """The scene without the triangles that see no way out, nor their vertices.

    A triangle stays where a ray from one of its corners or its middle, to either side, meets nothing; 256 directions
    are tried. Nobody outside sees the triangles that are dropped, and no light reaches them but through slits.

    Raises:
        ValueError: a whole region is hidden.
    """
    kinds.check("scene", scene, Scene)
    faces = scene.faces
    keep = _sees_out(scene, scene.points, scene.normals)[faces].any(1)
    unsure = torch.nonzero(~keep)[:, 0]
    corners = scene.vertices[faces[unsure]]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    keep[unsure] = _sees_out(scene, corners.mean(1), torch.nn.functional.normalize(across, dim=1))
    for index, region in enumerate(scene.regions):
        if not bool(keep[scene.face_region == index].any()):
            raise ValueError(f"region {region.name!r} is hidden: nothing of it sees a way out of the scene")
    return only(scene, keep)


def only(scene: Scene, keep: Tensor) -> Scene:
    """The scene with those of its triangles that keep (f,) holds, and their vertices."""
    rows, renumbered = scene.faces[keep].unique(return_inverse=True)
    return taken(scene, rows, renumbered)


def _sees_out(scene: Scene, points: Tensor, normals: Tensor) -> Tensor:
    """Tell (n,) whether a ray leads out of the scene from each point (n, 3) of its surface."""
    directions = Octahedral(TRIED_SIDE).directions().reshape(-1, 3)
    directions = directions[torch.randperm(len(directions), generator=torch.Generator().manual_seed(0))]
    found = torch.zeros(len(points), dtype=torch.bool)
    for some in directions.split(DIRECTIONS_AT_ONCE):
        blind = torch.nonzero(~found)[:, 0]
        normal = normals[blind, None].double()
        side = torch.where((normal * some).sum(2, keepdim=True) > 0, normal, -normal)  # shape: (blind, some, 3)
        origins = scene.surface.offset(points[blind, None], side).reshape(-1, 3)
        hidden = scene.surface.occluded(origins, some.repeat(len(blind), 1))
        found[blind] = ~hidden.reshape(len(blind), len(some)).all(1)
    return found
