"""Transfer tensors: how the light from each direction arrives at a point, before any lighting is known.

T0[v, i, t] = visibility[v, t] * factor_i(local direction) * cosine * solid angle      (Sun et al. 2007, section 3.3)

so that sum over t of L[t] T0[v, i, t] is the integral of lighting, visibility, cosine and the i-th incident factor.
Factor 0 is the constant 1, for diffuse reflection.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ptt.ops import lobes
from ptt.ops.constants import NORMAL, NOTHING
from ptt.ops.octahedral import HemiOctahedral, octahedral, sampled
from ptt.ops.raycast import Hits, Surface
from ptt.ops.sphere import Cube

GOLDEN = math.pi * (3 - math.sqrt(5))  # turn [rad] from one direction of the spiral of `gather_directions` to the next
POINTS_AT_ONCE = 64  # whose visibility is unpacked for lobes


def visibility(surface: Surface, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """Visibility of directions (t, 3) from points (v, 3), one ray each, as packed bits (v, ceil(t / 8)) uint8.

    A direction at or below the horizon of the point's normal (v, 3) counts as hidden.
    """
    above = normals.double() @ directions.double().T > 0  # shape: (v, t)
    point, texel = above.nonzero(as_tuple=True)
    origins = surface.offset(points, normals)
    above[point, texel] = ~surface.occluded(origins[point], directions[texel])
    return torch.from_numpy(np.packbits(above.numpy(), axis=1))


def gather_directions(count: int) -> Tensor:
    """Local directions (n, 3), float64, spread with a density proportional to the cosine: a spiral on the disk."""
    k = torch.arange(count, dtype=torch.float64)
    r2 = (k + 0.5) / count
    return torch.stack((r2.sqrt() * (GOLDEN * k).cos(), r2.sqrt() * (GOLDEN * k).sin(), (1 - r2).sqrt()), -1)


def gather(surface: Surface, faces: Tensor, points: Tensor, frames: Tensor, local: Tensor, u: Tensor) -> Tensor:
    """The vertex (v, n) int32 that each point sees in each local direction (n, 3); -1 for none.

    surface, faces (f, 3): the scene's triangles
    points (v, 3), frames (v, 3, 3): positions, and rows tangent, bitangent, normal
    u (v, n): uniform numbers that draw one corner of the triangle that is hit by its barycentric weight, so that the
        expectation of what is read there is the interpolated value

    Back faces show nothing.
    """
    hits = first_hits(surface, points, frames, local)
    corner = (hits.barycentric.cumsum(1)[:, :2] < u.flatten()[:, None]).sum(1)
    return _corners(faces, torch.where(hits.front, hits.triangle, -1), corner).reshape(u.shape)


def meets(surface: Surface, faces: Tensor, shading: Tensor, points: Tensor, frames: Tensor, local: Tensor) -> Tensor:
    """What each point sees in each local direction (n, 3), n even: (v, 3 n / 2) int32, as `meets_packed`: the vertex,
    the nearest of the triangle, and the normal in the world, interpolated between vertices. That of a back face points
    away from what sees it.

    surface, faces, points, frames: as for `gather`
    shading (p, 3, 3): frames of all vertices
    """
    hits = first_hits(surface, points, frames, local)
    met = _corners(faces, hits.triangle, hits.barycentric.argmax(1))
    corner_normals = shading[faces[hits.triangle.clamp(min=0)], 2]  # shape: (v * n, 3, 3)
    normal = (hits.barycentric[:, None].to(shading) @ corner_normals)[:, 0]
    normal = torch.where(hits.front[:, None], normal, (local.to(frames) @ frames).flatten(0, 1).to(normal))
    seen = len(points), len(local)
    return meets_packed(met.reshape(seen), normal.reshape(*seen, 3))


def meets_packed(met: Tensor, normals: Tensor) -> Tensor:
    """Vertices (v, n) int32, -1 for none, and normals (v, n, 3) there, as words (v, 3 n / 2) int32: of two directions
    the vertices, and then the normals, in two signed bytes each.

    Bytes are 127ths of coordinates on the map of the sphere (`octahedral`), right to 0.9 degrees, `NOTHING` for none.
    """
    v, n = met.shape
    up = normals.new_tensor([0.0, 0.0, 1.0])
    coordinates = (octahedral(torch.where(met[..., None] < 0, up, normals)) * NORMAL).round()
    coordinates = torch.where(met[..., None] < 0, NOTHING, coordinates).to(torch.int8)
    words = coordinates.flatten().view(torch.int32).reshape(v, n // 2, 1)
    return torch.cat((met.reshape(v, n // 2, 2), words), 2).reshape(v, n // 2 * 3)


def vertices_met(packed: Tensor) -> Tensor:
    """The vertices (v, n) int32 in words (v, 3 n / 2) of `meets_packed`."""
    v, words = packed.shape
    return packed.reshape(v, words // 3, 3)[..., :2].reshape(v, words // 3 * 2)


def first_hits(surface: Surface, points: Tensor, frames: Tensor, local: Tensor) -> Hits:
    """What points (v, ...) see in local directions (n, 3), v * n of them."""
    directions = (local.to(frames) @ frames).flatten(0, 1)
    return surface.first_hit(surface.offset(points, frames[:, 2]).repeat_interleave(len(local), 0), directions)


def _corners(faces: Tensor, triangle: Tensor, corner: Tensor) -> Tensor:
    """The vertices (n,) int32 at some corners (n,) of triangles (n,); -1 for none."""
    return torch.where(triangle < 0, -1, faces[triangle.clamp(min=0), corner]).int()


def unpack(bits: Tensor, length: int) -> Tensor:
    """The bits (v, t) bool of packed ones (v, ceil(t / 8)) uint8; length: t."""
    return torch.from_numpy(np.unpackbits(bits.numpy(), axis=1, count=length)).bool()


def lobe_visibility(
    bits: Tensor, frames: Tensor, grid: Cube, cells: int, angles: Sequence[float], fine: int = 64
) -> Tensor:
    """The share (v, cells * cells, k) uint8, in 255ths, of each lobe about a local direction that gets through.

    bits (v, bytes): packed visibility of the cells of a cube map (`visibility`)
    frames (v, 3, 3): rows tangent, bitangent, normal
    cells: cells along an edge of the map of axes, a `HemiOctahedral` grid
    angles (k): widths of the lobes [degrees]
    fine: cells along an edge of the local map on which the lobes are integrated

    Directions weigh as Gaussian times cosine; what lies below the horizon is hidden.

    Sun et al. 2007, section 4.1.
    """
    parts = [_through(seen, cells, fine, tuple(angles)) for seen in _on_hemispheres(bits, frames, grid, fine)]
    return torch.cat(parts).reshape(len(bits), cells * cells, len(angles))


def hemispheres(bits: Tensor, frames: Tensor, grid: Cube, cells: int, shares: Mapping[float, int]) -> Tensor:
    """What points see of their own hemispheres (v, words) int32: a bit for each cell of a `HemiOctahedral` map with so
    many along an edge, then a byte for each cell of the `lobe_visibility` of lobes of some degrees, on maps of so many.

    bits, frames, grid: as for `lobe_visibility`
    """
    return torch.cat([_packed(seen, cells, shares) for seen in _on_hemispheres(bits, frames, grid, cells)])


def _on_hemispheres(bits: Tensor, frames: Tensor, grid: Cube, cells: int) -> Iterator[Tensor]:
    """What is seen (b, cells * cells) bool of the cells of a map of the hemisphere, of some points after the others."""
    local = HemiOctahedral(cells).directions().reshape(-1, 3).to(frames)
    for some, turned in zip(bits.split(POINTS_AT_ONCE), frames.split(POINTS_AT_ONCE), strict=True):
        yield unpack(some, grid.cells).gather(1, grid.cell(local @ turned))


def traced_hemispheres(
    surface: Surface, points: Tensor, frames: Tensor, cells: int, shares: Mapping[float, int]
) -> Tensor:
    """The same as `hemispheres`, by a ray for each four cells, and one for each of the four whose neighbours differ: in
    a trial on a statue a third as many rays as cells, and as right under lamps as with all."""
    coarse, fine = (HemiOctahedral(side).directions().reshape(-1, 3).to(frames) for side in (cells // 2, cells))
    parts = []
    for some, turned in zip(points.split(POINTS_AT_ONCE), frames.split(POINTS_AT_ONCE), strict=True):
        origins = surface.offset(some, turned[:, 2])
        hidden = surface.occluded(origins.repeat_interleave(len(coarse), 0), (coarse @ turned).flatten(0, 1))
        seen, point, cell = _refined(~hidden.reshape(len(some), cells // 2, -1))
        directions = (fine[cell, None] @ turned[point])[:, 0]
        seen[point, cell] = ~surface.occluded(origins[point], directions)
        parts.append(_packed(seen, cells, shares))
    return torch.cat(parts)


def _refined(seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What is seen of cells (v, n, n) bool, of their quarters (v, 4 n n), and the points (k,) and quarters (k,) whose
    cells differ from a neighbour."""
    share = seen[:, None].float()
    most, least = max_pool2d(share, 3, 1, 1), -max_pool2d(-share, 3, 1, 1)
    differ, fine = ((each.repeat_interleave(2, 1).repeat_interleave(2, 2)) for each in ((most != least)[:, 0], seen))
    point, cell = differ.flatten(1).nonzero(as_tuple=True)
    return fine.flatten(1), point, cell


