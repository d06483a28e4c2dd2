"""Shading by triple products: against a loop, and the kernel against the plain function."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ptt.ops import native, shade, table
from ptt.ops.near import Near
from ptt.ops.shade import Functions, RegionCoats, ShadedPoints

STORAGE = [torch.float32, torch.float16, torch.uint8]
Given = tuple[Functions, RegionCoats, ShadedPoints]


def scene(n: int, p: int = 37, k: int = 4, j: int = 4, i: int = 1, storage: torch.dtype = torch.float16) -> Given:
    g = torch.Generator().manual_seed(100 * k + 10 * j + i)

    def near(count: int, most: int) -> Near:
        weights = torch.rand(p, count, generator=g)
        return Near(torch.randint(most, (p, count), generator=g).int(), weights / weights.sum(1, keepdim=True))

    light, glossy = (table.stored(torch.rand(*s, n, generator=g), storage) for s in ((6, 3), (18,)))
    visibility = torch.randint(256, (7, n), generator=g).to(torch.uint8)
    functions = Functions(light, visibility, torch.rand(n, generator=g), glossy)
    specular = torch.rand(i, 3, 3, generator=g)
    specular[:, 2] = 0  # a dull region
    coats = RegionCoats(torch.rand(i, 3, 3, generator=g), specular, torch.randint(2, (i, 3), generator=g).int() * 9)
    region = torch.randint(3, (p,), generator=g).int()
    shares = torch.rand(i, p, 3, generator=g)
    shares[:, :2] = torch.tensor([[0.0], [1.0]])
    return (
        functions,
        coats,
        ShadedPoints(near(k, 6), near(j, 7), near(min(k, 4), 9), region, torch.rand(p, 3, generator=g), shares),
    )


def test_the_sum_written_out() -> None:
    functions, coats, at = scene(20, p=5, i=2)
    light = functions.light.to_dense()
    glossy = functions.glossy.to_dense()
    got = shade.shade(functions, coats, at)
    for p in range(5):
        r = int(at.region[p])
        shares = at.shares[:, p].tolist()
        for c in range(3):
            total = 0.0
            for t in range(20):
                lit = sum(float(at.light.weights[p, k] * light[at.light.rows[p, k], c, t]) for k in range(4))
                rows = zip(at.seen.weights[p], at.seen.rows[p], strict=True)
                seen = sum(float(w * functions.visibility[row, t]) / 255 for w, row in rows)
                f = 0.0
                for i in range(2):
                    rows = zip(at.view.weights[p], at.view.rows[p], strict=True)
                    mirrored = sum(float(w * glossy[coats.first[i, r] + row, t]) for w, row in rows)
                    dull = float(coats.diffuse[i, r, c] * at.colour[p, c] * functions.dull[t])
                    f += shares[i][c] * (dull + float(coats.specular[i, r, c]) * mirrored)
                total += lit * seen * f
            assert float(got[p, c]) == pytest.approx(total, rel=1e-5)  # 20 / n = 1


@pytest.mark.parametrize(("storage", "error"), [(torch.float32, 0.0), (torch.float16, 2**-11), (torch.uint8, 1 / 255)])
def test_stored(storage: torch.dtype, error: float) -> None:
    """Each row by its own scale, so that bright rows take nothing from dim ones; error: a unit in the last place."""
    values = torch.rand(5, 3, 40, generator=torch.Generator().manual_seed(0)) * torch.logspace(-3, 6, 5)[:, None, None]
    values[2] = 0
    kept = table.stored(values, storage)
    assert kept.values.dtype == storage and kept.scale.shape == (5,)
    assert kept.bytes == values.numel() * kept.values.element_size() + 5 * 4
    largest = values.amax((1, 2), keepdim=True)
    assert bool(((kept.to_dense() - values).abs() <= error * 0.5001 * largest).all())
    assert torch.equal(kept.at(torch.tensor([[3, 1]])), kept.to_dense()[[3, 1]][None])


def test_stored_keeps_what_has_gradients_or_more_digits() -> None:
    for values in (torch.rand(2, 3).requires_grad_(), torch.rand(2, 3).double()):
        assert table.stored(values, torch.uint8).values is values


@pytest.mark.parametrize("n", [20, 80, 320, 1280])
@pytest.mark.parametrize(("k", "j"), [(1, 1), (4, 1), (4, 3), (4, 4), (8, 1), (8, 3), (8, 4)])
@pytest.mark.parametrize("i", [1, 2, 3])
@pytest.mark.parametrize("storage", STORAGE, ids=str)
def test_kernel(
    n: int, k: int, j: int, i: int, storage: torch.dtype, built: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In 16 bits each of about ten roundings of a product errs by 2^-11 at most, and their mean by far less."""
    arguments = scene(n, 150, k, j, i, storage)
    wanted = shade.shade(*arguments)
    monkeypatch.setattr(shade, "shade", None)  # so that it cannot have been the plain one
    tolerance = 2e-5 if storage == torch.float32 else 4e-3
    torch.testing.assert_close(native.shade(*arguments), wanted, rtol=tolerance, atol=1e-6)


@pytest.mark.parametrize("storage", STORAGE, ids=str)
def test_no_sum_overflows(storage: torch.dtype, built: None) -> None:
    """All functions as large as they can be stored, and coats of weight a thousand: the answer is their product."""
    functions, _, at = scene(1280, 40, 4, 4, 2, storage)
    light, glossy = (table.stored(torch.full_like(x.to_dense(), 7e4), storage) for x in functions[::3])
    ones = torch.ones_like(functions.dull)
    full = Functions(light, torch.full_like(functions.visibility, 255), ones / torch.pi, glossy)
    coats = RegionCoats(torch.ones(2, 3, 3), torch.full((2, 3, 3), 1000.0), torch.zeros(2, 3, dtype=torch.int32))
    got = native.shade(full, coats, at._replace(shares=torch.full_like(at.shares, 0.5)))
    torch.testing.assert_close(got, torch.full_like(got, 20 * 7e4 * 7e4 * 1000), rtol=1e-2, atol=0)


def test_what_the_kernel_does_not_take_is_computed_plainly(built: None) -> None:
    functions, coats, at = scene(80)
    mixed = functions._replace(light=table.stored(functions.light.to_dense(), torch.float32))
    for arguments in (scene(80, k=2), (mixed, coats, at)):
        with native.refusals() as found:
            torch.testing.assert_close(native.shade(*arguments), shade.shade(*arguments))
        assert list(found) == ["shade"]
    colour = at.colour.clone().requires_grad_()
    native.shade(functions, coats, at._replace(colour=colour, shares=torch.ones_like(at.shares))).sum().backward()
    assert colour.grad is not None and bool((colour.grad > 0).all())
    assert native.shade(functions, coats, at.part(0, 0)).shape == (0, 3)


def test_gradients() -> None:
    """In float64, of light, weights and colours."""

    def shaded(light: Tensor, specular: Tensor, colour: Tensor) -> Tensor:
        f = functions._replace(light=functions.light._replace(values=light))
        return shade.shade(f, coats._replace(specular=specular), at._replace(colour=colour))

    functions, coats, at = scene(20, p=3, i=2, storage=torch.float32)
    double = [x.double() for x in (functions.light.values, coats.specular, at.colour)]
    functions = functions._replace(dull=functions.dull.double())
    assert torch.autograd.gradcheck(shaded, [x.requires_grad_() for x in double])
