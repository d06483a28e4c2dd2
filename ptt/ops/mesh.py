"""Triangle meshes as tensors: checks, normals, tangents, subdivision, texture lookups, simple shapes.

Everywhere vertices (v, 3) are positions, and faces (f, 3) vertex indices, counter-clockwise from the front.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

FLAT = 1e-10  # a triangle has no direction where its doubled area is less than this share of its longest edge squared
CANCELLED = 1e-6  # a sum of unit vectors that is shorter has no direction
MARGIN = 0.02  # of dips: points are lit a little inside of their triangles, which are a little bent there
SEEN = 2.0  # the dip of a point that is seen from everywhere, more than any sine


def check_mesh(vertices: Tensor, faces: Tensor) -> None:
    """Refuse what no repair can save.

    Raises:
        ValueError: vertices are not finite (v, 3) floats, or faces not (f >= 1, 3) integers within 0..v-1.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not vertices.is_floating_point():
        raise ValueError(f"vertices must be (v, 3) floats, got {tuple(vertices.shape)} {vertices.dtype}")
    if faces.numel() == 0:
        raise ValueError(f"faces (f, 3) must hold at least one triangle, got {tuple(faces.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.is_floating_point() or faces.dtype == torch.bool:
        raise ValueError(f"faces must be (f, 3) integers, got {tuple(faces.shape)} {faces.dtype}")
    low = int(faces.min())
    high = int(faces.max())
    if low < 0:
        raise ValueError(f"faces (f, 3) must index vertices: min index {low} < 0")
    if high >= len(vertices):
        raise ValueError(f"faces (f, 3) must index vertices: max index {high} >= {len(vertices)}")
    if bad := int((~vertices.isfinite()).any(1).sum()):
        raise ValueError(f"vertices (v, 3) must be finite float32 numbers: {bad} of {len(vertices)} are not")


def face_crosses(vertices: Tensor, faces: Tensor) -> Tensor:
    """Front-facing normals (f, 3) whose length is twice the triangle's area; float64."""
    a, b, c = vertices.double()[faces].unbind(1)
    return torch.cross(b - a, c - a, dim=1)


def sound_faces(vertices: Tensor, faces: Tensor) -> Tensor:
    """Tell (f,) which triangles have an area: those that have not collapsed to a line or a point."""
    corners = vertices.double()[faces]
    longest = (corners - corners.roll(1, 1)).square().sum(-1).amax(1)
    return torch.gt(face_crosses(vertices, faces).norm(dim=1), FLAT * longest)


def corner_angles(vertices: Tensor, faces: Tensor) -> Tensor:
    """The angle at each corner (f, 3) [rad], float64; a sound triangle's sum to pi."""
    corners = vertices.double()[faces]
    ahead = corners.roll(-1, 1) - corners
    behind = corners.roll(1, 1) - corners
    return torch.atan2(torch.cross(ahead, behind, dim=-1).norm(dim=-1), (ahead * behind).sum(-1))


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (v, 3), float64: sums of the faces' normals, weighted by the faces' angles at the vertex.

    Zero where no face gives a direction: vertices outside every sound face, or amid faces that cancel.

    Thuermer and Wuethrich 1998.
    """
    normals = _unit(face_crosses(vertices, faces), 0.0)
    return _unit(_scatter(corner_angles(vertices, faces)[..., None] * normals[:, None], faces, len(vertices)))


def fill_normals(vertices: Tensor, normals: Tensor) -> Tensor:
    """Normals (v, 3) in which each zero row is replaced by the normal of the nearest vertex that has one.

    Raises:
        ValueError: no vertex has a normal.
    """
    known = (normals != 0).any(1)
    if not known.any():
        raise ValueError("faces (f, 3) must give a vertex a normal: every front cancels with a back")
    if known.all():
        return normals
    filled = normals.clone()
    sources = normals[known]
    for rows in torch.split(torch.nonzero(~known)[:, 0], 256):
        nearest = torch.cdist(vertices[rows].double(), vertices[known].double()).argmin(1)
        filled[rows] = sources[nearest]
    return filled


def tangents(vertices: Tensor, faces: Tensor, normals: Tensor, uv: Tensor | None = None) -> Tensor:
    """Unit tangents (v, 3), float64, orthogonal to the unit normals (v, 3).

    uv (v, 2): the tangent follows increasing u where the faces around the vertex give it a direction.
    Elsewhere the tangent is level, (0, 1, 0) x normal, or +x where the normal is vertical.
    """
    normals = normals.double()
    up = normals.new_tensor([0.0, 1.0, 0.0]).expand_as(normals)
    level = _unit(torch.cross(up, normals, dim=1))
    level = torch.where((level == 0).all(1, keepdim=True), normals.new_tensor([1.0, 0.0, 0.0]), level)
    if uv is not None:
        along = _unit(_across(_u_directions(vertices, faces, uv), normals))
        level = torch.where((along == 0).all(1, keepdim=True), level, along)
    return _unit(_across(level, normals))


def frames(normals: Tensor, tangents: Tensor, substitute: Callable[[Tensor], Tensor]) -> tuple[Tensor, int]:
    """Orthonormal frames (n, 3, 3), rows tangent, bitangent, normal, of interpolated normals and tangents (n, 3).

    substitute: gives unit normals (k, 3) for the rows (k,) whose normals are zero, as they are between vertices that
        look to opposite sides

    A tangent that is parallel to its normal is replaced by another. The number counts the frames that were repaired.
    """
    flat = (normals.norm(dim=1) < CANCELLED).nonzero()[:, 0]
    if len(flat):
        normals = normals.index_copy(0, flat, substitute(flat).to(normals))
    n = _unit(normals)
    t = _across(tangents, n)
    shortest = CANCELLED * tangents.norm(dim=1).clamp(min=CANCELLED)
    along = (t.norm(dim=1) < shortest).nonzero()[:, 0]
    if len(along):
        smallest = torch.nn.functional.one_hot(n[along].abs().argmin(1), 3).to(n)
        t = t.index_copy(0, along, _across(smallest, n[along]))
    t = _unit(t)
    return torch.stack((t, torch.linalg.cross(n, t), n), 1), len(torch.cat((flat, along)).unique())


def _u_directions(vertices: Tensor, faces: Tensor, uv: Tensor) -> Tensor:
    """Directions (v, 3), not unit, in which u grows: sums over faces, weighted by the faces' angles at the vertex."""
    a, b, c = vertices.double()[faces].unbind(1)
    s, t, r = uv.double()[faces].unbind(1)
    du1, dv1 = (t - s).unbind(-1)
    du2, dv2 = (r - s).unbind(-1)
    area = du1 * dv2 - du2 * dv1
    direction = ((b - a) * dv2[:, None] - (c - a) * dv1[:, None]) * area.sign()[:, None]
    angles = corner_angles(vertices, faces)[..., None]
    return _scatter(angles * _unit(direction, 0.0)[:, None], faces, len(vertices))


def mirrored(uv: Tensor, faces: Tensor) -> Tensor:
    """Tell (f,) where texture coordinates (v, 2) run clockwise around a triangle that is seen from the front."""
    s, t, r = uv.double()[faces].unbind(1)
    (du1, dv1), (du2, dv2) = (t - s).unbind(-1), (r - s).unbind(-1)
    return torch.lt(du1 * dv2 - du2 * dv1, 0)


def inset(vertices: Tensor, faces: Tensor, normals: Tensor, share: float) -> Tensor:
    """Vertices (v, 3) moved along the surface by a share of their way to the mean of their triangles' centres."""
    centres = vertices[faces].mean(1, keepdim=True).expand(-1, 3, -1)
    counts = torch.bincount(faces.flatten(), minlength=len(vertices))[:, None]
    ahead = _scatter(centres, faces, len(vertices)) / counts.clamp(min=1) - vertices
    return vertices + share * _across(ahead, normals) * (counts > 0)


def dips(vertices: Tensor, faces: Tensor, normals: Tensor) -> Tensor:
    """How far below its horizon each vertex (v,) is seen at most: the sine of the largest angle between its unit normal
    (v, 3) and those of its triangles. An eye below that sees the backs of all of them.

    A triangle turned to an eye at an angle of a to the normal has its own normal within 90 degrees of that way, so that
    the eye is less than a below the horizon. `SEEN` for vertices with triangles that face away from their normals.
    """
    flat = _unit(face_crosses(vertices, faces), 0.0).to(normals)
    cosine = (normals[faces] * flat[:, None]).sum(2)
    lowest = normals.new_ones(len(normals)).scatter_reduce(0, faces.flatten(), cosine.flatten(), "amin")
    return torch.where(lowest > 0, (1 - lowest.square()).clamp(min=0).sqrt() + MARGIN, SEEN)


def _scatter(values: Tensor, faces: Tensor, count: int) -> Tensor:
    """Sum the corners' values (f, 3, 3) at their vertices: (count, 3)."""
    return values.new_zeros(count, 3).index_add_(0, faces.reshape(-1), values.reshape(-1, 3))


def _across(vectors: Tensor, normals: Tensor) -> Tensor:
    """The part of vectors (..., 3) at right angles to unit normals (..., 3)."""
    return vectors - (vectors * normals).sum(-1, keepdim=True) * normals


def _unit(vectors: Tensor, shortest: float = CANCELLED) -> Tensor:
    """Vectors (..., 3) scaled to length 1; zero where they are not longer than `shortest`."""
    length = vectors.norm(dim=-1, keepdim=True)
    return torch.where(length > shortest, vectors / length.clamp(min=1e-300), 0.0)


def weld(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Join vertices at the same position: vertices (w, 3), faces (f, 3), the new index (v,) of each old vertex."""
    joined, index = torch.unique(vertices, dim=0, return_inverse=True)
    return joined, index[faces], index


def apart(faces: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Give the back of a sheet, faces (f, 3) that turn earlier ones over, its own vertices: together none has a normal.

    faces of a mesh with `count` vertices -> faces (f, 3), and the old vertex (w,) of each new one, the old ones first
    """
    rows = torch.arange(count, device=faces.device)
    ordered, order = faces.sort(1)
    flipped = (order[:, 0] - order[:, 1]) * (order[:, 1] - order[:, 2]) * (order[:, 2] - order[:, 0]) < 0
    _, pairs = torch.unique(ordered[:, 0] * count + ordered[:, 1], return_inverse=True)
    keys = pairs * count + ordered[:, 2]
    alike = keys.sort().values
    if not bool((alike[1:] == alike[:-1]).any()):
        return faces, rows
    _, index = torch.unique(keys, return_inverse=True)
    numbers = torch.arange(len(faces), device=faces.device)
    first = numbers.scatter_reduce(0, index, numbers, "amin", include_self=False)[index]
    back = flipped != flipped[first]
    if not bool(back.any()):
        return faces, rows
    own, renumbered = faces[back].unique(return_inverse=True)
    faces = faces.index_put((back,), renumbered + count)
    return faces, torch.cat((rows, own))


def looks_inwards(vertices: Tensor, faces: Tensor) -> bool:
    """Tell whether a surface is closed, every edge between two faces, and has its front inside: its volume is < 0."""
    centred = vertices.double() - vertices.double().mean(0)
    a, b, c = centred[faces].unbind(1)
    if float((a * torch.linalg.cross(b, c)).sum()) >= 0:
        return False
    _, joined, _ = weld(vertices, faces)
    joined = joined[sound_faces(vertices, faces)]
    ahead = joined.roll(-1, 1)
    there = (joined * len(vertices) + ahead).flatten().sort().values
    back = (ahead * len(vertices) + joined).flatten().sort().values
    return torch.equal(there, back)


def subdivide(faces: Tensor, count: int, cut: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Cut triangles at the middles of their edges: all edges, which makes four triangles of each, or some.

    faces (f, 3) of a mesh with `count` vertices -> faces (g, 3), edges (e, 2). The new vertex count + i is
    the middle of edges[i]; faces that share an edge share its middle. Winding is kept.
    cut (f, 3) bool: says which edges are cut, the first from corner 0 to corner 1; faces that share one must agree
    """
    cut = torch.ones_like(faces, dtype=torch.bool) if cut is None else cut
    pairs = torch.stack([faces, faces.roll(-1, 1)], -1).sort(-1).values  # shape: (f, 3, 2)
    edges, index = torch.unique(pairs[cut], dim=0, return_inverse=True)
    middles = torch.full_like(faces, -1)
    middles[cut] = index + count
    finer = []
    cuts = cut.sum(1)
    for number, pieces in enumerate(_PIECES):
        own = cuts == number
        # the cut edges come first: a single one, or those after the edge that is whole
        first = cut[own].int().argmax(1) if number == 1 else (~cut[own]).int().argmax(1) + 1
        around = (first[:, None] + torch.arange(3)) % 3
        six = torch.cat((faces[own].gather(1, around), middles[own].gather(1, around)), 1)
        finer.append(six[:, pieces].reshape(-1, 3))
    return torch.cat(finer), edges


_PIECES = (  # of a triangle with 0, 1, 2, 3 cut edges: corners are 0, 1, 2, the middles of the edges after them 3, 4, 5
    [0, 1, 2],
    [0, 3, 2, 3, 1, 2],
    [3, 1, 4, 0, 3, 4, 0, 4, 2],
    [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5],
)


def sample_texture(texture: Tensor, uv: Tensor, wrap: tuple[str, str] = ("repeat", "repeat")) -> Tensor:
    """Bilinear values (n, c) of a texture (h, w, c) at uv (n, 2); differentiable in the texture.

    u grows with the column, v against the row (v = 1 is the top of row 0); texel centres lie at half texels.
    wrap: how it goes on beyond its edges, along u and along v: repeat, mirror or clamp
    """
    height, width = texture.shape[:2]
    x = uv[:, 0].double() * width - 0.5
    y = (1 - uv[:, 1].double()) * height - 0.5
    column = x.floor()
    row = y.floor()
    fx = (x - column).to(texture)[:, None]
    fy = (y - row).to(texture)[:, None]
    c0, c1 = (_wrapped(column.long() + k, width, wrap[0]) for k in (0, 1))
    r0, r1 = (_wrapped(row.long() + k, height, wrap[1]) for k in (0, 1))
    top = texture[r0, c0] * (1 - fx) + texture[r0, c1] * fx
    return top * (1 - fy) + (texture[r1, c0] * (1 - fx) + texture[r1, c1] * fx) * fy


def _wrapped(index: Tensor, count: int, wrap: str) -> Tensor:
    """The texels 0..count-1 that stand for others."""
    if wrap == "clamp":
        return index.clamp(0, count - 1)
    if wrap == "repeat":
        return index % count
    there = index % (2 * count)
    return torch.minimum(there, 2 * count - 1 - there)


def plane_mesh(size: float = 1.0, cells: int = 1) -> tuple[Tensor, Tensor]:
    """A level square of `size` x `size` about the origin, facing +y: vertices ((cells + 1)^2, 3), faces (f, 3)."""
    ticks = torch.linspace(-size / 2, size / 2, cells + 1, dtype=torch.float64)
    z, x = torch.meshgrid(ticks, ticks, indexing="ij")
    vertices = torch.stack([x, torch.zeros_like(x), z], -1).reshape(-1, 3)
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).reshape(-1)
    return vertices.float(), _quads(corner, corner + cells + 1, corner + cells + 2, corner + 1)


def box_mesh(size: tuple[float, float, float] = (1.0, 1.0, 1.0), cells: int = 1) -> tuple[Tensor, Tensor]:
    """A box about the origin, facing outwards; each side is a grid of its own, so that edges are sharp."""
    grid, faces = plane_mesh(1.0, cells)
    x = grid[:, 0]
    z = grid[:, 2]
    half = torch.full_like(x, 0.5)
    sides = [(half, -z, -x), (-half, -z, x), (x, half, z), (x, -half, -z), (x, -z, half), (-x, -z, -half)]
    vertices = torch.cat([torch.stack(side, -1) for side in sides]) * torch.tensor(size)
    return vertices, torch.cat([faces + i * len(grid) for i in range(6)])


def sphere_mesh(subdivisions: int = 3, radius: float = 1.0) -> tuple[Tensor, Tensor]:
    """An icosphere about the origin, facing outwards: 10 x 4^subdivisions + 2 vertices on the sphere."""
    g = (1 + math.sqrt(5)) / 2
    ring = torch.tensor([[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0]], dtype=torch.float64)
    vertices = _unit(torch.cat([ring, ring.roll(1, 1), ring.roll(2, 1)]))
    cap = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11]]
    belt = [[1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8]]
    under = [[3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9]]
    under_belt = [[4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    faces = torch.tensor(cap + belt + under + under_belt)
    for _ in range(subdivisions):
        faces, edges = subdivide(faces, len(vertices))
        vertices = torch.cat([vertices, _unit(vertices[edges].mean(1))])
    return (vertices * radius).float(), faces


def torus_mesh(radius: float = 1.0, tube: float = 0.4, around: int = 64, across: int = 24) -> tuple[Tensor, Tensor]:
    """A torus about the y axis, facing outwards: `around` x `across` vertices."""
    angle = torch.arange(around, dtype=torch.float64) * (2 * math.pi / around)
    centre = torch.stack([angle.cos(), torch.zeros_like(angle), -angle.sin()], -1)
    return tube_mesh(radius * centre, tube, across)


def tube_mesh(path: Tensor, radius: float, across: int) -> tuple[Tensor, Tensor]:
    """A closed tube along the loop of points path (n, 3), facing outwards: n x `across` vertices.

    The rings do not twist against the vector from the path's middle, which must nowhere run along the path.
    """
    path = path.double()
    ahead = _unit(path.roll(-1, 0) - path.roll(1, 0))
    outward = _unit(_across(path - path.mean(0), ahead))
    side = torch.cross(ahead, outward, dim=1)
    angle = torch.arange(across, dtype=torch.float64)[:, None] * (2 * math.pi / across)
    ring = angle.cos() * outward[:, None] + angle.sin() * side[:, None]  # shape: (n, across, 3)
    vertices = (path[:, None] + radius * ring).reshape(-1, 3)
    here = torch.arange(len(vertices)).reshape(len(path), across)
    beyond = here.roll(-1, 0)
    a, b, c, d = (q.reshape(-1) for q in (here, here.roll(-1, 1), beyond.roll(-1, 1), beyond))
    return vertices.float(), _quads(a, b, c, d)


def _quads(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Two triangles for each quadrilateral a b c d (q,): (2 q, 3)."""
    return torch.stack([a, b, c, a, c, d], 1).reshape(-1, 3)