def _packed(seen: Tensor, cells: int, shares: Mapping[float, int]) -> Tensor:
    """Words (v, words) int32 of what is seen (v, cells * cells) bool of the cells of a map of the hemisphere."""
    packed = torch.from_numpy(np.packbits(seen.numpy(), axis=1, bitorder="little"))
    wide = [_through(seen, side, cells, (angle,)) for angle, side in shares.items()]
    return torch.cat((packed, *wide), 1).view(torch.int32)


def _through(seen: Tensor, cells: int, fine: int, angles: tuple[float, ...]) -> Tensor:
    """The share (v, cells * cells * k) uint8 of lobes of which fine cells are seen (v, fine * fine)."""
    filters = _lobe_filters(cells, fine, angles)
    return (seen.to(filters) @ filters).mul_(255).round_().to(torch.uint8)


@cache
def _lobe_filters(cells: int, fine: int, angles: tuple[float, ...]) -> Tensor:
    """Weights (fine * fine, cells * cells * k) of the fine cells under each lobe about each axis; they sum to 1."""
    grid = HemiOctahedral(fine)
    wi = grid.directions().reshape(-1, 3)
    solid = grid.solid_angles().flatten()
    axes = HemiOctahedral(cells).directions().reshape(-1, 3)
    angle = lobes.angle_between(axes[:, None], wi)  # shape: (cells^2, fine^2)
    weight = torch.stack([lobes.gaussian(angle, a) for a in angles], 1) * (solid * wi[:, 2])
    return (weight / weight.sum(2, keepdim=True)).flatten(0, 1).T.float()


