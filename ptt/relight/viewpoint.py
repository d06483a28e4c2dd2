"""Where points are looked at from."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ptt.imaging.gbuffer import GBuffer
from ptt.ops.compiling import opaque
from ptt.ops.transforms import beneath
from ptt.scene.camera import Camera
from ptt.scene.scene import Scene

View = Camera | Tensor | GBuffer
ANYWHERE = Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def glow_of(scene: Scene, view: View) -> Tensor | None:
    """Radiance that the vertices (v, 3), or the pixels (p, 3) of a GBuffer, send out by themselves; None of none."""
    return view.glow if isinstance(view, GBuffer) else scene.vertex_glow


def from_anywhere(view: GBuffer) -> GBuffer:
    """The same pixels seen by one camera: an input of what does not depend on the eye, which may move alone."""
    return replace(view, camera=ANYWHERE)


@opaque
def eye_of(view: View, positions: Tensor) -> Tensor:
    """The eye (3,), or unit directions (v, 3) from positions (v, 3) to the viewer, of the type of the positions.

    view: a Camera, the G-buffer of one, an eye (3,), or directions (v, 3) of any length

    Raises:
        ValueError: a tensor of another shape, not finite, or with directions that are zero.
    """
    if isinstance(view, GBuffer):
        view = view.camera
    if isinstance(view, Camera):
        return torch.tensor(view.eye).to(positions)
    if not isinstance(view, Tensor):
        raise ValueError(f"view must be a Camera, a GBuffer or a tensor, got {view!r}")
    if view.shape not in ((3,), positions.shape):
        raise ValueError(f"view must be a Camera, (3,) or {tuple(positions.shape)}, got {tuple(view.shape)}")
    finite = bool(beneath(view).isfinite().all())
    if not finite or (view.ndim == 2 and not bool(beneath((view != 0).any(1)).all())):
        raise ValueError("view must be finite, and directions not zero")
    view = view.to(positions)
    return view if view.ndim == 1 else normalize(view, dim=1)
