"""Transfer of all points -> eigen-points of clusters, region by region (Sun et al. 2007, section 4.3).

1. T1 is worked out for some points on the whole coarse lighting, whose principal axes then serve all points.
2. T1 and T2 of every point on these axes, in blocks, kept in 16 bits.
3. Features of a point: T0, T1 and T2, weighted by what they add to the picture under natural light, on a few hundred
   common directions. Clusters and eigen-points are found there (`ops.cpca`) and lifted back.
4. The lighting axis of every cluster is reduced once more (Tucker, on the modes of points and lighting).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ptt.bounces import COARSE, ORDER, Bounces, responses
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.clustered_transfer import LOBES, STORAGE, WIDTH, ClusteredTransfer, Parts, in_blocks
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import cpca, haar
from ptt.ops.sphere import Cube
from ptt.precompute import RawTransfer

if TYPE_CHECKING:
    from ptt.compress import Direct

AXES = 128  # of lighting, common to all points
COARSEST = 2  # cells along an edge of the cube map that lights the second bounce
SAMPLE = 768  # points whose T1 decides the axes
SKETCH = 256  # common directions of the features
PROBES = 2048  # points that decide those
POINTS = 32  # whose T1 is worked out at once
ALWAYS = 1e9  # weight of the means of the faces
LARGEST = 1e3  # of a 16-bit number, with room above
TYPICAL = 0.5  # weight of a material's part, where features are weighed


@dataclass(frozen=True)
class Clusters:
    """How points share eigen-points.

    points: of a cluster, on average; the paper has 1,000
    eigenvectors: of each cluster: the paper's 32
    lighting: of each cluster, dimensions in which indirect light is lit: the paper's 64
    columns: coefficients of T0 of each cluster
    storage: float32, float16 or bfloat16

    Raises:
        ValueError: a number below 1, or another storage.
    """

    points: int = 250
    eigenvectors: int = 32
    lighting: int = 64
    columns: int = 512
    storage: torch.dtype = torch.bfloat16

    def __post_init__(self) -> None:
        if min(self.points, self.eigenvectors, self.lighting, self.columns) < 1:
            raise ValueError(f"points, eigenvectors, lighting and columns must be at least 1, got {self}")
        if self.storage not in STORAGE.values():
            raise ValueError(f"storage must be one of {', '.join(STORAGE)}, got {self.storage}")


class Features(NamedTuple):
    """Weights in the features: of T0's factors (1 + i,) and coefficients (l,), T1's slots (q,) and harmonics (s,)."""

    factors: Tensor
    light: Tensor
    slots: Tensor
    harmonics: Tensor


class Indirect(NamedTuple):
    """T1 (v, q, s, l') and T2 (v, q', q, l''), float16, times `scale`; axes (l', l): the lighting of T1."""

    one: Tensor
    two: Tensor
    axes: Tensor
    scale: float


def compress_regions(
    raw: RawTransfer,
    grid: Cube,
    brdf: TensorBRDF,
    basis: BRDFBasis,
    direct: Direct,
    cuts: Tensor,
    paths: Bounces | None,
    clusters: Clusters,
    progress: bool,
) -> list[ClusteredTransfer]:
    """The clustered transfer of every region, in their order."""
    weights = _features(brdf, basis, paths)
    indirect = _indirect(paths, weights, progress) if paths and paths.slots else _none(raw)
    found = []
    total = sum(1 for count in raw.receivers.counts if count)
    with tqdm(total=total, desc="clusters", unit=" regions", disable=not progress) as bar:
        for first, end in raw.receivers.spans:
            found.append(_region(torch.arange(first, end), grid, direct, cuts, indirect, weights, clusters))
            bar.update()
    return found


def _features(brdf: TensorBRDF, basis: BRDFBasis, paths: Bounces | None) -> Features:
    importance = brdf.importance()
    c = responses(brdf)
    light = natural(Cube(COARSE))
    table = basis.table.square().mean(0).sqrt() * TYPICAL
    sizes = [TYPICAL if slot.function <= 0 else float(table[slot.function - 1]) for slot in paths.slots] if paths else []
    return Features(importance, light, torch.tensor(sizes), (c.square() @ importance.square()).sqrt())


def _none(raw: RawTransfer) -> Indirect:
    v = len(raw.receivers)
    two = torch.zeros(v, 0, 0, 6 * COARSEST**2)
    return Indirect(torch.zeros(v, 0, ORDER**2, 0), two, torch.zeros(0, 6 * COARSE**2), 1.0)


def _indirect(paths: Bounces, weights: Features, progress: bool) -> Indirect:
    """T1 and T2 of all points."""
    v = len(paths.raw.receivers)
    sample = torch.randperm(v, generator=torch.Generator().manual_seed(0))[:SAMPLE].sort().values
    gram = torch.zeros(len(weights.light), len(weights.light), dtype=torch.float64)
    largest = 0.0
    of_slots = weights.slots[:, None, None] * weights.harmonics[:, None]
    for rows in sample.split(4):
        t1 = paths.one(rows) * weights.light
        largest = max(largest, float(t1.abs().max()))
        t1 = (t1 * of_slots).flatten(0, 2)
        gram += (t1.T @ t1).double()
    axes = torch.linalg.eigh(gram).eigenvectors.flip(1)[:, :AXES].float()  # shape: (l, l')
    paths.reduced(weights.light[:, None] * axes)
    scale = LARGEST / max(largest, 1e-30)
    one = torch.empty(v, len(paths.slots), ORDER**2, axes.shape[1], dtype=torch.float16)
    with tqdm(total=v, desc="one bounce", unit=" points", disable=not progress) as bar:
        for rows in torch.arange(v).split(POINTS):
            one[rows[0] : rows[-1] + 1] = paths.one(rows) * scale
            bar.update(len(rows))
    back = axes.T / weights.light  # shape: (l', l)
    return Indirect(one, _two(paths, one, back, progress), back, scale)


def _two(paths: Bounces, one: Tensor, back: Tensor, progress: bool) -> Tensor:
    v, q = one.shape[:2]
    coarsest = torch.zeros(6, COARSE, COARSE, dtype=torch.bool)
    coarsest[:, :COARSEST, :COARSEST] = True
    if paths.raw.bounces < 2:
        return torch.zeros(v, 0, 0, int(coarsest.sum()), dtype=torch.float16)
    lit = back[:, coarsest.flatten()]
    arriving = torch.cat([(part.float() @ lit).half() for part in one.split(1024)]).transpose(1, 2).contiguous()
    two = torch.empty(v, q, q, lit.shape[1], dtype=torch.float16)
    with tqdm(total=v, desc="two bounces", unit=" points", disable=not progress) as bar:
        for rows in torch.arange(v).split(POINTS):
            two[rows[0] : rows[-1] + 1] = paths.two(rows, arriving)
            bar.update(len(rows))
    return two


def _region(
    rows: Tensor,
    grid: Cube,
    direct: Direct,
    cuts: Tensor,
    indirect: Indirect,
    weights: Features,
    clusters: Clusters,
) -> ClusteredTransfer:
    first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
    one, two = indirect.one[first:end], indirect.two[first:end]
    slots = torch.nonzero(one.abs().amax((0, 2, 3)) > 0)[:, 0] if one.numel() else torch.zeros(0, dtype=torch.int64)
    pairs = torch.nonzero(two.abs().amax((0, 3)) > 0) if two.numel() else torch.zeros(0, 2, dtype=torch.int64)
    x = _sketch(first, end, direct, indirect, weights, slots, pairs)
    labels = cpca.cluster(x, max(1, round(len(x) / clusters.points)), clusters.eigenvectors) if len(x) else rows
    count = int(labels.max()) + 1 if len(x) else 1
    cluster, place = in_blocks(labels)
    combination = torch.zeros(len(x), clusters.eigenvectors)
    made = []
    for k in range(count):
        at = torch.nonzero(labels == k)[:, 0]
        found = cpca.basis(x[at], clusters.eigenvectors)
        q, r = torch.linalg.qr((x[at] @ found.T).double())
        full = r.diagonal().abs() > 1e-6 * r.diagonal().norm()
        combination[at, : q.shape[1]] = (q * full).float() * math.sqrt(len(at))
        made.append(_lifted(at + first, combination[at] / len(at), grid, direct, indirect, weights, slots, pairs, clusters))
    stored = clusters.storage
    columns, t0, lighting, t1, t2 = (torch.stack(parts) for parts in zip(*made, strict=True))
    blocks = torch.zeros(len(cluster) * WIDTH, clusters.eigenvectors)
    blocks[place] = combination
    kept_cuts = torch.zeros(len(blocks), cuts.shape[1], LOBES, dtype=torch.uint8)
    kept_cuts[place, :, : cuts.shape[2]] = cuts[first:end]
    parts = Parts(
        cluster,
        place,
        blocks.unflatten(0, (-1, WIDTH)).transpose(1, 2).contiguous().to(stored),
        columns,
        t0.to(stored),
        lighting,
        t1.to(stored),
        t2.to(stored),
        kept_cuts.view(torch.int32).squeeze(2),
    )
    return ClusteredTransfer(parts, slots.tolist(), pairs.tolist())


def _sketch(
    first: int, end: int, direct: Direct, indirect: Indirect, weights: Features, slots: Tensor, pairs: Tensor
) -> Tensor:
    """Features (v, r) of the points of a region."""

    def features(rows: Tensor) -> Tensor:
        t0 = direct.coarse[rows] * weights.factors[:, None] * weights.light
        t1 = indirect.one[rows][:, slots].float() / indirect.scale
        t1 = t1 * (weights.slots[slots][:, None, None] * weights.harmonics[:, None])
        t2 = indirect.two[rows][:, pairs[:, 0], pairs[:, 1]].float() / indirect.scale
        t2 = t2 * (weights.slots[pairs].prod(1)[:, None] * weights.harmonics[0])
        return torch.cat((t0.flatten(1), t1.flatten(1), t2.flatten(1)), 1)

    rows = torch.arange(first, end)
    probes = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:PROBES].sort().values]
    directions = cpca.basis(features(probes), min(SKETCH, len(probes)))
    return torch.cat([features(part) @ directions.T for part in rows.split(512)])