def lookup(table: Tensor, local: Tensor) -> Tensor:
    """Bilinear values (b, i, k) of a table on the disk grid (i, n, n) at local directions (b, 3, k); z is unused."""
    return sampled(table.expand(len(local), -1, -1, -1), local[:, :2])


def direct_transfer(
    visible: Tensor, frames: Tensor, directions: Tensor, solid_angles: Tensor, factors: Tensor
) -> Tensor:
    """T0 (v, 1 + i, t) in the texel basis.

    visible (v, t) bool: the texels that each point sees
    frames (v, 3, 3): rows tangent, bitangent, normal
    directions (t, 3), solid_angles (t,) [sr]: the lighting's texels
    factors (i, n, n): incident factors of the BRDF tensor on the disk grid

    The cosine weights of each point are scaled so that all of its hemisphere sums to pi exactly: without occlusion
    a constant map gives exactly its value, and with it never more.
    """
    local = frames @ directions.T  # shape: (v, 3, t)
    weight = local[:, 2].clamp(min=0) * solid_angles
    weight *= math.pi / weight.sum(1, keepdim=True)
    weight *= visible
    out = weight.new_empty(len(visible), 1 + len(factors), len(directions))
    out[:, 0] = weight
    torch.mul(lookup(factors, local), weight[:, None], out=out[:, 1:])
    return out
