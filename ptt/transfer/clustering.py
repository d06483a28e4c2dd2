"""Transfer of all points -> eigen-points of clusters, region by region (Sun et al. 2007, section 4.3).

1. The features of a point are its T0, T1 and T2, weighted by what they add to the picture under natural light, on a few
   hundred common directions.
2. Clusters and their eigen-points are found among the features (`ops.cpca`); then T0, T1 and T2 of the eigen-points are
   made from those of the points.
3. The lighting axis of every cluster is reduced once more (Tucker, on the modes of points and lighting).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm import tqdm

from ptt import threads
from ptt.models.clustered_transfer import STORAGE, WIDTH, ClusteredTransfer, in_blocks
from ptt.models.indirect import TWICE
from ptt.models.transfer_model import TransferModel
from ptt.ops import cpca, kinds
from ptt.ops.constants import MOST_LOBES
from ptt.ops.octahedral import tiles
from ptt.ops.sparse import csr
from ptt.ops.sphere import Cube
from ptt.transfer.assembly import ALWAYS, Transfer, natural
from ptt.transfer.filling import of_all

SKETCH_DIRECTIONS = 256  # common directions of the features: more take longer and lose less of them
SKETCHED_POINTS = 1024  # points that decide those directions: in a trial 512 and 2048 left the same error
POINTS_AT_ONCE = 64  # whose features are worked out together: of 512 half of the time went into fresh memory
TRIED_EIGENVECTORS = (8, 16, 24, 32, 48, 64)  # numbers of eigenvectors that are tried for a given error
DEPENDENT = 1e-6  # an eigenvector whose part at right angles to those before it is relatively smaller is left out


@dataclass(frozen=True)
class Clusters:
    """The settings of clusters: how points share eigen-points.

    points: points of a cluster, on average; the paper has 1,000
    eigenvectors: eigenvectors of each cluster; the paper has 32
    lighting: dimensions of the light that lights T1, in each cluster; the paper has 64
    columns: coefficients of T0 in each cluster
    storage: type of T0, T1 and T2, float32, float16 or bfloat16
    bytes: size of all clusters together; when given, `points` follows from it
    error: relative L2 error of the features; when given, `eigenvectors` follows from it, region by region

    Raises:
        ValueError: a number is below 1, the error outside of (0, 1), the storage of another type, or both bytes and
            error are given.
    """

    points: int = 250
    eigenvectors: int = 32
    lighting: int = 64
    columns: int = 512
    storage: torch.dtype = torch.bfloat16
    bytes: float | None = None
    error: float | None = None

    def __post_init__(self) -> None:
        if self.bytes is not None and self.error is not None:
            raise ValueError("bytes and error exclude each other: error decides the eigenvectors, and so the bytes")
        if min(self.points, self.eigenvectors, self.lighting, self.columns) < 1:
            raise ValueError(f"points, eigenvectors, lighting and columns must be at least 1, got {self}")
        if self.storage not in STORAGE.values():
            raise ValueError(f"storage must be one of {', '.join(STORAGE)}, got {self.storage}")
        if self.error is not None and not 0 < self.error < 1:
            raise ValueError(f"error must satisfy 0 < error < 1, got {self.error}")


def cluster(transfer: Transfer, clusters: Clusters = Clusters(), *, progress: bool = False) -> TransferModel:
    """The compressed model: the clustered transfer of every region.

    Raises:
        ValueError: the bytes are too few for one cluster a region, or the most eigenvectors do not meet the error.
    """
    kinds.check("transfer", transfer, Transfer)
    kinds.check("clusters", clusters, Clusters)
    own = transfer.raw.receivers
    regions = [_RegionTransfer(transfer, r) for r in range(len(own.names))]
    if clusters.bytes is not None:
        clusters = replace(clusters, points=_points_for(clusters, regions))
    found = []
    with tqdm(total=len(own), desc="clusters", unit=" points", disable=not progress) as bar:
        for region in regions:
            threads.share()
            found.append(region.compress(clusters))
            bar.update(region.points)
    raw = transfer.raw
    error = transfer.direct.error
    settings = raw.resolution, raw.bounces, None, found, error, transfer.highlights
    return TransferModel(own, transfer.brdf, transfer.basis, *settings)


def _points_for(clusters: Clusters, regions: list[_RegionTransfer]) -> int:
    """The fewest points a cluster with which all clusters together fit in the bytes."""
    assert clusters.bytes is not None
    limit = clusters.bytes
    most = max(1, *(region.points for region in regions))

    def size(points: int) -> int:
        return sum(_cluster_count(region.points, points) * region.bytes(clusters) for region in regions)

    if size(most) > limit:
        raise ValueError(f"bytes must be at least {size(most)}, one cluster a region, got {limit:g}")
    return 1 + bisect_left(range(1, most + 1), True, key=lambda points: size(points) <= limit)


class _RegionTransfer:
    """The transfer to one region's points, first..end, from the slots and pairs of slots that light them.

    cut: says whether the region may show lobes of the BRDF tensor under direct light
    """

    def __init__(self, transfer: Transfer, region: int) -> None:
        own = transfer.raw.receivers
        first, end = own.spans[region]
        self.transfer = transfer
        self.first = first
        self.end = end
        shines = any(layer.highlights for layer in own.materials[own.names[region]].layers)
        self.cut = transfer.highlights == "tensor" and bool(transfer.brdf.angles) and (own.editable[region] or shines)
        one = transfer.indirect.one[first:end]
        two = transfer.indirect.two[first:end]
        self.slots = torch.nonzero((one != 0).any(dim=(0, 2, 3)))[:, 0]
        self.pairs = torch.nonzero((two != 0).any(dim=(0, 3)))

    @property
    def points(self) -> int:
        """The number of the region's points."""
        return self.end - self.first

    def bytes(self, clusters: Clusters) -> int:
        """The size of one cluster."""
        indirect = self.transfer.indirect
        factors = len(self.transfer.weights.factors)
        m = min(clusters.columns, Cube(self.transfer.raw.resolution).cells)
        n = self._lighting_dimensions(clusters)
        each = factors * m + len(self.slots) * indirect.one.shape[2] * n + len(self.pairs) * indirect.two.shape[3]
        return clusters.eigenvectors * each * clusters.storage.itemsize + 8 * m + 4 * n * indirect.axes.shape[1]

    def _lighting_dimensions(self, clusters: Clusters) -> int:
        """The dimensions of a cluster's own lighting: none where no slot lights the region."""
        return min(clusters.lighting, len(self.transfer.indirect.axes)) if len(self.slots) else 0

    def compress(self, clusters: Clusters) -> ClusteredTransfer:
        """The region's transfer by clustered PCA of the features."""
        x = self._sketch()
        if clusters.error is not None:
            clusters = replace(clusters, eigenvectors=_eigenvectors_for(x, clusters))
        e = clusters.eigenvectors
        labels = _cluster_labels(x, clusters.points, e)
        combination = torch.zeros(len(x), e, dtype=torch.float32)
        made = []
        for k in range(_clusters_in(labels) or 1):
            at = torch.nonzero(labels == k)[:, 0]
            q, r = torch.linalg.qr((x[at] @ cpca.basis(x[at], e).T).double())
            independent = r.diagonal().abs() > DEPENDENT * r.diagonal().norm()
            combination[at, : q.shape[1]] = (q * independent).float() * math.sqrt(len(at))
            made.append(self._eigen_points(at, combination[at] / max(len(at), 1), clusters))
        columns, t0, lighting, t1, t2 = (torch.stack(parts) for parts in zip(*made, strict=True))
        cluster, place = in_blocks(labels, self.transfer.raw.receivers.frames[self.first : self.end, 2])
        weights = torch.zeros(len(cluster) * WIDTH, e, dtype=torch.float32).index_copy(0, place, combination)
        return ClusteredTransfer(
            self.slots.tolist(),
            self.pairs.tolist(),
            cluster=cluster,
            place=place,
            weights=weights.unflatten(0, (-1, WIDTH)).transpose(1, 2).contiguous(),
            columns=columns,
            direct=t0.to(clusters.storage),
            lighting=lighting,
            one=t1.to(clusters.storage),
            twice=self.transfer.indirect.axes[:TWICE].T.contiguous(),
            two=t2.to(clusters.storage),
            cuts=self._cuts(place, len(cluster)),
            seen=self._in_blocks(self.transfer.seen, 0, place, len(cluster)),
            meets=self._in_blocks(self.transfer.meets, -1, place, len(cluster)),
            sky=self._sky(place, len(cluster)),
        )

    def _cuts(self, place: Tensor, blocks: int) -> Tensor:
        """Fractional visibility (b * WIDTH, cells) int32, a byte for each lobe, in tiles; no cells without lobes."""
        if not self.cut:
            return torch.zeros(blocks * WIDTH, 0, dtype=torch.int32)
        cuts = self.transfer.cuts[self.first : self.end]
        bytes_ = torch.zeros(blocks * WIDTH, cuts.shape[1], MOST_LOBES, dtype=torch.uint8)
        bytes_[place[:, None], tiles(math.isqrt(cuts.shape[1])), : cuts.shape[2]] = cuts
        return bytes_.view(torch.int32).squeeze(2)

    def _sky(self, place: Tensor, blocks: int) -> Tensor:
        """Bits (words, b * WIDTH) int32 of what is seen of the cube map; no words without narrow lobes."""
        if self.transfer.highlights != "lobes":
            return torch.zeros(0, blocks * WIDTH, dtype=torch.int32)
        return self._in_blocks(self.transfer.raw.visible.view(torch.int32), 0, place, blocks).T.contiguous()

    def _in_blocks(self, values: Tensor, padding: int, place: Tensor, blocks: int) -> Tensor:
        """Of values (v, n) of all points those of the region (b * WIDTH, n)."""
        own = values[self.first : self.end]
        return own.new_full((blocks * WIDTH, own.shape[1]), padding).index_copy(0, place, own)

    def _sketch(self) -> Tensor:
        """Features (v, r) of all points on common directions."""
        shuffled = torch.randperm(self.points, generator=torch.Generator().manual_seed(0))
        some = shuffled[:SKETCHED_POINTS].sort().values
        directions = cpca.basis(self._features(some), min(SKETCH_DIRECTIONS, len(some)))
        return of_all(self.points, POINTS_AT_ONCE, lambda rows: (self._features(rows) @ directions.T,))[0]

    def _features(self, rows: Tensor) -> Tensor:
        """T0, T1 and T2 of some points (v,), weighted by what they add to the picture, side by side."""
        weights = self.transfer.weights
        coarse = self.transfer.direct.coarse[rows + self.first, : len(weights.factors)]
        t0 = coarse * weights.factors[:, None] * weights.light
        t1, t2 = self._indirect(rows)
        t1 *= weights.of_t1(self.slots)
        t2 *= weights.slots[self.pairs].prod(1)[:, None] * weights.harmonics[0]
        return torch.cat((t0.flatten(1), t1.flatten(1), t2.flatten(1)), 1)

    def _indirect(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """T1 (v, q, s, l') and T2 (v, pairs, l'') of some points (v,)."""
        indirect = self.transfer.indirect
        rows = rows + self.first
        t1 = indirect.one.index_select(0, rows).index_select(1, self.slots)
        t2 = indirect.two.index_select(0, rows)[:, self.pairs[:, 0], self.pairs[:, 1]]
        return t1.float().div_(indirect.scale), t2.float().div_(indirect.scale)

    def _eigen_points(self, rows: Tensor, combination: Tensor, clusters: Clusters) -> tuple[Tensor, ...]:
        """Columns, T0, lighting, T1 and T2 of a cluster's eigen-points, which are combinations (v, e) of its points."""
        weights = self.transfer.weights
        axes = self.transfer.indirect.axes
        t1, t2 = self._indirect(rows)
        t1 = torch.einsum("ve,vqsl->eqsl", combination, t1)
        weighed = (t1 * weights.of_t1(self.slots)).flatten(0, 2).double()
        eigenvectors = torch.linalg.eigh(weighed.T @ weighed).eigenvectors.flip(1)
        own = eigenvectors[:, : self._lighting_dimensions(clusters)].float()  # shape: (l', n)
        t1 = (t1 @ own).permute(3, 1, 0, 2)
        t2 = torch.einsum("ve,vpl->lpe", combination, t2)
        columns, t0 = self._eigen_direct(rows, combination, clusters)
        return columns, t0, axes.T @ own, t1.flatten(1), t2.flatten(1)

    def _eigen_direct(self, rows: Tensor, combination: Tensor, clusters: Clusters) -> tuple[Tensor, Tensor]:
        """The coefficients (m,) that matter most, and T0 (m, e * (1 + i)) of the eigen-points there."""
        direct = self.transfer.direct
        grid = Cube(self.transfer.raw.resolution)
        factors = len(self.transfer.weights.factors)
        index = direct.indices[rows + self.first]
        n, kept = index.shape
        own = direct.values[rows + self.first].flatten()
        points = csr(torch.arange(n + 1) * kept, index.flatten(), own, factors * grid.cells)
        t0 = (points.transpose(0, 1) @ combination).unflatten(0, (factors, grid.cells))
        size = torch.linalg.vector_norm(t0, dim=2) * self.transfer.weights.factors[:, None]
        energy = size.square().sum(0)
        weighed = energy * natural(grid, ALWAYS).square()
        columns = weighed.topk(min(clusters.columns, grid.cells)).indices.sort().values
        return columns, t0[:, columns].permute(1, 2, 0).flatten(1)


def _cluster_labels(x: Tensor, points: int, eigenvectors: int) -> Tensor:
    """The cluster (v,) of every row of features (v, r), for so many points a cluster."""
    if not len(x):
        return torch.zeros(0, dtype=torch.int64)
    return cpca.cluster(x, _cluster_count(len(x), points), eigenvectors)


def _cluster_count(points: int, each: int) -> int:
    return max(1, round(points / each))


def _clusters_in(labels: Tensor) -> int:
    """The number of clusters that labels (v,) name."""
    return int(labels.max()) + 1 if len(labels) else 0


def _eigenvectors_for(x: Tensor, clusters: Clusters) -> int:
    """The fewest eigenvectors with which clusters leave no more than the error of features (v, r)."""
    assert clusters.error is not None
    whole = float(x.square().sum())
    left = 0.0
    for e in TRIED_EIGENVECTORS:
        labels = _cluster_labels(x, clusters.points, e)
        left = 0.0
        for k in range(_clusters_in(labels)):
            own = x[labels == k]
            caught = own @ cpca.basis(own, e).T
            left += max(0.0, float(own.square().sum() - caught.square().sum()))
        if left <= clusters.error**2 * whole:
            return e
    reached = math.sqrt(left / whole)
    most = TRIED_EIGENVECTORS[-1]
    raise ValueError(
        f"error must be at least {reached:.3g} with {most} eigenvectors and {clusters.points} points a cluster, "
        f"got {clusters.error:g}: fewer points reach less"
    )
