"""Kernels as torch operators `torch.ops.ptt.*`, which autograd, torch.compile and fake tensors know.

The plain function is the operator's implementation on every device and its derivative; the kernel answers on the CPU
where its conditions hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ptt.ops.compiling import inlined, opaque
from ptt.ops.native.kernels import available
from ptt.ops.transforms import active, stands_in

LIBRARY = torch.library.Library("ptt", "DEF")
Conditions = Iterable[tuple[bool, str]]
"""What must hold for a kernel, and the reason to give where it does not; one may rely on those before it."""

DEFINED: dict[str, Callable[..., Any]] = {}
"""The plain function of each operator, by name."""

OWN = (Tensor, torch.nn.Parameter)
"""The types of tensors that have data of their own, and no dispatch of their own."""

_asked: list[dict[str, str]] = []


def operator(
    schema: str,
    *,
    plain: Callable[..., Any],
    kernel: Callable[..., Any],
    conditions: Callable[..., Conditions],
    fake: Callable[..., Any],
    calls: str = "",
) -> Callable[..., Any]:
    """Define `torch.ops.ptt.<name>`; plain, kernel, conditions and fake take what the schema says.

    fake: empty results of the right shapes and types, of tensors without data
    calls: what the kernel is named in C++, if not as the operator
    """
    name = schema.split("(", 1)[0]
    calls = calls or name
    plain = _contiguous(plain)
    DEFINED[name] = plain
    LIBRARY.define(schema, tags=(torch.Tag.pt2_compliant_tag,))
    defined = getattr(torch.ops.ptt, name).default

    def on_cpu(*arguments: Any) -> Any:
        reason = refusal(conditions(*arguments), calls)
        if reason is None:
            return kernel(*arguments)
        _note(name, reason)
        return plain(*arguments)

    def recorded(*arguments: Any) -> Any:
        if _differentiated(_tensors(arguments)):
            _note(name, "derivatives are asked for")
            return plain(*arguments)
        with torch._C._AutoDispatchBelowAutograd():
            return defined(*arguments)

    straight = opaque(on_cpu)

    @inlined
    def call(*arguments: Any) -> Any:
        """The operator, straight where nothing but the CPU has a say.

        torch's dispatcher would hand the arguments to Python twice, which costs a view step 130 us of 1800.
        """
        if torch.compiler.is_compiling():
            return defined(*arguments)
        tensors = _tensors(arguments)
        if _only_cpu(tensors) and not _differentiated(tensors):
            return straight(*arguments)
        if active() and any(map(stands_in, tensors)):
            _note(name, "derivatives or batches of torch.func are asked for")
            return plain(*arguments)
        return defined(*arguments)

    LIBRARY.impl(name, plain, "CompositeExplicitAutograd")
    LIBRARY.impl(name, on_cpu, "CPU")
    LIBRARY.impl(name, recorded, "Autograd")
    torch.library.register_fake(f"ptt::{name}", fake, lib=LIBRARY)
    return call


def _contiguous(plain: Callable[..., Any]) -> Callable[..., Any]:
    """The plain function with contiguous results, as kernels and fakes have them."""

    def contiguous(result: Any) -> Any:
        if isinstance(result, Tensor):
            return result.contiguous()
        parts = map(contiguous, result)
        return list(parts) if isinstance(result, list) else tuple(parts)

    return lambda *arguments: contiguous(plain(*arguments))


def refusal(conditions: Conditions, kernel: str) -> str | None:
    """Why a kernel is not for its arguments: the first condition that does not hold; None where it is."""
    for holds, reason in conditions:
        if not holds:
            return reason
    return None if available(kernel) else "the kernel cannot be built here"


@contextmanager
def refusals() -> Iterator[dict[str, str]]:
    """Collect why kernels are not used, by operator, while the block runs.

    Example:
        >>> with refusals() as found:
        ...     radiance = relighter(light, materials, camera)
        >>> found
        {}
    """
    found: dict[str, str] = {}
    _asked.append(found)
    try:
        yield found
    finally:
        _asked.remove(found)


def _note(name: str, reason: str) -> None:
    for found in _asked:
        found[name] = reason


@inlined
def _tensors(arguments: Iterable[Any]) -> list[Tensor]:
    """The tensors among arguments, and those in lists among them."""
    found: list[Tensor] = []
    for argument in arguments:
        if isinstance(argument, Tensor):
            found.append(argument)
        elif isinstance(argument, list):
            for each in argument:  # no comprehension: torch.compile would begin a graph for it
                if isinstance(each, Tensor):
                    found.append(each)
    return found


@inlined
def _differentiated(tensors: Iterable[Tensor]) -> bool:
    """Tell whether a derivative of tensors is recorded."""
    if forward_ad._current_level >= 0:
        return True
    if not torch.is_grad_enabled():
        return False
    for tensor in tensors:  # noqa: SIM110
        if tensor.requires_grad:
            return True
    return False


@inlined
def _only_cpu(tensors: Iterable[Tensor]) -> bool:
    """Tell whether nothing but the CPU has a say: no mode or transform is on, and the tensors have data there."""
    if torch._C._len_torch_dispatch_stack() or torch._C._functorch.peek_interpreter_stack() is not None:
        return False
    for tensor in tensors:  # noqa: SIM110
        if type(tensor) not in OWN or not tensor.is_cpu:
            return False
    return True
