"""Raw transfer -> compressed model: T0, T1 and T2 of every point, truncated, clustered, and reduced per cluster."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from ptt import bounces, clustering
from ptt.bounces import Bounces
from ptt.clustering import ALWAYS, Clusters, natural
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.tensor_brdf import TensorBRDF
from ptt.models.transfer_model import SparseTransfer, TransferModel
from ptt.ops import haar, transfer
from ptt.ops.sphere import Cube
from ptt.precompute import RawTransfer
from ptt.spaces import BRDFSpace

BLOCK_BYTES = 5e6  # of T0 at once: what stays in the cache is transformed three times as fast
RANKS = (4, 16, 16)  # BRDF, outgoing and incident factors


def compress(
    raw: RawTransfer,
    coefficients: int | None = 96,
    brdf: TensorBRDF | None = None,
    basis: BRDFBasis | None = None,
    clusters: Clusters | None = Clusters(),  # noqa: B008 (frozen)
    *,
    progress: bool = False,
) -> TransferModel:
    """Transfer to every point, as far as the scene and the accuracy require.

    coefficients: Haar coefficients of T0 kept, on average over the factors of a point; None keeps all. 96 is the paper's
    brdf: the materials that the model can show, as one reflects at the points; default: Blinn-Phong exponents 1..200
        at ranks (4, 16, 16)
    basis: the same space as light is reflected on its way; default: four functions and the diffuse one
    clusters: how points share eigen-points; None keeps every point's own T0, for direct light alone: exact, but 10 to
        100 times as large and as slow to light anew
    progress: show bars with the rate and the time left

    Each point shares its coefficients out among its factors: magnitudes are weighted by what a factor adds to the
    picture (`TensorBRDF.importance`) and by the square root of the wavelet's side, since natural light has less in
    fine wavelets. The faces' means come first, so that constant light stays exact.

    Raises:
        ValueError: coefficients out of range, a basis of another space than brdf, or indirect light without clusters.

    Sun et al. 2007, sections 3.3 and 4.3; Ng et al. 2003 for the weighting by area.
    """
    grid = Cube(raw.resolution)
    keep = grid.cells if coefficients is None else coefficients
    if not 6 <= keep <= grid.cells:
        raise ValueError(f"coefficients must be in 6..{grid.cells}, got {keep}")
    if raw.bounces and clusters is None:
        raise ValueError("light that bounces needs clusters, got None")
    if clusters and raw.resolution < bounces.COARSE:
        raise ValueError(f"clusters need a resolution of at least {bounces.COARSE}, got {raw.resolution}")
    brdf = brdf or TensorBRDF.fit(BRDFSpace.blinn_phong(), ranks=RANKS, separated=3 if clusters else 0)
    if clusters is None:
        if brdf.angles:
            raise ValueError("brdf must be fitted with separated=0: without clusters no lobes are shown")
        direct = _direct(raw, grid, brdf, keep, progress)
        return TransferModel(raw.receivers, brdf, None, raw.resolution, direct.sparse, [], direct.error)
    basis = basis or BRDFBasis.fit(brdf.space)
    if len(basis.space.samples) != len(brdf.space.samples):
        raise ValueError("basis must be fitted to the space of brdf")
    direct = _direct(raw, grid, brdf, keep, progress)
    cuts = _cuts(raw, grid, brdf, progress)
    paths = Bounces(raw, brdf, basis, direct.coarse, cuts) if raw.bounces else None
    regions = clustering.compress_regions(raw, grid, brdf, basis, direct, cuts, paths, clusters, progress)
    return TransferModel(raw.receivers, brdf, basis, raw.resolution, None, regions, direct.error)


@dataclass(frozen=True, eq=False)
class Direct:
    """T0 of all points: its largest coefficients, and all of the coarsest (v, 1 + i, l)."""

    indices: Tensor
    values: Tensor
    coarse: Tensor
    cells: int
    error: float

    @property
    def sparse(self) -> SparseTransfer:
        """The former as rows (i, v)."""
        return SparseTransfer.of(haar.Truncated(self.indices, self.values), self.coarse.shape[1], self.cells)


def _direct(raw: RawTransfer, grid: Cube, brdf: TensorBRDF, keep: int, progress: bool) -> Direct:
    factors = 1 + len(brdf.u_i)
    weights = torch.outer(brdf.importance(), natural(grid, ALWAYS)).flatten()
    coarsest = min(bounces.COARSE, grid.n)
    indices, values, coarse, whole, left = [], [], [], 0.0, 0.0
    with tqdm(total=len(raw.receivers), desc="direct light", unit=" points", disable=not progress) as bar:
        for t0 in _blocks(raw, grid, brdf.u_i):
            part = haar.truncate(t0.flatten(1), keep * factors, weights)
            indices.append(part.indices)
            values.append(part.values)
            coarse.append(t0.unflatten(2, grid.shape)[..., :coarsest, :coarsest].flatten(2))
            whole += float(t0.norm()) ** 2
            left += float(t0.flatten(1).scatter(1, part.indices.long(), 0.0).norm()) ** 2
            bar.update(len(t0))
    error = math.sqrt(left / whole) if whole else 0.0
    return Direct(torch.cat(indices), torch.cat(values), torch.cat(coarse), grid.cells, error)


def _blocks(raw: RawTransfer, grid: Cube, factors: Tensor) -> Iterator[Tensor]:
    """T0 (v, i, l) in the Haar basis, some receivers at a time; the diffuse factor first."""
    directions = grid.directions().reshape(-1, 3).float()
    solid_angles = grid.solid_angles().reshape(-1).float()
    block = max(1, int(BLOCK_BYTES / (4 * (1 + len(factors)) * grid.cells)))
    for first in range(0, len(raw.receivers), block):
        rows = slice(first, first + block)
        visible = transfer.unpack(raw.visible[rows], grid.cells)
        t0 = transfer.direct_transfer(visible, raw.receivers.frames[rows], directions, solid_angles, factors)
        yield haar.analyse(t0.unflatten(2, grid.shape)).flatten(2)


def _cuts(raw: RawTransfer, grid: Cube, brdf: TensorBRDF, progress: bool) -> Tensor:
    """Fractional visibility (v, cells, k) uint8 of the lobes; none without lobes."""
    if not brdf.angles:
        return torch.zeros(len(raw.receivers), bounces.CUTS**2, 0, dtype=torch.uint8)
    parts = []
    with tqdm(total=len(raw.receivers), desc="lobes", unit=" points", disable=not progress) as bar:
        for visible, frames in zip(raw.visible.split(512), raw.receivers.frames.split(512), strict=True):
            parts.append(transfer.lobe_visibility(visible, frames, grid, bounces.CUTS, brdf.angles))
            bar.update(len(frames))
    return torch.cat(parts)

