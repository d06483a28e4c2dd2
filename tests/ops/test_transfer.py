"""Direct transfer: the white furnace, what is hidden, and texels against wavelets."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

import ptt
from ptt.models.transfer_model import SparseTransfer
from ptt.ops import haar, mesh, transfer
from ptt.ops.constants import NORMAL, NOTHING
from ptt.ops.octahedral import HemiOctahedral, Octahedral, from_octahedral
from ptt.ops.sphere import Cube
from ptt.scene.parts import Part


def relight(
    scene: ptt.Scene, environment: ptt.Environment, resolution: int = 64, coefficients: int | None = 96
) -> Tensor:
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((20.0,)), ranks=(1, 1, 1), separated=0)
    model = ptt.compress(ptt.precompute(scene, resolution=resolution), coefficients, brdf, clusters=None)
    far = torch.tensor([0.0, 50.0, 0.0])
    radiance: Tensor = ptt.TransferRelighter(model)(environment, scene.materials, far)
    return radiance


def small_brdf() -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((4.0, 20.0)), ranks=(2, 4, 4), separated=0)


def test_white_furnace_of_a_convex_body() -> None:
    """Albedo 1 under 1 from everywhere reflects 1, at every vertex, to 0.5 %."""
    scene = ptt.Scene.from_mesh(*mesh.sphere_mesh(2, 1.0), material=ptt.lambert(1.0))
    radiance = relight(scene, ptt.Environment.constant(1.0))
    assert (radiance - 1).abs().max() < 5e-3


def test_white_furnace_with_occlusion_never_exceeds_one_and_does_shade() -> None:
    body, faces = mesh.sphere_mesh(2, 0.5)
    parts = [
        Part("floor", *mesh.plane_mesh(3.0, 12), material=ptt.lambert(1.0)),
        Part("ball", body + torch.tensor([0.0, 0.51, 0.0]), faces, material=ptt.lambert(1.0)),
    ]
    radiance = relight(ptt.Scene.from_parts(parts), ptt.Environment.constant(1.0), coefficients=None)
    assert radiance.max() <= 1 + 1e-5
    assert radiance.min() < 0.3


@pytest.mark.parametrize("height", [0.5, 2.0])
def test_a_wall_hides_the_light_behind_it_and_not_the_light_before_it(height: float) -> None:
    """The same light on either side of a floor that stands before a wall as large as the sky."""
    wall = torch.tensor([[0.0, -1e3, -1e3], [0.0, 1e3, -1e3], [0.0, 1e3, 1e3], [0.0, -1e3, 1e3]])
    parts = [
        Part("floor", *mesh.plane_mesh(1.0, 1), material=ptt.lambert(1.0)),
        Part("wall", wall + torch.tensor([-0.6, 0.0, 0.0]), torch.tensor([[0, 1, 2], [0, 2, 3]])),
    ]
    scene = ptt.Scene.from_parts(parts)
    light = ptt.Environment.area_light((-1.0, height, 0.0), 20.0)
    radiance = relight(scene, light, coefficients=None)
    assert radiance[:4].abs().max() < 1e-7
    mirrored = relight(scene, ptt.Environment.area_light((1.0, height, 0.0), 20.0), coefficients=None)
    assert (mirrored[:4] > 0.01).all()


def test_visibility_sees_a_plate_where_it_is() -> None:
    """A square plate of side 2 at height 1 above a point fills the cells of the cube map's +Y face, no others."""
    plate, faces = mesh.plane_mesh(1.999, 1)
    parts = [
        Part("point", *mesh.plane_mesh(1e-3, 1)),
        Part("plate", plate + torch.tensor([0.0, 1.0, 0.0]), faces),
    ]
    scene = ptt.Scene.from_parts(parts)
    raw = ptt.precompute(scene, resolution=16)
    visible = transfer.unpack(raw.visible, Cube(16).cells).reshape(-1, 6, 16, 16)[0]
    assert not visible[2].any()  # +Y
    assert visible[[0, 1, 4, 5], :8].all()  # upper halves of the sides
    assert not visible[[0, 1, 4, 5], 8:].any() and not visible[3].any()  # below the horizon


