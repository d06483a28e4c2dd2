"""A memory of what was made of the last few shapes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from ptt.materials.shapes import Shape, carries_gradient, shape_key
from ptt.ops.compiling import in_python
from ptt.ops.transforms import outside

T = TypeVar("T")
REMEMBERED = 32  # shapes: a material with textures has up to 26 at once


@in_python
class ShapeTables(Generic[T]):
    """make(shape) of a shape with its parameters as they are now, on a device."""

    def __init__(self, make: Callable[[Shape], T]) -> None:
        self._make = make
        self._kept = dict[object, T]()

    def __call__(self, shape: Shape, device: torch.device) -> T:
        """The table of a shape.

        Raises:
            ValueError: a parameter requires a gradient, which a table would lose.
        """
        if carries_gradient(shape):
            raise ValueError("shapes carry no gradients here: detach the parameters, or use TransferRelighter")
        key = shape_key(shape), device
        if key not in self._kept:
            while len(self._kept) >= REMEMBERED:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = outside(self._make, shape)
        return self._kept[key]
