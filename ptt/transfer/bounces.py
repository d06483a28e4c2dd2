"""Transfer after one and two reflections, T1 and T2, point by point from rays that were traced once.

    T1[v, q, s, l] = integral of Z_s(w) cos(w) O_q[y(v, w), -w, l] dw           (Sun et al. 2007, section 3.1)
    O_q[y, wo, l]  = sum over j of  g_q[wo, j] T0[y, j, l]                      a slot's reflection of direct light
    T2[v, q', q, l] = integral of Z_0 cos(w) sum over s of d_q'[wo, s] T1[y, q, s, l] dw

y(v, w) is what point v sees in direction w. The BRDF functions of the slots are those of the BRDF tensor, factors and
lobes (j runs over both: the diffuse factor, the incident factors, the light about the axes of the lobes times its
fractional visibility); so both reflections are matrix products. Lighting l: the coarse Haar coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.models.brdf_basis import BRDFBasis
from ptt.models.indirect import COARSE, ORDER, blurs, responses
from ptt.models.slots import OWN, Slot, slots_of
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import haar, harmonics, lobes, octahedral, transfer
from ptt.ops.sphere import Cube
from ptt.transfer.raw import RawTransfer

MIRRORS = Cube(16)  # cells to which the axes of lobes are rounded
SMOOTH = Cube(32)  # cells on which lobes are integrated
CUTS = 24  # cells along an edge of the hemispherical map of fractional visibility


class Seen(NamedTuple):
    """What some points see of one region: n rays at most, those that a point has not are zeros.

    at (b, n): vertex; ray (b, n): number of the direction; wo (b, n, 3): towards the point, in the vertex's frame
    weight (b, n): 1, or 0 where there is no ray or the vertex is seen from below its horizon
    """

    at: Tensor
    ray: Tensor
    wo: Tensor
    weight: Tensor


@dataclass(frozen=True, eq=False)
class Reflector:
    """How one region reflects: its slots' functions in the terms of the BRDF tensor.

    slots: numbers of its slots; channels (p,): colour channel of each, -1 for all
    diffuse (p,): 1 / pi or 0; cores (p, o, i), peaks (p, k, turns, tilts)
    """

    slots: list[int]
    channels: Tensor
    diffuse: Tensor
    cores: Tensor
    peaks: Tensor

    @classmethod
    def of(cls, region: int, slots: Sequence[Slot], raw: RawTransfer, brdf: TensorBRDF, basis: BRDFBasis) -> Reflector:
        own = [k for k, slot in enumerate(slots) if slot.region == region]
        material = raw.receivers.materials[raw.receivers.names[region]]
        mixtures = []
        for slot in (slots[k] for k in own):
            if slot.function == OWN:
                assert material.shape is not None
                mixtures.append(brdf.space.coordinates(material.shape).to(brdf.core))
            elif slot.function > 0:
                mixtures.append(basis.mixture[:, slot.function - 1])
            else:
                mixtures.append(brdf.core.new_zeros(len(brdf.space.samples)))
        mixture = torch.stack(mixtures)
        return cls(
            own,
            torch.tensor([slots[k].channel for k in own]),
            torch.tensor([1 / math.pi if slots[k].function == 0 else 0.0 for k in own]),
            torch.einsum("ph,hj,joi->poi", mixture, brdf.u_h, brdf.core),
            torch.einsum("ph,hkut->pkut", mixture, brdf.peaks),
        )

    def shade(self, colours: Tensor) -> Tensor:
        """The base colour (m, p) that each diffuse function has at points of colours (m, 3), over pi."""
        return self.diffuse * torch.where(self.channels >= 0, colours[:, self.channels.clamp(min=0)], colours[:, :1])

    def factors(self, wo: Tensor, brdf: TensorBRDF) -> Tensor:
        """Responses (m, p, i) of the specular functions to the incident factors, towards wo (m, 3)."""
        return torch.einsum("om,poi->mpi", brdf.outgoing(wo), self.cores)

    def reflectances(self, wo: Tensor) -> Tensor:
        """Reflectances (m, p, k) of their lobes, towards wo (m, 3)."""
        p, k = self.peaks.shape[:2]
        return lobes.lookup(self.peaks.flatten(0, 1), wo).reshape(p, k, len(wo)).permute(2, 0, 1)


class Bounces:
    """All that light reflects from: made once, then asked for blocks of points.

    t0 (v, 1 + i, l): direct transfer to every vertex, in the coarse Haar basis (flattened)
    cuts (v, cells, k) uint8: fractional visibility of the lobes (`transfer.lobe_visibility`)
    """

    def __init__(self, raw: RawTransfer, brdf: TensorBRDF, basis: BRDFBasis, t0: Tensor, cuts: Tensor) -> None:
        own = raw.receivers
        self.raw = raw
        self.brdf = brdf
        self.t0 = t0
        self.cuts = cuts
        self.slots = slots_of(own, basis.mixture.shape[1])
        self.reflectors = [Reflector.of(r, self.slots, raw, brdf, basis) for r in range(len(own.names)) if self._has(r)]
        local = transfer.gather_directions(raw.hits.shape[1])
        change = harmonics.hemispherical(ORDER)
        values = harmonics.evaluate(local, ORDER) @ change.T
        self.projector = torch.linalg.pinv(values).float()  # shape: (s, n); exact for what the harmonics span
        self.local = local.float()
        self.change = change.float()
        self.response = responses(brdf)
        self.blurs = blurs(brdf.angles).float()
        self.mirrored = _mirrored(brdf.angles, raw.resolution)

    def _has(self, region: int) -> bool:
        return any(slot.region == region for slot in self.slots)

    def reduced(self, lighting: Tensor) -> None:
        """From now on, lighting is a combination of the columns of a matrix (l, l')."""
        self.t0 = self.t0 @ lighting
        self.mirrored = self.mirrored @ lighting

    def seen(self, rows: Tensor, reflector: Reflector) -> Seen:
        """What the points (b,) see of a region."""
        own = self.raw.receivers
        region = self.slots[reflector.slots[0]].region
        first, end = own.spans[region]
        hits = self.raw.hits[rows].long()
        mine = (hits >= first) & (hits < end)
        count = mine.sum(1)
        ray = mine.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, : int(count.max())]
        at = hits.gather(1, ray).clamp(first, end - 1)
        direction = self.local[ray] @ own.frames[rows]
        wo = -(own.frames[at] @ direction[..., None])[..., 0]
        weight = (torch.arange(ray.shape[1]) < count[:, None]) & (wo[..., 2] > 0)
        return Seen(at, ray, wo, weight.float())

    def one(self, rows: Tensor) -> Tensor:
        """T1 (b, q, s, l) of points (b,)."""
        out = self.t0.new_zeros(len(rows), len(self.slots), ORDER**2, self.t0.shape[2])
        for reflector in self.reflectors:
            seen = self.seen(rows, reflector)
            if seen.ray.shape[1]:
                at = seen.at.flatten()
                wo = seen.wo.flatten(0, 1)
                g, light = self._specular(reflector, at, wo)
                diffuse = reflector.shade(self.raw.receivers.colours[at])[..., None]
                g = torch.cat((diffuse, g), 2) * seen.weight.flatten()[:, None, None]
                sent = (g @ torch.cat((self.t0[at], light), 1)).reshape(*seen.at.shape, -1)  # shape: (b, n, p * l)
                onto = self.projector.T[seen.ray].transpose(1, 2)
                out[:, reflector.slots] = (onto @ sent).unflatten(2, (len(reflector.slots), -1)).transpose(1, 2)
        return out

    def _specular(self, reflector: Reflector, at: Tensor, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Responses (m, p, i + k) to the incident factors and to the light (m, k, l) about the axes of the lobes."""
        axes = lobes.lean(self.brdf.axes, wo)
        each = torch.arange(len(self.brdf.angles))  # shape: (m, k, 3)
        light = self.mirrored[MIRRORS.cell(axes @ self.raw.receivers.frames[at]), each]
        cell = octahedral.HemiOctahedral(CUTS).cell(axes)
        through = self.cuts[at[:, None], cell, each].float() / 255
        return torch.cat((reflector.factors(wo, self.brdf), reflector.reflectances(wo) * through[:, None]), 2), light

    def two(self, rows: Tensor, t1: Tensor) -> Tensor:
        """T2 (b, q', q, l) of points (b,) from T1 (v, s, q, l) of all, q' the last reflection's slot."""
        _, s, q, l = t1.shape  # noqa: E741 (the field's letter)
        out = self.t0.new_zeros(len(rows), len(self.slots), q, l)
        for reflector in self.reflectors:
            seen = self.seen(rows, reflector)
            if seen.ray.shape[1]:
                at = seen.at.flatten()
                wo = seen.wo.flatten(0, 1)
                weight = seen.weight * self.projector[0][seen.ray]
                d = self._to_harmonics(reflector, at, wo) * weight.flatten()[:, None, None]  # shape: (m, p, s)
                onto = d.reshape(*seen.at.shape, -1, s).transpose(1, 2).flatten(2)  # shape: (b, p, n * s)
                sent = t1[at].reshape(len(rows), -1, q * l).to(onto)
                out[:, reflector.slots] = (onto @ sent).unflatten(2, (q, l))
        return out

    def _to_harmonics(self, reflector: Reflector, at: Tensor, wo: Tensor) -> Tensor:
        """What each function sends towards wo (m, 3) of light that arrives in each harmonic (m, p, s)."""
        diffuse = reflector.shade(self.raw.receivers.colours[at])[..., None]
        out = torch.cat((diffuse, reflector.factors(wo, self.brdf)), 2) @ self.response.T
        return out + torch.einsum("mpk,mks->mps", reflector.reflectances(wo), self.filtered(wo))

    def filtered(self, wo: Tensor) -> Tensor:
        """Z_s about the axis of each lobe for wo (m, 3), as it blurs them (m, k, s)."""
        y = harmonics.evaluate(torch.nn.functional.normalize(lobes.lean(self.brdf.axes, wo), dim=2), ORDER)
        return (y * self.blurs) @ self.change.T


@cache
def _mirrored(angles: tuple[float, ...], resolution: int) -> Tensor:
    """Mean light about the cells of MIRRORS under each lobe (cells, k, l), of a cube map's coarse Haar coefficients.

    The lobe of 0 degrees as that of 7: both are narrower than the cells of the lighting.
    """
    if not angles:
        return torch.zeros(MIRRORS.cells, 0, 6 * COARSE**2)
    fine = SMOOTH.directions().reshape(-1, 3).float()
    solid = SMOOTH.solid_angles().flatten().float()
    rows = []
    for axis in MIRRORS.directions().reshape(-1, 3).float().split(64):
        angle = lobes.angle_between(axis[:, None], fine)
        weight = torch.stack([lobes.gaussian(angle, max(a, 7.0)) for a in angles], 1) * solid
        weight = weight / weight.sum(2, keepdim=True)
        coarse = haar.analyse(weight.unflatten(2, SMOOTH.shape))[..., :COARSE, :COARSE] * (SMOOTH.n / resolution)
        rows.append(coarse.flatten(2))
    return torch.cat(rows)
