"""A BRDF space in a few functions: exact where it can be, honest where it cannot."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from torch import Tensor

import ptt
from ptt import BRDFBasis, BRDFSpace
from ptt.models.brdf_basis import principal
from ptt.ops.albedo import albedo

Shape = ptt.materials.shapes.Shape
EXPONENTS = (1.0, 3.0, 8.0, 16.0, 32.0)
SPACE = BRDFSpace.blinn_phong(EXPONENTS)
NARROW = BRDFSpace.blinn_phong((4.0, 30.0, 200.0, 1000.0))
WARD = BRDFSpace.ward((0.3, 0.5, 0.9), anisotropic=True)


def brushed(ax: float, ay: float) -> ptt.Material:
    """Bounded, unlike Ward's, whose square few directions do not settle on, and turned by 20 degrees."""
    c = math.cos(math.radians(20))
    s = math.sin(math.radians(20))

    def evaluate(wi: Tensor, wo: Tensor) -> Tensor:
        x, y, _ = torch.nn.functional.normalize(wi + wo, dim=-1, eps=1e-9).unbind(-1)
        return torch.exp(-(((c * x + s * y) / ax) ** 2) - ((c * y - s * x) / ay) ** 2)

    return ptt.Material(0.0, 1.0, ptt.Named("", evaluate, isotropic=False))


ANISOTROPIC = BRDFSpace.user({f"{x}, {y}": brushed(x, y) for x in (0.2, 0.4, 0.8) for y in (0.2, 0.4, 0.8)})


def cosine_directions(n: int, seed: int) -> Tensor:
    """Distributed by projected solid angle, the measure of the basis: means over them times pi are integrals."""
    u = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    r = u[:, 0].sqrt()
    phi = 2 * math.pi * u[:, 1]
    return torch.stack((r * phi.cos(), r * phi.sin(), (1 - u[:, 0]).clamp(min=1e-12).sqrt()), 1)


WI = cosine_directions(100_000, 0)
WO = cosine_directions(100_000, 1)


def missed(basis: BRDFBasis, shape: Shape) -> float:
    """Point by point, not blurred."""
    exact = shape.evaluate(WI, WO)
    specular = basis.evaluate(WI, WO)[:, 1:]
    return float((specular @ basis.of_shape(shape).to(specular) - exact).norm() / exact.norm())


def cells(fine: int) -> tuple[Tensor, Tensor]:
    """Incident directions (c, fine^2, 3) inside of every cell, and their solid angles (c, fine^2)."""
    width = math.pi / 16
    inside = (torch.arange(fine).double() + 0.5) / fine
    wi = []
    weights = []
    for band in range(8):
        arcs = round(2 * math.pi * math.sin((band + 0.5) * width) / width)
        for arc in range(arcs):
            theta, phi = torch.cartesian_prod(width * (band + inside), 2 * math.pi / arcs * (arc + inside)).T
            wi.append(torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()), 1))
            weights.append(theta.sin() * (width / fine) * (2 * math.pi / arcs / fine))
    return torch.stack(wi), torch.stack(weights)


CELLS, SOLID = cells(8)
SPREAD = (torch.arange(180).double() + 0.5) / 180
OUTGOING = torch.stack(
    (SPREAD.sqrt() * (SPREAD * 180 * 2.4).cos(), SPREAD.sqrt() * (SPREAD * 180 * 2.4).sin(), (1 - SPREAD).sqrt()), 1
)


