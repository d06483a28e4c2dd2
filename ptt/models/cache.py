"""A memory of results that cannot go stale: one is kept for as long as everything that went in is unchanged."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.marks import mark, version
from ptt.ops.transforms import active, outside, stands_in

SMALL = 64  # tensors of up to this many elements are compared by value


@in_python
class Watch:
    """Tensors that are equal to themselves alone, and only until one is written to.

    given: says whether they are a user's, who may write to them through numpy or `.data`, which torch does not count:
        some of their values are looked at, too (`ptt.ops.marks`)
    """

    def __init__(self, tensors: Iterable[Tensor], given: bool = False) -> None:
        self.tensors = tuple(tensors)
        self.marks = [mark(t) if given else version(t) for t in self.tensors]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Watch) or other.marks != self.marks:
            return False
        return all(map(operator.is_, self.tensors, other.tensors))


class Kept:
    """A result that a cache keeps, which nobody writes to: equal to itself alone."""

    def __init__(self, result: Any) -> None:
        self.result = result

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Kept) and other.result is self.result


@opaque
def watched(*modules: nn.Module) -> Watch:
    """The buffers of modules, without those of modules inside of them."""
    return Watch(buffer for part in modules for buffer in part._buffers.values() if buffer is not None)


@in_python
class Cache:
    """Remembers the last results of one step, so many."""

    def __init__(self, most: int = 1) -> None:
        self._most = most
        self._kept: tuple[tuple[Any, Any], ...] = ()

    @uncompiled
    def __call__(self, inputs: Any, compute: Callable[[], Any]) -> Any:
        """`compute()`, or what it gave when `inputs` (tensors, `Watch`, dataclasses, mappings, values) were the same.

        Results that carry derivatives, or stand for a batch, or were made from inference tensors are not kept: they
        serve once. What is kept under a transform of torch.func is made outside of it.
        """
        stamp = _stamp_of(inputs)
        if stamp is None:
            return compute()
        for kept, result in self._kept:  # read at once, and written so: other threads may ask too
            if _same(kept, stamp):
                return result
        result = outside(compute)
        self._kept = ((stamp, result), *self._kept[: self._most - 1])
        return result

    def named(self, result: Any) -> Any:
        """A result as inputs of another cache tell it from others: by what it is where it is kept, else by itself."""
        return Kept(result) if any(result is kept for _, kept in self._kept) else result


@opaque
def _stamp_of(inputs: Any) -> Any:
    """What tells inputs from others; None where what is made of them is not to be kept."""
    leaves: list[Tensor] = []
    stamp = _stamp(inputs, leaves)
    recorded = torch.is_grad_enabled()
    for leaf in leaves:
        if leaf.is_inference() or (recorded and leaf.requires_grad):
            return None
    if active() and any(map(stands_in, leaves)):
        return None
    return stamp, torch.is_inference_mode_enabled()


@opaque
def _same(kept: Any, stamp: Any) -> bool:
    return bool(kept == stamp)


def _stamp(value: Any, leaves: list[Tensor], given: bool = False) -> Any:
    """What tells a value from others; dataclasses are a user's, and so is all that is in them."""
    if isinstance(value, Tensor):
        leaves.append(value)
        if value.is_inference() or stands_in(value):
            return None
        if value.layout == torch.strided and value.numel() <= SMALL:
            return value.dtype, value.device, value.shape, value.flatten().tolist()  # rows without numbers are no lists
        return Watch((value,), given)
    if isinstance(value, Watch):
        leaves.extend(value.tensors)
        return value
    if isinstance(value, tuple | list):
        return [_stamp(item, leaves, given) for item in value]
    if isinstance(value, Mapping):
        return [(key, _stamp(item, leaves, given)) for key, item in value.items()]
    kind: Any = type(value)
    names = _members(kind)
    return value if names is None else (kind, [_stamp(getattr(value, name), leaves, True) for name in names])


@functools.cache
def _members(kind: type) -> tuple[str, ...] | None:
    """The fields of a dataclass; None of another type."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else None
