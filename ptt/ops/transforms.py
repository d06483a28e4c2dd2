"""What holds under the transforms of torch.func: grad, jvp, jacrev, jacfwd, vmap.

There a tensor may stand for one with a derivative, or for every sample of a batch. It has no data of its own, and means
nothing once the transform is over. Checks of values look at what lies `beneath`; tables that are kept are made
`outside`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch._C import _functorch
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack
from torch.autograd import forward_ad

from ptt.ops.compiling import inlined, uncompiled

T = TypeVar("T")


@inlined
def active() -> bool:
    """Tell whether a transform is on, or forward derivatives are; torch.compile has its own."""
    if torch.compiler.is_compiling():
        return False
    return _functorch.peek_interpreter_stack() is not None or forward_ad._current_level >= 0


@inlined
def stands_in(tensor: Tensor) -> bool:
    """Tell whether a tensor stands for another, or for another and a tangent."""
    return active() and (bool(_functorch.is_functorch_wrapped_tensor(tensor)) or _has_tangent(tensor))


@inlined
def differentiated(tensor: Tensor) -> bool:
    """Tell whether a derivative goes with a tensor, backward where gradients are recorded, or forward."""
    return (tensor.requires_grad and torch.is_grad_enabled()) or _has_tangent(tensor)


@inlined
def _has_tangent(tensor: Tensor) -> bool:
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(tensor).tangent is not None


@inlined
def is_batch(tensor: Tensor) -> bool:
    """Tell whether a tensor stands for all samples of a batch, maybe with derivatives."""
    while _functorch.is_functorch_wrapped_tensor(tensor):
        if _functorch.is_batchedtensor(tensor):
            return True
        tensor = _functorch.get_unwrapped(tensor)
    return False


def chosen(mask: Tensor, most: int) -> list[Tensor]:
    """Numbers (m,) of what a mask (n,) chooses, in parts of at most so many.

    Those of all, in one part, in a graph and for a batch of masks, where shapes do not follow from values.
    """
    if torch.compiler.is_compiling() or is_batch(mask):
        return [torch.arange(len(mask), device=mask.device)]
    return list(torch.nonzero(mask)[:, 0].split(most))


def beneath(tensor: Tensor) -> Tensor:
    """The tensor with data that one stands for: itself, or all samples of a batch, its axis anywhere."""
    while _functorch.is_functorch_wrapped_tensor(tensor):
        tensor = _functorch.get_unwrapped(tensor)
    return tensor


@uncompiled
def outside(function: Callable[..., T], *arguments: Any) -> T:
    """What a function gives outside of all transforms, of arguments that stand for themselves."""
    if _functorch.peek_interpreter_stack() is None:
        return function(*arguments)
    with temporarily_clear_interpreter_stack():
        return function(*arguments)
