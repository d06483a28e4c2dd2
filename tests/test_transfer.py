"""Direct transfer: the white furnace, what is hidden, and texels against wavelets."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt.meshes import Part
from ptt.models.transfer_model import SparseTransfer
from ptt.ops import haar, mesh, transfer
from ptt.ops.sphere import Cube


def relight(scene: ptt.Scene, environment: ptt.Environment, resolution: int = 64, coefficients: int | None = 96):
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong((20.0,)), ranks=(1, 1, 1), separated=0)
    model = ptt.compress(ptt.precompute(scene, resolution), coefficients, brdf)
    return ptt.TransferRelighter(model)(environment, scene.materials, torch.tensor([0.0, 50.0, 0.0]))


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
    raw = ptt.precompute(scene, 16)
    visible = transfer.unpack(raw.visible, Cube(16).cells).reshape(-1, 6, 16, 16)[0]
    assert not visible[2].any()  # +Y
    assert visible[[0, 1, 4, 5], :8].all()  # upper halves of the sides
    assert not visible[[0, 1, 4, 5], 8:].any() and not visible[3].any()  # below the horizon


def test_direct_transfer_is_visibility_times_factor_times_cosine_by_a_plain_loop() -> None:
    """In float64, term by term; the factor table is linear in x and y, where bilinear lookups are exact."""
    grid, n = Cube(8), 32
    directions, solid = grid.directions().reshape(-1, 3), grid.solid_angles().flatten()
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


def test_wavelet_sums_equal_texel_sums(small_raw: ptt.RawTransfer) -> None:
    """Keeping all coefficients, U is the plain sum over texels of light times transfer."""
    environment = ptt.Environment.sun_sky(radius=8.0)
    model = ptt.compress(small_raw, None, small_brdf())
    u = ptt.TransferRelighter(model).incident(environment)
    grid = model.grid
    visible = transfer.unpack(small_raw.visible, grid.cells)
    directions, solid = grid.directions().reshape(-1, 3).float(), grid.solid_angles().flatten().float()
    t0 = transfer.direct_transfer(visible, small_raw.receivers.frames, directions, solid, model.brdf.u_i)
    texels = environment.project(grid).reshape(-1, 3)
    assert torch.allclose(u, torch.einsum("vit,tc->civ", t0, texels), rtol=1e-3, atol=1e-4)
    assert model.truncation_error < 1e-3


def test_truncation_error_is_what_is_left_out(small_raw: ptt.RawTransfer) -> None:
    whole, part = (ptt.compress(small_raw, k, small_brdf()) for k in (None, 40))
    dense, kept = (m.transfer().to_dense() for m in (whole, part))
    assert part.truncation_error == pytest.approx(float((dense - kept).norm() / dense.norm()), rel=1e-3)


def test_refusals(small_scene: ptt.Scene, small_raw: ptt.RawTransfer) -> None:
    with pytest.raises(ValueError, match="resolution must be a power of two from 2 to 128, got 48"):
        ptt.precompute(small_scene, 48)
    with pytest.raises(ValueError, match="index must hold ascending numbers"):
        ptt.precompute(small_scene, 2, index=torch.tensor([3, 2]))
    with pytest.raises(ValueError, match=r"coefficients must be in 6..1536, got 0"):
        ptt.compress(small_raw, 0)


def test_rows_of_the_sparse_transfer_are_those_of_the_dense_one() -> None:
    """Random T0 (v, i, l), truncated jointly; the CSR matrix must hold the kept entries at rows (i, v)."""
    t0 = torch.randn(5, 3, 16, generator=torch.Generator().manual_seed(0))
    kept = haar.truncate(t0.flatten(1), 20)
    parts = [SparseTransfer.of(haar.Truncated(kept.indices[r], kept.values[r]), 3, 16) for r in (slice(3), slice(3, 5))]
    dense = SparseTransfer.cat(parts).to_csr(16).to_dense().reshape(3, 5, 16)
    assert torch.equal(dense.transpose(0, 1).flatten(1), kept.to_dense(48))
