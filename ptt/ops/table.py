"""Tables of functions in as few bits as one likes, each row with a scale of its own."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.constants import TINY
from ptt.ops.transforms import stands_in

LARGEST = {torch.float16: 32.0, torch.uint8: 255.0}  # of a row as it is stored: sums of products stay within float16


class Table(NamedTuple):
    """Functions as they are stored: values (f, ..., n) in float32, float16 or uint8, times scale (f,)."""

    values: Tensor
    scale: Tensor

    @property
    def bytes(self) -> int:
        """Size of both."""
        return sum(t.numel() * t.element_size() for t in self)

    def to_dense(self) -> Tensor:
        """(f, ..., n)."""
        return self.at(torch.arange(len(self.values), device=self.values.device))

    def at(self, rows: Tensor) -> Tensor:
        """Functions (*rows, ..., n)."""
        scale = self.scale[rows]
        values = self.values[rows].to(torch.promote_types(self.values.dtype, scale.dtype))
        return values * scale.reshape(*scale.shape, *(1,) * (self.values.ndim - 1))


def stored(values: Tensor, storage: torch.dtype) -> Table:
    """A table of values (f, ..., n): float32, or 16 or 8 bits, in which the largest of each row is `LARGEST`.

    With derivatives or of a batch (`ptt.ops.transforms`), and of float64 values, as they are.
    """
    exact = values.dtype == torch.float64 or (torch.is_grad_enabled() and values.requires_grad) or stands_in(values)
    if exact or storage == torch.float32:
        return Table(values, values.new_ones(len(values)))
    scale = values.flatten(1).abs().amax(1).clamp(min=TINY) / LARGEST[storage]
    rows = values / scale.reshape(-1, *(1,) * (values.ndim - 1))
    return Table(rows.round().to(storage) if storage == torch.uint8 else rows.to(storage), scale)
