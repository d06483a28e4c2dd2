"""Marks by which a tensor that was written to is told from what it was."""

from __future__ import annotations

from torch import Tensor

SAMPLED = 4096  # values that are looked at, 20 us of a frame


def version(tensor: Tensor) -> int:
    """How often torch wrote to a tensor; -1 for one made in inference mode, which does not count."""
    return -1 if tensor.is_inference() else tensor._version


def mark(tensor: Tensor) -> tuple[int, float]:
    """The version of a tensor, and a sum of some of its values, evenly spread.

    Writes through numpy or `.data` count no version. Those to most of a tensor change the sum; one to a few values
    alone is seen if it is announced: `torch.autograd.graph.increment_version(tensor)`.
    """
    if not tensor.is_contiguous() or tensor.is_meta or tensor.is_complex():
        return version(tensor), 0.0
    some = tensor.detach().reshape(-1)[:: max(1, tensor.numel() // SAMPLED)]
    return version(tensor), float(some.double().sum())