def test_direct_transfer_is_visibility_times_factor_times_cosine_by_a_plain_loop() -> None:
    """In float64, term by term; the factor table is linear in x and y, where bilinear lookups are exact."""
    grid = Cube(8)
    n = 32
    directions = grid.directions().reshape(-1, 3)
    solid = grid.solid_angles().flatten()
    generator = torch.Generator().manual_seed(0)
    frames = torch.linalg.qr(torch.randn(3, 3, 3, dtype=torch.float64, generator=generator))[0]
    visible = torch.rand(3, grid.cells, generator=generator) < 0.7
    at = (torch.arange(n, dtype=torch.float64) + 0.5) / n * 2 - 1
    factors = torch.stack((1 + 2 * at.expand(n, n) - 0.5 * at[:, None], at.expand(n, n)))
    t0 = transfer.direct_transfer(visible, frames, directions, solid, factors)
    for v in range(3):
        x, y, z = frames[v] @ directions.T
        whole = (z.clamp(min=0) * solid).sum()
        weight = visible[v] * z.clamp(min=0) * solid * math.pi / whole
        inside = torch.hypot(x, y) < 1 - 1 / n
        for k, factor in enumerate((torch.ones_like(x), 1 + 2 * x - 0.5 * y, x)):
            assert torch.allclose(t0[v, k][inside], (weight * factor)[inside], atol=1e-14)


def test_gathered_directions_have_the_cosine_for_density() -> None:
    """Means of polynomials under cos / pi over the hemisphere. With u = sin^2, uniform in 0..1, and phi: those of

    z, z^2, z^3 are the integrals of (1 - u)^(k/2), 2/3, 1/2, 2/5; of x^2 and y^2, 1/2 1/2; of x^4, 1/3 3/8; of
    x^2 y^2, 1/3 1/8; of x^2 z, 1/2 times the integral of u sqrt(1 - u), 4/15; whatever is odd in x or y is 0. The
    spiral's error falls faster than that of random directions, 0.5 / sqrt(n); an unweighted spiral misses z by 1/6.
    """
    for count, atol in ((64, 0.03), (512, 0.005), (4096, 0.001)):
        d = transfer.gather_directions(count)
        x, y, z = d.T
        assert d.dtype == torch.float64 and d.shape == (count, 3)
        assert torch.allclose(d.norm(dim=1), torch.ones(count, dtype=torch.float64)) and (z > 0).all()
        values = (z, z**2, z**3, x**2, y**2, x**4, x**2 * y**2, x**2 * z, x, y, x * y, x * z, y * z, x**3)
        means = torch.stack(values).mean(1)
        expected = [2 / 3, 1 / 2, 2 / 5, 1 / 4, 1 / 4, 1 / 8, 1 / 24, 2 / 15, *[0.0] * 6]
        assert torch.allclose(means, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=atol)
    assert transfer.gather_directions(0).shape == (0, 3)


def test_gather_sees_the_ball_where_it_is() -> None:
    """From under a ball of radius 0.5 with its centre at height 1: rays within asin(0.5) of upwards meet it.

    Those that miss its rim by 3 % either way; the icosphere lies up to 1.5 % inside. The vertex seen is a corner of the
    triangle that is hit, so within an edge, 0.17, of the ray's first point on the sphere.
    """
    ball, faces = mesh.sphere_mesh(3, 0.5)
    parts = [Part("floor", *mesh.plane_mesh(1.0, 4)), Part("ball", ball + torch.tensor([0.0, 1.0, 0.0]), faces)]
    scene = ptt.Scene.from_parts(parts)
    frame = torch.tensor([[0.6, 0.0, 0.8], [0.8, 0.0, -0.6], [0.0, 1.0, 0.0]])
    local = transfer.gather_directions(400)
    u = torch.rand(1, 400, generator=torch.Generator().manual_seed(0))
    seen = transfer.gather(scene.surface, scene.faces, torch.zeros(1, 3), frame[None], local, u)[0]
    assert seen.dtype == torch.int32
    sine = local[:, :2].norm(dim=1)
    assert (seen[sine > 0.5 * 1.03] == -1).all()
    inner = sine < 0.5 * 0.97
    assert int(inner.sum()) > 80 and (seen[inner] >= 25).all()
    direction = local[inner] @ frame.double()
    distance = local[inner, 2] - (0.25 - sine[inner] ** 2).sqrt()
    at = scene.vertices[seen[inner].long()].double()
    assert float((at - distance[:, None] * direction).norm(dim=1).max()) < 0.17


