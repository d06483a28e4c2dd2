"""Environments: the interpolant, its rotations, its means and integral, its sampler; maps from disk."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from math import cos, pi, radians, sin
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from torch import Tensor

from ptt.io.images import write_image
from ptt.light.environment import Environment
from ptt.ops import latlong
from ptt.ops.sphere import Cube, Disk, Grid, LatLong

GRIDS = [Cube(4), Cube(16), LatLong(16, 32)]


def random_directions(n: int, seed: int = 0) -> Tensor:
    d = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(d, dim=-1)


def noise(height: int = 16, width: int = 32, seed: int = 0) -> Environment:
    return Environment(torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)))


def smooth(height: int = 64) -> Environment:
    """exp(d . a) in each channel: no symmetry that a mirrored or rotated map could hide behind."""
    d = LatLong(height, 2 * height).directions()
    a = torch.tensor([[1.0, 0.3, -0.5], [-0.4, 0.8, 0.6], [0.2, -0.7, 0.9]], dtype=torch.float64)
    return Environment((d @ a.T).exp().float())


def one_texel(height: int, row: int, radiance: float = 1e5) -> Environment:
    texels = torch.zeros(height, 2 * height, 3)
    texels[row, height // 3] = radiance
    return Environment(texels)


def energy(means: Tensor, grid: Grid) -> Tensor:
    return torch.einsum("tc,t->c", means.double().reshape(-1, 3), grid.solid_angles().flatten())


def oracle(texels: Tensor, directions: Tensor) -> Tensor:
    """The bilinear interpolant in float64, from its definition, one texel at a time."""
    height, width = texels.shape[:2]
    x, y, z = directions.double().unbind(-1)
    u = torch.atan2(x, -z) / (2 * pi) * width - 0.5
    v = torch.atan2(torch.hypot(x, z), y) / pi * height - 0.5
    total = torch.zeros(*directions.shape, dtype=torch.float64)
    for row in (v.floor(), v.floor() + 1):
        for column in (u.floor(), u.floor() + 1):
            beyond = (row < 0) | (row >= height)
            i = row.clamp(0, height - 1).long()
            j = (column + beyond * (width // 2)).long() % width
            weight = (1 - (u - column).abs()) * (1 - (v - row).abs())
            total += weight[..., None] * texels[i, j].double()
    return total


def test_radiance_against_the_definition() -> None:
    light = noise()
    d = random_directions(20_000)
    near_poles = torch.cat((d, d * torch.tensor([0.02, 1, 0.02])))
    near_poles /= near_poles.norm(dim=-1, keepdim=True)
    assert torch.allclose(light.radiance(near_poles).double(), oracle(light.map, near_poles), atol=2e-4)


def test_radiance_at_texel_centres_is_the_texel() -> None:
    light = noise(7, 12)
    assert torch.allclose(light.radiance(LatLong(7, 12).directions()), light.map, atol=1e-5)


def test_convention_of_axes() -> None:
    """u = atan2(x, -z) / 2 pi: -Z on the left edge, +X at a quarter, +Z in the middle."""
    texels = torch.zeros(8, 16, 3)
    texels[:, :, 0], texels[:, :, 1] = torch.arange(16.0), torch.arange(8.0)[:, None]
    d = torch.tensor([[1.0, 0, 0], [0, 0, 1], [-1, 0, 0]])
    assert torch.allclose(Environment(texels).radiance(d)[:, 0], torch.tensor([3.5, 7.5, 11.5]), atol=1e-5)
    assert torch.allclose(Environment(texels).radiance(d)[:, 1], torch.tensor(3.5), atol=1e-5)
    poles = Environment(texels).radiance(torch.tensor([[0.0, 1, 0], [0, -1, 0]]))
    assert poles[:, 1].tolist() == pytest.approx([0, 7], abs=1e-4)


def test_radiance_is_continuous_across_the_seam_and_the_poles() -> None:
    light = noise()
    step = 1e-4
    for centre in ([0.0, 1, 0], [0, -1, 0], [0, 0.4, -1], [0, -0.99, -0.1]):
        pairs = torch.tensor(centre) + step * torch.tensor([[[1.0, 0, 1]], [[-1.0, 0, -1]]])
        left, right = light.radiance(pairs)
        slope = 16 / pi * step / (1 - abs(centre[1]) if abs(centre[1]) < 1 else 1)
        assert torch.allclose(left, right, atol=20 * slope)


def test_lengths_shapes_and_types_of_directions() -> None:
    light = noise()
    d = random_directions(6).view(2, 3, 3)
    assert light.radiance(d).shape == (2, 3, 3)
    assert torch.allclose(light.radiance(d), light.radiance(7.0 * d.double()), atol=1e-5)
    assert light.radiance(d[0, 0]).shape == (3,)
    assert light.radiance(d[:0]).shape == (0, 3, 3)


def test_rotated_environment_at_rotated_directions() -> None:
    light = smooth()
    d = random_directions(1000).double()
    turned = light.rotated(20, 30, 40)
    moved = d @ turned.rotation.T
    assert torch.allclose(turned.radiance(moved), light.radiance(d), atol=1e-4)
    assert not torch.allclose(turned.radiance(d), light.radiance(d), atol=1e-1)
    back = turned.rotated(z=-40).rotated(y=-30).rotated(x=-20)
    assert torch.allclose(back.rotation, torch.eye(3, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotations_are_right_handed(axis: int) -> None:
    """A quarter about x takes y to z, about y takes z to x, about z takes x to y."""
    turned = noise().rotated(**{"xyz"[axis]: 90.0})
    axes = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(turned.rotation @ axes[(axis + 1) % 3], axes[(axis + 2) % 3], atol=1e-12)


def test_a_quarter_about_y_permutes_the_faces() -> None:
    """+Z goes to +X: the new +X face is the old +Z face, and so on; +Y and -Y turn in themselves."""
    light = smooth()
    old = light.project(Cube(8))
    new = light.rotated(y=90).project(Cube(8))
    assert torch.allclose(new[[0, 5, 1, 4]], old[[4, 0, 5, 1]], rtol=1e-3)
    assert torch.allclose(new[2], old[2].rot90(1), rtol=2e-3)  # columns run to +X, rows to +Z: z goes to x
    assert torch.allclose(new[3], old[3].rot90(-1), rtol=2e-3)


@pytest.mark.parametrize("grid", [*GRIDS, Cube(1), Disk(8), LatLong(40, 6)], ids=str)
def test_constants_project_to_themselves(grid: Grid) -> None:
    light = Environment(torch.full((32, 64, 3), 2.5))
    assert light.project(grid).shape == (*grid.shape, 3)
    assert torch.allclose(light.project(grid), torch.tensor(2.5), rtol=1e-6)


def test_means_against_a_fine_oracle() -> None:
    """White noise, texel by texel, is the worst case for three samples a texel and for the blur at the poles.

    Cells are about four texels wide; the oracle averages the float64 interpolant over 64 x 64 points of each.
    """
    light = noise(16, 32)
    grid = Cube(2)
    fine = grid.refine(64)
    weights = fine.solid_angles()
    total = grid.coarsen(oracle(light.map, fine.directions()) * weights[..., None], 64)
    expected = total / grid.solid_angles()[..., None]
    assert torch.allclose(light.project(grid).double(), expected, atol=0.015)


def test_cells_finer_than_the_map_hold_the_interpolant() -> None:
    light = smooth(8)
    grid = Cube(32)
    error = (light.project(grid) / light.radiance(grid.directions()) - 1).abs()
    assert error[[0, 1, 4, 5]].max() < 1e-5
    assert error[2:4].max() < 0.02  # one texel in eight rows is wide: rows are blurred around the poles


@pytest.mark.parametrize("height", [2, 16, 128])
def test_integral_of_the_interpolant(height: int) -> None:
    """A constant gives 4 pi; one texel of any row, the sum of the interpolant on a fine grid."""
    assert torch.allclose(Environment(torch.ones(height, 6, 3)).integral(), torch.tensor(4 * pi), rtol=1e-6)
    fine = LatLong(16 * 48, 12)
    for row in (0, 1, height - 1):
        light = Environment(torch.zeros(height, 2, 3).index_fill(0, torch.tensor(row), 1))
        expected = energy(oracle(light.map, fine.directions()), fine)
        assert torch.allclose(light.integral().double(), expected, rtol=0.02)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize("row", [0, 1, 2, 5, 16, 32, 64, 125, 127])
def test_one_bright_texel_keeps_its_energy(grid: Grid, row: int) -> None:
    """1e5 in one texel of 128 rows, at elevations up to the poles: 2 %, as `project` promises."""
    light = one_texel(128, row).rotated(10, 20, 30)
    assert torch.allclose(energy(light.project(grid), grid), light.integral().double(), rtol=0.02)


@pytest.mark.parametrize("row", [0, 1, 2, 3, 50, 128])
def test_halved_maps_keep_constants_and_energy(row: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ptt.ops.latlong._LOOKUPS", 1 << 16)
    light = one_texel(256, row)
    grid = Cube(4)
    assert len(latlong.sampled(light.map, grid)[0]) < 256
    half = Environment(latlong.halved(light.map))
    assert half.map.shape == (128, 256, 3)
    assert torch.allclose(half.integral(), light.integral(), rtol=1e-4)
    assert torch.allclose(energy(light.project(grid), grid), light.integral().double(), rtol=0.02)
    ones = latlong.halved(torch.ones_like(light.map))
    assert torch.allclose(ones, torch.ones_like(ones), atol=1e-5)


def test_projection_is_linear_and_differentiable_in_the_map() -> None:
    a = noise(seed=1)
    b = noise(seed=2)
    grid = Cube(4)
    both = Environment(a.map + 3 * b.map).project(grid)
    assert torch.allclose(both, a.project(grid) + 3 * b.project(grid), atol=1e-5)
    texels = a.map.clone().requires_grad_()
    weights = torch.rand(6, 4, 4, 3)
    (Environment(texels).rotated(y=20).project(grid) * weights).sum().backward()
    expected = (b.rotated(y=20).project(grid) * weights).sum()  # linear: <gradient, b> is the value at b
    assert texels.grad is not None and float((texels.grad * b.map).sum()) == pytest.approx(float(expected), rel=1e-4)


def test_sums_of_half_float_range_stay_finite() -> None:
    light = Environment(torch.full((16, 32, 3), 65504.0))
    assert torch.allclose(light.project(Cube(4)), torch.tensor(65504.0))
    assert light.sampler().sample(torch.rand(10, 2))[1].isfinite().all()


@pytest.mark.parametrize("name", ["uffizi.hdr", "pisa.hdr", "grace.hdr", "grace_cross.hdr", "city.exr"])
def test_real_maps_keep_their_energy(data_dir: Path, name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        light = Environment.load(data_dir / "hdri" / name)
    grid = Cube(16)
    areas = LatLong(*light.map.shape[:2]).solid_angles()
    assert torch.allclose(energy(light.project(grid), grid), light.integral().double(), rtol=2e-3)
    assert torch.allclose(torch.einsum("hw,hwc->c", areas, light.map.double()), light.integral().double(), rtol=1e-3)


def test_cross_of_grace_is_the_lat_long_of_grace(data_dir: Path) -> None:
    """pbrt's file of the same probe has its rows bottom up and half a turn: it holds the radiance of -d."""
    cross = Environment.load(data_dir / "hdri" / "grace_cross.hdr")
    other = Environment.load(data_dir / "hdri" / "grace_latlong.exr")
    d = random_directions(5000)
    logs = torch.stack([(light.radiance(x).mean(-1) / light.map.mean() + 0.01).log()
                        for light, x in ((cross, d), (other, -d), (other, d))])  # fmt: skip
    correlation = torch.corrcoef(logs)[0]
    assert correlation[1] > 0.99
    assert correlation[2] < 0.9


