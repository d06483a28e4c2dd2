"""Transfer to the points of one region, direct and indirect together, by clustered PCA (Sun et al. 2007, section 4.3).

Every point is a combination of the eigen-points of its cluster, which have a T0, a T1 and a T2 of their own:

    T[v] ~ sum over e of weights[v, e] T[k(v), e]

so that light and materials are worked out for eigen-points alone. Points lie in blocks of one cluster, padded with
zeros, points innermost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ptt.io.saved import Shapes
from ptt.models.indirect import ORDER
from ptt.ops.compiling import in_python
from ptt.ops.memory import in_large_pages
from ptt.ops.octahedral import Octahedral, tiles
from ptt.ops.transfer import vertices_met
from ptt.ops.tucker import Tucker, multiply
from ptt.ops.view import points_at

WIDTH = 128  # points in a block
FACING = 16  # cells along an edge of the map of normals by which points are ordered
SPAN = 1e-6  # of the largest singular value: a smaller one adds no direction to a joint factor of the points
TRANSFER = ("columns", "direct", "lighting", "one", "twice", "two")
PARTS = ("cluster", "place", "weights", *TRANSFER, "cuts", "seen", "meets", "sky")
STORAGE = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


class ClusterTensors(NamedTuple):
    """What a cluster of v points stands for, as tensorly's TuckerTensors.

    direct (v, m, 1 + i): T0, by the m `columns` of the cluster and the incident factors, the diffuse one first
    one (v, l', q, s): T1, by the coarse lighting, slots and harmonics; None where no slot lights the region
    two (v, l'', pairs): T2, by its lighting (the axes `twice` of the coarse one) and pairs of slots; None where there
        are no pairs

    The factor of the points is the same in all three; T1 has one of the coarse lighting too. All others are identities.
    """

    direct: Any
    one: Any | None = None
    two: Any | None = None


@in_python
class ClusteredTransfer(nn.Module):
    """k clusters with e eigen-points each, and which slots light the points: slots (q,) after one reflection.

    pairs: (last slot, first slot) of each after two; positions in the model's list of slots
    cluster (b,) int64, place (v,) int64: of each block; where each point lies in the blocks (block * WIDTH + lane)
    weights (b, e, WIDTH)
    columns (k, m) int64, direct (k, m, e * (1 + i)): T0 of the eigen-points, at some positions l of the lighting
    lighting (k, l', n): the cluster's own lighting axis, from coefficients of the coarse one
    one (k, n, q * e * s): T1 on it
    twice (l', l''): the lighting axes of T2, from coefficients of the coarse one; two (k, l'', pairs * e): T2 on them
    cuts (b * WIDTH, cells) int32: fractional visibility of the lobes, a byte each; cells = 0 where there are none
    seen (b * WIDTH, words), meets (b * WIDTH, words) int32: what is seen of the hemisphere, and which points of the
        model (`ops.gloss`); nothing without narrow lobes, which also leave of s the constant alone
    sky (words, b * WIDTH) int32: bits of the lighting's cube map that are seen (`ops.gloss.lamp_visibility`); as seen
    """

    cluster: Tensor
    place: Tensor
    weights: Tensor
    columns: Tensor
    direct: Tensor
    lighting: Tensor
    one: Tensor
    twice: Tensor
    two: Tensor
    cuts: Tensor
    seen: Tensor
    meets: Tensor
    sky: Tensor

    def __init__(self, slots: Sequence[int], pairs: Sequence[Sequence[int]], **parts: Tensor) -> None:
        super().__init__()
        self.slots = list(slots)
        self.pairs = [list(pair) for pair in pairs]
        for name in PARTS:
            self.register_buffer(name, in_large_pages(parts[name]))

    @property
    def points(self) -> int:
        """The number of the region's points."""
        return len(self.place)

    @property
    def eigenvectors(self) -> int:
        """The number of each cluster's eigenvectors."""
        return self.weights.shape[1]

    @property
    def harmonics(self) -> int:
        """The number s of harmonics in which light that bounced arrives."""
        terms = len(self.slots) * self.eigenvectors
        return self.one.shape[2] // terms if terms else ORDER**2

    @property
    def clusters(self) -> int:
        """The number of the region's clusters."""
        return len(self.direct)

    def rows(self, cluster: int) -> Tensor:
        """Which of the region's points (v,) belong to a cluster, in the order of its `ClusterTensors`."""
        return torch.nonzero(self.cluster[self.place // WIDTH] == cluster)[:, 0]

    def to_tensorly(self) -> list[ClusterTensors]:
        """What every cluster stands for, in float32 whatever the storage is.

        with_tensorly(to_tensorly()) is the same region to the bit.
        """
        fits = [self._fits(k) for k in range(self.clusters)]
        return [ClusterTensors(*(fit.to_tensorly() if fit.core.numel() else None for fit in own)) for own in fits]

    def with_tensorly(self, clusters: Sequence[ClusterTensors]) -> ClusteredTransfer:
        """The same points with the tensors of every cluster, at any ranks, rounded to the storage.

        Where the factors of a cluster's points differ, one that spans them takes their place: give all three tensors
        the same to make a region smaller. Every cluster takes the memory of the highest ranks of all.
        `TransferModel.with_parts` puts the result into a model.

        Raises:
            ValueError: another number of clusters, a tensor too many or too few, another shape, or values that are not
                finite in the storage.
        """
        if len(clusters) != self.clusters:
            raise ValueError(f"clusters must be the {self.clusters} of the region, got {len(clusters)}")
        taken = [self._taken(k, tensors) for k, tensors in enumerate(clusters)]
        e = max(direct.core.shape[0] for direct, _, _ in taken)
        n = max(one.core.shape[1] for _, one, _ in taken)
        count, m, _ = self.direct.shape
        weights = self.weights.new_zeros(len(self.cluster) * WIDTH, e)
        lighting = self.lighting.new_zeros(count, self.lighting.shape[1], n)
        t0 = self.direct.new_zeros(count, m, e, taken[0][0].core.shape[2])
        t1 = self.one.new_zeros(count, n, len(self.slots), e, self.harmonics)
        t2 = self.two.new_zeros(count, self.two.shape[1], len(self.pairs), e)
        for k, (direct, one, two) in enumerate(taken):
            rank = direct.core.shape[0]
            lit = one.core.shape[1]
            weights[self.place[self.rows(k)], :rank] = direct.factors[0]
            lighting[k, :, :lit] = one.factors[1]
            t0[k, :, :rank] = direct.core.transpose(0, 1)
            t1[k, :lit, :, :rank] = one.core.permute(1, 2, 0, 3)
            t2[k, :, :, :rank] = two.core.permute(1, 2, 0)
        if not all(bool(t.isfinite().all()) for t in (t0, t1, t2)):
            raise ValueError(f"clusters must be finite in {self.direct.dtype}")
        parts = {
            "weights": weights.unflatten(0, (-1, WIDTH)).transpose(1, 2).contiguous(),
            "direct": t0.flatten(2),
            "lighting": lighting,
            "one": t1.flatten(2),
            "two": t2.flatten(2),
        }
        return ClusteredTransfer(self.slots, self.pairs, **{**dict(self.named_buffers()), **parts})

    def _fits(self, k: int) -> list[Tucker]:
        """T0, T1 and T2 of a cluster; T1 and T2 are empty where there is no such light."""
        e = self.eigenvectors
        points = self.weights.transpose(1, 2).flatten(0, 1)[self.place[self.rows(k)]]  # shape: (v, e)
        direct = self.direct[k].to(points).unflatten(1, (e, -1)).transpose(0, 1)
        one = self.one[k].to(points).unflatten(1, (len(self.slots), e, self.harmonics)).permute(2, 0, 1, 3)
        two = self.two[k].to(points).unflatten(1, (len(self.pairs), e)).permute(2, 0, 1)
        return [
            Tucker(core, (*compressed, *_eyes(core)[len(compressed) :]))
            for core, compressed in ((direct, [points]), (one, [points, self.lighting[k]]), (two, [points]))
        ]

    def _taken(self, k: int, tensors: ClusterTensors) -> list[Tucker]:
        """As `_fits`, from tensors at any ranks: one factor of the points, and identities where `_fits` has them."""
        fits = []
        for own, given, name in zip(self._fits(k), tensors, ClusterTensors._fields, strict=True):
            if not own.core.numel():
                if given is not None:
                    raise ValueError(f"{name} of cluster {k} must be None: no such light reaches the region")
                fits.append(own)
                continue
            shape = [len(factor) for factor in own.factors]
            fit = Tucker.checked(given, shape, own.factors[0], f"{name} of cluster {k}")
            compressed = 2 if name == "one" else 1
            core = multiply(fit.core, (*_eyes(fit.core)[:compressed], *fit.factors[compressed:]))
            fits.append(Tucker(core, (*fit.factors[:compressed], *own.factors[compressed:])))
        return _joint(fits)

    def in_line(self, values: Tensor) -> Tensor:
        """Values (v, ...) of the points as (..., b * WIDTH), block by block; padding repeats the first point."""
        source = points_at(self.place, len(self.cluster) * WIDTH).clamp(min=0).to(values.device)
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
            "seen": self.seen.shape[1],
            "meets": self.meets.shape[1],
            "sky": len(self.sky),
            "harmonics": self.harmonics,
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
        n, coarse, twice = config["lighting"]
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
            "one": (stored, (k, n, q * e * config["harmonics"])),
            "twice": (torch.float32, (coarse, twice)),
            "two": (stored, (k, twice, pairs * e)),
            "cuts": (torch.int32, (b * WIDTH, config["cuts"])),
            "seen": (torch.int32, (b * WIDTH, config["seen"])),
            "meets": (torch.int32, (b * WIDTH, config["meets"])),
            "sky": (torch.int32, (config["sky"], b * WIDTH)),
        }

    @classmethod
    def restore(
        cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor], cells: int, slots: int, points: int
    ) -> ClusteredTransfer:
        """The inverse of `config` and of the buffers, for a lighting of so many cells, so many slots, and a model of so
        many points."""
        limits = {
            "cluster": config["clusters"],
            "place": len(tensors["cluster"]) * WIDTH,
            "columns": cells,
            "slots": slots,
            "pairs": slots,
            "meets": points + 1,
        }
        numbers = {name: torch.tensor(config[name]) for name in ("slots", "pairs")}
        numbers["meets"] = vertices_met(tensors["meets"]) + 1  # -1 is for none
        for name, limit in limits.items():
            index = {**tensors, **numbers}[name]
            if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < limit:
                got = f"{int(index.min())}..{int(index.max())}"
                raise ValueError(f"holds wrong indices: {name} must be in 0..{limit - 1}, got {got}")
        return cls(config["slots"], config["pairs"], **tensors)


def _eyes(core: Tensor) -> list[Tensor]:
    """Identities, one for each axis."""
    return [torch.eye(n, dtype=core.dtype, device=core.device) for n in core.shape]


def _joint(fits: Sequence[Tucker]) -> list[Tucker]:
    """The same tensors with one factor of the points, whose columns are about 1, so that cores fit the storage.

    The powers of two that make them so round nothing.
    """
    full = [fit.factors[0] for fit in fits if fit.core.numel()]
    same = all(torch.equal(full[0], points) for points in full)
    if same:
        points = full[0]
    else:
        units = [torch.nn.functional.normalize(points.double(), dim=0) for points in full]
        basis, sizes, _ = torch.linalg.svd(torch.cat(units, 1), full_matrices=False)
        points = basis[:, sizes > SPAN * sizes.amax()].to(full[0])
    size = torch.linalg.vector_norm(points, dim=0) / math.sqrt(max(1, len(points)))
    size = torch.where(size > 0, size.log2().round().exp2(), 1.0)
    made = []
    for fit in fits:
        if not fit.core.numel():
            core = fit.core.new_zeros(points.shape[1], *fit.core.shape[1:])
        else:
            core = fit.core if same else torch.tensordot(points.T @ fit.factors[0], fit.core, 1)
            core = core * size.reshape(-1, *(1 for _ in core.shape[1:]))
        made.append(Tucker(core, (points / size, *fit.factors[1:])))
    return made


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