def blurred(f: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Of f (..., k): what every cell reflects, and the albedo, for directions spread over the outgoing hemisphere,
    (k, m), such that dot products are the basis's."""
    rows = []
    for wo in OUTGOING:
        reflected = (f(CELLS, wo) * (SOLID * CELLS[..., 2])[..., None]).sum(1)
        whole = reflected.sum(0, keepdim=True)
        rows.append(torch.cat((reflected / SOLID.sum(1, keepdim=True).sqrt(), 4 * whole / math.sqrt(math.pi))))
    return torch.stack(rows).flatten(0, 1).T * math.sqrt(math.pi / len(OUTGOING))


def of(*shapes: Shape) -> Tensor:
    return blurred(lambda wi, wo: torch.stack([s.evaluate(wi, wo.expand_as(wi)) for s in shapes], -1))


def blurred_errors(basis: BRDFBasis, table: Tensor, *shapes: Shape) -> Tensor:
    exact = of(*shapes)
    functions = blurred(lambda wi, wo: basis.evaluate(wi, wo)[..., 1:])
    errors: Tensor = (table.double() @ functions - exact).norm(dim=1) / exact.norm(dim=1)
    return errors


@pytest.mark.parametrize("space", [SPACE, WARD, BRDFSpace.ggx((0.4, 0.6, 1.0)), BRDFSpace.ward((0.3, 0.8))],
                         ids=["blinn-phong", "ward-anisotropic", "ggx", "ward"])  # fmt: skip
def test_as_many_functions_as_samples_reproduce_them(space: BRDFSpace) -> None:
    basis = BRDFBasis.fit(space, len(space.samples))
    assert float(basis.error.max()) < 1e-5
    for shape in space.samples:
        assert missed(basis, shape) < 1e-4
    material = ptt.Material((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), space.samples[1])
    value = basis.evaluate(WI, WO) @ basis.coefficients(material).double()
    assert torch.allclose(value, material.evaluate(WI, WO), rtol=1e-3, atol=1e-4)


def test_evaluate_broadcasts_and_is_zero_below_the_horizon() -> None:
    basis = BRDFBasis.fit(SPACE, 2)
    grid = basis.evaluate(WI[:5], WO[:4, None])
    assert grid.shape == (4, 5, 3)
    assert torch.allclose(grid[2, 3], basis.evaluate(WI[3], WO[2]))
    assert torch.allclose(grid[..., 0], torch.full((4, 5), 1 / math.pi).double())
    below = WI[:4] * torch.tensor([1.0, 1.0, -1.0])
    assert float(basis.evaluate(below, WO[:4]).abs().max()) == 0


SPACES = pytest.mark.parametrize("space", [SPACE, NARROW, ANISOTROPIC], ids=["wide", "narrow", "anisotropic"])


@SPACES
def test_the_functions_are_orthonormal(space: BRDFSpace) -> None:
    """In the basis's norm, estimated by other directions."""
    basis = BRDFBasis.fit(space, 3)
    functions = blurred(lambda wi, wo: basis.evaluate(wi, wo)[..., 1:])
    assert torch.allclose(functions @ functions.T, torch.eye(3).double(), atol=0.02)


def test_more_functions_miss_less() -> None:
    errors = [BRDFBasis.fit(SPACE, n).error.norm() for n in (1, 2, 3, 4)]
    assert all(b < 0.7 * a for a, b in pairwise(errors))


@SPACES
def test_the_stated_error_is_the_error_at_other_directions(space: BRDFSpace) -> None:
    basis = BRDFBasis.fit(space, 2)
    errors = blurred_errors(basis, basis.table, *space.samples)
    assert errors.tolist() == pytest.approx(basis.error.tolist(), rel=0.05, abs=1e-3)


def test_lobes_narrower_than_a_cell_look_alike() -> None:
    """All they reflect comes from a few cells; point by point, one function would miss 0.46 of exponents 1 : 10."""
    assert float(BRDFBasis.fit(BRDFSpace.blinn_phong((2e4, 2e5)), 1).error.max()) < 0.1


def test_a_lambertian_function_has_its_exact_norm() -> None:
    """pi of outgoing directions, an albedo of 1 that counts 4^2 / pi, and cells: a band from c to d in the cosine
    reflects c^2 - d^2, of a solid angle of 2 pi (c - d)."""
    bands = pairwise(math.cos(k * math.pi / 16) for k in range(9))
    norm = math.sqrt(16 + sum((c - d) * (c + d) ** 2 / 2 for c, d in bands))
    basis = BRDFBasis.fit(BRDFSpace.user({"a": ptt.ops.brdf.lambert}), 1)
    assert abs(float(basis.mixture)) == pytest.approx(1 / norm, rel=1e-4)


def test_what_four_functions_leave_of_the_fitted_materials() -> None:
    error = BRDFBasis.fit(BRDFSpace.fitted()).error
    assert 0.08 < float(error.median()) < 0.11
    assert 0.2 < float(error.max()) < 0.3


def test_four_functions_keep_the_albedo_of_the_fitted_materials() -> None:
    """By direction, root mean square over projected solid angle; means by the cosine alone would miss 0.28 and 1.15."""
    basis = BRDFBasis.fit(BRDFSpace.fitted())
    cos = ((torch.arange(12).double() + 0.5) / 12).sqrt()
    wo = torch.stack(((1 - cos * cos).sqrt(), 0 * cos, cos), 1)

    def albedos(f: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        return albedo(f, wo, finest=1e-4, rings=96, turns=32)

    exact = albedos(lambda i, o: torch.stack([shape.evaluate(i, o) for shape in basis.space.samples]))
    functions = albedos(lambda i, o: basis.evaluate(i, o).movedim(-1, 0))
    coefficients = [basis.coefficients(ptt.Material(0.0, 1.0, shape))[:, 0] for shape in basis.space.samples]
    error = (torch.stack(coefficients).double() @ functions - exact).norm(dim=1) / exact.norm(dim=1)
    assert len(error) == 86
    assert float(error.median()) < 0.075 and float(error.max()) < 0.18


def test_two_functions_are_the_best_of_rank_two() -> None:
    """The functions are principal components of samples of norm 1: the sum of squared errors is the sum of the
    remaining eigenvalues of their cosines, estimated here at other directions."""
    unit = torch.nn.functional.normalize(of(*NARROW.samples), dim=1)
    remaining = torch.linalg.eigvalsh(unit @ unit.T)[:-2].sum()
    assert float(BRDFBasis.fit(NARROW, 2).error.square().sum()) == pytest.approx(float(remaining), rel=0.05)


def test_a_diffuse_material_is_the_first_coefficient() -> None:
    basis = BRDFBasis.fit(SPACE, 3)
    coefficients = basis.coefficients(ptt.lambert((0.1, 0.2, 0.3)))
    assert coefficients.shape == (4, 3)
    assert coefficients[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert float(coefficients[1:].abs().max()) == 0


def test_coefficients_are_linear_in_the_weights() -> None:
    basis = BRDFBasis.fit(SPACE, 3)
    shape = ptt.BlinnPhong(5.0)
    one, two = (basis.coefficients(ptt.Material(0.0, s, shape)) for s in ((0.1, 0.2, 0.4), (0.3, 0.5, 0.0)))
    both = basis.coefficients(ptt.Material(0.25, (0.4, 0.7, 0.4), shape))
    assert torch.allclose(both[1:], (one + two)[1:]) and torch.allclose(both[0], torch.full((3,), 0.25))
    assert torch.allclose(basis.of_shape(ptt.BlinnPhong(5.5)), (basis.table[1] + basis.table[2]) / 2)
    blend = ptt.Blend((shape, ptt.BlinnPhong(20.0)), (0.5, 2.0))
    assert torch.allclose(
        basis.of_shape(blend), 0.5 * basis.of_shape(shape) + 2 * basis.of_shape(ptt.BlinnPhong(20.0)), atol=1e-6
    )


def test_gradients_reach_the_exponent_and_the_weights() -> None:
    """Linear between samples: the slope is the difference of their rows over that of their exponents."""
    basis = BRDFBasis.fit(SPACE, 3)
    exponent = torch.tensor(5.0, requires_grad=True)
    specular = torch.tensor([0.2, 0.3, 0.4], requires_grad=True)
    basis.coefficients(ptt.Material(0.0, specular, ptt.BlinnPhong(exponent)))[1, 0].backward()
    slope = float(basis.table[2, 0] - basis.table[1, 0]) / 5 * 0.2
    assert exponent.grad is not None and float(exponent.grad) == pytest.approx(slope, rel=1e-4)
    assert specular.grad is not None
    assert specular.grad.tolist() == pytest.approx([float(basis.of_shape(ptt.BlinnPhong(5.0))[0]), 0, 0])


def test_identical_functions_stay_finite() -> None:
    """Rank two of three: the third function is zero, and nothing is missed."""
    f = ptt.BlinnPhong(5.0).evaluate
    space = BRDFSpace.user({"a": f, "b": f, "c": ptt.BlinnPhong(30.0).evaluate})
    basis = BRDFBasis.fit(space, 3)
    assert all(bool(torch.isfinite(buffer).all()) for buffer in basis.buffers())
    assert float(basis.error.max()) < 1e-5
    assert torch.allclose(basis.table[0], basis.table[1], atol=1e-6)
    assert basis.evaluate(WI, WO)[:, 3].abs().max() < 1e-6
    assert missed(basis, space.samples[2]) < 1e-4


def test_a_black_function_has_no_coefficients() -> None:
    space = BRDFSpace.user({"black": lambda i, o: 0 * i[..., 2] * o[..., 2], "a": ptt.BlinnPhong(5.0).evaluate})
    basis = BRDFBasis.fit(space, 2)
    assert all(bool(torch.isfinite(buffer).all()) for buffer in basis.buffers())
    assert float(basis.table[0].abs().max()) == 0 and float(basis.error.max()) < 1e-5


@pytest.mark.parametrize("functions", [0, -1, len(EXPONENTS) + 1])
def test_counts_refused(functions: int) -> None:
    with pytest.raises(ValueError, match=rf"functions must be in 1..5, the samples, got {functions}"):
        BRDFBasis.fit(SPACE, functions)


def test_with_brdf_adds_a_row_and_keeps_the_functions() -> None:
    basis = BRDFBasis.fit(SPACE, 3)
    grown = basis.with_brdf("mine", ptt.GGX(1.0, 0.6).evaluate)
    assert torch.equal(grown.mixture[:-1], basis.mixture) and float(grown.mixture[-1].abs().max()) == 0
    assert torch.equal(grown.table[:-1], basis.table) and torch.equal(grown.error[:-1], basis.error)
    assert len(grown.table) == len(grown.error) == len(grown.space.samples) == 6
    assert torch.allclose(grown.evaluate(WI[:9], WO[:9]), basis.evaluate(WI[:9], WO[:9]))
    error = blurred_errors(grown, grown.table[-1:], grown.space.samples[-1])
    assert float(error) == pytest.approx(float(grown.error[-1]), rel=0.05)


def test_with_brdf_finds_what_the_functions_already_show() -> None:
    """A sample of the space under another name, where rounding has its hand in the weakest of many functions."""
    basis = BRDFBasis.fit(BRDFSpace.blinn_phong(), 20)
    grown = basis.with_brdf("again", ptt.BlinnPhong(ptt.materials.spaces.EXPONENTS[20]).evaluate)
    assert float(basis.error.max()) < 1e-5 and float(grown.error[-1]) < 1e-5


def test_with_an_anisotropic_brdf() -> None:
    grown = BRDFBasis.fit(SPACE, 3).with_brdf("brushed", brushed(0.3, 0.6))
    assert not grown.space.isotropic
    error = blurred_errors(grown, grown.table[-1:], grown.space.samples[-1])
    assert float(error) == pytest.approx(float(grown.error[-1]), rel=0.05)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_units_do_not_matter(scale: float) -> None:
    """Coefficients times functions scale with the samples; the errors stay."""
    lobes = {name: ptt.BlinnPhong(n) for name, n in (("a", 2.0), ("b", 9.0), ("c", 30.0))}

    def times(s: float) -> BRDFBasis:
        scaled = {k: lambda i, o, lobe=lobe: lobe.evaluate(i, o) * s for k, lobe in lobes.items()}
        return BRDFBasis.fit(BRDFSpace.user(scaled), 2)

    plain = times(1.0)
    basis = times(scale)
    assert basis.error.tolist() == pytest.approx(plain.error.tolist(), rel=1e-4)
    product = basis.evaluate(WI, WO)[:, 1:] @ (basis.table.double() / scale).T
    assert torch.allclose(product, plain.evaluate(WI, WO)[:, 1:] @ plain.table.double().T, rtol=1e-3, atol=1e-4)


def test_principal_components_are_sorted_and_orthonormal() -> None:
    root = torch.rand(6, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    size, vectors = principal(root @ root.T, 5)
    assert bool((size[:-1] >= size[1:]).all()) and float(size[4]) == pytest.approx(0, abs=1e-12)
    assert torch.allclose(vectors.T @ vectors, torch.eye(5).double())
    assert torch.allclose(vectors * size @ vectors.T, root @ root.T)


def test_a_space_of_few_samples_has_a_function_for_each() -> None:
    assert BRDFBasis.fit(BRDFSpace.blinn_phong((4.0, 20.0))).table.shape == (2, 2)
    assert BRDFBasis.fit(BRDFSpace.blinn_phong()).table.shape[1] == 4