def angular_of(function: Callable[[Tensor], Tensor], n: int = 256) -> Tensor:
    centres = (torch.arange(n) + 0.5) * 2 / n - 1
    b, a = torch.meshgrid(-centres, centres, indexing="ij")
    r = torch.hypot(a, b)
    d = torch.stack((torch.sin(pi * r) * a / r, torch.sin(pi * r) * b / r, -torch.cos(pi * r)), dim=-1)
    return function(d) * (r <= 1)[..., None]


def cross_of(function: Callable[[Tensor], Tensor], n: int = 64) -> Tensor:
    """Faces as the inventory has them, each built as a plane in space; the unused tiles are bright."""
    c = (torch.arange(n) + 0.5) * 2 / n - 1
    t, s = torch.meshgrid(c, c, indexing="ij")
    one = torch.ones_like(s)
    faces = {(0, 1): (s, one, -t), (1, 0): (-one, -t, -s), (1, 1): (s, -t, -one),
             (1, 2): (one, -t, s), (2, 1): (s, -one, t), (3, 1): (s, t, one)}  # fmt: skip
    image = torch.full((4 * n, 3 * n, 3), 1e3)
    for (row, column), d in faces.items():
        image[row * n : (row + 1) * n, column * n : (column + 1) * n] = function(torch.stack(d, dim=-1))
    return image


