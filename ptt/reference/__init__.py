"""Ground truth: path-traced radiance with its standard error, the judge of every relighter."""

from ptt.reference.estimators import (
    Points,
    Settings,
    along_rays,
    at_vertices,
    image,
    radiance,
    unshadowed,
    vertex_points,
)
from ptt.reference.path_tracer import Estimate

__all__ = [
    "Estimate",
    "Points",
    "Settings",
    "along_rays",
    "at_vertices",
    "image",
    "radiance",
    "unshadowed",
    "vertex_points",
]
