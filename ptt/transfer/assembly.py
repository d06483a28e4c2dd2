"""Raw transfer -> T0, T1 and T2 of every point, in blocks, each as small as the rest of the way allows.

T0: its largest Haar coefficients, and all of the coarsest. T1 and T2: on the principal axes of the coarse lighting,
which are those of some points' T1 under natural light, in 16 bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ptt.models.brdf_basis import BRDFBasis
from ptt.models.indirect import COARSE, COARSEST, ORDER, responses
from ptt.models.slots import Slot, slots_of
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import haar, transfer
from ptt.ops.sphere import Cube
from ptt.transfer.bounces import CUTS, Bounces
from ptt.transfer.raw import RawTransfer

BLOCK_BYTES = 5e6  # of T0 at once: what stays in the cache is transformed three times as fast
POINTS = 32  # whose T1 is worked out at once
ALWAYS = 1e9  # weight of the means of the faces
AXES = 128
FEWEST = 32  # of the lighting of T1
SAMPLE = 768  # points whose T1 decides the axes
LARGEST = 1e3  # of a 16-bit number, with room above
TYPICAL = 0.5  # weight of a part of a material
SHARE = 0.5  # of the memory allowed that T1 and T2 may fill


@dataclass(frozen=True, eq=False)
class Direct:
    """T0 of all points: its largest coefficients (v, k), and all of the coarsest (v, 1 + i, l).

    error: relative, in L2, of the largest coefficients
    """

    indices: Tensor
    values: Tensor
    coarse: Tensor
    error: float


class Indirect(NamedTuple):
    """T1 (v, q, s, l') and T2 (v, q', q, l''), float16, times `scale`; axes (l', l): the lighting l' of T1."""

    one: Tensor
    two: Tensor
    axes: Tensor
    scale: float


class Weights(NamedTuple):
    """What T adds to the picture: T0's factors (1 + i,) and coefficients (l,), T1's slots (q,) and harmonics (s,)."""

    factors: Tensor
    light: Tensor
    slots: Tensor
    harmonics: Tensor

    def one(self, slots: Tensor) -> Tensor:
        """Of T1 (q, s, 1), for some slots (q,)."""
        return self.slots[slots][:, None, None] * self.harmonics[:, None]


@dataclass(frozen=True, eq=False)
class Transfer:
    """All of it; cuts (v, cells, k) uint8: fractional visibility of the lobes."""

    raw: RawTransfer
    brdf: TensorBRDF
    basis: BRDFBasis
    direct: Direct
    cuts: Tensor
    indirect: Indirect
    weights: Weights


def assemble(
    raw: RawTransfer,
    brdf: TensorBRDF,
    basis: BRDFBasis,
    coefficients: int | None = 96,
    *,
    max_memory: float = 10e9,
    progress: bool = False,
) -> Transfer:
    """T0, T1 and T2 of every point, for the materials of a space.

    coefficients: of T0, as for `compress`
    max_memory: bytes that may be in use; T1 and T2 take fewer axes of lighting, from 128 down, to fill half of it
    progress: show bars with the rate and the time left

    Raises:
        ValueError: a resolution below 8, basis and brdf of different spaces, or memory for fewer than 32 axes.

    Sun et al. 2007, sections 3.1, 3.3 and 4.3.
    """
    if raw.resolution < COARSE:
        raise ValueError(f"clusters need a resolution of at least {COARSE}, got {raw.resolution}")
    if len(basis.space.samples) != len(brdf.space.samples):
        raise ValueError("basis must be fitted to the space of brdf")
    slots = slots_of(raw.receivers, basis.mixture.shape[1]) if raw.bounces else []
    axes = _axes(len(raw.receivers), len(slots), raw.bounces, max_memory)
    direct = direct_light(raw, brdf, coefficients, progress)
    cuts = _cuts(raw, brdf, progress)
    weights = _weights(brdf, basis, slots)
    paths = Bounces(raw, brdf, basis, direct.coarse, cuts) if slots else None
    indirect = _indirect(paths, weights, axes, progress) if paths else _none(len(raw.receivers))
    return Transfer(raw, brdf, basis, direct, cuts, indirect, weights)


def direct_light(raw: RawTransfer, brdf: TensorBRDF, coefficients: int | None, progress: bool) -> Direct:
    """T0 of every point.

    Each point shares its coefficients out among its factors: magnitudes are weighted by what a factor adds to the
    picture and by what natural light has in a wavelet. The faces' means come first, so that constant light stays exact.
    """
    grid = Cube(raw.resolution)
    keep = grid.cells if coefficients is None else coefficients
    if not 6 <= keep <= grid.cells:
        raise ValueError(f"coefficients must be in 6..{grid.cells}, got {keep}")
    weights = torch.outer(brdf.importance(), natural(grid, ALWAYS)).flatten()
    coarse = min(COARSE, grid.n)
    parts = []
    whole = 0.0
    left = 0.0
    with tqdm(total=len(raw.receivers), desc="direct light", unit=" points", disable=not progress) as bar:
        for t0 in _blocks(raw, grid, brdf.u_i):
            largest = haar.truncate(t0.flatten(1), keep * t0.shape[1], weights)
            parts.append((*largest, t0.unflatten(2, grid.shape)[..., :coarse, :coarse].flatten(2)))
            whole += float(t0.norm()) ** 2
            left += float(t0.flatten(1).scatter(1, largest.indices.long(), 0.0).norm()) ** 2
            bar.update(len(t0))
    indices, values, coarsest = (torch.cat(part) for part in zip(*parts, strict=True))
    return Direct(indices, values, coarsest, math.sqrt(left / whole) if whole else 0.0)


def natural(grid: Cube, means: float = 1.0) -> Tensor:
    """How large natural light's coefficients (l,) are expected to be: as the root of the wavelet's side.

    means: those of the faces' means
    """
    wavelets = haar.support(grid.n).sqrt()
    wavelets[0, 0] = means
    return wavelets.flatten().float().repeat(6)


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


def _cuts(raw: RawTransfer, brdf: TensorBRDF, progress: bool) -> Tensor:
    if not brdf.angles:
        return torch.zeros(len(raw.receivers), CUTS**2, 0, dtype=torch.uint8)
    parts = []
    grid = Cube(raw.resolution)
    with tqdm(total=len(raw.receivers), desc="lobes", unit=" points", disable=not progress) as bar:
        for visible, frames in zip(raw.visible.split(512), raw.receivers.frames.split(512), strict=True):
            parts.append(transfer.lobe_visibility(visible, frames, grid, CUTS, brdf.angles))
            bar.update(len(frames))
    return torch.cat(parts)


def _axes(points: int, slots: int, bounces: int, max_memory: float) -> int:
    """As many as fit beside T2."""
    each = 2 * points * slots * ORDER**2
    two = 2 * points * slots**2 * 6 * COARSEST**2 if bounces == 2 else 0
    fit = int((SHARE * max_memory - two) / each) if each else AXES
    if fit < FEWEST:
        need = math.ceil((two + each * FEWEST) / SHARE)
        raise ValueError(
            f"max_memory must be at least {need} for {points} points and {slots} slots, got {max_memory:g}: "
            "allow more, or make regions fixed and the basis of fewer functions"
        )
    return min(AXES, fit)


def _weights(brdf: TensorBRDF, basis: BRDFBasis, slots: list[Slot]) -> Weights:
    importance = brdf.importance()
    c = responses(brdf)
    table = basis.table.square().mean(0).sqrt() * TYPICAL
    sizes = [TYPICAL if slot.function <= 0 else float(table[slot.function - 1]) for slot in slots]
    light = natural(Cube(COARSE))
    return Weights(importance, light, torch.tensor(sizes), (c.square() @ importance.square()).sqrt())


def _none(points: int) -> Indirect:
    two = torch.zeros(points, 0, 0, 6 * COARSEST**2)
    return Indirect(torch.zeros(points, 0, ORDER**2, 0), two, torch.zeros(0, 6 * COARSE**2), 1.0)


def _indirect(paths: Bounces, weights: Weights, count: int, progress: bool) -> Indirect:
    v = len(paths.raw.receivers)
    axes, largest = _principal(paths, weights, count)
    paths.reduced(weights.light[:, None] * axes)
    scale = LARGEST / max(largest, 1e-30)
    one = torch.empty(v, len(paths.slots), ORDER**2, axes.shape[1], dtype=torch.float16)
    with tqdm(total=v, desc="one bounce", unit=" points", disable=not progress) as bar:
        for rows in torch.arange(v).split(POINTS):
            one[rows[0] : rows[-1] + 1] = paths.one(rows) * scale
            bar.update(len(rows))
    back = axes.T / weights.light  # shape: (l', l)
    return Indirect(one, _two(paths, one, back, progress), back, scale)


def _principal(paths: Bounces, weights: Weights, count: int) -> tuple[Tensor, float]:
    """Axes (l, l') of natural light that matter most to the T1 of some points, and the largest value of those."""
    v = len(paths.raw.receivers)
    largest = 0.0
    gram = torch.zeros(len(weights.light), len(weights.light), dtype=torch.float64)
    of_slots = weights.one(torch.arange(len(weights.slots)))
    for rows in torch.randperm(v, generator=torch.Generator().manual_seed(0))[:SAMPLE].sort().values.split(4):
        t1 = paths.one(rows) * weights.light
        largest = max(largest, float(t1.square().sum(3).amax().sqrt()))
        weighed = (t1 * of_slots).flatten(0, 2)
        gram += (weighed.T @ weighed).double()
    return torch.linalg.eigh(gram).eigenvectors.flip(1)[:, :count].float(), largest


def _two(paths: Bounces, one: Tensor, back: Tensor, progress: bool) -> Tensor:
    """T2 from T1 of all points on the coarsest lighting."""
    v, q = one.shape[:2]
    coarsest = torch.zeros(6, COARSE, COARSE, dtype=torch.bool)
    coarsest[:, :COARSEST, :COARSEST] = True
    if paths.raw.bounces < 2:
        return torch.zeros(v, 0, 0, 6 * COARSEST**2, dtype=torch.float16)
    lit = back[:, coarsest.flatten()]
    arriving = torch.cat([(part.float() @ lit).half() for part in one.split(1024)]).transpose(1, 2).contiguous()
    two = torch.empty(v, q, q, lit.shape[1], dtype=torch.float16)
    with tqdm(total=v, desc="two bounces", unit=" points", disable=not progress) as bar:
        for rows in torch.arange(v).split(POINTS):
            two[rows[0] : rows[-1] + 1] = paths.two(rows, arriving)
            bar.update(len(rows))
    return two
