"""Fits of spaces, which take seconds: made once, kept on disk by what they were made from, and found again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from ptt import threads
from ptt.io import saved
from ptt.materials.shapes import Analytic
from ptt.materials.spaces import BRDFSpace
from ptt.ops import keeping


def fit(
    kind: str, space: BRDFSpace, settings: Mapping[str, Any], make: Callable[[], Mapping[str, Tensor]]
) -> Mapping[str, Tensor]:
    """The tensors that `make` fits to a space, or fitted before, in this process or another.

    A space with functions of the user's own is fitted anew: nothing tells whether they changed.
    """
    threads.share()
    if not all(isinstance(shape, Analytic) for shape in space.samples):
        return make()
    path = keeping.place(kind, {"space": space.to_config(), **settings})
    if path.exists():
        try:
            return saved.load(path, kind)[1]
        except ValueError as error:
            warnings.warn(f"{error}; it is made anew", stacklevel=4)
    made = make()
    try:
        saved.save(path, kind, {}, made)
    except ValueError as error:
        warnings.warn(f"{error}; it is made anew the next time", stacklevel=4)
    return made
