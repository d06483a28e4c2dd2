"""Error measures."""

from __future__ import annotations

import math

from torch import Tensor


def relative_rmse(a: Tensor, b: Tensor) -> float:
    """The root mean square of a - b over that of the reference b: sqrt(mean (a - b)^2) / sqrt(mean b^2), in float64.

    a, b: the same shape, e.g. radiance (points, 3); the mean runs over every element.

    - 0 if and only if a = b; scaling both by the same factor changes nothing
    - against a black reference: 0 for black, inf for anything else

    Raises:
        ValueError: the shapes differ, or are empty.
    """
    if a.shape != b.shape or not a.numel():
        raise ValueError(f"a and b must have the same shape, not empty, got {tuple(a.shape)} and {tuple(b.shape)}")
    reference = b.detach().double()
    error = float((a.detach().double() - reference).norm())
    size = float(reference.norm())
    if size != 0:
        return error / size
    if math.isnan(error):
        return math.nan
    return 0.0 if error == 0 else math.inf
