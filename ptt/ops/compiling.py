"""What torch.compile may look into, and what it leaves to Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import torch

F = TypeVar("F", bound=Callable[..., object])


def uncompiled(function: F) -> F:
    """Leave a function to Python, and let torch.compile look into those that it calls.

    It marks what decides which steps run: caches, checks, choices by name. A graph begins below it, and none breaks.
    """
    return cast("F", torch.compiler.disable(function, recursive=False))


def opaque(function: F) -> F:
    """Leave a function, and all that it calls, to Python: tables that are made once."""
    return cast("F", torch.compiler.disable(function))
