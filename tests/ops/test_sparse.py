"""Sparse products: the product, its derivatives of first and second order, and those of torch.func."""

from __future__ import annotations

import torch
from torch.func import grad, jvp, vmap

from ptt.ops.sparse import product


def test_product_and_derivatives() -> None:
    random = torch.Generator().manual_seed(0)
    dense = torch.randn(5, 4, generator=random, dtype=torch.float64) * (torch.rand(5, 4, generator=random) > 0.5)
    matrix = dense.to_sparse_csr()
    x = torch.randn(4, 3, generator=random, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(product(matrix, x), dense @ x)
    assert torch.autograd.gradcheck(lambda y: product(matrix, y), x)
    assert torch.autograd.gradgradcheck(lambda y: product(matrix, y).sin(), x)
    value = x.detach()
    torch.testing.assert_close(grad(lambda y: product(matrix, y).sin().sum())(value), dense.T @ (dense @ value).cos())
    torch.testing.assert_close(jvp(lambda y: product(matrix, y), (value,), (value,))[1], dense @ value)
    batch = torch.randn(4, 3, 6, generator=random, dtype=torch.float64)
    each = torch.stack([dense @ batch[..., k] for k in range(6)])
    torch.testing.assert_close(vmap(lambda y: product(matrix, y), in_dims=2)(batch), each)
    torch.testing.assert_close(
        vmap(grad(lambda y: product(matrix, y).sin().sum()), in_dims=2)(batch), dense.T @ each.cos()
    )
