"""A map made ready for lookups, as an operator; its plain function is `ptt.ops.latlong.octahedral_means`."""

from __future__ import annotations

import torch
from torch import Tensor

from ptt.ops import latlong
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS
from ptt.ops.native.arguments import of_type
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator


@inlined
def octahedral_means(texels: Tensor, n: int, samples: int, arc: float) -> Tensor:
    """Means (n * n, 3), as `ptt.ops.latlong.octahedral_means`."""
    result: Tensor = _octahedral_means(texels, n, samples, arc)
    return result


def _conditions(texels: Tensor, n: int, samples: int, arc: float) -> Conditions:
    yield of_type(torch.float32, texels), "texels must be float32"
    yield texels.ndim == 3 and texels.shape[2] == 3, "texels must be (h, w, 3)"


def _kernel(texels: Tensor, n: int, samples: int, arc: float) -> Tensor:
    height, width, _ = texels.shape
    out = texels.new_empty(n * n, 3)
    run(
        "octahedral_means",
        texels=texels.contiguous(),
        even=texels.new_empty(height + 2, width + 2, CHANNELS),
        out=out,
        height=height,
        width=width,
        n=n,
        arc=arc,
        samples=samples,
    )
    return out


_octahedral_means = operator(
    "octahedral_means(Tensor texels, int n, int samples, float arc) -> Tensor",
    plain=lambda *arguments: latlong.octahedral_means(*arguments),
    kernel=_kernel,
    conditions=_conditions,
    fake=lambda texels, n, samples, arc: texels.new_empty(n * n, 3),
)