def octahedral_of(function: Callable[[Tensor], Tensor], n: int = 181) -> Tensor:
    """pbrt-v4's EqualAreaSquareToSphere, texel by texel, its z axis up and its y axis to -Z."""
    centres = (torch.arange(n) + 0.5) * 2 / n - 1
    v, u = torch.meshgrid(centres, centres, indexing="ij")
    inside = 1 - (u.abs() + v.abs())
    r = 1 - inside.abs()
    phi = torch.where(r == 0, 1.0, (v.abs() - u.abs()) / r + 1) * pi / 4
    z = (1 - r * r).copysign(inside)
    wide = r * (2 - r * r).sqrt()
    x = (phi.cos() * wide).copysign(u)
    y = (phi.sin() * wide).copysign(v)
    return function(torch.stack((x, z, -y), dim=-1))


def latlong_of(function: Callable[[Tensor], Tensor]) -> Tensor:
    return function(LatLong(128, 129).directions().float())


@pytest.mark.parametrize(
    ("layout", "unfold"),
    [("angular", angular_of), ("cross", cross_of), ("octahedral", octahedral_of), ("latlong", latlong_of)],
)
def test_layouts_hold_the_same_sphere(tmp_path: Path, layout: str, unfold: Callable[..., Tensor]) -> None:
    """At their own ratio, and stretched in height."""
    function = Environment(smooth(128).map).radiance
    image = unfold(function)
    for rows in (1, 2):
        write_image(tmp_path / "a.exr", image.repeat_interleave(rows, 0))
        light = Environment.load(tmp_path / "a.exr", layout)  # type: ignore[arg-type]
        assert light.map.shape[0] == 128 * rows
        error = (light.radiance(random_directions(5000)) / function(random_directions(5000)) - 1).abs()
        assert error.max() < 0.06 and error.mean() < 0.006


