"""The steps of relighting by clusters: light and BRDF for eigen-points, the view for points in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ptt.light import prefiltered as light_maps
from ptt.light.environment import Environment
from ptt.light.prefiltered import LightMaps
from ptt.materials.material import Material
from ptt.models import slots
from ptt.models.cache import Cache, watched
from ptt.models.indirect import COARSE, COARSEST, ORDER, blurs, responses
from ptt.models.transfer_model import TransferModel
from ptt.ops import harmonics, native, relight
from ptt.ops.relight import Arriving, Responses, Sent
from ptt.ops.view import Gloss, Points, Seen, view

DULL = 1e-4  # a lobe that reflects no more than this is left out


class Operations(NamedTuple):
    """What the steps are made of."""

    lighting: Callable[..., Tensor]
    light_eigen: Callable[..., Tensor]
    eigen: Callable[..., Tensor]
    expand: Callable[..., Sent]
    view: Callable[..., Tensor]


PLAIN = Operations(relight.lighting, relight.light_eigen, relight.eigen, relight.expand, view)
NATIVE = Operations(native.lighting, native.light_eigen, native.eigen, native.expand, native.view)


class Lit(NamedTuple):
    """Under one light: what arrives in every region; the blurred maps (k, cells, 4), and the turn of the light."""

    arriving: list[Arriving]
    maps: Tensor
    turn: Tensor


class Lobes(NamedTuple):
    """Those that a material has: `Gloss` without the light."""

    which: Tensor
    rho: Tensor
    axes: Tensor
    specular: Tensor
    blurs: Tensor


class Dressed(NamedTuple):
    """A region's material: its part of H (1 + p + 1, c), M (c, 1 + o, 1 + i), its lobes."""

    functions: Tensor
    coupling: Tensor
    lobes: Lobes | None


class Exitant(NamedTuple):
    """With materials: Q and I (b, c, 1 + o + s, w) and the lobes of every region."""

    sent: list[Sent]
    gloss: list[Gloss | None]


