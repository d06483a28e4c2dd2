"""Where points are looked at from."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.scene.camera import Camera

View = Camera | Tensor


def toward(view: View, positions: Tensor) -> Tensor:
    """The eye (3,), or unit directions (v, 3) to the viewer, of a view of positions (v, 3).

    Raises:
        ValueError: a tensor of another shape, not finite, or with directions that are zero.
    """
    if isinstance(view, Camera):
        return torch.tensor(view.eye).to(positions)
    if view.shape not in ((3,), positions.shape):
        raise ValueError(f"view must be a Camera, (3,) or {tuple(positions.shape)}, got {tuple(view.shape)}")
    if not bool(torch.isfinite(view).all()) or (view.ndim == 2 and not bool((view != 0).any(1).all())):
        raise ValueError("view must be finite, and directions not zero")
    view = view.to(positions)
    return view if view.ndim == 1 else normalize(view, dim=1)
