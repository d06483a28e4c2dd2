"""The steps of relighting by clusters: light and BRDF for eigen-points, the view for points in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ptt.light.environment import Environment
from ptt.materials.material import LayersAt, Material
from ptt.materials.varying import SurfaceMaterial, Varying, all_shares
from ptt.models import slots
from ptt.models.cache import Cache, watched
from ptt.models.clustered_transfer import ClusteredTransfer
from ptt.models.indirect import COARSE, ORDER, blurs, responses
from ptt.models.transfer_model import TransferModel
from ptt.ops import harmonics
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.relight import ArrivingLight, LitRegion, OutgoingLight, Responses
from ptt.ops.view import LitLobes, SurfaceBlocks, ViewedRegion, points_at
from ptt.relight.light_step import BlurredLight, LightStep
from ptt.relight.operations import operations

DULL = 1e-4
"""A lobe that reflects no more than this is left out: a hundredth of what eight bits of visibility resolve."""


class ClusterLight(NamedTuple):
    """Under one light: what arrives in every region, and the light as lobes see it."""

    arriving: list[ArrivingLight]
    blurred: BlurredLight


class MaterialLobes(NamedTuple):
    """The lobes that a material has: `LitLobes` without the light."""

    which: Tensor
    rho: Tensor
    axes: Tensor
    specular: Tensor
    blurs: Tensor


class LayerTables(NamedTuple):
    """A layer of a region's material: M (c, 1 + o, 1 + i), the lobes of its highlights, and how much of it there is at
    each of the region's points (n, c), None for all."""

    coupling: Tensor
    lobes: list[MaterialLobes]
    share: Tensor | None


class RegionMaterial(NamedTuple):
    """A region's material: its part of H (1 + p + 1, c), its layers, and the base colour (c, n) of its points in
    blocks, None for white."""

    functions: Tensor
    layers: list[LayerTables]
    colour: Tensor | None


class Layer(NamedTuple):
    """A part of what a region sends out: Q and I (b, c, 1 + o + s, w), its lobes, and how much of it all there is at
    each point (n, c), None for all. whole: says whether there is a Q, or I alone."""

    sent: OutgoingLight
    lobes: LitLobes | None
    share: Tensor | None
    whole: bool


class ClusterExitant(NamedTuple):
    """With materials: of every region its points and its layers; V (cells, o)."""

    surfaces: list[SurfaceBlocks]
    layers: list[list[Layer]]
    outgoing: Tensor


@in_python
class RegionPoints(nn.Module):
    """The points of one region in blocks.

    position (3, n), frame (3, 3, n), dip (n,), colour (3, n), None where it is white, point (n,) int32, -1 for none:
        of n = blocks * width points
    """

    position: Tensor
    frame: Tensor
    dip: Tensor
    colour: Tensor | None
    point: Tensor

    def __init__(
        self, region: ClusteredTransfer, positions: Tensor, frames: Tensor, dips: Tensor, colours: Tensor
    ) -> None:
        super().__init__()
        white = not bool((colours != 1).any())
        tensors = {
            "position": region.in_line(positions),
            "frame": region.in_line(frames),
            "dip": region.in_line(dips),
            "colour": None if white else region.in_line(colours),
            "point": points_at(region.place, region.weights.shape[2] * len(region.cluster)),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=False)

    def blocks(self, region: ClusteredTransfer, colour: Tensor | None) -> SurfaceBlocks:
        """The points with the base colour (3, n) of a material, None for white."""
        return SurfaceBlocks(self.position, self.frame, self.dip, colour, region.cuts, region.place, self.point)