def test_gather_sees_no_back_faces() -> None:
    """Below a plane that faces upwards there is nothing to see, below one that faces downwards the plane."""
    vertices, faces = mesh.plane_mesh(50.0, 2)
    up = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
    local = transfer.gather_directions(64)
    below = torch.tensor([[0.3, -1.0, 0.2]])
    u = torch.rand(1, 64, generator=torch.Generator().manual_seed(0))
    for turned, hit in ((faces, False), (faces.flip(1), True)):
        scene = ptt.Scene.from_mesh(vertices, turned)
        seen = transfer.gather(scene.surface, scene.faces, below, up, local, u)
        assert bool((seen >= 0).all()) == hit and bool((seen == -1).all()) != hit


def test_gather_draws_corners_by_their_barycentric_weights() -> None:
    """The ray straight up meets the triangle at weights (0.2, 0.5, 0.3): of n even numbers u so many draw each corner,
    in this order, to within one."""
    corners = torch.tensor([[-1.0, 2.0, -1.0], [1.0, 2.0, -1.0], [0.0, 2.0, 2.0]])
    weights = torch.tensor([0.2, 0.5, 0.3])
    n = 1000
    point = weights @ corners * torch.tensor([1.0, 0.0, 1.0])
    scene = ptt.Scene.from_mesh(corners, torch.tensor([[2, 0, 1]]))
    scene = scene if bool((scene.normals[:, 1] < 0).all()) else ptt.Scene.from_mesh(corners, torch.tensor([[2, 1, 0]]))
    up = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
    local = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(n, 3)
    u = ((torch.arange(n) + 0.5) / n)[None]
    seen = transfer.gather(scene.surface, scene.faces, point[None], up, local, u)[0].long()
    counts = torch.bincount(seen, minlength=3)
    assert torch.allclose(counts.float() / n, weights, rtol=0, atol=1.01 / n)
    order = [scene.faces[0].tolist().index(k) for k in seen.unique_consecutive().tolist()]
    assert order == [0, 1, 2]


def test_what_is_met_is_the_nearest_vertex_and_the_normal_between_all() -> None:
    """Straight up at weights (0.2, 0.5, 0.3) of a triangle whose vertex normals lean apart; down there is nothing."""
    corners = torch.tensor([[-1.0, -1.0, 2.0], [0.0, 2.0, 2.0], [1.0, -1.0, 2.0]])
    faces = torch.tensor([[0, 1, 2]])
    leaning = torch.tensor([[-0.6, 0.0, -0.8], [0.0, 0.6, -0.8], [0.28, 0.0, -0.96]])
    scene = ptt.Scene.from_mesh(corners, faces, normals=leaning)
    weights = torch.tensor([0.2, 0.5, 0.3])
    point = weights @ corners * torch.tensor([1.0, 1.0, 0.0])
    local = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    words = transfer.meets(scene.surface, scene.faces, scene.frames, point[None], torch.eye(3)[None], local)
    assert words.shape == (1, 3) and transfer.vertices_met(words)[0].tolist() == [1, -1]
    coordinates = words[:, 2:].view(torch.int8).float() / NORMAL
    found = torch.nn.functional.normalize(from_octahedral(coordinates[0, :2]), dim=0)
    between = torch.nn.functional.normalize(weights @ scene.frames[:, 2].float(), dim=0)
    assert float(found @ between) > math.cos(math.radians(0.9))
    assert float(scene.frames[1, 2].float() @ between) < math.cos(math.radians(15))
    assert words[:, 2:].view(torch.int8)[0, 2:].tolist() == [NOTHING, NOTHING]


