"""The plain functions that `ptt.ops.native` has kernels for, by the same names: their oracles and derivatives."""

from ptt.ops.cells import cell_sums
from ptt.ops.gloss import lamp_visibility, reflected_lamps, shine
from ptt.ops.hemispheres import lamps_between, lamps_seen
from ptt.ops.latlong import octahedral_means
from ptt.ops.near import of_frames, of_texels, of_views
from ptt.ops.relight import exitants, light_eigens, lighting
from ptt.ops.rotation import local_light, quantised, resampled_light, resampled_values, rotated_light
from ptt.ops.shade import shade
from ptt.ops.slices import reflected
from ptt.ops.triple import adaptive
from ptt.ops.view import view

__all__ = [
    "adaptive",
    "cell_sums",
    "exitants",
    "lamp_visibility",
    "lamps_between",
    "lamps_seen",
    "light_eigens",
    "lighting",
    "local_light",
    "octahedral_means",
    "of_frames",
    "of_texels",
    "of_views",
    "quantised",
    "reflected",
    "reflected_lamps",
    "resampled_light",
    "resampled_values",
    "rotated_light",
    "shade",
    "shine",
    "view",
]
