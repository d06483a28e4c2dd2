"""What torch.compile looks into, and what it leaves to Python.

Graphs begin at pure functions of tensors. What decides which of them run (relighters, caches, checks) stays in Python;
so do the kernels, whose frames have nothing to fuse: in a trial on a small scene a graph around the kernel of the view
step made a frame of 0.23 ms one of 0.38, for its guards. By torch's own C functions, so that `import ptt` does not
import the compiler, and that nothing is asked anew at every call.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import CodeType
from typing import Any, TypeVar, cast

import torch
from torch._C._dynamo import eval_frame

SKIPPED = eval_frame._FrameExecStrategy(eval_frame._FrameAction.SKIP, eval_frame._FrameAction.DEFAULT)
"""A frame of its own is left to Python; those that it calls are looked into."""

F = TypeVar("F", bound=Callable[..., object])
C = TypeVar("C", bound=type)


def inlined(function: F) -> F:
    """Begin no graph for a function; a graph that calls it takes it in."""
    _skip(function.__code__)
    return function


def uncompiled(function: F) -> F:
    """Leave a function to Python, and let torch.compile look into those that it calls.

    As `torch.compiler.disable(recursive=False)`, which costs a wrapper and a question at every call.
    """
    function._torchdynamo_disable = True  # type: ignore[attr-defined]
    return inlined(function)


def in_python(cls: C) -> C:
    """Begin no graph for the methods of a class: they choose, and call pure functions."""
    for member in vars(cls).values():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        code = getattr(function, "__code__", None)
        if code is not None:
            _skip(code)
    return cls


def opaque(function: F) -> F:
    """Leave a function, and all that it calls, to Python: tables that are made once, and calls of kernels."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        before = eval_frame.set_eval_frame(None)
        try:
            return function(*arguments, **named)
        finally:
            eval_frame.set_eval_frame(before)

    return cast("F", uncompiled(call))


def spans(count: int, most: int) -> list[tuple[int, int]]:
    """First and end of parts of at most so many of `count`, so that what is made of each stays in the cache.

    One part, of all, in a graph: torch.compile keeps little of what it fuses in memory at all.
    """
    each = max(1, count if torch.compiler.is_compiling() else most)
    return [(first, min(first + each, count)) for first in range(0, max(1, count), each)]


def _skip(code: CodeType) -> None:
    """Skip a code, and those of the comprehensions and lambdas within."""
    eval_frame.set_code_exec_strategy(code, SKIPPED)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            _skip(constant)
