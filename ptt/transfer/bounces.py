"""Transfer after one and two reflections, T1 and T2, point by point from rays that were traced once.

    T1[v, q, s, l] = integral of Z_s(w) cos(w) O_q[y(v, w), -w, l] dw           (Sun et al. 2007, section 3.1)
    O_q[y, wo, l]  = sum over j of  g_q[wo, j] T0[y, j, l]                      what slot q reflects of direct light
    T2[v, q', q, l] = integral of Z_0 cos(w) sum over s of d_q'[wo, s] T1[y, q, s, l] dw

y(v, w) is what point v sees in direction w. Factors and lobes of the BRDF tensor give the functions of the slots, so
both reflections are matrix products: j runs over the diffuse factor, the incident factors, and the light about the
axes of the lobes times its fractional visibility. l runs over the coarse Haar coefficients of the lighting.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial, all_shares
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.indirect import COARSE, ORDER, blurs, responses
from ptt.models.receivers import Receivers
from ptt.models.slots import OWN, Slot, slots_of
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops import haar, harmonics, lobes, octahedral, transfer
from ptt.ops.sphere import Cube
from ptt.transfer.raw import RawTransfer

AXIS_CELLS = Cube(16)  # cells to which the axes of lobes are rounded: 5.6 degrees wide
LOBE_CELLS = Cube(32)  # cells on which lobes are integrated
CUTS = 24  # cells along an edge of the hemispherical map of fractional visibility


class RegionHits(NamedTuple):
    """What some points (b,) see of one region, by up to n rays each.

    at (b, n): the vertex that a ray meets
    ray (b, n): number of its direction
    wo (b, n, 3): direction back to the point, in the vertex's frame
    weight (b, n): 1, or 0 where a point has no ray left or sees the vertex from below its horizon
    """

    at: Tensor
    ray: Tensor
    wo: Tensor
    weight: Tensor


@dataclass(frozen=True, eq=False)
class OwnLayers:
    """A region's own material that varies over its n points, whole: the last three slots of the region, one a channel.

    diffuse (n, 3): albedo over pi
    shares (n, 3, k): how much of the highlight of each of its layers; these follow the functions of the other slots
    """

    diffuse: Tensor
    shares: Tensor

    @classmethod
    def of(cls, region: int, material: SurfaceMaterial, receivers: Receivers) -> OwnLayers:
        """Those of a region, by its number."""
        at = receivers.layers_at(region, material)
        shares = all_shares(material, at)
        albedo = torch.stack([layer.diffuse for layer in material.layers])[:, None] * shares
        colours = torch.stack([layer.specular for layer in material.layers])[:, None] * shares
        return cls(albedo.sum(0) * at.colour / math.pi, colours.permute(1, 2, 0).contiguous())


@dataclass(frozen=True, eq=False)
class Reflector:
    """The reflection of one region: the functions of its slots in terms of the BRDF tensor, p of them.

    slots, first: numbers of the slots, and of the region's first point
    channels (q,): colour channel of each slot, -1 for all
    diffuse (q,): 1 / pi, or 0 for a specular function
    cores (p, o, i): responses to the tensor's factors
    peaks (p, k, turns, tilts): reflectances of the lobes (`lobes.lookup`)
    own: the region's own material where it varies, else None, and a slot is a function
    """

    slots: list[int]
    first: int
    channels: Tensor
    diffuse: Tensor
    cores: Tensor
    peaks: Tensor
    own: OwnLayers | None

    @classmethod
    def of(cls, region: int, slots: Sequence[Slot], raw: RawTransfer, brdf: TensorBRDF, basis: BRDFBasis) -> Reflector:
        """The reflector of a region, by its number."""
        own = [k for k, slot in enumerate(slots) if slot.region == region]
        material = raw.receivers.materials[raw.receivers.names[region]]
        varies = not isinstance(material, Material)
        mixtures = []
        for slot in (slots[k] for k in own):
            if slot.function == OWN and isinstance(material, Material):
                mixtures.append(_own(brdf, material, slot.channel).to(brdf.core))
            elif slot.function > 0:
                mixtures.append(basis.mixture[:, slot.function - 1])
            elif slot.function == 0:
                mixtures.append(brdf.core.new_zeros(len(brdf.space.samples)))
        if varies:
            mixtures += [_of_layer(brdf, layer) for layer in material.layers]
        mixture = torch.stack(mixtures)
        return cls(
            own,
            raw.receivers.spans[region][0],
            torch.tensor([slots[k].channel for k in own]),
            brdf.core.new_tensor([1 / math.pi if slots[k].function == 0 else 0.0 for k in own]),
            torch.einsum("ph,hj,joi->poi", mixture, brdf.u_h, brdf.core),
            torch.einsum("ph,hkut->pkut", mixture, brdf.peaks),
            OwnLayers.of(region, material, raw.receivers) if varies else None,
        )

    def shade(self, at: Tensor, colours: Tensor) -> Tensor:
        """The albedo over pi (m, q) of each slot at points (m,) of base colours (m, 3); 0 for specular functions."""
        shade = self.diffuse * torch.where(self.channels >= 0, colours[:, self.channels.clamp(min=0)], colours[:, :1])
        if self.own is None:
            return shade
        return torch.cat((shade[:, :-3], self.own.diffuse.index_select(0, at - self.first)), 1)

    def factors(self, at: Tensor, wo: Tensor, brdf: TensorBRDF) -> Tensor:
        """Responses (m, q, i) of the specular parts of points (m,) to the incident factors, towards wo (m, 3)."""
        return self._of_slots(at, torch.einsum("om,poi->mpi", brdf.outgoing(wo), self.cores))

    def reflectances(self, at: Tensor, wo: Tensor) -> Tensor:
        """Reflectances (m, q, k) of the lobes of the specular parts of points (m,), towards wo (m, 3)."""
        p, k = self.peaks.shape[:2]
        each = lobes.lookup(self.peaks.flatten(0, 1), wo).reshape(p, k, len(wo)).permute(2, 0, 1)
        return self._of_slots(at, each)

    def _of_slots(self, at: Tensor, values: Tensor) -> Tensor:
        """Values (m, q, ...) of the slots at points (m,) from those of the functions (m, p, ...)."""
        if self.own is None:
            return values
        shares = self.own.shares.index_select(0, at - self.first)
        count = values.shape[1] - shares.shape[2]
        return torch.cat((values[:, :count], shares @ values[:, count:]), 1)


def _of_layer(brdf: TensorBRDF, layer: Material) -> Tensor:
    """Coordinates (h,) of the highlight of a layer, 0 where it has none."""
    if layer.shape is None:
        return brdf.core.new_zeros(len(brdf.space.samples))
    return brdf.space.coordinates(layer.shape).to(brdf.core)


def _own(brdf: TensorBRDF, material: Material, channel: int) -> Tensor:
    """Coordinates (h,) of the only highlight of a material, or of a channel of several."""
    if channel >= 0:
        return brdf.space.coloured(material)[:, channel]
    (highlight,) = material.shining
    return brdf.space.coordinates(highlight.shape)


class Bounces:
    """The surfaces that reflect light on its way: made once, they give T1 and T2 of some points at a time.

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
        regions = sorted({slot.region for slot in self.slots})
        self.reflectors = [Reflector.of(region, self.slots, raw, brdf, basis) for region in regions]
        local = transfer.gather_directions(raw.hits.shape[1])
        hemispherical = harmonics.hemispherical(ORDER)
        values = harmonics.evaluate(local, ORDER) @ hemispherical.T
        self.projector = torch.linalg.pinv(values).float()  # shape: (s, n); exact for what the harmonics span
        self.local_directions = local.float()
        self.hemispherical = hemispherical.float()
        self.response = responses(brdf)
        self.blurs = blurs(brdf.angles).float()
        self.light_about = _light_about_axes(brdf.angles, raw.resolution)

    def change_lighting(self, lighting: Tensor) -> None:
        """Make l of T1 and T2 run over the columns of a matrix (l, l'), from now on."""
        self.t0 = self.t0 @ lighting
        self.light_about = self.light_about @ lighting

    def hits_on(self, rows: Tensor, reflector: Reflector) -> RegionHits:
        """What points (b,), by their numbers, see of a reflector's region."""
        own = self.raw.receivers
        region = self.slots[reflector.slots[0]].region
        first, end = own.spans[region]
        hits = self.raw.hits[rows].long()
        mine = (hits >= first) & (hits < end)
        count = mine.sum(1)
        ray = mine.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, : int(count.max())]
        at = hits.gather(1, ray).clamp(first, end - 1)
        direction = self.local_directions[ray] @ own.frames[rows]
        wo = -(own.frames[at] @ direction[..., None])[..., 0]
        weight = (torch.arange(ray.shape[1]) < count[:, None]) & (wo[..., 2] > 0)
        return RegionHits(at, ray, wo, weight.float())

    def first_bounce(self, rows: Tensor) -> Tensor:
        """T1 (b, q, s, l) of points (b,), by their numbers."""
        out = self.t0.new_zeros(len(rows), len(self.slots), ORDER**2, self.t0.shape[2])
        for reflector in self.reflectors:
            hits = self.hits_on(rows, reflector)
            if hits.ray.shape[1]:
                at = hits.at.flatten()
                wo = hits.wo.flatten(0, 1)
                g, light = self._specular(reflector, at, wo)
                diffuse = reflector.shade(at, self.raw.receivers.colours[at])[..., None]
                g = torch.cat((diffuse, g), 2) * hits.weight.flatten()[:, None, None]
                to_factors, to_lobes = g.tensor_split((self.t0.shape[1],), 2)
                sent = torch.baddbmm(to_lobes @ light, to_factors, self.t0.index_select(0, at))
                sent = sent.reshape(*hits.at.shape, -1)  # shape: (b, n, p * l)
                onto = self.projector.T[hits.ray].transpose(1, 2)
                out[:, reflector.slots] = (onto @ sent).unflatten(2, (len(reflector.slots), -1)).transpose(1, 2)
        return out

    def _specular(self, reflector: Reflector, at: Tensor, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Responses (m, p, i + k) to incident factors and lobes, and the light (m, k, l) about the lobes' axes."""
        axes = lobes.lean(self.brdf.axes, wo)  # shape: (m, k, 3)
        each = torch.arange(len(self.brdf.angles))
        cell = AXIS_CELLS.cell(axes @ self.raw.receivers.frames[at])
        light = self.light_about.flatten(0, 1).index_select(0, (cell * len(each) + each).flatten())
        light = light.unflatten(0, cell.shape)
        cell = octahedral.HemiOctahedral(CUTS).cell(axes)
        through = self.cuts[at[:, None], cell, each].float() / 255
        of_lobes = reflector.reflectances(at, wo) * through[:, None]
        return torch.cat((reflector.factors(at, wo, self.brdf), of_lobes), 2), light

    def second_bounce(self, rows: Tensor, t1: Tensor) -> Tensor:
        """T2 (b, q', q, l) of points (b,), by their numbers, from T1 (v, s, q, l) of all; q' reflects last."""
        _, s, q, l = t1.shape  # noqa: E741 (the field's letter)
        out = self.t0.new_zeros(len(rows), len(self.slots), q, l)
        for reflector in self.reflectors:
            hits = self.hits_on(rows, reflector)
            if hits.ray.shape[1]:
                at = hits.at.flatten()
                wo = hits.wo.flatten(0, 1)
                weight = hits.weight * self.projector[0][hits.ray]
                d = self._to_harmonics(reflector, at, wo) * weight.flatten()[:, None, None]  # shape: (m, p, s)
                onto = d.reshape(*hits.at.shape, -1, s).transpose(1, 2).flatten(2)  # shape: (b, p, n * s)
                sent = t1.flatten(1).index_select(0, at).reshape(len(rows), -1, q * l).to(onto)
                out[:, reflector.slots] = (onto @ sent).unflatten(2, (q, l))
        return out

    def _to_harmonics(self, reflector: Reflector, at: Tensor, wo: Tensor) -> Tensor:
        """Light (m, p, s) that each function sends towards wo (m, 3) of light that arrives in each harmonic."""
        diffuse = reflector.shade(at, self.raw.receivers.colours[at])[..., None]
        out = torch.cat((diffuse, reflector.factors(at, wo, self.brdf)), 2) @ self.response.T
        return out + torch.einsum("mpk,mks->mps", reflector.reflectances(at, wo), self.lobe_harmonics(wo))

    def lobe_harmonics(self, wo: Tensor) -> Tensor:
        """Means (m, k, s) of the harmonics Z_s under each lobe for wo (m, 3)."""
        y = harmonics.evaluate(torch.nn.functional.normalize(lobes.lean(self.brdf.axes, wo), dim=2), ORDER)
        return (y * self.blurs) @ self.hemispherical.T


@cache
def _light_about_axes(angles: tuple[float, ...], resolution: int) -> Tensor:
    """Mean light (cells, k, l) under each lobe about each of AXIS_CELLS, from a cube map's coarse Haar coefficients.

    The lobe of 0 degrees counts as that of 7: both are narrower than the cells of the lighting.
    """
    if not angles:
        return torch.zeros(AXIS_CELLS.cells, 0, 6 * COARSE**2, dtype=torch.float32)
    fine = LOBE_CELLS.directions().reshape(-1, 3).float()
    solid = LOBE_CELLS.solid_angles().flatten().float()
    rows = []
    for axis in AXIS_CELLS.directions().reshape(-1, 3).float().split(64):
        angle = lobes.angle_between(axis[:, None], fine)
        weight = torch.stack([lobes.gaussian(angle, max(a, 7.0)) for a in angles], 1) * solid
        weight = weight / weight.sum(2, keepdim=True)
        coarse = haar.analyse(weight.unflatten(2, LOBE_CELLS.shape))[..., :COARSE, :COARSE] * (
            LOBE_CELLS.n / resolution
        )
        rows.append(coarse.flatten(2))
    return torch.cat(rows)
