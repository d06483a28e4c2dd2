"""The steps of relighting where narrow lobes reflect: light and BRDF for eigen-points, the view for points in blocks.

light   U0[c, e]    = sum over l of  L[c, l] T0[l, e]           U1, U2 alike, and what arrives of lamps
BRDF    E[v, c]     = U0 + sum over q of  H[q, c] U1[c, q, e]  +  sum of  H[q, c] H[q', c] U2[c, qq', e], at points
        D[v, c]     = albedo / pi E[v, c]
view    B[v, c]     = D[v, c]  and what narrow lobes reflect (`ops.gloss`)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, pad

from ptt.light.environment import Environment
from ptt.light.lamps import Lamps
from ptt.materials.material import Material
from ptt.materials.varying import SurfaceMaterial, Varying, all_shares
from ptt.models import slots
from ptt.models.cache import Cache, watched
from ptt.models.clustered_transfer import ClusteredTransfer
from ptt.models.indirect import COARSE
from ptt.models.transfer_model import TransferModel
from ptt.ops import haar
from ptt.ops.around import Around
from ptt.ops.cells import Gloss, in_parts
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.constants import RECORD, ROW, SENT, TILTS, TINY
from ptt.ops.gloss import GlossLight
from ptt.ops.relight import ArrivingLight, expand
from ptt.ops.sphere import Cube
from ptt.ops.view import SurfaceBlocks
from ptt.relight.cluster_steps import RegionPoints, arriving_light, slot_weights, varying_functions
from ptt.relight.glosses import WIDTHS, Glosses, light_for
from ptt.relight.light_step import LightStep, SplitLight
from ptt.relight.operations import operations

OPEN = 0.02  # of the hemisphere: what a point sees of surfaces counts as at least as much where their mean is taken
BROAD = 24.0
"""Degrees about the mirror direction within which half of a highlight lies, GGX of roughness 0.46, from which what it
sees of surfaces reflects as one lobe: in a trial with gold of roughness 0.5 on an engine and a dragon, a few lobes
erred by 16.1 and 7.6 %, one by 16.2 and 7.3, in half the time; at 0.3, 19.9 and 25.9 on the engine."""


class LobeLight(NamedTuple):
    """Under one light: what arrives in every region but from lamps (of one factor and one harmonic), how much of its
    lamps points in blocks see (m, n), and all of them together (s, m), what arrives of lamps (n, c), and the light."""

    arriving: list[ArrivingLight]
    through: list[Tensor]
    together: Tensor
    of_lamps: list[Tensor]
    split: SplitLight


class LobeLayer(NamedTuple):
    """A layer of a region's material: albedo over pi (c,), its lobes, None where it is dull, and its share at the
    region's points in blocks (n, c), None for all of it."""

    albedo: Tensor
    gloss: Gloss | None
    share: Tensor | None


class LobeMaterial(NamedTuple):
    """A region's material: its part of H (1 + p + 1, c), its layers, the base colour (n, c) of its points, None for
    white, and all of it that is glossy as one lobe (TILTS, ROW), and as a few (TILTS, PARTS, ROW)."""

    functions: Tensor
    layers: list[LobeLayer]
    colour: Tensor | None
    whole: Tensor
    parts: Tensor


class LobeRegion(NamedTuple):
    """With materials and light: a region's points, what is dull (v, c), what is glossy, each with its share (c, n), and
    what lies around, None where no light bounces."""

    surface: SurfaceBlocks
    dull: Tensor
    layers: list[tuple[Gloss, GlossLight, Tensor | None]]
    around: Around | None


