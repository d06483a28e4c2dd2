"""Tables as functions, and RGB data as colours around one shape."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

import ptt
from ptt.materials.material import Highlight
from ptt.ops.albedo import albedo
from ptt.ops.sphere import Disk

KD = torch.tensor([0.3, 0.1, 0.05]).double()
KS = torch.tensor([0.2, 0.6, 0.4]).double()
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def cosine_directions(n: int, seed: int, most: float = 1.0) -> Tensor:
    """Distributed by projected solid angle, up to a sine of `most`."""
    u = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    r = u[:, 0].sqrt() * most
    phi = 2 * math.pi * u[:, 1]
    return torch.stack((r * phi.cos(), r * phi.sin(), (1 - r * r).clamp(min=1e-12).sqrt()), 1)


def table_of(f: Callable[[Tensor, Tensor], Tensor], n: int) -> Tensor:
    d = Disk(n).directions().reshape(-1, 3)
    d = torch.nn.functional.normalize(d + UP * 1e-9, dim=1)
    return f(d[None], d[:, None].expand(-1, n * n, -1)).reshape(n, n, n, n)


def lopsided(wi: Tensor, wo: Tensor) -> Tensor:
    """Tells wi from wo, rows from columns, and both signs."""
    return 2 + wi[..., 0] - 0.5 * wi[..., 1] + 0.25 * wo[..., 0] + 0.1 * wo[..., 1] + 0.2 * wi[..., 0] * wo[..., 1]


def test_a_smooth_brdf_is_reproduced() -> None:
    """In L2 by projected solid angle, 24 cells across, an exponent of 5: 1 % up to 64 degrees, 4 % with the rim, where
    the cells that the circle cuts hold the value of a point inside."""
    shape = ptt.BlinnPhong(5.0)
    f = ptt.tabulated(table_of(shape.evaluate, 24))
    for most, bound in ((0.9, 0.015), (1.0, 0.06)):
        wi = cosine_directions(20_000, 0, most)
        wo = cosine_directions(20_000, 1, most)
        exact = shape.evaluate(wi, wo)
        assert 1e-4 < float((f(wi, wo) - exact).norm() / exact.norm()) < bound
    assert f(wi.float(), wo.float()).dtype == torch.float32


def test_bilinear_in_the_disk_is_exact_and_the_axes_are_as_stated() -> None:
    """Away from the rim, a function that is bilinear in x and y of each direction is its own interpolant."""
    f = ptt.tabulated(table_of(lopsided, 12))
    wi = cosine_directions(500, 2, 0.8)
    wo = cosine_directions(500, 3, 0.8)
    assert torch.allclose(f(wi, wo), lopsided(wi, wo), atol=1e-12)
    assert torch.allclose(f(wi[:, None], wo[:40]), lopsided(wi[:, None], wo[:40]), atol=1e-12)


def test_cells_outside_are_not_read_and_below_the_horizon_is_zero() -> None:
    table = torch.ones(9, 9, 9, 9)
    table[0, 0] = table[:, :, 8, 8] = math.nan
    f = ptt.tabulated(table)
    grazing = torch.tensor([[math.sqrt(0.5 - 1e-6)] * 2 + [1e-3], [-math.sqrt(0.5 - 1e-6)] * 2 + [1e-3]])
    assert f(grazing, grazing.flip(0)).tolist() == pytest.approx([1, 1])
    up = torch.tensor([0.0, 0.6, 0.8])
    down = torch.tensor([0.0, 0.6, -0.8])
    assert f(up, up) == 1
    assert [float(f(i, o)) for i, o in ((up, down), (down, up), (down, down))] == [0, 0, 0]


@pytest.mark.parametrize(("values", "message"), [
    (torch.ones(4, 4, 4), r"values must be \(n, n, n, n\), got \(4, 4, 4\)"),
    (torch.ones(4, 4, 4, 5), r"got \(4, 4, 4, 5\)"),
    (torch.ones(0, 0, 0, 0), r"got \(0, 0, 0, 0\)"),
    (-torch.ones(4, 4, 4, 4), "finite and >= 0 inside"),
    (torch.full((4, 4, 4, 4), math.nan), "finite and >= 0 inside"),
])  # fmt: skip
def test_tables_refused(values: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ptt.tabulated(values)


def test_separate_recovers_colours_and_shape() -> None:
    """kd / pi + ks s with s almost zero at most pairs, so that the 2 % quantile is kd / pi. The shape that comes back
    has albedo 1 at normal incidence: s over its own, which `specular` takes up."""
    lobe = ptt.BlinnPhong(200.0)
    truth = ptt.Material(KD, KS, lobe)
    got = ptt.separate("mine", truth.evaluate)
    assert isinstance(got.shape, ptt.Named) and got.shape.name == "mine" and got.shape.isotropic
    size = float(albedo(lobe.evaluate, UP))
    assert got.diffuse.tolist() == pytest.approx(KD.tolist(), rel=0.03)
    assert got.specular.tolist() == pytest.approx((KS * size).tolist(), rel=0.03)
    assert float(albedo(got.shape.evaluate, UP)) == pytest.approx(1, rel=1e-6)
    wi = cosine_directions(20_000, 4)
    wo = cosine_directions(20_000, 5)
    exact = lobe.evaluate(wi, wo) / size
    assert float((got.shape.evaluate(wi, wo) - exact).norm() / exact.norm()) < 0.03
    assert torch.allclose(got.evaluate(wi, wo), truth.evaluate(wi, wo), rtol=0.03, atol=1e-3)
    turned = ptt.separate("mine", truth.evaluate, isotropic=False).shape
    assert turned is not None and not turned.isotropic


RED, GREEN, BLUE = torch.eye(3).double()


def of_colours(*parts: tuple[Tensor, float]) -> Callable[[Tensor, Tensor], Tensor]:
    """Blinn-Phong lobes of some colours (3,) and exponents, over a diffuse part."""
    return ptt.Material(KD, 0.0, None, *(Highlight(colour, ptt.BlinnPhong(n)) for colour, n in parts)).evaluate


def test_separate_takes_the_colour_of_the_largest_part() -> None:
    """Two lobes of disjoint colours, and an error that allows for one: the brighter decides."""
    f = of_colours((RED * 0.2, 20.0), (BLUE, 400.0))
    got = ptt.separate("two", f, error=0.2)
    assert len(got.highlights) == 1 and 0 < float(got.specular[0]) < 0.1 * float(got.specular[2])
    assert float(got.specular[2]) == pytest.approx(float(albedo(ptt.BlinnPhong(400.0).evaluate, UP)), rel=0.1)
    assert 0.05 < ptt.separation_error(got, f) < 0.2


@pytest.mark.parametrize("parts", [
    ((RED + 0.1 * BLUE, 60.0), (0.5 * BLUE + 0.2 * GREEN, 400.0)),
    ((0.3 * RED + 0.3, 8.0), (torch.ones(3).double(), 1000.0)),
    ((RED, 30.0), (GREEN, 100.0), (BLUE, 400.0)),
], ids=["of two hues", "tinted gloss, white highlight", "of three hues"])  # fmt: skip
def test_separate_takes_as_many_colours_as_the_error_asks_for(parts: tuple[tuple[Tensor, float], ...]) -> None:
    """Shapes of a few colours come back with an error of 2 % where one colour leaves 10 and more."""
    f = of_colours(*parts)
    found = {count: ptt.separate("mine", f, error=error) for error, count in ((10.0, 1), (0.02, len(parts)))}
    for count, got in found.items():
        assert [h.shape.name for h in got.highlights] == ["mine", "mine/2", "mine/3"][:count]  # type: ignore[union-attr]
        for highlight in got.highlights:
            out = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 0.75**0.5], [0.75**0.5, 0.0, 0.5]]).double()
            assert float(albedo(highlight.shape.evaluate, out).max()) == pytest.approx(1, rel=1e-6)
    errors = {count: ptt.separation_error(got, f) for count, got in found.items()}
    assert errors[1] > 0.1 and errors[len(parts)] < 0.02
    wi, wo = cosine_directions(20_000, 4), cosine_directions(20_000, 5)
    exact = f(wi, wo)
    assert float((found[len(parts)].evaluate(wi, wo) - exact).abs().sum() / exact.sum()) < 0.03


def test_the_error_is_misplaced_light_over_all_light() -> None:
    f = ptt.lambert((0.2, 0.1, 0.3)).evaluate
    assert ptt.separation_error(ptt.lambert((0.2, 0.1, 0.3)), f) == pytest.approx(0, abs=1e-6)
    assert ptt.separation_error(ptt.lambert((0.1, 0.2, 0.3)), f) == pytest.approx(0.2 / 0.6, rel=1e-5)
    moved = ptt.Material(0.0, 0.3, ptt.BlinnPhong(100.0)), ptt.Material(0.0, 0.3, ptt.BlinnPhong(1.0))
    assert ptt.separation_error(moved[0], moved[1].evaluate) > 1
    brushed = ptt.ward(0.0, 0.3, 0.1, 0.4)
    turned = ptt.ward(0.0, 0.3, 0.4, 0.1)
    assert ptt.separation_error(brushed, turned.evaluate, isotropic=False) > 0.5


def rough(wi: Tensor, wo: Tensor) -> Tensor:
    """Lambert, but for rounding that depends on the direction."""
    rounded: Tensor = wi.float().norm(dim=-1) * wo.float().norm(dim=-1)
    return ptt.lambert(KD).evaluate(wi, wo) * rounded[..., None]


@pytest.mark.parametrize("f", [ptt.lambert(KD).evaluate, rough, ptt.lambert(0.0).evaluate], ids=["kd", "rounded", "0"])
def test_a_diffuse_one_has_no_shape(f: Callable[[Tensor, Tensor], Tensor]) -> None:
    got = ptt.separate("matt", f)
    assert got.shape is None and float(got.specular.sum()) == 0
    up = UP.expand(1, 3)
    assert got.diffuse.tolist() == pytest.approx((f(up, up)[0] * math.pi).tolist(), rel=1e-5)


@pytest.mark.parametrize("f", [
    lambda i, o: (i * o).sum(-1),
    lambda i, o: torch.full_like(i, math.nan),
    lambda i, o: torch.ones(*i.shape[:-1], 4),
], ids=["grey", "nan", "four"])  # fmt: skip
def test_separate_refuses(f: Callable[[Tensor, Tensor], Tensor]) -> None:
    with pytest.raises(ValueError, match="the BRDF 'bad' must return finite RGB"):
        ptt.separate("bad", f)


def test_a_negative_error_is_refused() -> None:
    with pytest.raises(ValueError, match="error must be >= 0"):
        ptt.separate("mine", ptt.lambert(KD).evaluate, error=-0.1)


@pytest.mark.parametrize("name", ["gold-metallic-paint", "red-phenolic", "chrome-steel", "color-changing-paint1"])
def test_measured_materials(data_dir: Path, name: str) -> None:
    """Within the error; finite and >= 0; away from the highlight (half vectors from 30 degrees) within a fifth."""
    path = data_dir / "brdf" / "merl_nbrdf.npz"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    data = ptt.NeuralBRDF.load(path, name)
    got = ptt.separate(name, data.evaluate)
    assert ptt.separation_error(got, data.evaluate) <= 0.05
    wi = cosine_directions(20_000, 6, 0.9)
    wo = cosine_directions(20_000, 7, 0.9)
    value = got.evaluate(wi, wo)
    assert bool(torch.isfinite(value).all()) and bool((value >= 0).all())
    off = torch.nn.functional.normalize(wi + wo, dim=1)[:, 2] < math.cos(math.radians(30))
    mean = value[off].mean(0)
    exact = data.evaluate(wi, wo)[off].double().mean(0)
    assert bool(((mean - exact).abs() <= 0.2 * exact + 2e-3).all()), (mean, exact)
    peak = UP.expand(1, 3)
    assert float(got.evaluate(peak, peak).mean()) == pytest.approx(float(data.evaluate(peak, peak).mean()), rel=0.2)
