"""Under the transforms of torch.func: what stands for what, tables made outside, and lookups of batches."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, jvp, vmap

from ptt.ops import latlong, rotation
from ptt.ops.octahedral import HemiOctahedral, Octahedral, mix
from ptt.ops.transforms import active, beneath, differentiated, is_batch, outside, stands_in

X = torch.arange(6.0).reshape(2, 3)
pytestmark = pytest.mark.filterwarnings("error:There is a performance drop")


def told(x: Tensor) -> tuple[bool, ...]:
    return active(), stands_in(x), is_batch(x), differentiated(x)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (lambda f: f(X), (False, False, False, False)),
        (lambda f: f(X.clone().requires_grad_()), (False, False, False, True)),
        (lambda f: vmap(f)(X), (True, True, True, False)),
        (lambda f: grad(lambda x: f(x).sum())(X), (True, True, False, True)),
        (lambda f: jvp(f, (X,), (X,)), (True, True, False, True)),
        (lambda f: vmap(grad(lambda x: f(x).sum()))(X), (True, True, True, True)),
    ],
    ids=["none", "autograd", "vmap", "grad", "jvp", "vmap of grad"],
)
def test_what_tensors_stand_for(
    transform: Callable[[Callable[[Tensor], Tensor]], object], expected: tuple[bool, ...]
) -> None:
    """Beneath is what was given, with data; and what is made outside has data, whatever is on."""
    found = []

    def function(x: Tensor) -> Tensor:
        found.append((told(x), beneath(x).tolist(), outside(lambda n: torch.ones(n).numpy().sum(), 3)))
        assert active() == expected[0]
        return x * 2

    transform(function)
    assert found == [(expected, X.tolist(), 3.0)]
    assert told(X) == (False,) * 4


def test_dual_numbers_and_what_is_not_recorded() -> None:
    with forward_ad.dual_level():
        assert told(forward_ad.make_dual(X, X)) == (True, True, False, True)
        assert told(X) == (True, False, False, False)
    with torch.no_grad():
        assert not differentiated(X.clone().requires_grad_())


def test_lookups_of_batches() -> None:
    """Against a loop over tables, over weights, and over both, and autograd; between texels; and by S."""
    random = torch.Generator().manual_seed(0)
    tables = torch.rand(4, 16, 3, generator=random, dtype=torch.float64)
    index = torch.randint(0, 16, (7, 4), generator=random)
    weights = torch.rand(4, 7, 4, generator=random, dtype=torch.float64)

    def function(table: Tensor, weight: Tensor) -> Tensor:
        return mix(table, index, weight)

    each = torch.stack([function(*pair) for pair in zip(tables, weights, strict=True)])
    torch.testing.assert_close(vmap(function)(tables, weights), each)
    torch.testing.assert_close(vmap(function, (0, None))(tables, weights[0])[0], each[0])
    torch.testing.assert_close(vmap(function, (None, 0))(tables[0], weights)[0], each[0])
    leaves = tables.clone().requires_grad_(), weights.clone().requires_grad_()
    sum(function(*pair).sin().sum() for pair in zip(*leaves, strict=True)).backward()  # type: ignore[union-attr]
    slopes = vmap(grad(lambda *pair: function(*pair).sin().sum(), (0, 1)))(tables, weights)
    for found, leaf in zip(slopes, leaves, strict=True):
        torch.testing.assert_close(found, leaf.grad)
    x, y = 10 * torch.rand(2, 50, generator=random, dtype=torch.float64) - 1  # beyond the edges, too
    images = tables.reshape(4, 8, 2, 3).repeat(1, 1, 4, 1)
    each = torch.stack([latlong.bilinear(image, x, y) for image in images])
    torch.testing.assert_close(vmap(lambda image: latlong.bilinear(image, x, y))(images), each)
    s = rotation.resampling(Octahedral(4), HemiOctahedral(2), torch.eye(3)[None])
    each = torch.stack([rotation.resample(table, s) for table in tables])
    torch.testing.assert_close(vmap(lambda table: rotation.resample(table, s))(tables), each)
