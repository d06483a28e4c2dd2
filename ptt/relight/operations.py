"""What the steps are made of: operators with kernels, or the plain functions of the same names."""

from __future__ import annotations

from typing import Any

from ptt.ops import native, plain


def operations(compiled: bool) -> Any:
    """`ptt.ops.native` or `ptt.ops.plain`.

    compiled: by kernels in C++, built on first use, where they fit (`ptt.ops.native.refusals` tells where they do
        not); else by torch alone
    """
    return native if compiled else plain
