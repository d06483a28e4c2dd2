"""Scene -> raw transfer, block by block: all results that need rays, and none that depends on materials."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import torch
from torch import Tensor

from ptt.io import saved
from ptt.models.receivers import Receivers
from ptt.ops import kinds, transfer
from ptt.ops.constants import MEETS
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.sphere import Cube
from ptt.scene.scene import Scene
from ptt.transfer.filling import of_all

POINTS_AT_ONCE = 128  # about 1.5 million rays
RAYS = 512  # default, over a hemisphere, for light from other surfaces: more take time and leave less noise
KIND = "raw transfer"


@dataclass(frozen=True, eq=False)
class RawTransfer:
    """The visibility that `precompute` finds and `compress` reads.

    receivers: v points
    visible (v, cells / 8) uint8: packed bits that say which of the 6 n n cells of the cube map each point sees
    hits (v, rays) int32: vertex that each point sees in each direction of `transfer.gather_directions`; -1 for none
    meets (v, words) int32: the vertex that it sees about each axis of a map of the hemisphere, and the normals there
        (`transfer.meets`); nothing without bounces
    resolution: n, cells along an edge of the cube map
    bounces: number of bounces for which the hits were traced
    """

    receivers: Receivers
    visible: Tensor
    hits: Tensor
    meets: Tensor
    resolution: int
    bounces: int

    def __repr__(self) -> str:
        size = (self.visible.numel() + 4 * (self.hits.numel() + self.meets.numel())) / 1e6
        rays = self.hits.shape[1]
        return f"RawTransfer({len(self.receivers)} points, {self.bounces} bounces, {rays} rays, {size:.0f} MB)"

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file."""
        config = {
            "resolution": self.resolution,
            "bounces": self.bounces,
            "rays": self.hits.shape[1],
            "meets": self.meets.shape[1],
            **self.receivers.config(),
        }
        tensors = {"visible": self.visible, "hits": self.hits, "meets": self.meets, **self.receivers.tensors()}
        saved.save(path, KIND, config, tensors)

    def part(self, rows: slice) -> RawTransfer:
        """The transfer to some of the receivers, for direct light: the others, which they may see, are left out."""
        seen = self.visible[rows], self.hits[rows, :0], self.meets[rows, :0]
        return RawTransfer(self.receivers.part(rows), *seen, self.resolution, 0)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> RawTransfer:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing, damaged or not a raw transfer; the message names what is wrong.
        """
        config, tensors = saved.load(path, KIND)
        with saved.describing(path):
            v = len(tensors.get("positions", ()))
            cells = 6 * config["resolution"] ** 2
            expected = {
                "visible": (torch.uint8, (v, (cells + 7) // 8)),
                "hits": (torch.int32, (v, config["rays"])),
                "meets": (torch.int32, (v, config["meets"])),
            }
            saved.check(tensors, {**expected, **Receivers.expected(config)})
            for name, found in (("hits", tensors["hits"]), ("meets", transfer.vertices_met(tensors["meets"]))):
                if found.numel() and not -1 <= int(found.min()) <= int(found.max()) < v:
                    got = f"{int(found.min())}..{int(found.max())}"
                    raise ValueError(f"holds wrong {name}: must be in -1..{v - 1}, got {got}")
            settings = config["resolution"], config["bounces"]
            return cls(
                Receivers.restore(config, tensors), tensors["visible"], tensors["hits"], tensors["meets"], *settings
            )


def precompute(
    scene: Scene,
    bounces: int = 0,
    *,
    resolution: int = 64,
    rays: int = RAYS,
    index: Tensor | None = None,
    progress: bool = False,
) -> RawTransfer:
    """Trace what every vertex of a scene sees: cells of the cube map and, for indirect light, other vertices.

    bounces: reflections before the last one that the model shall show: 0 for direct light, 1 or 2
    resolution: cells along an edge of the cube map, a power of two; the paper has 64
    rays: number of rays over the hemisphere of each vertex, for indirect light
    index (v,): vertices to keep, ascending, for direct light alone; default: all
    progress: show a bar with the rate and the time left

    At a resolution of 64 a vertex takes about 12,000 rays, 2 ms on two cores; light that bounces adds 0.3 ms.

    Raises:
        ValueError: resolution is not a power of two from 2 to 128, bounces are not 0, 1 or 2, rays < 16, or index does
            not hold ascending vertex numbers or comes with bounces.

    Sun et al. 2007, sections 3.3 and 4.3.
    """
    kinds.check("scene", scene, Scene)
    if resolution not in (2, 4, 8, 16, 32, 64, 128):
        raise ValueError(f"resolution must be a power of two from 2 to 128, got {resolution}")
    if bounces not in (0, 1, 2) or rays < 16:
        raise ValueError(f"bounces must be 0, 1 or 2 and rays at least 16, got {bounces} and {rays}")
    if index is not None and bounces:
        raise ValueError("index serves direct light alone: light that bounces needs every vertex")
    receivers = Receivers.of(scene, _checked(index, len(scene.vertices)))
    directions = Cube(resolution).directions().reshape(-1, 3)
    local = transfer.gather_directions(rays if bounces else 0)
    axes = HemiOctahedral(MEETS).directions().reshape(-1, 3)[: None if bounces else 0]
    random = torch.Generator().manual_seed(0)

    def met(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        points = receivers.positions[rows]
        frames = receivers.frames[rows]
        u = torch.rand(len(rows), len(local), generator=random, dtype=torch.float32)
        return (
            transfer.visibility(scene.surface, points, frames[:, 2], directions),
            transfer.gather(scene.surface, scene.faces, points, frames, local, u),
            transfer.meets(scene.surface, scene.faces, receivers.frames, points, frames, axes),
        )

    visible, hits, meets = of_all(len(receivers), POINTS_AT_ONCE, met, "rays", progress)
    return RawTransfer(receivers, visible, hits, meets, resolution, bounces)


def _checked(index: Tensor | None, vertices: int) -> Tensor | None:
    if index is None:
        return None
    index = torch.as_tensor(index)
    if not len(index) or bool((index.diff() <= 0).any()) or index[0] < 0 or index[-1] >= vertices:
        raise ValueError(f"index must hold ascending numbers of the scene's {vertices} vertices")
    return index
