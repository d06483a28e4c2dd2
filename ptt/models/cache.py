"""A memory of one result, that cannot go stale: it is kept for as long as everything that went in is unchanged."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ptt.ops.compiling import in_python, opaque, uncompiled

SMALL = 64  # tensors of up to this many elements are compared by value


@in_python
class Watch:
    """Tensors that are equal to themselves alone, and only until one is written to."""

    def __init__(self, tensors: Iterable[Tensor]) -> None:
        self.tensors = tuple(tensors)
        self.versions = [-1 if t.is_inference() else t._version for t in self.tensors]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Watch) or other.versions != self.versions:
            return False
        return all(map(operator.is_, self.tensors, other.tensors))


@opaque
def watched(*modules: nn.Module) -> Watch:
    """The buffers of modules, without those of modules inside of them."""
    return Watch(buffer for part in modules for buffer in part._buffers.values() if buffer is not None)


@in_python
class Cache:
    """Remembers the last result of one step."""

    def __init__(self) -> None:
        self._stamp: Any = None
        self._result: Any = None

    @uncompiled
    def __call__(self, inputs: Any, compute: Callable[[], Any]) -> Any:
        """`compute()`, or its last result if `inputs` (tensors, `Watch`, dataclasses, mappings, values) are the same.

        Results that carry gradients or were made from inference tensors are not kept: their graph serves once.
        """
        stamp = _stamp_of(inputs)
        if stamp is None:
            return compute()
        if not _same(self._stamp, stamp):
            self._result = compute()
            self._stamp = stamp
        return self._result


@opaque
def _stamp_of(inputs: Any) -> Any:
    """What tells inputs from others; None where they carry gradients or are inference tensors."""
    leaves: list[Tensor] = []
    stamp = _stamp(inputs, leaves)
    recorded = torch.is_grad_enabled()
    if any([t.is_inference() or (recorded and t.requires_grad) for t in leaves]):
        return None
    return stamp, torch.is_inference_mode_enabled()


@opaque
def _same(kept: Any, stamp: Any) -> bool:
    return bool(kept == stamp)


def _stamp(value: Any, leaves: list[Tensor]) -> Any:
    if isinstance(value, Tensor):
        leaves.append(value)
        if value.is_inference():
            return None
        if value.layout == torch.strided and value.numel() <= SMALL:
            return value.dtype, value.device, value.shape, value.tolist()
        return Watch((value,))
    if isinstance(value, Watch):
        leaves.extend(value.tensors)
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), [_stamp(getattr(value, f.name), leaves) for f in fields(value)]
    if isinstance(value, Mapping):
        return [(key, _stamp(item, leaves)) for key, item in value.items()]
    if isinstance(value, tuple | list):
        return [_stamp(item, leaves) for item in value]
    return value
