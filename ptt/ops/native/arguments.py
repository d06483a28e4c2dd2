"""What kernels can take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from ctypes import c_void_p

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

KINDS = {torch.float32: 0, torch.float16: 1, torch.uint8: 2}  # of numbers in an `ops.table.Table`


def ready(*tensors: Tensor, types: Sequence[torch.dtype] = (torch.float32,)) -> bool:
    """Whether a kernel can read tensors: of one of these types, on the CPU, without derivatives."""
    if torch.compiler.is_compiling():
        return False
    recorded = torch.is_grad_enabled()
    for t in tensors:  # sixty a frame
        if t.dtype not in types or not t.is_cpu or (recorded and t.requires_grad) or unpack_dual(t)[1] is not None:
            return False
    return True


def address(t: Tensor | None) -> c_void_p:
    return c_void_p(None if t is None else t.data_ptr())


def side(cells: int) -> int:
    return math.isqrt(cells)


def square(cells: int) -> bool:
    return side(cells) ** 2 == cells > 0
