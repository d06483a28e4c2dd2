"""Raw transfer -> compressed model: factors of the BRDF space times visibility, in the Haar basis, truncated."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from tqdm import tqdm

from ptt.materials import BlinnPhongSpace
from ptt.models.tensor_brdf import TensorBRDF
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar, transfer
from ptt.ops.sphere import Cube
from ptt.precompute import RawTransfer

BLOCK_BYTES = 10e6  # of T0 at once: what stays in the cache is transformed three times as fast
SPACE = BlinnPhongSpace()
RANKS = (4, 24, 24)  # BRDF, outgoing and incident factors


def compress(
    raw: RawTransfer, coefficients: int | None = 96, brdf: TensorBRDF | None = None, *, progress: bool = False
) -> TransferModel:
    """T0 of every receiver and incident factor, its largest coefficients alone.

    coefficients: Haar coefficients kept for each receiver and factor, the faces' means always among them; None keeps
        all. 96 is the paper's: about 2 % relative error in the picture under a natural map, 256 well below 1 %
    brdf: the materials that the model can show; default: Blinn-Phong exponents 1..64 at ranks (4, 24, 24). Storage
        grows with the incident factors
    progress: show a bar with the rate and the time left

    Raises:
        ValueError: coefficients out of range.

    Sun et al. 2007, sections 3.3 and 4.3.
    """
    grid = Cube(raw.resolution)
    keep = grid.cells if coefficients is None else coefficients
    if not 6 <= keep <= grid.cells:
        raise ValueError(f"coefficients must be in 6..{grid.cells}, got {keep}")
    brdf = brdf or TensorBRDF.fit(SPACE, ranks=RANKS)
    return TransferModel(raw.receivers, brdf, raw.resolution, *_truncated(raw, grid, brdf.u_i, keep, progress))


def _truncated(
    raw: RawTransfer, grid: Cube, factors: Tensor, keep: int, progress: bool
) -> tuple[Tensor, Tensor, float]:
    """Indices (i, v, k) int16 and values (i, v, k) of T0's largest coefficients, and the relative error of the rest."""
    directions = grid.directions().reshape(-1, 3).float()
    solid_angles = grid.solid_angles().reshape(-1).float()
    count = 1 + len(factors)
    means = torch.arange(6) * grid.n**2  # of the faces, so that constant light stays exact
    index = torch.empty(count, len(raw.receivers), keep, dtype=torch.int16 if grid.cells <= 1 << 15 else torch.int32)
    value = torch.empty(count, len(raw.receivers), keep)
    block = max(1, int(BLOCK_BYTES / (4 * count * grid.cells)))
    whole = kept_part = 0.0
    bar = tqdm(total=len(raw.receivers), desc="transfer", unit=" points", disable=not progress)
    for first in range(0, len(raw.receivers), block):
        rows = slice(first, first + block)
        visible = transfer.unpack(raw.visible[rows], grid.cells)
        t0 = transfer.direct_transfer(visible, raw.receivers.frames[rows], directions, solid_angles, factors)
        kept = haar.truncate(haar.analyse(t0.unflatten(2, grid.shape)).flatten(2), keep, means)
        index[:, rows], value[:, rows] = kept.indices.transpose(0, 1), kept.values.transpose(0, 1)
        whole += float(t0.square().sum(dtype=torch.float64))
        kept_part += float(kept.values.square().sum(dtype=torch.float64))
        bar.update(len(visible))
    bar.close()
    return index, value, math.sqrt(max(0.0, 1 - kept_part / whole)) if whole else 0.0
