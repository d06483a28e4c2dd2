"""Conditions on what kernels read, said once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

STORED = {torch.float32: 0, torch.float16: 1, torch.uint8: 2, torch.bfloat16: 3}
"""The numbers that signatures.h gives to types of stored tables."""


def of_type(dtype: torch.dtype, *tensors: Tensor | None) -> bool:
    """Tell whether tensors are of a type; None is of every type."""
    for tensor in tensors:  # noqa: SIM110 (a generator would cost more than the sixty comparisons of a frame)
        if tensor is not None and tensor.dtype != dtype:
            return False
    return True


def contiguous(*tensors: Tensor | None) -> bool:
    """Tell whether a kernel can read tensors in place; those that are small are copied instead of asked."""
    for tensor in tensors:  # noqa: SIM110
        if tensor is not None and not tensor.is_contiguous():
            return False
    return True


def side(cells: int) -> int:
    """The cells along the edge of a square of cells."""
    return math.isqrt(cells)


def square(cells: int) -> bool:
    """Tell whether so many cells fill a square."""
    return side(cells) ** 2 == cells > 0
