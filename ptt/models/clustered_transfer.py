"""Transfer to the points of one region, direct and indirect together, by clustered PCA (Sun et al. 2007, section 4.3).

Every point is a combination of the eigen-points of its cluster, which have a T0, a T1 and a T2 of their own:

    T[v] ~ sum over e of weights[v, e] T[k(v), e]

so that light and materials are worked out for eigen-points alone. Points lie in blocks of one cluster, padded with
zeros, points innermost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ptt.io.saved import Shapes
from ptt.models.indirect import ORDER
from ptt.ops.memory import in_large_pages
from ptt.ops.octahedral import Octahedral, tiles

WIDTH = 128  # points in a block
FACING = 16  # cells along an edge of the map of normals by which points are ordered
LOBES = 4  # bytes in a cell of the cuts
STORAGE = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


class ClusteredTransfer(nn.Module):
    """k clusters with e eigen-points each, and which slots light the points: slots (q,) after one reflection.

    pairs: (last slot, first slot) of each after two; positions in the model's list of slots
    cluster (b,) int64, place (v,) int64: of each block; where each point lies in the blocks (block * WIDTH + lane)
    weights (b, e, WIDTH)
    columns (k, m) int64, direct (k, m, e * (1 + i)): T0 of the eigen-points, at some positions l of the lighting
    lighting (k, l', n): the cluster's own lighting axis, from coefficients of the coarse one
    one (k, n, q * e * s): T1 on it; two (k, l'', pairs * e): T2 on the coarsest lighting
    cuts (b * WIDTH, cells) int32: fractional visibility of the lobes, a byte each; cells = 0 where there are none
    """

    cluster: Tensor
    place: Tensor
    weights: Tensor
    columns: Tensor
    direct: Tensor
    lighting: Tensor
    one: Tensor
    two: Tensor
    cuts: Tensor

    def __init__(self, slots: Sequence[int], pairs: Sequence[Sequence[int]], **parts: Tensor) -> None:
        super().__init__()
        self.slots = list(slots)
        self.pairs = [list(pair) for pair in pairs]
        for name in ("cluster", "place", "weights", "columns", "direct", "lighting", "one", "two", "cuts"):
            self.register_buffer(name, in_large_pages(parts[name]))

    @property
    def points(self) -> int:
        """Of the region."""
        return len(self.place)

    @property
    def eigenvectors(self) -> int:
        """Of each cluster."""
        return self.weights.shape[1]

    def in_line(self, values: Tensor) -> Tensor:
        """Values (v, ...) of the points as (..., b * WIDTH), block by block; padding repeats the first point."""
        source = torch.zeros(len(self.cluster) * WIDTH, dtype=torch.int64, device=values.device)
        source[self.place] = torch.arange(self.points, device=values.device)
        return values[source].movedim(0, -1).contiguous() if self.points else values.movedim(0, -1)

    def config(self) -> dict[str, Any]:
        """What `expected` and `restore` need beside the tensors."""
        k, coarse, n = self.lighting.shape
        return {
            "blocks": len(self.cluster),
            "clusters": k,
            "eigenvectors": self.eigenvectors,
            "columns": self.columns.shape[1],
            "lighting": [n, coarse, self.two.shape[1]],
            "cuts": self.cuts.shape[1],
            "slots": self.slots,
            "pairs": self.pairs,
            "storage": str(self.direct.dtype).removeprefix("torch."),
        }

    @staticmethod
    def expected(config: Mapping[str, Any], points: int, factors: int) -> Shapes:
        """Types and shapes of the tensors that belong to a config."""
        b = config["blocks"]
        k = config["clusters"]
        e = config["eigenvectors"]
        n, coarse, coarsest = config["lighting"]
        m = config["columns"]
        q = len(config["slots"])
        pairs = len(config["pairs"])
        stored = STORAGE[config["storage"]]
        return {
            "cluster": (torch.int64, (b,)),
            "place": (torch.int64, (points,)),
            "weights": (torch.float32, (b, e, WIDTH)),
            "columns": (torch.int64, (k, m)),
            "direct": (stored, (k, m, e * factors)),
            "lighting": (torch.float32, (k, coarse, n)),
            "one": (stored, (k, n, q * e * ORDER**2)),
            "two": (stored, (k, coarsest, pairs * e)),
            "cuts": (torch.int32, (b * WIDTH, config["cuts"])),
        }

    @classmethod
    def restore(
        cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor], cells: int, slots: int
    ) -> ClusteredTransfer:
        """The inverse of `config` and of the buffers, for a lighting of so many cells and so many slots."""
        limits = {
            "cluster": config["clusters"],
            "place": len(tensors["cluster"]) * WIDTH,
            "columns": cells,
            "slots": slots,
            "pairs": slots,
        }
        numbers = {name: torch.tensor(config[name]) for name in ("slots", "pairs")}
        for name, limit in limits.items():
            index = {**tensors, **numbers}[name]
            if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < limit:
                got = f"{int(index.min())}..{int(index.max())}"
                raise ValueError(f"holds wrong indices: {name} must be in 0..{limit - 1}, got {got}")
        return cls(config["slots"], config["pairs"], **tensors)


def in_blocks(labels: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """cluster (b,) of each block and place (v,) of each point, for the cluster (v,) of each, 0..k-1.

    Points of a cluster lie by their normals (v, 3): neighbours then look in like directions, and share lobes.
    """
    counts = labels.bincount()
    blocks = (counts + WIDTH - 1) // WIDTH
    first = (blocks.cumsum(0) - blocks) * WIDTH
    towards = tiles(FACING)[Octahedral(FACING).cell(normals)].argsort(stable=True)
    order = towards[labels[towards].argsort(stable=True)]
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(labels)) - (counts.cumsum(0) - counts)[labels[order]]
    return torch.arange(len(counts)).repeat_interleave(blocks), first[labels] + rank
