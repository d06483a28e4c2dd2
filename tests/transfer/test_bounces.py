"""Transfer after reflections: a dense float64 oracle, what must be zero or linear, energy, and path tracing."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

import ptt
from ptt import reference
from ptt.models.indirect import COARSE, ORDER
from ptt.models.receivers import Receivers
from ptt.models.slots import OWN, Slot, coefficients
from ptt.ops import haar, harmonics, lobes, mesh, transfer
from ptt.ops.octahedral import HemiOctahedral
from ptt.ops.sphere import Cube, Disk
from ptt.scene.parts import Part
from ptt.transfer.assembly import _cuts
from ptt.transfer.bounces import CUTS, Bounces

N = 16  # cells along an edge of the cube map
SHAPE = ptt.BlinnPhong(10.0)


def fitted(separated: int) -> tuple[ptt.TensorBRDF, ptt.BRDFBasis]:
    """Three samples, and as many functions as samples: exact."""
    space = ptt.BRDFSpace.blinn_phong((4.0, 16.0, 64.0))
    return ptt.TensorBRDF.fit(space, ranks=(2, 5, 5), separated=separated, resolution=16), ptt.BRDFBasis.fit(space, 3)


@pytest.fixture(scope="module")
def models() -> tuple[ptt.TensorBRDF, ptt.BRDFBasis]:
    return fitted(separated=3)


@pytest.fixture(scope="module")
def raw() -> ptt.RawTransfer:
    """A glossy fixed floor, an editable ball over it, a wall of varying colours, and a sheet that nobody sees.

    The sheet lies under the floor and faces down: only its own points could see it, and they look away. 190 points.
    """
    floor = mesh.plane_mesh(2.0, 6)
    wall = mesh.plane_mesh(1.6, 5)
    ball, faces = mesh.sphere_mesh(1, 0.4)
    upright = torch.stack((wall[0][:, 0], 0.7 - wall[0][:, 2], torch.full_like(wall[0][:, 0], -0.8)), 1)
    sheet, down = mesh.plane_mesh(2.0, 3)
    colours = torch.rand(len(upright), 3, generator=torch.Generator().manual_seed(0))
    parts = [
        Part("floor", *floor, material=ptt.Material(0.6, 0.3, SHAPE), editable=False),
        Part("ball", ball + torch.tensor([0.1, 0.6, 0.0]), faces, material=ptt.blinn_phong(0.3, 0.4, 12.0)),
        Part("wall", upright, wall[1], colours=colours, material=ptt.blinn_phong(1.0, 0.2, 30.0)),
        Part("sheet", sheet - torch.tensor([0.0, 0.5, 0.0]), down.flip(1), material=ptt.lambert(0.9)),
    ]
    return ptt.precompute(ptt.Scene.from_parts(parts), 2, resolution=N, rays=64)


def coarse_t0(raw: ptt.RawTransfer, brdf: ptt.TensorBRDF) -> Tensor:
    """T0 (v, 1 + i, l) in the coarse Haar basis."""
    grid = Cube(N)
    directions = grid.directions().reshape(-1, 3).float()
    solid = grid.solid_angles().flatten().float()
    visible = transfer.unpack(raw.visible, grid.cells)
    t0 = transfer.direct_transfer(visible, raw.receivers.frames, directions, solid, brdf.u_i)
    return haar.analyse(t0.unflatten(2, grid.shape))[..., :COARSE, :COARSE].flatten(2)


def paths(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis], lighting: Tensor | None = None
) -> Bounces:
    """On the whole coarse lighting, or on combinations of it, which is faster."""
    brdf, basis = models
    cuts = transfer.lobe_visibility(raw.visible, raw.receivers.frames, Cube(N), CUTS, brdf.angles)
    made = Bounces(raw, brdf, basis, coarse_t0(raw, brdf), cuts)
    if lighting is not None:
        made.change_lighting(lighting)
    return made


def some_lights(count: int = 8) -> Tensor:
    """(l, l')."""
    return torch.randn(6 * COARSE**2, count, generator=torch.Generator().manual_seed(0))


def coloured(raw: ptt.RawTransfer, region: int, colours: Tensor) -> ptt.RawTransfer:
    """With other colours (n, 3) on a region."""
    first, end = raw.receivers.spans[region]
    every = raw.receivers.colours.clone()
    every[first:end] = colours
    return replace(raw, receivers=replace(raw.receivers, colours=every))


def light(environment: ptt.Environment) -> Tensor:
    """Coarse Haar coefficients (l, 3)."""
    values = haar.analyse(environment.project(Cube(N)).movedim(-1, 0))[..., :COARSE, :COARSE]
    return values.flatten(1).T


def slots_in(made: Bounces, region: int) -> list[int]:
    return [k for k, slot in enumerate(made.slots) if slot.region == region]


def assert_close(found: Tensor, expected: Tensor, share: float) -> None:
    """To a share of the largest."""
    size = float(expected.abs().max())
    assert size > 0
    assert float((found - expected).abs().max()) < share * size


class Oracle(NamedTuple):
    """The definitions, float64, one hit and one slot at a time."""

    made: Bounces
    basis: ptt.BRDFBasis
    brdf: ptt.TensorBRDF
    functions: Tensor  # shape: (l, cells of a map of 32)
    means: dict[int, Tensor]  # mirror cells -> mean light (k, l)

    @classmethod
    def of(cls, made: Bounces, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> Oracle:
        functions = torch.zeros(6 * COARSE**2, 6, N, N, dtype=torch.float64)
        for k in range(6 * COARSE**2):
            functions[k, k // COARSE**2, k // COARSE % COARSE, k % COARSE] = 1
        values = haar.synthesise(functions).repeat_interleave(2, -1).repeat_interleave(2, -2).flatten(1)
        return cls(made, copy.deepcopy(models[1]).double(), copy.deepcopy(models[0]).double(), values, {})

    def samples(self, slot: Slot) -> Tensor:
        """The slot's function as a mixture (h,) of the space's samples."""
        if slot.function == OWN:
            return self.brdf.space.coordinates(SHAPE).double()
        return self.basis.mixture[:, slot.function - 1]

    def albedo(self, slot: Slot, y: int) -> float:
        return float(self.made.raw.receivers.colours[y, max(slot.channel, 0)])

    def mean_light(self, world: Tensor) -> Tensor:
        """(k, l): of each Haar function's values on a map of 32, weighted by the lobe about the cell's centre."""
        cell = int(Cube(16).cell(world))
        if cell not in self.means:
            axis = Cube(16).directions().reshape(-1, 3)[cell]
            grid = Cube(32)
            angle = torch.acos((grid.directions().reshape(-1, 3) @ axis).clamp(-1, 1))
            rows = []
            for a in self.brdf.angles:  # the lobe of 0 degrees is below the map's resolution
                weight = lobes.gaussian(angle, max(a, 7.0)) * grid.solid_angles().flatten()
                rows.append(self.functions @ weight / weight.sum())
            self.means[cell] = torch.stack(rows)
        return self.means[cell]

    def axes(self, wo: Tensor) -> Tensor:
        """Of lobes (k, 3): in the plane of wo and the normal, between the tilts of the table."""
        sine = float(wo[:2].norm())
        tilts = self.brdf.axes.shape[2]
        at = min(max(math.atan2(sine, float(wo[2])) * 2 * tilts / math.pi - 0.5, 0.0), tilts - 1.0)
        low = min(int(at), tilts - 2)
        along, up = self.brdf.axes[..., low] * (1 - at + low) + self.brdf.axes[..., low + 1] * (at - low)
        axes = torch.stack((-along * wo[0], -along * wo[1], up), 1)
        return torch.nn.functional.normalize(axes, dim=1)

    def reflected_direct(self, slot: Slot, y: int, wo: Tensor) -> Tensor:
        """O_q (l,)."""
        t0 = self.made.t0[y].double()
        frame = self.made.raw.receivers.frames[y].double()
        if slot.function == 0:
            return self.albedo(slot, y) / math.pi * t0[0]
        axes = self.axes(wo)
        out = torch.zeros_like(t0[0])
        cut = self.made.cuts[y, HemiOctahedral(CUTS).cell(axes), torch.arange(len(axes))].double() / 255
        mean = torch.stack([self.mean_light(axis @ frame)[k] for k, axis in enumerate(axes)])
        u_o = self.brdf.outgoing(wo[None])[:, 0]
        for h, share in enumerate(self.samples(slot)):
            for b, factor in enumerate(self.brdf.core):
                out += share * self.brdf.u_h[h, b] * (u_o @ factor @ t0[1:])
            out += share * (lobes.lookup(self.brdf.peaks[h], wo) * cut) @ mean
        return out

    def reflected_harmonics(self, slot: Slot, y: int, wo: Tensor) -> Tensor:
        """d_q (s,): integrals of Z_s(wi) f_q(wi, wo) cos(wi); a lobe leaves `lobes.zonal` of what it is centred on."""
        change = harmonics.hemispherical(ORDER)
        out = torch.zeros(ORDER**2, dtype=torch.float64)
        if slot.function == 0:
            out[0] = self.albedo(slot, y) / math.pi * math.sqrt(math.pi)
            return out
        disk = Disk(self.brdf.u_i.shape[-1])
        z = harmonics.evaluate(disk.directions().reshape(-1, 3), ORDER) @ change.T
        integrals = (self.brdf.u_i.flatten(1) * disk.projected_solid_angles().flatten()) @ z  # shape: (i, s)
        about = harmonics.evaluate(self.axes(wo), ORDER)  # shape: (k, s)
        u_o = self.brdf.outgoing(wo[None])[:, 0]
        for h, share in enumerate(self.samples(slot)):
            for b, factor in enumerate(self.brdf.core):
                out += share * self.brdf.u_h[h, b] * (u_o @ factor @ integrals)
            for angle, peak, y_axis in zip(self.brdf.angles, lobes.lookup(self.brdf.peaks[h], wo), about, strict=True):
                blurred = y_axis * lobes.zonal(angle, ORDER)[harmonics.degrees(ORDER)]
                out += share * peak * (change @ blurred)
        return out

    def fit(self, v: int, sent: dict[tuple[int, int], Tensor]) -> Tensor:
        """(q, s, ...): least squares over the rays, whose density has the cosine; sent: by ray and slot."""
        local = transfer.gather_directions(self.made.raw.hits.shape[1])
        z = harmonics.evaluate(local, ORDER) @ harmonics.hemispherical(ORDER).T
        shape = next(iter(sent.values())).shape
        right = torch.zeros(len(self.made.slots), len(local), *shape, dtype=torch.float64)
        for (ray, q), value in sent.items():
            right[q, ray] = value
        solved: Tensor = torch.linalg.solve(z.T @ z, z.T @ right.flatten(2)).unflatten(2, shape)
        return solved

    def hits(self, v: int) -> list[tuple[int, int, Tensor, list[int]]]:
        """Ray, vertex, wo there, slots."""
        receivers = self.made.raw.receivers
        region = torch.repeat_interleave(torch.arange(len(receivers.counts)), torch.tensor(receivers.counts))
        found = []
        for ray, local in enumerate(transfer.gather_directions(self.made.raw.hits.shape[1])):
            y = int(self.made.raw.hits[v, ray])
            wo = -receivers.frames[y].double() @ (receivers.frames[v].double().T @ local)
            if y >= 0 and wo[2] > 0:
                found.append((ray, y, wo, slots_in(self.made, int(region[y]))))
        return found

    def one(self, v: int) -> Tensor:
        """(q, s, l)."""
        slots = self.made.slots
        return self.fit(
            v, {(ray, q): self.reflected_direct(slots[q], y, wo) for ray, y, wo, own in self.hits(v) for q in own}
        )

    def two(self, v: int, t1: Tensor) -> Tensor:
        """(q', q, l) from T1 (v, q, s, l)."""
        sent = {}
        for ray, y, wo, own in self.hits(v):
            for q in own:
                sent[ray, q] = torch.einsum("s,qsl->ql", self.reflected_harmonics(self.made.slots[q], y, wo), t1[y])
        return self.fit(v, sent)[:, 0]


def seeing_points(raw: ptt.RawTransfer) -> Tensor:
    """A few points of every region: those that see most, and those that see most vertices from below their horizon."""
    receivers = raw.receivers
    rows = set[int]()
    directions = transfer.gather_directions(raw.hits.shape[1]).float() @ receivers.frames  # shape: (v, n, 3)
    facing = -(receivers.frames[raw.hits.clamp(min=0).long(), 2] * directions).sum(2)
    above = ((raw.hits >= 0) & (facing > 0)).sum(1)
    below = ((raw.hits >= 0) & (facing < 0)).sum(1)
    assert below.any()
    for first, end in receivers.spans:
        for count in (above[first:end], below[first:end]):
            best = count.topk(2)
            rows |= set((first + best.indices[best.values > 0]).tolist())
    return torch.tensor(sorted(rows))


def test_one_bounce_against_the_dense_oracle(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """The float32 code differs from float64 by 1e-5 of the largest number."""
    made = paths(raw, models)
    oracle = Oracle.of(made, models)
    rows = seeing_points(raw)
    assert len(rows) >= 4 and {slot.function for slot in made.slots} == {OWN, 0, 1, 2, 3}
    expected = torch.stack([oracle.one(int(v)) for v in rows])
    found = made.first_bounce(rows)
    for q in range(len(made.slots)):
        if made.slots[q].region < 3:
            assert_close(found[:, q].double(), expected[:, q], 2e-5)


def test_two_bounces_against_the_dense_oracle(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """From a random T1, so that every number counts; also where T1 comes in half precision."""
    made = paths(raw, models)
    oracle = Oracle.of(made, models)
    rows = seeing_points(raw)
    q = len(made.slots)
    t1 = torch.randn(len(raw.receivers), q, ORDER**2, 3, generator=torch.Generator().manual_seed(0)).half()
    expected = torch.stack([oracle.two(int(v), t1.double()) for v in rows])
    for some in (t1, t1.float()):
        found = made.second_bounce(rows, some.transpose(1, 2).contiguous())
        assert found.shape == (len(rows), q, q, 3)
        assert_close(found.double(), expected, 2e-5)


def test_blocks_do_not_matter(raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> None:
    """Points with few hits are padded to the most of the block."""
    made = paths(raw, models, some_lights())
    rows = torch.arange(0, len(raw.receivers), 5)
    whole = made.first_bounce(rows)
    parts = torch.cat([made.first_bounce(some) for some in rows.split(3)])
    assert_close(parts, whole, 1e-6)
    t1 = torch.randn(len(raw.receivers), ORDER**2, len(made.slots), 4, generator=torch.Generator().manual_seed(0))
    assert_close(
        torch.cat([made.second_bounce(some, t1) for some in rows.split(3)]), made.second_bounce(rows, t1), 1e-6
    )


def test_a_region_that_nobody_sees_sends_nothing(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """The sheet's slots, as the first and as the last reflection; and the sheet, which sees nothing, gets nothing."""
    made = paths(raw, models, some_lights())
    every = torch.arange(len(raw.receivers))
    unseen = slots_in(made, 3)
    first = raw.receivers.spans[3][0]
    t1 = made.first_bounce(every)
    assert len(unseen) == 4 and not t1[:, unseen].any() and not t1[first:].any()
    t2 = made.second_bounce(every, t1.transpose(1, 2).contiguous())
    assert not t2[:, unseen].any() and not t2[:, :, unseen].any() and not t2[first:].any()
    assert t1[:first, slots_in(made, 0)].any() and t2[:first].any()


def test_channels_are_grey_regions_of_their_own(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """Transfer is linear in the base colour: the wall's slot of each channel is that of a grey wall as bright as the
    channel, their sum that of the sum, and with one colour everywhere each is the white one times its channel."""
    first, end = raw.receivers.spans[2]
    rows = torch.arange(0, first, 7)
    colours = raw.receivers.colours[first:end]
    lights = some_lights()
    made = paths(raw, models, lights)
    at = slots_in(made, 2)[:3]
    assert [made.slots[q][1:] for q in at] == [(0, 0), (0, 1), (0, 2)]
    channels = made.first_bounce(rows)[:, at]

    def grey(values: Tensor) -> Tensor:
        other = paths(coloured(raw, 2, values[:, None].expand(-1, 3)), models, lights)
        assert [slot.channel for slot in other.slots if slot.region == 2] == [-1] * 4
        return other.first_bounce(rows)[:, slots_in(other, 2)[0]]

    for c in range(3):
        assert_close(channels[:, c], grey(colours[:, c]), 1e-5)
    assert_close(channels.sum(1), grey(colours.sum(1)), 1e-5)

    one_colour = torch.tensor([0.2, 0.9, 0.4])
    constant = paths(coloured(raw, 2, one_colour.expand(end - first, 3)), models, lights).first_bounce(rows)[:, at]
    assert_close(constant, grey(torch.ones(end - first))[:, None] * one_colour[:, None, None], 1e-5)


def test_a_fixed_region_reflects_as_an_editable_one_with_its_material(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """A basis of as many functions as samples is exact: the floor's own function is their sum with its coefficients.

    The exponent 10 lies between samples, where both are linear. Mixtures of large parts that cancel cost 1e-4.
    """
    fixed = paths(raw, models)
    basis = models[1]
    editable = (True, *raw.receivers.editable[1:])
    free = paths(replace(raw, receivers=replace(raw.receivers, editable=editable)), models)
    assert [slot.function for slot in fixed.slots if slot.region == 0] == [0, OWN]
    assert [slot.function for slot in free.slots if slot.region == 0] == [0, 1, 2, 3]
    rows = torch.arange(raw.receivers.spans[1][0], len(raw.receivers), 5)
    own = fixed.first_bounce(rows)[:, :2]
    others = free.first_bounce(rows)[:, :4]
    assert_close(others[:, 0], own[:, 0], 1e-6)
    assert_close(torch.einsum("p,vpsl->vsl", basis.of_shape(SHAPE), others[:, 1:]), own[:, 1], 5e-4)


def test_a_material_that_varies_is_the_sum_of_its_layers(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """Of a fixed floor of two materials: with a share of 0 or 1 it is one of them, and linear in the share in between.

    Each channel has what the fixed floor of `raw` has in its slots, diffuse and own, times its colours.
    """
    first, second = ptt.Material(0.6, (0.3, 0.5, 0.7), SHAPE), ptt.lambert((0.2, 0.1, 0.3))
    rows = torch.arange(raw.receivers.spans[1][0], len(raw.receivers), 5)
    t1 = torch.randn(len(raw.receivers), ORDER**2, 2, 3, generator=torch.Generator().manual_seed(0))

    def reflected(receivers: Receivers) -> tuple[Tensor, Tensor]:
        """What the floor's slots reflect once, and of some T1."""
        made = paths(replace(raw, receivers=receivers), models)
        own = slots_in(made, 0)
        return made.first_bounce(rows)[:, own], made.second_bounce(rows, t1)[:, own]

    def mixed(share: Tensor) -> tuple[Tensor, Tensor]:
        materials = raw.receivers.materials | {"floor": ptt.Mixed(first, second, share)}
        return reflected(replace(raw.receivers, materials=materials))

    share = torch.rand(len(raw.receivers), generator=torch.Generator().manual_seed(1))
    every = [torch.zeros_like(share), torch.ones_like(share), share, 1 - share, share / 2]
    for parts, uniform in zip(zip(*map(mixed, every), strict=True), reflected(raw.receivers), strict=True):
        none, whole, some, others, half = parts
        for found, material in ((none, first), (whole, second)):
            for channel in range(3):
                diffuse, own = (float(x[channel]) for x in (material.diffuse, material.specular))
                assert_close(found[:, channel], diffuse * uniform[:, 0] + own * uniform[:, 1], 1e-5)
        assert_close(some + others, none + whole, 1e-5)
        assert_close(2 * half, some + none, 1e-5)
        assert float((some - (none + whole) / 2).abs().max()) > 0.05 * float(none.abs().max())


def test_reduced_lighting_commutes(raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> None:
    """T1 is linear in the lighting, so combinations of columns may be taken before or after."""
    made = paths(raw, models)
    rows = torch.arange(0, len(raw.receivers), 11)
    matrix = some_lights(7)
    expected = made.first_bounce(rows) @ matrix
    made.change_lighting(matrix)
    found = made.first_bounce(rows)
    assert found.shape == (len(rows), len(made.slots), ORDER**2, 7)
    assert_close(found, expected, 1e-5)


def test_without_lobes(raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> None:
    """A tensor that separates no lobes, with the table of visibility that `compress` makes then."""
    brdf, basis = fitted(separated=0)
    made = Bounces(raw, brdf, basis, coarse_t0(raw, brdf), _cuts(raw, brdf.angles, progress=False))
    rows = seeing_points(raw)[:3]
    diffuse = [q for q, slot in enumerate(made.slots) if slot.function == 0]
    assert_close(made.first_bounce(rows)[:, diffuse], paths(raw, models).first_bounce(rows)[:, diffuse], 1e-5)
    t1 = torch.randn(len(raw.receivers), ORDER**2, len(made.slots), 2, generator=torch.Generator().manual_seed(0))
    assert made.second_bounce(rows, t1).isfinite().all()


def irradiance(
    raw: ptt.RawTransfer, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis], environment: ptt.Environment
) -> tuple[Tensor, Tensor, Tensor]:
    """Over pi (v, 3): what arrives directly, after one reflection, and after two. Z_0 is 1 / sqrt(pi)."""
    made = paths(raw, models, light(environment))
    own = [material for material in raw.receivers.materials.values() if isinstance(material, ptt.Material)]
    h = coefficients(made.slots, models[1], own)
    every = torch.arange(len(raw.receivers))
    t1 = made.first_bounce(every)
    t2 = made.second_bounce(every, t1.transpose(1, 2).contiguous())
    one = torch.einsum("vqc,qc->vc", t1[:, :, 0], h)
    two = torch.einsum("vpqc,pc,qc->vc", t2, h, h)
    return made.t0[:, 0] / math.pi, one / math.sqrt(math.pi), two / math.sqrt(math.pi)


def test_white_surfaces_never_send_more_than_the_constant(models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> None:
    """Two white sheets that face each other under light of 1 from everywhere: what is not seen of the sky is the other
    sheet, which reflects at most 1 of what arrives after 0, or 1 reflections. And not nothing: with more than half
    hidden, at least a tenth comes back after one.

    Directions and visibility are those of two quadratures, cells and rays, which differ by up to 2 %.
    """
    sheet, faces = mesh.plane_mesh(2.0, 7)
    parts = [("floor", sheet, faces), ("ceiling", sheet + torch.tensor([0.0, 0.7, 0.0]), faces.flip(1))]
    scene = ptt.Scene.from_parts([Part(*part, material=ptt.lambert(1.0), editable=False) for part in parts])
    raw = ptt.precompute(scene, 2, resolution=N, rays=256)
    direct, one, two = irradiance(raw, models, ptt.Environment.constant(1.0))
    assert float((direct + one + two).max()) < 1.02
    hidden = direct < 0.5
    assert hidden.any() and (one[hidden] > 0.1).all() and (two > 0).all() and (two < one.max()).all()


@pytest.mark.parametrize(
    ("wall", "reflections", "close"),
    [(ptt.lambert(0.7), 2, 0.05), (ptt.Material(0.1, 0.6, ptt.BlinnPhong(16.0)), 1, 0.10)],
    ids=["matt", "glossy"],
)
def test_against_path_tracing(
    wall: ptt.Material, reflections: int, close: float, models: tuple[ptt.TensorBRDF, ptt.BRDFBasis]
) -> None:
    """What each reflection adds to some points of a matt floor before a wall, under a sky with a wide sun.

    Vertices stand for what lies between them, which costs 2 %, the reference's noise as much; a glossy wall adds the
    errors of the tensor and of the lobes. On average over the floor errors cancel: 4 %. The light that reaches the
    glossy wall from below alone is beyond order-4 harmonics, so the second reflection is not asked of it. The wall
    stands off the floor: points that lie in another surface see nothing.
    """
    environment = ptt.Environment.sun_sky((0.5, 0.8, 0.6), radius=20.0)
    sheet, faces = mesh.plane_mesh(2.0, 14)
    upright = torch.stack((sheet[:, 0], 1.02 - sheet[:, 2], torch.full_like(sheet[:, 0], -1.02)), 1)
    scene = ptt.Scene.from_parts(
        [
            Part("floor", sheet, faces, material=ptt.lambert(0.7), editable=False),
            Part("wall", upright, faces, material=wall, editable=False),
        ]
    )
    raw = ptt.precompute(scene, 2, resolution=N, rays=256)
    floor = torch.arange(0, len(sheet), 11)
    points = reference.vertex_points(scene).take(floor)
    truth = [
        reference.radiance(scene, environment, scene.materials, points, scene.normals[floor], bounces=k, samples=24000)
        for k in range(reflections + 1)
    ]
    added = irradiance(raw, models, environment)[1:]
    for found, less, more in zip(added, truth, truth[1:], strict=False):
        expected = more.mean - less.mean
        error = (0.7 * found[floor].double() - expected) / expected.mean()
        assert float(error.abs().mean()) < close
        assert abs(float(error.mean())) < 0.04