def test_a_back_that_is_met_looks_away() -> None:
    """Above a point is the back of a triangle, whichever way its vertices lean."""
    corners = torch.tensor([[-1.0, -1.0, 2.0], [0.0, 2.0, 2.0], [1.0, -1.0, 2.0]])
    down = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
    scene = ptt.Scene.from_mesh(corners, torch.tensor([[0, 2, 1]]), normals=down)
    local = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.1, 1.0]], dtype=torch.float64)
    words = transfer.meets(scene.surface, scene.faces, scene.frames, torch.zeros(1, 3), torch.eye(3)[None], local)
    assert int(transfer.vertices_met(words).min()) >= 0
    normals = from_octahedral(words[:, 2:].view(torch.int8).float().reshape(2, 2) / NORMAL)
    away = torch.nn.functional.cosine_similarity(normals.double(), local, dim=1)
    assert float(away.min()) > math.cos(math.radians(0.9))


def test_normals_of_bytes_are_right_to_a_degree() -> None:
    """Everywhere on the sphere: half a step of either coordinate, where the map is stretched the most."""
    directions = Octahedral(64).directions().reshape(1, -1, 3).float()
    words = transfer.meets_packed(torch.zeros(1, 64 * 64, dtype=torch.int32), directions)
    bytes_ = words.reshape(-1, 3)[:, 2].contiguous().view(torch.int8).reshape(-1, 2)
    back = torch.nn.functional.normalize(from_octahedral(bytes_.float() / NORMAL), dim=1)
    assert float((back * directions[0]).sum(1).min()) > math.cos(math.radians(0.9))


ANGLES = (3.5, 7.0, 14.0, 21.0)


def turned_frames(count: int) -> torch.Tensor:
    """Right-handed."""
    q = torch.linalg.qr(torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(1)))[0]
    frames: Tensor = q * torch.linalg.det(q)[:, None, None]
    return frames


