"""A BRDF space as one Tucker tensor over (BRDF, outgoing, incident) on the disk grid (Sun et al. 2007, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ptt.materials import Shape
from ptt.ops import transfer, tucker
from ptt.ops.sphere import Disk
from ptt.spaces import BlinnPhongSpace

RESOLUTION = 32  # texels across the disk; 48 lower the error of exponent 20 from 7.9 to 7.7 %


class TensorBRDF(nn.Module):
    """f(h, wi, wo) ~ sum over h', o, i of core[h', o, i] u_h[h, h'] u_o[o, wo] u_i[i, wi]   (equation 2).

    core (h', o, i), u_h (h, h'), u_o (o, n, n), u_i (i, n, n), error (h,)

    The fit weighs directions by projected solid angle and every sample of the space alike: each is scaled to norm 1
    first. `error` is the relative L2 error of every sample under that measure.

    Example:
        >>> brdf = TensorBRDF.fit(BlinnPhongSpace((5.0, 10.0, 20.0)), ranks=(3, 12, 12), resolution=24)
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> brdf.evaluate(BlinnPhong(10.0), up, up)
    """

    core: Tensor
    u_h: Tensor
    u_o: Tensor
    u_i: Tensor
    error: Tensor

    def __init__(
        self, space: BlinnPhongSpace, core: Tensor, u_h: Tensor, u_o: Tensor, u_i: Tensor, error: Tensor
    ) -> None:
        super().__init__()
        self.space = space
        for name, tensor in {"core": core, "u_h": u_h, "u_o": u_o, "u_i": u_i, "error": error}.items():
            self.register_buffer(name, tensor)

    @classmethod
    def fit(
        cls,
        space: BlinnPhongSpace,
        ranks: Sequence[int] | None = None,
        error: float | None = None,
        resolution: int = RESOLUTION,
    ) -> TensorBRDF:
        """Sample the space and decompose it, by ranks (h, o, i) or by a relative error.

        Raises:
            ValueError: not exactly one of ranks and error is given, or one is out of range.
        """
        directions, weights = _samples_of_disk(resolution)
        raw = torch.stack([shape.evaluate(directions, directions[:, None]) for shape in space.samples])
        raw *= weights * weights[:, None]  # shape: (h, o, i)
        scales = raw.flatten(1).norm(dim=1)
        raw /= scales[:, None, None]
        fit = tucker.decompose(raw, ranks=ranks, error=error)
        missed = torch.stack([(a - b).norm() for a, b in zip(raw, fit.to_dense(), strict=True)])
        tables = [(u / weights[:, None]).T.reshape(-1, resolution, resolution) for u in fit.factors[1:]]
        parts = fit.core, fit.factors[0] * scales[:, None], *tables, missed
        return cls(space, *(part.float().contiguous() for part in parts))

    def matrix(self, shape: Shape) -> Tensor:
        """The core of one shape (o, i): f(wi, wo) = outgoing(wo) . matrix . incident(wi)."""
        coordinates = self.space.coordinates(shape).to(self.core) @ self.u_h
        return torch.einsum("h,hoi->oi", coordinates, self.core)

    def importance(self) -> Tensor:
        """How much each incident factor adds to the picture (1 + i,), the diffuse one first.

        Root mean square, over outgoing directions and the samples of the space, of what a unit of it sends out at
        albedo 1 and specular weight 1. The outgoing factors are orthonormal on the disk, whose area is pi.
        """
        matrices = torch.einsum("sh,hoi->soi", self.u_h, self.core)
        specular = matrices.square().sum(1).mean(0).div(math.pi).sqrt()
        return torch.cat((specular.new_tensor([1 / math.pi]), specular))

    def outgoing(self, wo: Tensor) -> Tensor:
        """Outgoing factors (o, v) of local directions (v, 3); below the horizon those of the mirror image above."""
        return transfer.lookup(self.u_o, wo.T[None])[0]

    def incident(self, wi: Tensor) -> Tensor:
        """Incident factors (i, v) of local directions (v, 3); below the horizon those of the mirror image above."""
        return transfer.lookup(self.u_i, wi.T[None])[0]

    def evaluate(self, shape: Shape, wi: Tensor, wo: Tensor) -> Tensor:
        """The approximated BRDF (v,) [1/sr] for local unit directions (v, 3); 0 below the horizon."""
        value = torch.einsum("ov,oi,iv->v", self.outgoing(wo), self.matrix(shape), self.incident(wi))
        return value * ((wi[:, 2] > 0) & (wo[:, 2] > 0))


def _samples_of_disk(resolution: int) -> tuple[Tensor, Tensor]:
    """Directions (t, 3) and square roots of fitting weights (t,) of all texels, float64.

    Bilinear lookups near the horizon read texels that the unit circle cuts or excludes, so these take part too, at
    a direction near the horizon, a quarter of a texel inside, and a small weight.
    """
    grid = Disk(resolution)
    directions = grid.directions().reshape(-1, 3)
    directions[:, 2].clamp_(min=(0.5 / resolution) ** 0.5)
    area = grid.projected_solid_angles().reshape(-1)
    return nn.functional.normalize(directions, dim=1), area.clamp(min=0.05 * float(area.max())).sqrt()