def _lifted(
    rows: Tensor,
    combination: Tensor,
    grid: Cube,
    direct: Direct,
    indirect: Indirect,
    weights: Features,
    slots: Tensor,
    pairs: Tensor,
    clusters: Clusters,
) -> tuple[Tensor, ...]:
    """Columns, T0, lighting, T1 and T2 of the eigen-points of one cluster; combination (v, e) makes them of points."""
    e, factors = combination.shape[1], direct.coarse.shape[1]
    index, values = direct.indices[rows].long(), direct.values[rows]
    t0 = torch.zeros(factors * grid.cells, e)
    t0.index_add_(0, index.flatten(), (values[..., None] * combination[:, None]).flatten(0, 1))
    t0 = t0.unflatten(0, (factors, grid.cells))
    energy = (t0.square().sum(2) * weights.factors[:, None].square()).sum(0) * natural(grid, ALWAYS)
    columns = energy.topk(min(clusters.columns, grid.cells)).indices.sort().values
    kept = t0[:, columns].permute(2, 0, 1).flatten(0, 1)

    t1 = torch.einsum("ve,vqsl->eqsl", combination, indirect.one[rows][:, slots].float() / indirect.scale)
    weighed = (t1 * (weights.slots[slots][:, None, None] * weights.harmonics[:, None])).flatten(0, 2).double()
    axes = torch.linalg.eigh(weighed.T @ weighed).eigenvectors.flip(1)[:, : clusters.lighting].float()
    t2 = torch.einsum("ve,vpl->epl", combination, indirect.two[rows][:, pairs[:, 0], pairs[:, 1]].float() / indirect.scale)
    return columns, kept, axes.T @ indirect.axes, (t1 @ axes).flatten(0, 2), t2.flatten(0, 1)



def natural(grid: Cube, means: float = 1.0) -> Tensor:
    """How large natural light's coefficients (l,) are expected to be: as the root of the wavelet's side.

    means: those of the faces' means
    """
    wavelets = haar.support(grid.n).sqrt()
    wavelets[0, 0] = means
    return wavelets.flatten().float().repeat(6)