@in_python
class ClusterSteps(nn.Module):
    """Light, BRDF and view step of a model whose highlights are those of the BRDF tensor."""

    to_factors: Tensor
    to_harmonics: Tensor
    blurs: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        assert model.basis is not None
        self.model = model
        self.basis = model.basis
        self.light = LightStep(model.grid, model.brdf.angles, compiled)
        tensors = {
            "to_factors": responses(model.brdf),
            "to_harmonics": harmonics.hemispherical(ORDER).float(),
            "blurs": blurs(model.brdf.angles).float(),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=False)
        self.points = [
            RegionPoints(region, *(x[own] for x in (model.positions, model.frames, model.dips, model.colours)))
            for region, own in zip(model.clustered, self._rows(), strict=True)
        ]
        self.regions = nn.ModuleList(self.points)
        self.slots = slot_weights(model)
        self._materials = [Cache() for _ in model.clustered]
        self._operations = operations(compiled)

    def _rows(self) -> list[slice]:
        """The rows of each region among the model's points."""
        return [slice(first, end) for first, end in self.model.receivers.spans]

    @uncompiled
    def incident(self, environment: Environment) -> ClusterLight:
        """The light step."""
        blurred = self.light.blurred(environment)
        light = blurred.light
        coarse = light[..., :COARSE, :COARSE].flatten(1)
        arriving = arriving_light(self._operations, self.model.clustered, light.flatten(1), coarse)
        return ClusterLight(arriving, blurred)

    @opaque
    def materials(self, materials: Sequence[SurfaceMaterial]) -> list[RegionMaterial]:
        """From the materials of all regions to tables, made anew only where a material changed."""
        buffers = watched(self.model.brdf, self.basis)
        return [
            cache((material, buffers), partial(self._material, region, material))
            for region, (cache, material) in enumerate(zip(self._materials, materials, strict=True))
        ]

    def _material(self, region: int, material: SurfaceMaterial) -> RegionMaterial:
        own = self.model.receivers.materials[self.model.receivers.names[region]]
        colour = self.points[region].colour
        if isinstance(material, Material):
            layer, coloured = self._layer(material, None)
            functions = slots.functions_of(self.basis, material, coloured, not isinstance(own, Material))
            return RegionMaterial(functions, [layer], colour)
        return self._varying(region, material, own)

    def _varying(self, region: int, material: Varying, own: SurfaceMaterial) -> RegionMaterial:
        """The tables of a material that varies: the layers of which there are some, each with its shares."""
        at = self.model.receivers.layers_at(region, material)
        shares = all_shares(material, at).to(self.basis.table)
        there = [
            (layer, share) for layer, share in zip(material.layers, shares, strict=True) if bool((share > 0).any())
        ]
        layers = [self._layer(layer, share)[0] for layer, share in there]
        functions = varying_functions(self.model, region, material, own, at, shares)
        return RegionMaterial(functions, layers, self.model.clustered[region].in_line(at.colour.to(shares)))

    def _layer(self, material: Material, share: Tensor | None) -> tuple[LayerTables, Tensor]:
        """The tables of a material that is the same everywhere, and its coordinates (h, c) in the space."""
        brdf = self.model.brdf
        highlights = brdf.space.highlights(material)
        coloured = brdf.space.mixed(highlights)
        lobes = [self._lobes(*highlight) for highlight in highlights] if brdf.angles else []
        coupling = brdf.coupling(material, coloured)
        return LayerTables(coupling, [one for one in lobes if one is not None], share), coloured

    def _lobes(self, coordinates: Tensor, colour: Tensor) -> MaterialLobes | None:
        """The lobes of a shape, by its coordinates in the space; None where all are dull."""
        brdf = self.model.brdf
        tables = brdf.lobe_tables(coordinates)
        reflected = tables.detach().abs().amax((1, 2)).tolist()
        some = [lobe for lobe, share in enumerate(reflected) if share > DULL]
        if not some:
            return None
        which = torch.tensor(some, device=tables.device)
        every = len(some) == len(tables)
        rho = (tables if every else tables[which]).flatten(1).T.contiguous()
        axes = (brdf.axes if every else brdf.axes[:, which]).flatten(0, 1).T.contiguous()
        return MaterialLobes(which, rho, axes, colour.to(rho), self.blurs if every else self.blurs[which])

    @uncompiled
    def exitant(self, light: ClusterLight, materials: Sequence[Material]) -> ClusterExitant:
        """The BRDF step."""
        return self.contracted(light, self.materials(materials))

    def contracted(self, light: ClusterLight, materials: Sequence[RegionMaterial]) -> ClusterExitant:
        """The BRDF step, of what `materials` gives."""
        h = self.slots([material.functions for material in materials])
        lit = []
        for region, arriving, material, own in zip(self.model.clustered, light.arriving, materials, h, strict=True):
            for coupling, glossy in (each for tables in material.layers for each in _couplings(tables)):
                lit.append(LitRegion(arriving, own[0], own[1], coupling, region.weights, region.cluster, glossy))
        sent = iter(self._operations.exitants(lit, Responses(self.to_factors, self.to_harmonics)))
        layers = [
            [layer for tables in material.layers for layer in self._layers(tables, light, sent)]
            for material in materials
        ]
        surfaces = [
            points.blocks(region, material.colour)
            for points, region, material in zip(self.points, self.model.clustered, materials, strict=True)
        ]
        return ClusterExitant(surfaces, layers, self.model.brdf.u_o.flatten(1).T.contiguous())

    def _layers(self, tables: LayerTables, light: ClusterLight, sent: Iterator[OutgoingLight]) -> list[Layer]:
        """A layer with its first highlight, and one for the lobes of each further highlight.

        sent: what is sent out by each of `_couplings`
        """
        lobes = [self._lit(own, light) for own in tables.lobes]
        found = [Layer(next(sent), lobes[0] if lobes else None, tables.share, True)]
        if lobes[1:]:
            arrived = next(sent)
            found += [Layer(arrived, own, tables.share, False) for own in lobes[1:]]
        return found

    @staticmethod
    def _lit(lobes: MaterialLobes, light: ClusterLight) -> LitLobes:
        """Lobes under a light."""
        maps = light.blurred.maps
        maps = maps if len(lobes.which) == len(maps) else maps[lobes.which]
        return LitLobes(lobes.which, lobes.rho, lobes.axes, lobes.specular, maps, light.blurred.turn, lobes.blurs)

    def radiance(self, exitant: ClusterExitant, eye: Tensor) -> Tensor:
        """The view step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        eyes = [eye] * len(exitant.surfaces)
        if eye.ndim == 2:
            eyes = [region.in_line(eye[own]) for region, own in zip(self.model.clustered, self._rows(), strict=True)]
        seen = [
            ViewedRegion(surface, at, layers[0].sent, layers[0].lobes)
            for surface, at, layers in zip(exitant.surfaces, eyes, exitant.layers, strict=True)
        ]
        radiance: Tensor = self._operations.view(seen, exitant.outgoing)
        if all(len(layers) == 1 and layers[0].share is None for layers in exitant.layers):
            return radiance
        parts = list(radiance.split([len(surface.place) for surface in exitant.surfaces]))
        for r, (first, *more) in enumerate(exitant.layers):
            parts[r] = _some(parts[r], first.share)
            for layer in more:
                outgoing = exitant.outgoing if layer.whole else exitant.outgoing[:, :0]
                points = exitant.surfaces[r] if layer.whole else exitant.surfaces[r]._replace(colour=None)
                part = self._operations.view([ViewedRegion(points, eyes[r], layer.sent, layer.lobes)], outgoing)
                parts[r] = parts[r] + _some(part, layer.share)
        return torch.cat(parts)


def arriving_light(
    operations: Any, regions: Sequence[ClusteredTransfer], fine: Tensor, coarse: Tensor
) -> list[ArrivingLight]:
    """What arrives at the eigen-points of each region, of lighting (c, l) at two resolutions."""
    n = len(regions)
    anywhere = [None] * 2 * n
    direct = operations.light_eigens(
        [region.direct for region in regions], [fine] * n, [region.columns for region in regions]
    )
    axes = [region.lighting for region in regions] + [region.twice[None] for region in regions]
    lighting = operations.light_eigens(axes, [coarse] * 2 * n, anywhere)
    lighting[n:] = [own[0] for own in lighting[n:]]
    bounced = operations.light_eigens(
        [region.one for region in regions] + [region.two for region in regions], lighting, anywhere
    )
    return [
        ArrivingLight(
            u0.unflatten(2, (region.eigenvectors, -1)),
            u1.unflatten(2, (len(region.slots), region.eigenvectors, region.harmonics)),
            u2.unflatten(2, (len(region.pairs), region.eigenvectors)),
        )
        for region, u0, u1, u2 in zip(regions, direct, bounced[:n], bounced[n:], strict=True)
    ]


def _couplings(tables: LayerTables) -> list[tuple[Tensor, bool]]:
    """M of a layer, and whether harmonics are reflected; of its further highlights there are those alone."""
    own = [(tables.coupling, bool(tables.lobes))]
    return [*own, (torch.zeros_like(tables.coupling[:, :1]), True)] if tables.lobes[1:] else own


def _some(radiance: Tensor, share: Tensor | None) -> Tensor:
    return radiance if share is None else radiance * share


def varying_functions(
    model: TransferModel, region: int, material: Varying, own: SurfaceMaterial, at: LayersAt, shares: Tensor
) -> Tensor:
    """A region's part of H (1 + p + 1, c) for a material that varies: its own whole, another one by its mean.

    at, shares (k, n, c): its layers at the region's points
    """
    assert model.basis is not None
    if material is own:
        return slots.whole_of(model.basis)
    first, end = model.receivers.spans[region]
    colours = model.colours[first:end]
    tint = at.colour.mean(0).to(colours) / colours.mean(0).clamp(min=1e-6)
    return slots.mean_of(model.basis, material.layers, shares, tint, not isinstance(own, Material))


def slot_weights(model: TransferModel) -> slots.SlotWeights:
    """H of the slots that light each of a model's regions."""
    assert model.basis is not None
    lit = [(region.slots, region.pairs) for region in model.clustered]
    return slots.SlotWeights(model.slots, model.basis.table.shape[1], lit)