def test_a_cross_and_a_lat_long_are_known_by_their_ratio(tmp_path: Path) -> None:
    function = Environment(smooth(128).map).radiance
    write_image(tmp_path / "cross.exr", cross_of(function))
    assert torch.equal(
        Environment.load(tmp_path / "cross.exr").map, Environment.load(tmp_path / "cross.exr", "cross").map
    )
    write_image(tmp_path / "latlong.exr", smooth(128).map)
    assert torch.equal(Environment.load(tmp_path / "latlong.exr").map, smooth(128).map)


def test_load_counts_negatives_once_and_clamps_them(tmp_path: Path) -> None:
    texels = torch.rand(4, 8, 4)
    texels[1, :5, 0], texels[2, 3, 3] = -0.1, -1.0  # alpha does not count
    write_image(tmp_path / "a.exr", texels)
    with pytest.warns(UserWarning, match=r"a\.exr: 5 of 96 values were negative") as caught:
        light = Environment.load(tmp_path / "a.exr")
    assert len(caught) == 1
    assert torch.equal(light.map, texels[..., :3].clamp(min=0))


def test_load_grey_half_black_and_hdr(tmp_path: Path) -> None:
    plane = np.arange(32, dtype=np.float16).reshape(4, 8)
    OpenEXR.File({}, {"Y": plane}).write(str(tmp_path / "y.exr"))
    grey = torch.from_numpy(plane).float()[..., None].expand(-1, -1, 3)
    assert torch.equal(Environment.load(tmp_path / "y.exr").map, grey)
    write_image(tmp_path / "black.hdr", torch.zeros(4, 8, 3))
    assert Environment.load(str(tmp_path / "black.hdr")).integral().tolist() == [0, 0, 0]