@in_python
class LobeSteps(nn.Module):
    """Light, BRDF and view step of a model whose highlights are narrow lobes, so many of each material."""

    records: Tensor
    seen: Tensor
    others: Tensor | None

    def __init__(self, model: TransferModel, compiled: bool, lobes: int | None) -> None:
        super().__init__()
        assert model.basis is not None
        self.model = model
        self.basis = model.basis
        self.light = LightStep(model.grid, WIDTHS, compiled, lamps=True)
        self._operations = operations(compiled)
        self.own = [slice(first, end) for first, end in model.receivers.spans]
        self.points = [
            RegionPoints(region, *(x[rows] for x in (model.positions, model.frames, model.dips, model.colours)))
            for region, rows in zip(model.clustered, self.own, strict=True)
        ]
        self.regions = nn.ModuleList(self.points)
        self.slots = slot_weights(model)
        seen = [region.seen for region in model.clustered]
        tensors = {
            "records": self._records(),
            "seen": seen[0] if len(seen) == 1 else torch.cat(seen),
            "others": self._others(model),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=False)
        even = haar.analyse(model.frames.new_ones(3, *model.grid.shape)).flatten(1)
        for points, region in zip(self.points, model.clustered, strict=True):
            points.register_buffer("hidden", 1 - self._sky(region, even), persistent=False)
        self._materials = [Cache() for _ in model.clustered]
        self._glosses = Glosses(lobes, self._operations)

    @staticmethod
    def _others(model: TransferModel) -> Tensor | None:
        """What all points see of each other, in the order of `seen`; None where light does not bounce twice."""
        meets = [region.meets for region in model.clustered]
        if model.bounces < 2:
            return None
        return meets[0] if len(meets) == 1 else torch.cat(meets)

    def _records(self) -> Tensor:
        """The points as others see them (v, RECORD) (`ops.around.Around`)."""
        places = []
        first = 0
        for r, region in enumerate(self.model.clustered):
            tables = torch.full_like(region.place, r * TILTS)
            places.append(torch.stack((first + region.place, tables), 1))
            first += len(region.cluster) * region.weights.shape[2]
        record = torch.cat((self.model.frames.flatten(1), torch.cat(places).to(self.model.frames)), 1)
        return pad(record, (0, RECORD - record.shape[1]))

    def _sky(self, region: ClusteredTransfer, even: Tensor) -> Tensor:
        """The share of the hemisphere, by cosine, in which a region's points in blocks (n, 1) see the sky.

        even (c, l): the lighting of 1 from everywhere
        """
        (arriving,) = self._operations.light_eigens([region.direct], [even], [region.columns])
        return (self._at_points(region, arriving[..., None])[:, :1, 0] / math.pi).clamp(0, 1 - OPEN)

    @staticmethod
    def _at_points(region: ClusteredTransfer, eigen: Tensor) -> Tensor:
        """Of values (k, c, e, x) of eigen-points those of points in blocks (n, c, x)."""
        return expand(eigen, region.weights, region.cluster).values.movedim(3, 1).flatten(0, 1)

    @uncompiled
    def incident(self, environment: Environment) -> LobeLight:
        """The light step."""
        split = self.light.with_lobes(environment)
        light = split.whole.light
        fine = split.rest.light.flatten(1)
        coarse = light[..., :COARSE, :COARSE].flatten(1)
        arriving = arriving_light(self._operations, self.model.clustered, fine, coarse)
        cells, shares = _cells_of(split.lamps, self.model.grid)
        through = [self._operations.lamp_visibility(region.sky, cells, shares) for region in self.model.clustered]
        of_lamps = [
            split.lamps.irradiance(points.frame[2], seen) for points, seen in zip(self.points, through, strict=True)
        ]
        return LobeLight(arriving, through, torch.cat(through, 1).T.contiguous(), of_lamps, split)

    @opaque
    def materials(self, materials: Sequence[SurfaceMaterial]) -> list[LobeMaterial]:
        """From the materials of all regions to tables, made anew only where a material changed."""
        buffers = watched(self.model.brdf, self.basis)
        return [
            cache((material, buffers), partial(self._material, region, material))
            for region, (cache, material) in enumerate(zip(self._materials, materials, strict=True))
        ]

    def _material(self, region: int, material: SurfaceMaterial) -> LobeMaterial:
        own = self.model.receivers.materials[self.model.receivers.names[region]]
        if not isinstance(material, Material):
            return self._varying(region, material, own)
        coloured = self.model.brdf.space.coloured(material)
        functions = slots.functions_of(self.basis, material, coloured, not isinstance(own, Material))
        layer = self._layer(material, None)
        colour = self.points[region].colour
        return LobeMaterial(functions, [layer], None if colour is None else colour.T, *_to_others([layer], [1.0]))

    def _varying(self, region: int, material: Varying, own: SurfaceMaterial) -> LobeMaterial:
        """The tables of a material that varies: the layers of which there are some, each with its shares."""
        at = self.model.receivers.layers_at(region, material)
        shares = all_shares(material, at).to(self.basis.table)
        blocks = self.model.clustered[region]
        layers = []
        means = []
        for layer, share in zip(material.layers, shares, strict=True):
            if bool((share > 0).any()):
                layers.append(self._layer(layer, blocks.in_line(share).T))
                means.append(share.mean(0))
        functions = varying_functions(self.model, region, material, own, at, shares)
        return LobeMaterial(functions, layers, blocks.in_line(at.colour.to(shares)).T, *_to_others(layers, means))

    def _layer(self, material: Material, share: Tensor | None) -> LobeLayer:
        albedo = material.diffuse.to(self.basis.table) / math.pi
        return LobeLayer(albedo, self._glosses(material, albedo), share)

    @uncompiled
    def exitant(self, light: LobeLight, materials: Sequence[Material]) -> list[LobeRegion]:
        """The BRDF step."""
        tables = self.materials(materials)
        h = self.slots([material.functions for material in tables])
        dull = []
        sent = []
        means = []
        for r, (material, weights) in enumerate(zip(tables, h, strict=True)):
            diffuse, to_others, mean = self._diffuse(r, light, material, *weights)
            place = self.model.clustered[r].place
            dull.append(diffuse[place])
            sent.append(to_others[place])
            means.append(mean.T.contiguous())
        others = (
            self.records,
            pad(torch.cat(sent), (0, SENT - 9)),
            self.seen,
            self.others,
            torch.cat([material.whole for material in tables]),
            torch.cat([material.parts for material in tables]),
            light.split.rest.maps,
            light.split.lamps.directions,
            light.split.lamps.powers,
            light.together,
        )
        return [
            LobeRegion(
                self._surface(r),
                dull[r],
                _lit(material, light.split, light.through[r]),
                Around(means[r], self.model.clustered[r].meets, *others) if self.model.bounces else None,
            )
            for r, material in enumerate(tables)
        ]

    def _diffuse(
        self, region: int, light: LobeLight, material: LobeMaterial, h: Tensor, pairs: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What points in blocks send out diffusely (n, c), what others see of it and of what lies around them, of light
        that bounced once less, and of it where no light bounces (n, 3 c), and the mean of the surfaces that they see
        (n, c) (`ops.around.Around`).

        h (q, c), pairs (pairs, c): H of the slots that light them, and its products
        """
        direct, one, two = light.arriving[region]
        direct = direct[..., 0]
        once = math.sqrt(math.pi) * (h.T[:, None] @ one[..., 0])[:, :, 0]
        both = once + math.sqrt(math.pi) * (pairs.T[:, None] @ two)[:, :, 0]
        before = once if self.model.bounces == 2 else torch.zeros_like(once)
        eigen = torch.stack((direct + both, direct + before, direct, both, before), 3)
        *arriving, both, before = self._at_points(self.model.clustered[region], eigen).unbind(2)
        albedo = sum(_some(layer.albedo, layer.share) for layer in material.layers)
        albedo = albedo if material.colour is None else albedo * material.colour
        whole, less, direct = (albedo * (each + light.of_lamps[region]) for each in arriving)
        hidden = math.pi * self.points[region].get_buffer("hidden")
        mean, mean_less = (each.clamp(min=0) / hidden for each in (both, before))
        return whole, torch.cat((less, mean_less, direct), 1), mean

    def _surface(self, region: int) -> SurfaceBlocks:
        return self.points[region].blocks(self.model.clustered[region], None)

    def radiance(self, exitant: Sequence[LobeRegion], eye: Tensor) -> Tensor:
        """The view step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        return torch.cat([self._radiance(r, region, eye) for r, region in enumerate(exitant)])

    def _radiance(self, r: int, region: LobeRegion, eye: Tensor) -> Tensor:
        own = self.model.clustered[r]
        at = eye if eye.ndim == 1 else own.in_line(eye[self.own[r]])
        out = region.dull
        for gloss, light, share in region.layers:
            around = region.around
            if around is not None and gloss.spread > BROAD:
                around = around._replace(others=None)
            out = out + self._operations.shine(region.surface, at, own.seen, gloss, light, around, share)
        return out


def _cells_of(lamps: Lamps, grid: Cube) -> tuple[Tensor, Tensor]:
    """The cells (m, k) of a grid that lamps lie in, and how much of the power of each comes from there (m, k)."""
    found = []
    for area, share in zip(lamps.areas, lamps.shares, strict=True):
        lit = share > 0
        own, place = grid.cell(area[lit]).unique(return_inverse=True)
        found.append((own, share.new_zeros(len(own)).index_add(0, place, share[lit])))
    most = max((len(own) for own, _ in found), default=0)
    cells = torch.zeros(len(found), most, dtype=torch.int64, device=lamps.shares.device)
    shares = lamps.shares.new_zeros(len(found), most)
    for lamp, (own, share) in enumerate(found):
        cells[lamp, : len(own)], shares[lamp, : len(own)] = own, share
    return cells, shares


def _lit(material: LobeMaterial, light: SplitLight, through: Tensor) -> list[tuple[Gloss, GlossLight, Tensor | None]]:
    """The lobes of a material, each with its light and share (c, n)."""
    return [
        (
            layer.gloss,
            light_for(layer.gloss, light, through),
            None if layer.share is None else layer.share.T.contiguous(),
        )
        for layer in material.layers
        if layer.gloss is not None
    ]


def _some(values: Tensor, share: Tensor | None) -> Tensor:
    return values if share is None else values * share


def _to_others(layers: Sequence[LobeLayer], shares: Sequence[Tensor | float]) -> tuple[Tensor, Tensor]:
    """What is glossy of layers, by mean shares (c,), as one lobe (TILTS, ROW) and as a few (TILTS, PARTS, ROW); of
    several layers these are that one."""
    glossy = [(layer.gloss, share) for layer, share in zip(layers, shares, strict=True) if layer.gloss is not None]
    if len(glossy) == 1 and isinstance(glossy[0][1], float):
        return glossy[0][0].whole, glossy[0][0].parts
    albedo = layers[0].albedo
    whole = torch.cat((albedo.new_tensor([0.0, 0.0, 1.0]), albedo.new_zeros(ROW - 3))).expand(TILTS, -1)
    if glossy:
        weights = torch.stack([gloss.whole[:, 4:7] * share for gloss, share in glossy])  # shape: (k, t, c)
        mass = weights.sum(2, keepdim=True).clamp(min=TINY)
        lobes = (torch.stack([gloss.whole[:, :4] for gloss, _ in glossy]) * mass).sum(0) / mass.sum(0)
        whole = pad(torch.cat((normalize(lobes[:, :3], dim=1), lobes[:, 3:], weights.sum(0)), 1), (0, 1))
    return whole, in_parts(whole)