def test_lobes_that_see_everything_get_through() -> None:
    """255 of every lobe, also next to the horizon: what lies below is in no lobe. And 0 where nothing is seen."""
    grid = Cube(16)
    frames = turned_frames(70)
    bits = torch.full((70, grid.cells // 8), 255, dtype=torch.uint8)
    found = transfer.lobe_visibility(bits, frames, grid, 6, ANGLES)
    assert found.dtype == torch.uint8 and found.shape == (70, 36, 4)
    assert (found == 255).all()
    assert not transfer.lobe_visibility(torch.zeros_like(bits), frames, grid, 6, ANGLES).any()


def test_lobes_lose_what_lies_below_the_horizon_of_a_point_alone() -> None:
    """As `visibility` packs it: a cell is hidden if its centre is below, so only lobes near the horizon lose some."""
    scene = ptt.Scene.from_mesh(*mesh.plane_mesh(1.0, 1))
    raw = ptt.precompute(scene, resolution=32)
    found = transfer.lobe_visibility(raw.visible, raw.receivers.frames, Cube(32), 8, ANGLES)
    high = HemiOctahedral(8).directions().reshape(-1, 3)[:, 2] > math.sin(math.radians(26))
    assert (found[:, high] == 255).all()
    assert (found > 0.8 * 255).all()


def test_lobes_are_cut_by_a_half_space_as_their_weight_is() -> None:
    """The sum of Gaussian times cosine over what is seen, over that of all above the horizon, by midpoints about the
    axis, 200 rings of 240. The quadrature asks the same cells of the cube map.

    The code sums over 64 x 64 cells, 1.8 degrees wide; the narrowest lobe is 7 degrees across, and the step from seen
    to hidden falls within one cell: up to a sixth of it. Left and right swapped, or an inverse frame, differ by 1.
    """
    grid = Cube(64)
    cells = 8
    frames = turned_frames(3)
    side = torch.nn.functional.normalize(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    visible = side @ grid.directions().reshape(-1, 3).float().T > 0
    bits = torch.from_numpy(np.packbits(visible.numpy(), axis=1))
    found = transfer.lobe_visibility(bits, frames, grid, cells, ANGLES)
    axes = HemiOctahedral(cells).directions().reshape(-1, 3)
    worst = torch.zeros(4)
    total = torch.zeros(4)
    for cell, axis in enumerate(axes):
        across = torch.linalg.cross(axis, torch.tensor([0.3, 0.5, -0.8], dtype=torch.float64))
        across = across / across.norm()
        phi = torch.arange(240, dtype=torch.float64) * (2 * math.pi / 240)
        circle = phi.cos()[:, None] * across + phi.sin()[:, None] * torch.linalg.cross(axis, across)
        for k, angle in enumerate(ANGLES):
            t = (torch.arange(200, dtype=torch.float64) + 0.5) * (math.radians(angle) / 200)
            local = (t.cos()[:, None, None] * axis + t.sin()[:, None, None] * circle).reshape(-1, 3)
            gauss = (-0.5 * (t * 3 / math.radians(angle)) ** 2).exp() * t.sin()
            weight = gauss.repeat_interleave(240) * local[:, 2].clamp(min=0)
            for v in range(3):
                seen = visible[v, grid.cell(local @ frames[v].double())]
                error = abs(float((weight * seen).sum() / weight.sum()) - float(found[v, cell, k]) / 255)
                worst[k] = max(float(worst[k]), error)
                total[k] += error / (3 * len(axes))
    assert (worst < torch.tensor([0.2, 0.1, 0.06, 0.04])).all()
    assert (total < 0.01).all()
    assert (found == 255).any() and (found == 0).any() and ((found > 64) & (found < 192)).any()


def test_wavelet_sums_equal_texel_sums(small_raw: ptt.RawTransfer) -> None:
    """Keeping all coefficients, U is the plain sum over texels of light times transfer."""
    environment = ptt.Environment.sun_sky(radius=8.0)
    model = ptt.compress(small_raw, None, small_brdf(), clusters=None)
    u = ptt.TransferRelighter(model).incident(environment)
    grid = model.grid
    visible = transfer.unpack(small_raw.visible, grid.cells)
    directions = grid.directions().reshape(-1, 3).float()
    solid = grid.solid_angles().flatten().float()
    t0 = transfer.direct_transfer(visible, small_raw.receivers.frames, directions, solid, model.brdf.u_i)
    texels = environment.project(grid).reshape(-1, 3)
    assert torch.allclose(u, torch.einsum("vit,tc->civ", t0, texels), rtol=1e-3, atol=1e-4)
    assert model.truncation_error < 1e-3


def test_truncation_error_is_what_is_left_out(small_raw: ptt.RawTransfer) -> None:
    whole, part = (ptt.compress(small_raw, k, small_brdf(), clusters=None) for k in (None, 40))
    dense, kept = (m.transfer().to_dense() for m in (whole, part))
    assert part.truncation_error == pytest.approx(float((dense - kept).norm() / dense.norm()), rel=1e-3)


def test_refusals(small_scene: ptt.Scene, small_raw: ptt.RawTransfer) -> None:
    with pytest.raises(ValueError, match="resolution must be a power of two from 2 to 128, got 48"):
        ptt.precompute(small_scene, resolution=48)
    with pytest.raises(ValueError, match="index must hold ascending numbers"):
        ptt.precompute(small_scene, resolution=2, index=torch.tensor([3, 2]))
    with pytest.raises(ValueError, match="bounces must be 0, 1 or 2 and rays at least 16, got 3 and 512"):
        ptt.precompute(small_scene, 3)
    with pytest.raises(ValueError, match="bounces must be 0, 1 or 2 and rays at least 16, got 1 and 15"):
        ptt.precompute(small_scene, 1, rays=15)
    with pytest.raises(ValueError, match="index serves direct light alone"):
        ptt.precompute(small_scene, 1, index=torch.tensor([2, 3]))
    with pytest.raises(ValueError, match=r"coefficients must be in 6..1536, got 0"):
        ptt.compress(small_raw, 0)


def test_rows_of_the_sparse_transfer_are_those_of_the_dense_one() -> None:
    """Random T0 (v, i, l), truncated jointly; the CSR matrix must hold the kept entries at rows (i, v)."""
    t0 = torch.randn(5, 3, 16, generator=torch.Generator().manual_seed(0))
    kept = haar.truncate(t0.flatten(1), 20)
    parts = [SparseTransfer.of(haar.Truncated(kept.indices[r], kept.values[r]), 3, 16) for r in (slice(3), slice(3, 5))]
    dense = SparseTransfer.cat(parts).to_csr(16).to_dense().reshape(3, 5, 16)
    assert torch.equal(dense.transpose(0, 1).flatten(1), kept.to_dense(48))
