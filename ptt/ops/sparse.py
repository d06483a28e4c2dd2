"""Sparse matrices, and products of them that torch.func can differentiate, as torch's own cannot."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class _Held:
    """A sparse matrix that torch.func does not see: it would wrap it, which sparse CSR tensors do not support.

    transposed: says whether its transpose is meant
    """

    matrix: Tensor
    transposed: bool


class _Product(torch.autograd.Function):
    """matrix @ dense, differentiable in what is dense, any number of times, forwards and backwards."""

    @staticmethod
    def forward(dense: Tensor, held: _Held) -> Tensor:
        matrix = held.matrix.to(dense)
        return (matrix.transpose(0, 1) if held.transposed else matrix) @ dense

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, _Held], output: Tensor) -> None:
        ctx.held = inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _product(gradient, _Held(ctx.held.matrix, not ctx.held.transposed)), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, None], dense: Tensor, held: _Held) -> tuple[Tensor, int]:
        columns = dense.movedim(in_dims[0] or 0, -1)  # shape: (n, k, batch)
        return _product(columns.flatten(1), held).unflatten(1, columns.shape[1:]), 2

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        return _product(tangent, ctx.held)


def csr(starts: Tensor, columns: Tensor, values: Tensor, width: int) -> Tensor:
    """A sparse CSR matrix (rows, width): row r has the values (n,) starts[r]..starts[r + 1] - 1, in columns (n,)."""
    size = len(starts) - 1, width
    kind = torch.int32 if len(values) < 1 << 31 else torch.int64
    with torch.sparse.check_sparse_tensor_invariants(enable=False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(starts.to(kind), columns.to(kind), values, size=size)


def product(matrix: Tensor, dense: Tensor) -> Tensor:
    """A sparse matrix (m, n) times a dense one (n, k), in the type and on the device of that."""
    return _product(dense, _Held(matrix, False))


def _product(dense: Tensor, held: _Held) -> Tensor:
    result: Tensor = _Product.apply(dense, held)  # type: ignore[no-untyped-call]
    return result
