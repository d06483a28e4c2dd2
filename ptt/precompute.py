"""Scene -> raw transfer, block by block: all that needs rays, and nothing that depends on materials."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import torch
from torch import Tensor
from tqdm import tqdm

from ptt import saved
from ptt.ops import transfer
from ptt.ops.sphere import Cube
from ptt.receivers import Receivers
from ptt.scene import Scene

BLOCK = 128  # points traced at once: about 1.5 million rays
KIND = "raw transfer"


@dataclass(frozen=True, eq=False)
class RawTransfer:
    """What `precompute` finds and `compress` reads.

    receivers: v points
    visible (v, cells / 8) uint8: packed bits, which of the 6 n n cells of the cube map each point sees
    resolution: n, cells along an edge of the cube map
    """

    receivers: Receivers
    visible: Tensor
    resolution: int

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file."""
        config = {"resolution": self.resolution, **self.receivers.config()}
        saved.save(path, KIND, config, {"visible": self.visible, **self.receivers.tensors()})

    def part(self, rows: slice) -> RawTransfer:
        """Some of the receivers."""
        return RawTransfer(self.receivers.part(rows), self.visible[rows], self.resolution)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> RawTransfer:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing, damaged or not a raw transfer; the message names what is wrong.
        """
        config, tensors = saved.load(path, KIND)
        with saved.describing(path):
            shape = len(tensors.get("positions", ())), (6 * config["resolution"] ** 2 + 7) // 8
            saved.check(tensors, {"visible": (torch.uint8, shape), **Receivers.expected(config)})
            return cls(Receivers.restore(config, tensors), tensors["visible"], config["resolution"])


def precompute(
    scene: Scene, resolution: int = 64, *, index: Tensor | None = None, progress: bool = False
) -> RawTransfer:
    """Visibility of the cube map's cells from the vertices of a scene, one ray to each cell's centre.

    resolution: cells along an edge of the cube map, a power of two; the paper has 64
    index (v,): vertices to keep, ascending; default all
    progress: show a bar with the rate and the time left

    Takes about 12,000 rays a vertex at 64: 2 ms on two cores.

    Raises:
        ValueError: resolution is not a power of two from 2 to 128, or index is not ascending vertex numbers.

    Sun et al. 2007, section 3.3.
    """
    if resolution not in (2, 4, 8, 16, 32, 64, 128):
        raise ValueError(f"resolution must be a power of two from 2 to 128, got {resolution}")
    receivers = Receivers.of(scene, _checked(index, len(scene.vertices)))
    directions = Cube(resolution).directions().reshape(-1, 3)
    blocks = zip(receivers.positions.split(BLOCK), receivers.frames[:, 2].split(BLOCK), strict=True)
    bar = tqdm(total=len(receivers), desc="visibility", unit=" points", disable=not progress)
    visible = []
    for positions, normals in blocks:
        visible.append(transfer.visibility(scene.surface, positions, normals, directions))
        bar.update(len(positions))
    bar.close()
    return RawTransfer(receivers, torch.cat(visible), resolution)


def _checked(index: Tensor | None, vertices: int) -> Tensor | None:
    if index is None:
        return None
    index = torch.as_tensor(index)
    if not len(index) or bool((index.diff() <= 0).any()) or index[0] < 0 or index[-1] >= vertices:
        raise ValueError(f"index must hold ascending numbers of the scene's {vertices} vertices")
    return index
