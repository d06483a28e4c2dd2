"""Transfer to the points of one region, direct and indirect together, by clustered PCA (Sun et al. 2007, section 4.3).

Every point is a combination of the eigen-points of its cluster, which have a T0, a T1 and a T2 of their own:

    T[v] ~ sum over e of weights[v, e] T[k(v), e]

so that light and materials are worked out for eigen-points alone. Points lie in blocks of one cluster, padded with
zeros, points innermost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

WIDTH = 64  # points in a block


class Parts(NamedTuple):
    """What is stored of k clusters with e eigen-points each.

    cluster (b,) int64, place (v,) int64: of each block; where each point lies in the blocks (block * WIDTH + lane)
    weights (b, e, WIDTH)
    columns (k, m) int64, direct (k, e * (1 + i), m): T0 of the eigen-points, at some positions l of the lighting
    lighting (k, n, l'): the cluster's own lighting axis, in coefficients of the coarse one
    one (k, e * q * s, n): T1 on it; two (k, e * pairs, l''): T2 on the coarsest lighting
    cuts (b * WIDTH, cells, lobes) uint8: fractional visibility of the lobes; cells = 0 where there are none
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


class ClusteredTransfer(nn.Module):
    """The `Parts` of one region, and which slots light its points: slots (q,) after one reflection, pairs after two.

    pairs: (last slot, first slot) of each; positions in the model's list of slots
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

    def __init__(self, parts: Parts, slots: Sequence[int], pairs: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.slots, self.pairs = list(slots), [list(pair) for pair in pairs]
        for name, tensor in parts._asdict().items():
            self.register_buffer(name, tensor)

    @property
    def points(self) -> int:
        """Of the region."""
        return len(self.place)

    @property
    def eigenvectors(self) -> int:
        """Of each cluster."""
        return self.weights.shape[1]

    def blocked(self, values: Tensor) -> Tensor:
        """Values (v, ...) of the points in blocks (b, ..., WIDTH); padding repeats the first point."""
        source = torch.zeros(len(self.cluster) * WIDTH, dtype=torch.int64, device=values.device)
        source[self.place] = torch.arange(self.points, device=values.device)
        return values[source].unflatten(0, (-1, WIDTH)).movedim(1, -1).contiguous()

    def config(self) -> dict[str, Any]:
        """What `expected` and the constructor need beside the tensors."""
        return {"slots": self.slots, "pairs": self.pairs, "sizes": {n: list(b.shape) for n, b in self.named_buffers()}}


def in_blocks(labels: Tensor) -> tuple[Tensor, Tensor]:
    """cluster (b,) of each block and place (v,) of each point, for the cluster (v,) of each, 0..k-1."""
    counts = labels.bincount()
    blocks = (counts + WIDTH - 1) // WIDTH
    first = (blocks.cumsum(0) - blocks) * WIDTH
    order = labels.argsort(stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(labels)) - (counts.cumsum(0) - counts)[labels[order]]
    return torch.arange(len(counts)).repeat_interleave(blocks), first[labels] + rank
