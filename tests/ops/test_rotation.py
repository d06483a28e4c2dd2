"""Rotation in space and in the wavelet domain: laws, the dense product as oracle, rotation in space by directions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ptt.ops import haar, rotation
from ptt.ops.directions import turn
from ptt.ops.geodesic import Geodesic
from ptt.ops.octahedral import HemiOctahedral, Octahedral


def random_frames(count: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None]
    frames: Tensor = q * q.det().sign()[:, None, None]
    return frames


def smooth(directions: Tensor) -> Tensor:
    """Two functions on the sphere (..., 2) whose gradients are at most 2."""
    x, y, z = directions.unbind(-1)
    return torch.stack((x * y + z, (2 * x - z).sin()), -1)


def local_oracle(source: int, m: int, frame: Tensor, values: Tensor, samples: int) -> Tensor:
    """S by its definition: every sample looked up on its own, (M, c)."""
    fine = HemiOctahedral(m * samples)
    cell = Octahedral(source).cell(fine.directions() @ frame)
    read = values.reshape(-1, values.shape[-1])[cell]
    return HemiOctahedral(m)._block_sums(read, samples).flatten(0, 1) / samples**2


@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 2), (16, 8), (8, 16)])
@pytest.mark.parametrize("samples", [1, 3, 4])
def test_resampling_is_the_mean_of_samples(n: int, m: int, samples: int) -> None:
    frames = random_frames(3)
    values = torch.randn(n * n, 2, dtype=torch.float64)
    s = rotation.resampling(Octahedral(n), HemiOctahedral(m), frames, samples)
    got = rotation.resample(values, s).reshape(3, m * m, 2)
    for frame, local in zip(frames, got, strict=True):
        torch.testing.assert_close(local, local_oracle(n, m, frame, values, samples), rtol=1e-13, atol=1e-13)


def test_resampling_agrees_with_its_sparse_matrix_and_its_parts() -> None:
    s = rotation.resampling(Octahedral(8), HemiOctahedral(4), random_frames(5))
    values = torch.randn(64, 3, dtype=torch.float64)
    whole = rotation.resample(values, s)
    torch.testing.assert_close(s.to_csr(64) @ values, whole, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(rotation.resample(values, s.part(16, 48)), whole[16:48], rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_constant_stays_constant_exactly(dtype: torch.dtype) -> None:
    """Weights are whole sixteenths: what has 20 bits (49 in float64) comes back to the bit, the rest rounded."""
    value = torch.full((32, 32, 1), 0.7, dtype=torch.float64).to(dtype)
    bits = torch.tensor(2.0**20 if dtype == torch.float32 else 2.0**49)
    for frame in random_frames(5):
        if dtype.itemsize > 2:
            value = (value * bits).round() / bits
        wide = value.to(torch.float32 if dtype.itemsize < 4 else dtype)
        assert torch.equal(rotation.rotate(wide, frame), wide)
        third = torch.full_like(wide, 1 / 3)
        torch.testing.assert_close(rotation.rotate(third, frame), third, rtol=4 * torch.finfo(wide.dtype).eps, atol=0)


def test_identity_between_equal_grids_changes_nothing() -> None:
    values = torch.randn(16, 16, 3, dtype=torch.float64)
    assert torch.equal(rotation.rotate(values, torch.eye(3, dtype=torch.float64)), values)
    grid = Octahedral(16)
    s = rotation.resampling(grid, grid, torch.eye(3, dtype=torch.float64)[None])
    torch.testing.assert_close(rotation.matrices(s, 16, 16).to_dense(), torch.eye(256).double(), rtol=0, atol=1e-14)


def test_symmetries_of_the_map_permute_cells() -> None:
    """A quarter turn about z takes cells to cells: exact, and four of them are the identity."""
    values = torch.randn(16, 16, 1, dtype=torch.float64)
    quarter = turn(2, 90)
    once = rotation.rotate(values, quarter)
    assert torch.equal(once.flatten().sort().values, values.flatten().sort().values)
    four = values
    for _ in range(4):
        four = rotation.rotate(four, quarter)
    assert torch.equal(four, values)


@pytest.mark.parametrize("level", [2, 3, 4])
def test_rotation_on_triangles(level: int) -> None:
    """In the triangular basis: a constant, the identity, a smooth function, there and back, all as on squares."""
    grid = Geodesic(level)
    constant = torch.full((grid.cells, 1), 0.75, dtype=torch.float64)
    values = smooth(grid.directions())
    edge = 1.2 / 2**level  # of the largest triangle
    assert torch.equal(rotation.rotate(values, torch.eye(3, dtype=torch.float64), source=grid), values)
    for frame in random_frames(3):
        assert torch.equal(rotation.rotate(constant, frame, source=grid), constant)
        rotated = rotation.rotate(values, frame, source=grid)
        assert float((rotated - smooth(grid.directions() @ frame)).abs().max()) < 2 * edge
        back = rotation.rotate(rotated, frame.T, source=grid)
        assert float((back - values).square().mean().sqrt()) < edge / 2
    with pytest.raises(ValueError, match="power of two"):
        rotation.rotate(values, frame, source=grid, samples=3)
    with pytest.raises(ValueError, match="values must be"):
        rotation.rotate(values[:-1], frame, source=grid)


def test_direction_convention() -> None:
    """What the world shows along a frame's normal lies at the local pole."""
    frame = random_frames(1, 3)[0]
    world = Octahedral(64).directions()
    light = (world @ frame[2] > math.cos(0.3)).double()[..., None]
    local = rotation.rotate(light, frame, HemiOctahedral(32))[..., 0]
    expected = (HemiOctahedral(32).directions()[..., 2] > math.cos(0.3)).double()
    assert float((local - expected).abs().mean()) < 0.03
    tangent = rotation.rotate((world @ frame[0])[..., None], frame)[..., 0]
    assert float((tangent - world[..., 0]).abs().max()) < 0.06


