"""Atlas: a scene's surface unfolded to a square of texels, that hold what a mesh is too coarse for."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ptt.ops.raycast import Hits, Surface
from ptt.scene.scene import Scene

EDGE = 1e-3  # barycentric; nearer to an edge, two triangles may both be hit
OVERLAP = 0.01  # of the texels in use
TILE = 8  # texels along the edge of a square whose rows lie together: neighbours are read at once
PADDING = 2  # texels between the charts that are made here


@dataclass(frozen=True, eq=False)
class Atlas:
    """size x size texels, t of which show a triangle at their centre.

    corner_uv (f, 3, 2): where the corners of every triangle lie, in 0..1
    triangle (t,), barycentric (t, 3): of the texels in use, tile by tile
    rows (size * size,) int32: which of those stands for each texel: its own, or the nearest

    Where triangles overlap in a few texels, as xatlas leaves them on ragged meshes, a warning counts these.

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
        """The scene's triangles on a square.

        corner_uv (f, 3, 2): such as `scene.uv[scene.faces]`; None for an atlas that xatlas makes
        """
        if not 1 <= size <= 8192:
            raise ValueError(f"size must be in 1..8192, got {size}")
        uv = unwrapped(scene, size) if corner_uv is None else corner_uv.float()
        _check(uv, len(scene.faces))
        centre = (torch.arange(size) + 0.5) / size
        v, u = (x.flatten() for x in torch.meshgrid(centre, centre, indexing="ij"))
        flat, faces = _stacked(uv)
        surface = Surface(flat, faces)
        above, below = (_hits(surface, u, v, z, d) for z, d in ((2.0, -1.0), (-1.0, 1.0)))
        clear = (above.barycentric.amin(1) > EDGE) & (below.barycentric.amin(1) > EDGE)
        order = torch.cat([t.flatten() for rows in _texels(size).split(TILE) for t in rows.split(TILE, 1)])
        used = order[above.triangle[order] >= 0]
        if not len(used):
            raise ValueError(f"no texel of {size} x {size} shows a triangle: make size larger")
        twice = int((clear & (above.triangle != below.triangle)).sum())
        if twice > OVERLAP * len(used):
            raise ValueError(f"uv must not overlap: {twice} texels show two triangles; leave uv out for xatlas's own")
        if twice:
            warnings.warn(f"{twice} of {len(used)} texels show two triangles, and keep the last", stacklevel=2)
        places = torch.stack((u, v), 1)
        nearest = cKDTree(places[used].numpy()).query(places.numpy())[1]
        return cls(size, uv, above.triangle[used], above.barycentric[used], torch.from_numpy(nearest).int())

    def mixed(self, scene: Scene, values: Tensor) -> Tensor:
        """Values (t, ...) at the texels in use of those at the scene's vertices (v, ...)."""
        return scene.interpolated(values, self.triangle, self.barycentric)


def unwrapped(scene: Scene, size: int) -> Tensor:
    """(f, 3, 2) in 0..1: charts by xatlas, packed for so many texels, without overlap."""
    import xatlas

    atlas = xatlas.Atlas()
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.resolution = size
    atlas.add_mesh(scene.vertices.numpy(), scene.faces.numpy().astype("uint32"))
    atlas.generate(pack_options=options)
    _, faces, uv = atlas[0]
    return torch.from_numpy(uv)[torch.from_numpy(faces.astype("int64"))].clamp(0, 1)


def _texels(size: int) -> Tensor:
    return torch.arange(size * size).reshape(size, size)


def _hits(surface: Surface, u: Tensor, v: Tensor, height: float, direction: float) -> Hits:
    """Of rays from places (t,) at a height, straight up or down."""
    origins = torch.stack((u, v, torch.full_like(u, height)), 1)
    return surface.first_hit(origins, torch.tensor([[0.0, 0.0, direction]]).expand(len(u), 3))


def _stacked(uv: Tensor) -> tuple[Tensor, Tensor]:
    """Triangles in the plane, each at a height of its own in 0..1: vertices (3 f, 3), faces (f, 3)."""
    count = len(uv)
    height = torch.linspace(0, 1, count)[:, None, None].expand(-1, 3, 1)
    return torch.cat((uv, height), 2).reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3)


def _check(uv: Tensor, faces: int) -> None:
    if uv.shape != (faces, 3, 2) or not bool(uv.isfinite().all()):
        raise ValueError(f"corner_uv must be finite ({faces}, 3, 2): scene.uv[scene.faces], got {tuple(uv.shape)}")
    if outside := int(((uv < 0) | (uv > 1)).any(2).any(1).sum()):
        raise ValueError(f"uv must lie in 0..1: {outside} triangles do not; leave uv out for xatlas's own")
