"""Triangles cut until none of their edges is longer than a bound, with as few pieces as that takes.

Each edge is halved, and its halves, until none is too long: what cuts an edge depends on its ends alone, so that both
of its sides, across a seam too, are cut alike. A triangle with two long sides becomes a strip between them; any other
is halved at its longest edge (Rivara 1984), which keeps its shape.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Midpoints:
    """New vertices in the middles of edges, numbered from `count` on, each made once."""

    def __init__(self, vertices: Tensor) -> None:
        self.vertices = vertices
        self.pairs: list[Tensor] = []
        self._keys = torch.zeros(0, dtype=torch.int64)
        self._ids = torch.zeros(0, dtype=torch.int64)

    def of(self, a: Tensor, b: Tensor) -> Tensor:
        """The vertices (m,) in the middle between vertices a and b (m,)."""
        low, high = torch.minimum(a, b), torch.maximum(a, b)
        keys, index = torch.unique(low * MOST + high, return_inverse=True)
        at = torch.searchsorted(self._keys, keys).clamp(max=max(0, len(self._keys) - 1))
        known = self._keys[at] == keys if len(self._keys) else torch.zeros_like(keys, dtype=torch.bool)
        fresh = keys[~known]
        ids = torch.empty_like(keys)
        ids[known] = self._ids[at[known]] if len(self._keys) else ids[known]
        ids[~known] = len(self.vertices) + torch.arange(len(fresh))
        pairs = torch.stack((fresh // MOST, fresh % MOST), 1)
        self.pairs.append(pairs)
        self.vertices = torch.cat((self.vertices, self.vertices[pairs].mean(1)))
        every, order = torch.cat((self._keys, fresh)).sort()
        self._keys, self._ids = every, torch.cat((self._ids, ids[~known]))[order]
        return ids[index]

    def along(self, a: Tensor, b: Tensor, times: int) -> Tensor:
        """The vertices (m, 2^times + 1) from a to b (m,), halved so many times."""
        row = torch.stack((a, b), 1)
        for _ in range(times):
            middles = self.of(row[:, :-1].flatten(), row[:, 1:].flatten()).reshape(len(row), -1)
            row = torch.cat((torch.stack((row[:, :-1], middles), 2).flatten(1), row[:, -1:]), 1)
        return row


MOST = 1 << 31  # vertices


def refined(vertices: Tensor, faces: Tensor, edge: float, most: int) -> tuple[Tensor, list[Tensor]]:
    """Faces (g, 3) without an edge longer than a bound, and the pairs (k, 2) of vertices between which new ones lie.

    vertices (v, 3), faces (f, 3). New vertices are numbered from v on, in the order of the pairs, which come in
    batches, since new vertices lie between new ones too.

    Raises:
        ValueError: more than `most` faces are needed.
    """
    middles = Midpoints(vertices.double())
    done: list[Tensor] = []
    while len(faces):
        if sum(map(len, done)) + len(faces) > most:
            raise ValueError(f"edge = {edge:g} makes more than {most} triangles; take a longer one")
        lengths = edge_lengths(middles.vertices, faces)
        faces, lengths = _longest_first(faces, lengths)
        long = lengths > edge
        done.append(faces[~long.any(1)])
        strips = long[:, :2].all(1) & ~long[:, 2]
        halves = long.any(1) & ~strips
        faces = torch.cat((_halved(middles, faces[halves]), _in_strips(middles, faces[strips], lengths[strips], edge)))
    return torch.cat(done), middles.pairs


def edge_lengths(vertices: Tensor, faces: Tensor) -> Tensor:
    """The lengths (f, 3) of the edges after each corner."""
    corners = vertices[faces]
    lengths: Tensor = torch.linalg.vector_norm(corners - corners.roll(-1, 1), dim=2)
    return lengths


def _longest_first(faces: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Faces turned so that the shortest edge comes last, and their lengths so."""
    turned = (lengths.argmin(1, keepdim=True) + 1 + torch.arange(3)) % 3
    return faces.gather(1, turned), lengths.gather(1, turned)


def _halved(middles: Midpoints, faces: Tensor) -> Tensor:
    """Two faces of each, which is cut at its longest edge."""
    if not len(faces):
        return faces
    longest = edge_lengths(middles.vertices, faces).argmax(1, keepdim=True)
    a, b, c = faces.gather(1, (longest + torch.arange(3)) % 3).unbind(1)
    m = middles.of(a, b)
    return torch.cat((torch.stack((a, m, c), 1), torch.stack((m, b, c), 1)))


def _in_strips(middles: Midpoints, faces: Tensor, lengths: Tensor, edge: float) -> Tensor:
    """Faces between two long sides, the first edge and the second, which meet at the second corner."""
    times = (lengths[:, :2] / edge).log2().ceil().long().clamp(min=1)
    pieces = [faces[:0]]
    for left, right in torch.unique(times, dim=0).tolist():
        own = (times == torch.tensor([left, right])).all(1)
        a, tip, b = faces[own].unbind(1)
        one = middles.along(tip, a, left)  # shape: (m, 2^left + 1)
        other = middles.along(tip, b, right)
        pieces += _zipped(one, other)
    return torch.cat(pieces)


def _zipped(one: Tensor, other: Tensor) -> list[Tensor]:
    """Faces between two rows of vertices (m, n) and (m, k) that begin at the same vertex; `one` lies clockwise."""
    n, k = one.shape[1] - 1, other.shape[1] - 1
    i = j = 1
    found = [torch.stack((one[:, 0], other[:, 1], one[:, 1]), 1)]
    while i < n or j < k:
        if j == k or (i < n and i * k <= j * n):
            found.append(torch.stack((one[:, i], other[:, j], one[:, i + 1]), 1))
            i += 1
        else:
            found.append(torch.stack((one[:, i], other[:, j], other[:, j + 1]), 1))
            j += 1
    return found


def interpolated(values: Tensor, pairs: list[Tensor]) -> Tensor:
    """Values (w, ...) of old and new vertices from those of the old ones (v, ...), in the middles of pairs."""
    for some in pairs:
        values = torch.cat((values, values[some].mean(1)))
    return values
