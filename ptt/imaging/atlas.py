"""Atlas: a scene's surface unfolded to a square of texels, which hold detail that a mesh is too coarse for."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ptt.ops import kinds
from ptt.ops.raycast import Hits, Surface
from ptt.scene.scene import Scene

EDGE_WEIGHT = 1e-3  # barycentric weight of a corner below which a hit lies on an edge, where two triangles may meet
MOST_OVERLAP = 0.01  # share of the texels in use that may show two triangles, as xatlas leaves some on ragged meshes
TILE_SIDE = 8  # texels along an edge of a square whose texels lie together in memory: neighbours are read at once
PADDING = 2  # texels between the charts that xatlas makes


@dataclass(frozen=True, eq=False)
class Atlas:
    """A square of size x size texels, t of which are in use: they show a triangle at their centre.

    corner_uv (f, 3, 2): place of each corner of every triangle, in 0..1
    triangle (t,), barycentric (t, 3): the point that each texel in use shows, tile by tile
    rows (size * size,) int32: number of the texel in use that stands for each texel, itself or the nearest

    Where triangles overlap in a few texels, a warning counts these.

    Raises:
        ValueError: uv are of another shape, not finite, outside of 0..1, or overlap in more than a hundredth of texels.
    """

    size: int
    corner_uv: Tensor
    triangle: Tensor
    barycentric: Tensor
    rows: Tensor

    @classmethod
    def of(cls, scene: Scene, size: int = 512, corner_uv: Tensor | None = None) -> Atlas:
        """The atlas of a scene.

        corner_uv (f, 3, 2): such as `scene.uv[scene.faces]`; None for charts that xatlas makes
        """
        kinds.check("scene", scene, Scene)
        if not 1 <= size <= 8192:
            raise ValueError(f"size must be in 1..8192, got {size}")
        uv = unwrapped(scene, size) if corner_uv is None else corner_uv.float()
        _check(uv, len(scene.faces))
        centre = (torch.arange(size) + 0.5) / size
        v, u = (x.flatten() for x in torch.meshgrid(centre, centre, indexing="ij"))
        flat, faces = _stacked(uv)
        surface = Surface(flat, faces)
        above = _hits(surface, u, v, 2.0, -1.0)
        below = _hits(surface, u, v, -1.0, 1.0)
        clear = (above.barycentric.amin(1) > EDGE_WEIGHT) & (below.barycentric.amin(1) > EDGE_WEIGHT)
        order = _tile_by_tile(size)
        used = order[above.triangle[order] >= 0]
        if not len(used):
            raise ValueError(f"no texel of {size} x {size} shows a triangle: make size larger")
        twice = int((clear & (above.triangle != below.triangle)).sum())
        if twice > MOST_OVERLAP * len(used):
            raise ValueError(f"uv must not overlap: {twice} texels show two triangles; leave uv out for xatlas's own")
        if twice:
            warnings.warn(f"{twice} of {len(used)} texels show two triangles, and keep the last", stacklevel=2)
        places = torch.stack((u, v), 1)
        nearest = cKDTree(places[used].numpy()).query(places.numpy())[1]
        return cls(size, uv, above.triangle[used], above.barycentric[used], torch.from_numpy(nearest).int())

    def interpolated(self, scene: Scene, values: Tensor) -> Tensor:
        """Values (t, ...) at the texels in use, from those at the scene's vertices (v, ...)."""
        return scene.interpolated(values, self.triangle, self.barycentric)


def unwrapped(scene: Scene, size: int) -> Tensor:
    """Places (f, 3, 2) in 0..1 of the triangles' corners on charts by xatlas, packed for size x size texels."""
    import xatlas

    atlas = xatlas.Atlas()
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.resolution = size
    atlas.add_mesh(scene.vertices.numpy(), scene.faces.numpy().astype("uint32"))
    atlas.generate(pack_options=options)
    _, faces, uv = atlas[0]
    return torch.from_numpy(uv)[torch.from_numpy(faces.astype("int64"))].clamp(0, 1)


def _tile_by_tile(size: int) -> Tensor:
    """The numbers (size * size,) of the texels in the order of tiles; those at the rim may be smaller."""
    texels = torch.arange(size * size).reshape(size, size)
    tiles = [tile for rows in texels.split(TILE_SIDE) for tile in rows.split(TILE_SIDE, 1)]
    return torch.cat([tile.flatten() for tile in tiles])


def _hits(surface: Surface, u: Tensor, v: Tensor, height: float, direction: float) -> Hits:
    """Hits of rays from places u, v (t,) at a height, straight up (direction 1) or down (-1)."""
    origins = torch.stack((u, v, torch.full_like(u, height)), 1)
    return surface.first_hit(origins, torch.tensor([[0.0, 0.0, direction]], dtype=torch.float32).expand(len(u), 3))


def _stacked(uv: Tensor) -> tuple[Tensor, Tensor]:
    """The triangles of uv (f, 3, 2), each at a height of its own in 0..1: vertices (3 f, 3), faces (f, 3)."""
    count = len(uv)
    height = torch.linspace(0, 1, count, dtype=torch.float32)[:, None, None].expand(-1, 3, 1)
    return torch.cat((uv, height), 2).reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3)


def _check(uv: Tensor, faces: int) -> None:
    if uv.shape != (faces, 3, 2) or not bool(uv.isfinite().all()):
        raise ValueError(f"corner_uv must be finite ({faces}, 3, 2): scene.uv[scene.faces], got {tuple(uv.shape)}")
    if outside := int(((uv < 0) | (uv > 1)).any(2).any(1).sum()):
        raise ValueError(f"uv must lie in 0..1: {outside} triangles do not; leave uv out for xatlas's own")