@pytest.mark.parametrize("n", [16, 32, 64])
def test_rotation_of_a_smooth_function(n: int) -> None:
    """Cells are at most 4.6 / n wide and slopes at most 2: a value is off by half a diagonal times that."""
    grid = Octahedral(n)
    for frame in random_frames(4):
        rotated = rotation.rotate(smooth(grid.directions()), frame)
        wanted = smooth(grid.directions() @ frame)
        assert float((rotated - wanted).abs().max()) < 8 / n
        assert float((rotated - wanted).square().mean().sqrt()) < 1.0 / n


def test_energy_is_kept_to_a_bound_that_falls() -> None:
    worst = []
    for n in (16, 32, 64):
        grid = Octahedral(n)
        solid = grid.solid_angles()[..., None]
        values = smooth(grid.directions()) + 2
        frames = random_frames(4)
        whole = (values * solid).sum((0, 1))
        off = [((rotation.rotate(values, f) * solid).sum((0, 1)) - whole) / whole for f in frames]
        worst.append(float(torch.stack(off).abs().max()))
    assert worst[0] < 0.02 and worst[2] < 0.002 and worst[2] < worst[0] / 4


def test_one_texel_keeps_its_energy_roughly() -> None:
    """A sun of 1e9 in one cell: the 16 samples a cell see it to a tenth on average, and lose none of it for good."""
    grid = Octahedral(32)
    solid = grid.solid_angles()
    weights = []
    for k, frame in enumerate(random_frames(16)):
        light = torch.zeros(32, 32, 1, dtype=torch.float64)
        light.view(-1)[(k * 67) % 1024] = 1e9
        energy = float((light[..., 0] * solid).sum())
        weights.append(float((rotation.rotate(light, frame)[..., 0] * solid).sum()) / energy)
    assert 0.95 < sum(weights) / 16 < 1.05
    assert min(weights) > 0.6 and max(weights) < 1.4


def test_composition_and_inverse() -> None:
    a, b = random_frames(2, 5)
    errors = []
    for n in (16, 32, 64):
        values = smooth(Octahedral(n).directions())
        both = rotation.rotate(rotation.rotate(values, a), b)
        once = rotation.rotate(values, b @ a)
        back = rotation.rotate(rotation.rotate(values, a), a.T)
        assert max(float((both - once).abs().max()), float((back - values).abs().max())) < 8 / n
        errors.append([float(x.square().mean().sqrt()) for x in (both - once, back - values)])
    assert errors[2][0] < errors[0][0] / 3 and errors[2][1] < errors[0][1] / 3


@pytest.mark.parametrize("n", [2, 4, 16])
def test_haar_matrix_is_the_transform(n: int) -> None:
    values = torch.randn(3, n, n, dtype=torch.float64)
    back = rotation.haar_matrix(n) @ haar.analyse(values).flatten(1).T
    torch.testing.assert_close(back.T.reshape(3, n, n), values, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("n", "m"), [(2, 1), (16, 8), (8, 16), (16, 16)])