def test_load_refuses_what_is_no_environment(tmp_path: Path) -> None:
    texels = torch.rand(4, 8, 3)
    texels[0, 0] = torch.tensor([float("nan"), float("inf"), 1.0])
    write_image(tmp_path / "nan.exr", texels)
    with pytest.raises(ValueError, match=r"nan\.exr must be finite: 2 of 96 values"):
        Environment.load(tmp_path / "nan.exr")
    write_image(tmp_path / "wide.exr", torch.rand(4, 9, 3))
    with pytest.raises(ValueError, match=r"wide\.exr: 9 x 4 is neither of 2:1 \(latlong\), 3:4 \(cross\).*layout= one"):
        Environment.load(tmp_path / "wide.exr")
    write_image(tmp_path / "good.exr", torch.rand(8, 8, 3))
    with pytest.warns(UserWarning, match=r"taken for angular.*'latlong', 'cross', 'angular', 'octahedral'"):
        Environment.load(tmp_path / "good.exr")
    with pytest.raises(ValueError, match="one of auto, latlong, cross, angular, octahedral, got 'sphere'"):
        Environment.load(tmp_path / "good.exr", "sphere")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"missing\.exr"):
        Environment.load(tmp_path / "missing.exr")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.rand(4, 7, 3),), "even width"),
        ((torch.rand(4, 8),), "map must have shape"),
        ((torch.rand(4, 8, 3).double(),), "float32"),
        ((torch.rand(4, 8, 3) / 0,), "96 of 96"),
        ((torch.rand(4, 8, 3), torch.eye(3)), "float64 rotation"),
        ((torch.rand(4, 8, 3), 2 * torch.eye(3).double()), "rotation"),
        ((torch.rand(4, 8, 3), -torch.eye(3).double()), "rotation"),
    ],
)
def test_constructor_checks(arguments: tuple[Tensor, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Environment(*arguments)


def test_constant_scaled_and_gradient() -> None:
    assert torch.allclose(Environment.constant((1, 2, 3)).integral(), 4 * pi * torch.tensor([1.0, 2, 3]))
    light = noise()
    assert torch.allclose(light.scaled((1, 2, 0)).map, light.map * torch.tensor([1, 2, 0]))
    assert torch.allclose(light.rotated(y=40).scaled(3.0).rotation, light.rotated(y=40).rotation)
    sky = Environment.gradient_sky(1.0, (0.5, 0.4, 0.3), 0.1)
    d = torch.tensor([[0.0, 1, 0], [0, 0.5, 0.75**0.5], [0.6, -0.8, 0]])
    expected = torch.tensor([[1.0, 1, 1], [0.75, 0.7, 0.65], [0.1, 0.1, 0.1]])
    assert torch.allclose(sky.radiance(d), expected, atol=1e-3)


@pytest.mark.parametrize("radius", [0.01, 0.27, 3.0, 40.0, 130.0, 180.0])
@pytest.mark.parametrize("direction", [(0, 1, 0), (0.001, -2, 0.002), (1, 0.3, -1), (0, 0, -1), (0.1, 0, 1)])
def test_area_lights_hold_the_integral_of_their_cap(direction: tuple[float, ...], radius: float) -> None:
    """2 pi (1 - cos radius), and the mean direction sits on the axis (but for the full sphere)."""
    light = Environment.area_light(direction, radius, (1.0, 0.5, 0.0))
    expected = 2 * pi * (1 - cos(radians(radius)))
    assert light.integral().tolist() == pytest.approx([expected, expected / 2, 0], rel=1e-5)
    grid = LatLong(256, 512)
    moment = torch.einsum("hw,hw,hwc->c", light.map[..., 0].double(), grid.solid_angles(), grid.directions())
    axis = torch.tensor(direction, dtype=torch.float64)
    if radius < 180:  # the integral of d over a cap is pi sin^2 along its axis
        along = float(moment @ axis / axis.norm())
        assert float(moment.norm()) == pytest.approx(along, rel=1e-3)
        if radius > 1:
            assert along == pytest.approx(pi * sin(radians(radius)) ** 2, rel=5e-3)


def test_area_light_is_uniform_inside_and_black_outside() -> None:
    light = Environment.area_light((1, 2, 3), 25.0, 7.0)
    d = random_directions(20_000)
    angle = torch.rad2deg(torch.acos((d @ torch.tensor([1.0, 2, 3]) / 14**0.5).clamp(-1, 1)))
    values = light.radiance(d)[:, 0]
    assert torch.allclose(values[angle < 23.5], torch.tensor(7.0), rtol=1e-3)
    assert (values[angle > 26.5] == 0).all()


@pytest.mark.parametrize("direction", [(0, 1, 0), (0.4, 0.7, 0.6), (1, 0.02, 0)])
def test_sun_gives_its_irradiance(direction: tuple[float, ...]) -> None:
    """To a surface that faces it, beside what the sky gives; 2 % is what `project` promises."""
    sun = Environment.sun_sky(direction, (3.0, 2.0, 1.0), zenith=0.0, horizon=0.0, ground=0.0)
    grid = Cube(64)
    axis = torch.tensor(direction, dtype=torch.float64)
    cosine = (grid.directions() @ axis / axis.norm()).clamp(min=0)
    irradiance = energy(sun.project(grid) * cosine[..., None].float(), grid)
    assert irradiance.tolist() == pytest.approx([3, 2, 1], rel=0.02)
    both = Environment.sun_sky(direction, (3.0, 2.0, 1.0))
    assert torch.allclose(both.map, sun.map + Environment.gradient_sky().map, rtol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Environment.constant(-1.0), "radiance must be"),
        (lambda: Environment.constant((1.0, 2.0)), "radiance must be"),
        (lambda: Environment.gradient_sky(ground=float("nan")), "ground must be"),
        (lambda: Environment.area_light((0, 0, 0)), "direction must be"),
        (lambda: Environment.area_light((0, 1)), "direction must be"),
        (lambda: Environment.area_light((0, 1, 0), 0.0), "radius must satisfy"),
        (lambda: Environment.area_light((0, 1, 0), 181.0), "radius must satisfy"),
        (lambda: Environment.sun_sky(radius=91.0), "radius must satisfy"),
        (lambda: Environment.sun_sky(irradiance=-1.0), "irradiance must be"),
        (lambda: Environment.constant().scaled(-1.0), "factor must be"),
    ],
)
def test_makers_refuse_what_is_out_of_range(make: Callable[[], Environment], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def samples(n: int = 200_000) -> Tensor:
    return torch.rand(n, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(5))


def test_pdf_integrates_to_one_and_is_that_of_the_samples() -> None:
    sampler = noise().rotated(10, 20, 30).sampler()
    areas = LatLong(16, 32).solid_angles()
    assert float((sampler.density * areas).sum()) == pytest.approx(1, abs=1e-12)
    directions, pdf = sampler.sample(samples())
    assert torch.allclose(directions.norm(dim=-1), torch.tensor(1.0), atol=1e-6)
    assert (sampler.pdf(directions) == pdf).double().mean() > 0.999  # rounding moves a few across a border
    grid = LatLong(16, 32)
    lookup = sampler.pdf((grid.directions() @ sampler.rotation.T).reshape(-1, 3)).view(16, 32)
    assert torch.allclose(lookup.double(), sampler.density, rtol=1e-6)


def test_histogram_of_samples_follows_the_pdf_down_to_quarters_of_texels() -> None:
    """Five standard errors sqrt(p (1 - p) / n), on a finer grid: uniform inside texels too."""
    light = noise(6, 8).rotated(30, 20, 10)
    sampler = light.sampler()
    fine = LatLong(12, 16)
    u = samples(400_000)
    cell = fine.cell(sampler.sample(u)[0].double() @ light.rotation)
    share = torch.bincount(cell, minlength=fine.cells).view(12, 16) / len(u)
    density = sampler.density.repeat_interleave(2, 0).repeat_interleave(2, 1)
    expected = density * fine.solid_angles()
    assert ((share - expected).abs() < 5 * (expected / len(u)).sqrt()).all()


@pytest.mark.parametrize("light", [noise(), one_texel(64, 0), one_texel(64, 20), Environment.sun_sky()],
                         ids=["noise", "pole", "texel", "sun"])  # fmt: skip
def test_importance_sampling_gives_the_integral(light: Environment) -> None:
    light = light.rotated(10, 20, 30)
    directions, pdf = light.sampler().sample(samples())
    ratio = light.radiance(directions) / pdf[:, None]
    error = ratio.std(0) / len(ratio) ** 0.5
    assert ((ratio.mean(0) - light.integral()).abs() < 4 * error + 1e-4 * light.integral()).all()
    assert (error / light.integral() < 5e-3).all()


def test_pdf_is_positive_wherever_light_comes_from() -> None:
    light = one_texel(32, 7)
    d = random_directions(200_000)
    bright = light.radiance(d)[:, 0] > 0
    assert bright.any()
    assert (light.sampler().pdf(d)[bright] > 0).all()
    assert (light.sampler().sample(samples(10_000))[1] > 0).all()


def test_black_maps_are_sampled_uniformly() -> None:
    sampler = Environment(torch.zeros(8, 16, 3)).sampler()
    directions, pdf = sampler.sample(samples())
    assert torch.allclose(pdf, torch.tensor(1 / (4 * pi)))
    assert directions.mean(0).abs().max() < 0.01


def test_corners_of_the_unit_square_and_beyond() -> None:
    light = one_texel(32, 7)
    edge = torch.tensor([[0.0, 0.0], [1 - 2.0**-53, 1 - 2.0**-53], [0.0, 1 - 2.0**-53]], dtype=torch.float64)
    directions, pdf = light.sampler().sample(edge)
    assert directions.isfinite().all()
    assert (pdf > 0).all()
    for bad in (torch.tensor([[1.0, 0.5]]), torch.tensor([[-0.1, 0.5]]), torch.rand(3), torch.rand(3, 3)):
        with pytest.raises(ValueError, match=r"u must be \(n, 2\)"):
            light.sampler().sample(bad)


def test_lights_add_up() -> None:
    a = Environment.area_light((0, 1, 0), 20.0, 3.0)
    b = Environment.area_light((1, 0, 0), 10.0, (1.0, 2.0, 4.0))
    torch.testing.assert_close((a + b).integral(), a.integral() + b.integral())
    both = (a + b).rotated(y=30)
    d = torch.rand(50, 3) - torch.tensor([0.3, 0.1, 0.7])
    torch.testing.assert_close(both.radiance(d), a.rotated(y=30).radiance(d) + b.rotated(y=30).radiance(d))


def test_sums_of_lights_of_any_size_turn_and_factor() -> None:
    """A sum is linear in every respect; as one map it is resampled, in the frame of the first: a hundredth, if smooth.

    The sampler, which is made of that map, is positive wherever light comes from.
    """
    a = smooth(24).rotated(x=20)
    b = Environment.area_light((1, 0, 0), 40.0, (1.0, 2.0, 4.0)).rotated(y=30, z=-70)
    both = (a.scaled((2.0, 1.0, 0.5)) + b).rotated(x=10).scaled(3.0)
    d = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    factor = torch.tensor([6.0, 3.0, 1.5])
    one = a.rotated(x=10)
    other = b.rotated(x=10)
    torch.testing.assert_close(both.radiance(d), factor * one.radiance(d) + 3 * other.radiance(d))
    torch.testing.assert_close(both.project(Cube(4)), factor * one.project(Cube(4)) + 3 * other.project(Cube(4)))
    torch.testing.assert_close(both.integral(), factor * one.integral() + 3 * other.integral())
    assert both.map.shape == b.map.shape and torch.equal(both.rotation, one.rotation)
    resampled = Environment(both.map, both.rotation)
    error = (resampled.radiance(d) - both.radiance(d)).abs().mean(0) / both.radiance(d).mean(0)
    assert bool((error < 0.01).all())
    assert bool((both.sampler().pdf(d)[both.radiance(d).sum(1) > 0] > 0).all())


def test_factors_carry_gradients_and_stay_finite() -> None:
    factor = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    light = noise()
    light.scaled(factor).integral().sum().backward()
    assert factor.grad is not None
    torch.testing.assert_close(factor.grad, light.integral())
    with pytest.raises(ValueError, match="radiance must stay within 1e"):
        light.scaled(1e20).scaled(1e11)
