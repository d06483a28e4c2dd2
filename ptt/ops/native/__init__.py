"""The hot functions of `ptt.ops` as torch operators with kernels in C++: each takes and gives what the plain one of its
name does.

Where a kernel does not fit (another device or type, gradients, no compiler), the plain function answers; `refusals`
tells why.
"""

from ptt.ops.native.cells import cell_sums
from ptt.ops.native.forming import quantised
from ptt.ops.native.glossing import lamp_visibility, reflected_lamps, shine
from ptt.ops.native.hemispheres import lamps_between, lamps_seen
from ptt.ops.native.kernels import available, prepare
from ptt.ops.native.maps import octahedral_means
from ptt.ops.native.near import of_frames, of_texels, of_views
from ptt.ops.native.operators import refusals
from ptt.ops.native.relight import exitants, light_eigens, lighting
from ptt.ops.native.rotation import (
    local_light,
    resampled_light,
    resampled_values,
    rotated_light,
)
from ptt.ops.native.shading import shade
from ptt.ops.native.slices import reflected
from ptt.ops.native.triple import adaptive
from ptt.ops.native.viewing import view

__all__ = [
    "adaptive",
    "available",
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
    "prepare",
    "quantised",
    "reflected",
    "reflected_lamps",
    "refusals",
    "resampled_light",
    "resampled_values",
    "rotated_light",
    "shade",
    "shine",
    "view",
]