def test_factored_equals_matrix_equals_resample(n: int, m: int) -> None:
    frames = random_frames(6)
    target = HemiOctahedral(m)
    light = torch.rand(3, n, n, dtype=torch.float64) / 3
    s = rotation.resampling(Octahedral(n), target, frames)
    factored = rotation.local_light(light, s, m)
    assert factored.shape == (6, m * m, 3)
    by_matrices = rotation.rotated_light(light, rotation.matrices(s, n, m), m)
    torch.testing.assert_close(by_matrices, factored, rtol=0, atol=1e-12)
    torch.testing.assert_close(rotation.resampled_light(light, frames, target), factored, rtol=0, atol=1e-12)


def test_wavelet_rotation_equals_rotation_in_space() -> None:
    values = torch.randn(32, 32, 3, dtype=torch.float64)
    frames = random_frames(3)
    s = rotation.resampling(Octahedral(32), HemiOctahedral(16), frames)
    local = rotation.rotated_light(haar.analyse(values.movedim(-1, 0)), rotation.matrices(s, 32, 16), 16)
    for frame, coefficients in zip(frames, local, strict=True):
        maps = haar.synthesise(coefficients.T.reshape(3, 16, 16)).movedim(0, -1)
        torch.testing.assert_close(maps, rotation.rotate(values, frame, HemiOctahedral(16)), rtol=0, atol=1e-12)


def test_quantised_matrix() -> None:
    """Off by half a unit at most; a larger threshold leaves the larger numbers untouched."""
    s = rotation.resampling(Octahedral(16), HemiOctahedral(8), random_frames(2))
    exact = rotation.matrices(s, 16, 8).to_dense()
    fine = rotation.quantised(s, 16, 8, 1 / 32767, 1)
    assert float((fine.to_csr(256, torch.float64).to_dense() - exact).abs().max()) <= 0.5 / 32767 + 1e-12
    coarse = rotation.quantised(s, 16, 8, 1 / 32767, 1000)
    assert int(coarse.numbers.abs().min()) >= 1000 and len(coarse.numbers) < len(fine.numbers)
    kept = coarse.to_csr(256).to_dense()
    assert bool((kept[kept != 0] == fine.to_csr(256).to_dense()[kept != 0]).all())


def test_differentiable_in_the_light() -> None:
    frames = random_frames(2)
    s = rotation.resampling(Octahedral(4), HemiOctahedral(2), frames)
    matrix = rotation.matrices(s, 4, 2)
    light = torch.randn(2, 4, 4, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(lambda x: rotation.local_light(x, s, 2), light)
    torch.autograd.gradcheck(lambda x: rotation.resampled_light(x, frames, HemiOctahedral(2)), light)
    torch.autograd.gradcheck(lambda x: rotation.rotated_light(x, matrix, 2), light)
    torch.autograd.gradcheck(lambda x: rotation.rotate(x.movedim(0, -1), frames[0]), light)


def test_frames_of_normals() -> None:
    """Folds of the octahedron, the poles, -z and its neighbours, duplicates, any length."""
    axes = torch.cat((torch.eye(3), -torch.eye(3))).double()
    folds = torch.tensor([[1.0, 1, 0], [1, 0, -1], [0, -1, -1], [-1, 1, 0], [1e-12, 0, -1], [0, 0, -3]]).double()
    normals = torch.cat((axes, folds, axes, 1e-150 * axes, 1e150 * axes))
    frames = rotation.frames_of(normals)
    one = torch.eye(3).double().expand(len(normals), 3, 3)
    torch.testing.assert_close(frames @ frames.transpose(1, 2), one, rtol=0, atol=1e-14)
    torch.testing.assert_close(frames.det(), torch.ones(len(normals)).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(frames[:, 2], normals / normals.norm(dim=1, keepdim=True), rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="not zero: 1 of 2"):
        rotation.frames_of(torch.tensor([[0.0, 0, 0], [0, 0, 1]]))
    with pytest.raises(ValueError, match="1 of 1"):
        rotation.frames_of(torch.tensor([[math.nan, 0, 1]]))


def test_refuses() -> None:
    grid = Octahedral(4)
    frame = torch.eye(3)[None]
    for samples in (0, 16):
        with pytest.raises(ValueError, match="samples"):
            rotation.resampling(grid, grid, frame, samples)
    for bad in (torch.ones(1, 3, 3), torch.eye(3), torch.zeros(0, 3, 3), torch.full((1, 3, 3), math.nan)):
        with pytest.raises(ValueError, match="frames must"):
            rotation.resampling(grid, grid, bad)
    with pytest.raises(ValueError, match=r"values must be \(n, n, c\)"):
        rotation.rotate(torch.ones(4, 4), torch.eye(3))
