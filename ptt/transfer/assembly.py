"""Raw transfer -> T0, T1 and T2 of every point, block by block, each as small as clustering allows.

Of T0 the largest Haar coefficients stay, and all of the coarsest. T1 and T2 are held in 16 bits, T1 on the principal
axes of the coarse lighting: those of some points' T1 under natural light.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.models.brdf_basis import BRDFBasis
from ptt.models.indirect import COARSE, ORDER, TWICE, responses
from ptt.models.slots import Slot, slots_of
from ptt.models.tensor_brdf import TensorBRDF
from ptt.models.transfer_model import Highlights
from ptt.ops import haar, kinds, transfer
from ptt.ops.constants import BITS
from ptt.ops.hemispheres import SHARES
from ptt.ops.sphere import Cube
from ptt.transfer.bounces import CUTS, Bounces
from ptt.transfer.filling import of_all
from ptt.transfer.raw import RawTransfer

T0_BYTES_AT_ONCE = 5e6  # what stays in the cache is transformed three times as fast
POINTS_AT_ONCE = 4  # whose T1, or T2, is worked out together: what they see stays in the cache
ALWAYS = 1e9  # weight of the faces' means, so large that they are always kept
AXES = 128  # at most, of the lighting of T1: more take more memory and leave less error
FEWEST_AXES = 32  # with fewer the memory allowed is refused as too little
SAMPLED_POINTS = 768  # whose T1 decides the axes
LARGEST_STORED = 1e3  # of T1 in the sample, after scaling: float16 ends at 65,504, and other points may have more
TYPICAL = 0.5  # weight of a typical material's diffuse part, and of its specular one, where nothing is known of either
MEMORY_SHARE = 0.5  # of the memory allowed, which T1 and T2 may fill


@dataclass(frozen=True, eq=False)
class DirectTransfer:
    """T0 of all points.

    indices, values (v, k): its largest Haar coefficients (`haar.Truncated`, over factors times cells), of the diffuse
        factor alone where narrow lobes reflect glossily
    coarse (v, 1 + i, l): all of the coarsest, of every factor
    error: relative L2 error of the largest coefficients
    """

    indices: Tensor
    values: Tensor
    coarse: Tensor
    error: float


class IndirectTransfer(NamedTuple):
    """T1 and T2 of all points.

    one (v, q, s, l'), two (v, q', q, l''): T1 and T2 times `scale`, float16; l'' are the first of l'
    axes (l', l): the lighting l' of T1 in the coarse Haar basis, most important first
    """

    one: Tensor
    two: Tensor
    axes: Tensor
    scale: float


class PictureWeights(NamedTuple):
    """Weights of the parts of the transfer: how much each adds to the picture.

    factors (1 + i,), light (l,): those of T0's factors and coefficients
    slots (q,), harmonics (s,): those of T1's slots and harmonics
    diffuse_harmonics (1,): of the only harmonic that diffuse reflection knows
    """

    factors: Tensor
    light: Tensor
    slots: Tensor
    harmonics: Tensor
    diffuse_harmonics: Tensor

    def of_t1(self, slots: Tensor) -> Tensor:
        """The weights (q, s, 1) of T1, for some slots by their numbers (q,)."""
        return self.slots[slots][:, None, None] * self.harmonics[:, None]


@dataclass(frozen=True, eq=False)
class Transfer:
    """The transfer to all points, before it is clustered.

    raw, brdf, basis: what it was made from
    direct, indirect: T0, and T1 and T2
    cuts (v, cells, k) uint8: fractional visibility of the lobes (`transfer.lobe_visibility`)
    seen (v, words), meets (v, words) int32: what points see of their hemispheres, and which points
        (`transfer.hemispheres`, `transfer.meets`); nothing of it without narrow lobes
    weights: what each part adds to the picture
    highlights: how direct light is reflected glossily (`Highlights`)
    """

    raw: RawTransfer
    brdf: TensorBRDF
    basis: BRDFBasis
    direct: DirectTransfer
    cuts: Tensor
    seen: Tensor
    meets: Tensor
    indirect: IndirectTransfer
    weights: PictureWeights
    highlights: Highlights


def assemble(
    raw: RawTransfer,
    brdf: TensorBRDF,
    basis: BRDFBasis,
    coefficients: int | None = 96,
    *,
    highlights: Highlights = "tensor",
    max_memory: float = 10e9,
    progress: bool = False,
) -> Transfer:
    """T0, T1 and T2 of every point, for the materials of a space.

    coefficients, highlights: as for `compress`
    max_memory: bytes that may be in use; T1 takes as many axes of lighting, 128 at most, as leave T1 and T2 half of it
    progress: show bars with the rate and the time left

    Raises:
        ValueError: the resolution is below 8, basis and brdf have different spaces, or there is memory for fewer than
            32 axes.

    Sun et al. 2007, sections 3.1, 3.3 and 4.3.
    """
    kinds.check("raw", raw, RawTransfer)
    kinds.check("brdf", brdf, TensorBRDF)
    kinds.check("basis", basis, BRDFBasis)
    if raw.resolution < COARSE:
        raise ValueError(f"clusters need a resolution of at least {COARSE}, got {raw.resolution}")
    if len(basis.space.samples) != len(brdf.space.samples):
        raise ValueError("basis must be fitted to the space of brdf")
    slots = slots_of(raw.receivers, basis.mixture.shape[1]) if raw.bounces else []
    axes = _axis_count(len(raw.receivers), len(slots), raw.bounces, max_memory)
    narrow = highlights == "lobes"
    direct = direct_light(raw, brdf, coefficients, progress, dull=narrow)
    cuts = _cuts(raw, brdf.angles if slots or not narrow else (), progress)
    none = torch.zeros(len(raw.receivers), 0, dtype=torch.int32)
    seen = _seen(raw, progress) if narrow else none
    weights = _weights(brdf, basis, slots)
    if slots:
        indirect = _indirect(Bounces(raw, brdf, basis, direct.coarse, cuts), weights, axes, progress)
    else:
        indirect = _no_indirect(len(raw.receivers))
    if narrow:  # which reflect light glossily, whatever it was before
        indirect = indirect._replace(one=indirect.one[:, :, :1].contiguous())
        weights = weights._replace(factors=weights.factors[:1], harmonics=weights.diffuse_harmonics)
    return Transfer(raw, brdf, basis, direct, cuts, seen, raw.meets if narrow else none, indirect, weights, highlights)


def direct_light(
    raw: RawTransfer, brdf: TensorBRDF, coefficients: int | None, progress: bool, dull: bool = False
) -> DirectTransfer:
    """T0 of every point; dull: the largest coefficients are those of the diffuse factor.

    Each point shares its coefficients out among its factors: magnitudes are weighted by what a factor adds to the
    picture and by what natural light has in a wavelet. In a trial on 160 vertices of the bunny under uffizi, with 96
    coefficients, an equal share by plain magnitude left 2.3 % (diffuse) and 3.0 % (Blinn-Phong 20) of error, this one
    0.6 % and 1.9 %. The faces' means come first, so that constant light stays exact.
    """
    grid = Cube(raw.resolution)
    keep = grid.cells if coefficients is None else coefficients
    if not 6 <= keep <= grid.cells:
        raise ValueError(f"coefficients must be in 6..{grid.cells}, got {keep}")
    kept = 1 if dull else 1 + len(brdf.u_i)
    factors = brdf.u_i if raw.bounces else brdf.u_i[: kept - 1]
    weights = torch.outer(brdf.importance()[:kept], natural(grid, ALWAYS)).flatten()
    coarse = min(COARSE, grid.n)
    texels = _t0(raw, grid, factors)

    def analysed(rows: Tensor) -> tuple[Tensor, ...]:
        t0 = texels(rows)
        fine = haar.analyse(t0[:, :kept])
        shown = fine.flatten(1)
        largest = haar.truncate(shown, keep * kept, weights)
        others = haar.analyse_coarsely(t0[:, kept:], coarse)
        coarsest = torch.cat((fine[..., :coarse, :coarse], others), 1).flatten(2)
        left = shown.scatter(1, largest.indices.long(), 0.0)
        return *largest, coarsest, shown.square().sum(1), left.square().sum(1)

    at_once = max(1, int(T0_BYTES_AT_ONCE / (4 * (1 + len(factors)) * grid.cells)))
    indices, values, coarsest, *squares = of_all(len(raw.receivers), at_once, analysed, "direct light", progress)
    whole, left = (float(each.double().sum()) for each in squares)
    return DirectTransfer(indices, values, coarsest, math.sqrt(left / whole) if whole else 0.0)


def natural(grid: Cube, means: float = 1.0) -> Tensor:
    """The size (l,) that natural light's coefficients are expected to have: the root of the wavelet's side.

    means: the value for the faces' means
    """
    wavelets = haar.support(grid.n).sqrt()
    wavelets[0, 0] = means
    return wavelets.flatten().float().repeat(6)


def _t0(raw: RawTransfer, grid: Cube, factors: Tensor) -> Callable[[Tensor], Tensor]:
    """T0 (b, i, 6, n, n) of points (b,), by their numbers, in the texel basis; the diffuse factor first."""
    directions = grid.directions().reshape(-1, 3).float()
    solid_angles = grid.solid_angles().reshape(-1).float()

    def t0(rows: Tensor) -> Tensor:
        visible = transfer.unpack(raw.visible[rows], grid.cells)
        found = transfer.direct_transfer(visible, raw.receivers.frames[rows], directions, solid_angles, factors)
        return found.reshape(*found.shape[:2], *grid.shape)

    return t0


def _seen(raw: RawTransfer, progress: bool) -> Tensor:
    """What points see of their hemispheres (v, words) int32."""
    return _of_visibility(raw, partial(transfer.hemispheres, cells=BITS, shares=SHARES), "hemispheres", progress)


def _cuts(raw: RawTransfer, angles: Sequence[float], progress: bool) -> Tensor:
    """Fractional visibility (v, cells, k) uint8 of lobes of so many degrees."""
    if not angles:
        return torch.zeros(len(raw.receivers), CUTS**2, 0, dtype=torch.uint8)
    return _of_visibility(raw, partial(transfer.lobe_visibility, cells=CUTS, angles=angles), "lobes", progress)


def _of_visibility(
    raw: RawTransfer, made: Callable[[Tensor, Tensor, Cube], Tensor], what: str, progress: bool
) -> Tensor:
    """What is made (v, ...) of the visibility and the frames of all points."""
    grid = Cube(raw.resolution)

    def values(rows: Tensor) -> tuple[Tensor]:
        return (made(raw.visible[rows], raw.receivers.frames[rows], grid),)

    return of_all(len(raw.receivers), 512, values, what, progress)[0]


def _axis_count(points: int, slots: int, bounces: int, max_memory: float) -> int:
    """The number of axes of lighting with which T1 fits beside T2."""
    each = 2 * points * slots * ORDER**2
    if not each:
        return AXES
    two = 2 * points * slots**2 * TWICE if bounces == 2 else 0
    fit = int((MEMORY_SHARE * max_memory - two) / each)
    if fit < FEWEST_AXES:
        need = math.ceil((two + each * FEWEST_AXES) / MEMORY_SHARE)
        raise ValueError(
            f"max_memory must be at least {need} for {points} points and {slots} slots, got {max_memory:g}: "
            "allow more, or make regions fixed and the basis of fewer functions"
        )
    return min(AXES, fit)


def _weights(brdf: TensorBRDF, basis: BRDFBasis, slots: list[Slot]) -> PictureWeights:
    importance = brdf.importance()
    typical = basis.table.square().mean(0).sqrt() * TYPICAL  # shape: (p,)
    return PictureWeights(
        factors=importance,
        light=natural(Cube(COARSE)),
        slots=torch.tensor([TYPICAL if slot.function <= 0 else float(typical[slot.function - 1]) for slot in slots]),
        harmonics=(responses(brdf).square() @ importance.square()).sqrt(),
        diffuse_harmonics=responses(brdf)[:1, 0] * importance[0],
    )


def _no_indirect(points: int) -> IndirectTransfer:
    return IndirectTransfer(
        torch.zeros(points, 0, ORDER**2, 0, dtype=torch.float32),
        torch.zeros(points, 0, 0, 0, dtype=torch.float32),
        torch.zeros(0, 6 * COARSE**2, dtype=torch.float32),
        1.0,
    )


def _indirect(bounces: Bounces, weights: PictureWeights, count: int, progress: bool) -> IndirectTransfer:
    axes, largest = _principal_lighting(bounces, weights, count)
    bounces.change_lighting(weights.light[:, None] * axes)
    scale = LARGEST_STORED / max(largest, 1e-30)

    def once(rows: Tensor) -> tuple[Tensor]:
        return ((bounces.first_bounce(rows) * scale).half(),)

    (t1,) = of_all(len(bounces.raw.receivers), POINTS_AT_ONCE, once, "one bounce", progress)
    back = axes.T / weights.light  # shape: (l', l)
    return IndirectTransfer(t1, _t2(bounces, t1, progress), back, scale)


def _principal_lighting(bounces: Bounces, weights: PictureWeights, count: int) -> tuple[Tensor, float]:
    """Axes (l, l') of natural light that matter most to the T1 of sampled points, and its largest norm along l."""
    v = len(bounces.raw.receivers)
    sample = torch.randperm(v, generator=torch.Generator().manual_seed(0))[:SAMPLED_POINTS].sort().values
    largest = 0.0
    gram = torch.zeros(len(weights.light), len(weights.light), dtype=torch.float64)
    of_slots = weights.of_t1(torch.arange(len(weights.slots)))
    for rows in sample.split(4):
        t1 = bounces.first_bounce(rows) * weights.light
        largest = max(largest, float(t1.square().sum(3).amax().sqrt()))
        weighed = (t1 * of_slots).flatten(0, 2)
        gram += (weighed.T @ weighed).double()
    return torch.linalg.eigh(gram).eigenvectors.flip(1)[:, :count].float(), largest


def _t2(bounces: Bounces, t1: Tensor, progress: bool) -> Tensor:
    """T2 (v, q', q, l'') from T1 (v, q, s, l') of all points, on the first of its axes of lighting."""
    if bounces.raw.bounces < 2:
        return torch.zeros(len(t1), 0, 0, TWICE, dtype=torch.float16)
    arriving = t1[..., :TWICE].transpose(1, 2).contiguous()

    def twice(rows: Tensor) -> tuple[Tensor]:
        return (bounces.second_bounce(rows, arriving).half(),)

    return of_all(len(t1), POINTS_AT_ONCE, twice, "two bounces", progress)[0]
