"""Raw transfer -> compressed model: factors of the BRDF space times visibility, in the Haar basis, truncated."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from tqdm import tqdm

from ptt.models.tensor_brdf import TensorBRDF
from ptt.models.transfer_model import SparseTransfer, TransferModel
from ptt.ops import haar, transfer
from ptt.ops.sphere import Cube
from ptt.precompute import RawTransfer
from ptt.spaces import MODERATE, BRDFSpace

BLOCK_BYTES = 5e6  # of T0 at once: what stays in the cache is transformed three times as fast
SPACE = BRDFSpace.blinn_phong(MODERATE)
RANKS = (4, 24, 24)  # BRDF, outgoing and incident factors
ALWAYS = 1e9  # weight of the means of the faces


def compress(
    raw: RawTransfer, coefficients: int | None = 96, brdf: TensorBRDF | None = None, *, progress: bool = False
) -> TransferModel:
    """T0 of every receiver and incident factor, its largest coefficients alone.

    coefficients: Haar coefficients kept, on average over the factors of a receiver; None keeps all. 96 is the paper's
    brdf: the materials that the model can show; default: Blinn-Phong exponents 1..64 at ranks (4, 24, 24). Storage
        grows with the incident factors
    progress: show a bar with the rate and the time left

    Each receiver shares its coefficients out among its factors: magnitudes are weighted by what a factor adds to the
    picture (`TensorBRDF.importance`) and by the square root of the wavelet's side, since natural light has less in
    fine wavelets. The faces' means come first, so that constant light stays exact.

    Raises:
        ValueError: coefficients out of range, or a brdf with lobes.

    Sun et al. 2007, sections 3.3 and 4.3; Ng et al. 2003 for the weighting by area.
    """
    grid = Cube(raw.resolution)
    keep = grid.cells if coefficients is None else coefficients
    if not 6 <= keep <= grid.cells:
        raise ValueError(f"coefficients must be in 6..{grid.cells}, got {keep}")
    if brdf is not None and brdf.angles:
        raise ValueError("brdf must be fitted with separated=0: T0 holds the tensor's factors, not its lobes")
    brdf = brdf or TensorBRDF.fit(SPACE, ranks=RANKS, separated=0)
    weights = _weights(brdf, grid)
    kept, whole, left = [], 0.0, 0.0
    with tqdm(total=len(raw.receivers), desc="transfer", unit=" points", disable=not progress) as bar:
        for t0 in _blocks(raw, grid, brdf.u_i):
            part = haar.truncate(t0.flatten(1), keep * t0.shape[1], weights)
            kept.append(SparseTransfer.of(part, t0.shape[1], grid.cells))
            whole += float(t0.norm()) ** 2
            left += float(t0.flatten(1).scatter_(1, part.indices.long(), 0.0).norm()) ** 2
            bar.update(len(t0))
    error = math.sqrt(left / whole) if whole else 0.0
    return TransferModel(raw.receivers, brdf, raw.resolution, SparseTransfer.cat(kept), error)


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


def _weights(brdf: TensorBRDF, grid: Cube) -> Tensor:
    """Of the magnitudes of T0's coefficients (i * l,)."""
    wavelets = haar.support(grid.n).sqrt()
    wavelets[0, 0] = ALWAYS
    return torch.outer(brdf.importance(), wavelets.flatten().float().repeat(6)).flatten()