class ClusterSteps(nn.Module):
    """Light, BRDF and view step of a model with clusters."""

    to_factors: Tensor
    to_harmonics: Tensor
    blurs: Tensor
    directions: Tensor
    shares: Tensor
    rows: Tensor
    keep: Tensor

    def __init__(self, model: TransferModel, compiled: bool) -> None:
        super().__init__()
        assert model.basis is not None
        self.model = model
        self.basis = model.basis
        self.register_buffer("to_factors", responses(model.brdf), persistent=False)
        self.register_buffer("to_harmonics", harmonics.hemispherical(ORDER).float(), persistent=False)
        self.register_buffer("blurs", blurs(model.brdf.angles).float(), persistent=False)
        for r, (region, (first, end)) in enumerate(zip(model.clustered, model.receivers.spans, strict=True)):
            own = slice(first, end)
            pairs = torch.tensor(region.pairs, dtype=torch.int64).reshape(-1, 2)
            self.register_buffer(f"slots{r}", torch.tensor(region.slots, dtype=torch.int64), persistent=False)
            self.register_buffer(f"pairs{r}", pairs, persistent=False)
            self.register_buffer(f"position{r}", region.in_line(model.positions[own]), persistent=False)
            self.register_buffer(f"frame{r}", region.in_line(model.frames[own]), persistent=False)
            colours = model.colours[own]
            if bool((colours != 1).any()):
                self.register_buffer(f"colour{r}", region.in_line(colours), persistent=False)
        for name, samples in zip(("directions", "shares"), light_maps.samples(model.grid), strict=True):
            self.register_buffer(name, samples, persistent=False)
        for name, chosen in zip(("rows", "keep"), slots.chosen(model.slots, model.basis.table.shape[1]), strict=True):
            self.register_buffer(name, chosen, persistent=False)
        self._prepared = Cache()
        self._outgoing = Cache()
        self._materials = [Cache() for _ in model.clustered]
        self._ops = NATIVE if compiled else PLAIN

    def incident(self, environment: Environment) -> Lit:
        """Light step."""
        angles = self.model.brdf.angles
        dtype = self.to_factors.dtype
        maps: LightMaps = self._prepared(environment.map, lambda: light_maps.light_maps(environment, angles))
        turn = environment.rotation.to(self.to_factors)
        shape = self.model.grid.shape
        light = self._ops.lighting(maps.fine.to(dtype), turn, self.directions, self.shares, shape)
        fine, coarse, coarsest = (light[..., :n, :n].flatten(1) for n in (shape[-1], COARSE, COARSEST))
        lit = Lit([], maps.blurred.to(dtype), turn)
        for region in self.model.clustered:
            e = region.eigenvectors
            q = len(region.slots)
            pairs = len(region.pairs)
            direct = self._ops.light_eigen(region.direct, fine, region.columns).unflatten(2, (e, -1))
            reduced = self._ops.light_eigen(region.lighting, coarse)  # shape: (k, c, n)
            one = self._ops.light_eigen(region.one, reduced).unflatten(2, (q, e, ORDER**2))
            two = self._ops.light_eigen(region.two, coarsest).unflatten(2, (pairs, e))
            lit.arriving.append(Arriving(direct, one, two))
        return lit

    def exitant(self, lit: Lit, materials: Sequence[Material]) -> Exitant:
        """BRDF step."""
        buffers = watched(self.model.brdf, self.basis)
        dressed: list[Dressed] = [
            cache((material, buffers), partial(self._dressed, material))
            for cache, material in zip(self._materials, materials, strict=True)
        ]
        functions = torch.cat([one.functions for one in dressed])
        h = (functions[self.rows] * self.keep.to(functions)).T  # shape: (c, q)
        out = Exitant([], [])
        for r, (region, one) in enumerate(zip(self.model.clustered, dressed, strict=True)):
            last, first = self.get_buffer(f"pairs{r}").T
            own = h[:, self.get_buffer(f"slots{r}")]
            pairs = h[:, last] * h[:, first]
            glossy = one.lobes is not None
            eigen = self._ops.eigen(
                lit.arriving[r], own, pairs, one.coupling, Responses(self.to_factors, self.to_harmonics), glossy
            )
            out.sent.append(self._ops.expand(eigen, region.weights, region.cluster))
            out.gloss.append(self._gloss(one.lobes, lit))
        return out

    def _dressed(self, material: Material) -> Dressed:
        brdf = self.model.brdf
        shape = None
        if material.shape is not None:
            shape = brdf.space.coordinates(material.shape)
        functions = slots.functions_of(self.basis, material, shape)
        coupling = brdf.coupling(material, shape)
        if shape is None or not brdf.angles:
            return Dressed(functions, coupling, None)
        tables = brdf.lobe_tables(shape)
        which = torch.nonzero(tables.detach().abs().amax((1, 2)) > DULL)[:, 0]
        if not len(which):
            return Dressed(functions, coupling, None)
        rho = tables[which].flatten(1).T.contiguous()
        axes = brdf.axes[:, which].flatten(0, 1).T.contiguous()
        specular = material.specular.to(rho)
        return Dressed(functions, coupling, Lobes(which, rho, axes, specular, self.blurs[which]))

    def _gloss(self, lobes: Lobes | None, lit: Lit) -> Gloss | None:
        """Lobes under a light."""
        if lobes is None:
            return None
        maps = lit.maps if len(lobes.which) == len(lit.maps) else lit.maps[lobes.which]
        return Gloss(*lobes[:4], maps=maps, turn=lit.turn, blurs=lobes.blurs)

    def radiance(self, exitant: Exitant, eye: Tensor) -> Tensor:
        """View step: B (v, c), for an eye (3,) or directions (v, 3) from the points to the viewer."""
        u_o = self.model.brdf.u_o
        outgoing = self._outgoing(u_o, lambda: u_o.flatten(1).T.contiguous())
        seen = []
        for r, (region, (first, end)) in enumerate(zip(self.model.clustered, self.model.receivers.spans, strict=True)):
            position, frame, colour = (self._buffers.get(f"{name}{r}") for name in ("position", "frame", "colour"))
            assert position is not None and frame is not None
            points = Points(position, frame, colour, region.cuts, region.place)
            toward = eye if eye.ndim == 1 else region.in_line(eye[first:end])
            seen.append(Seen(points, toward, exitant.sent[r], exitant.gloss[r]))
        return self._ops.view(seen, outgoing)
