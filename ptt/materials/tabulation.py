"""Materials from one's own data: a table becomes a function, an RGB function becomes colours around one shape."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ptt.materials.material import Material
from ptt.materials.shapes import Named
from ptt.ops.albedo import albedo
from ptt.ops.sphere import Disk

DIFFUSE = 0.02  # quantile of a measured BRDF that counts as its diffuse part: the least values are noise
NOISE = 1e-6  # share of the diffuse part: a shape whose albedo is no more is rounding
TEXELS = 20  # across the disk on which RGB data are separated: finer data take longer, as the fourth power


def tabulated(values: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """A function f(wi, wo) of a table over the disk grid: values (n, n, n, n) [1/sr], rows and columns of wo, then wi.

    Cell (j, i) is the direction with x = -1 + (2 i + 1) / n and y = -1 + (2 j + 1) / n (`ops.sphere.Disk(n)`); cells
    that lie mostly outside of the unit circle are not read. Bilinear between cells.

    Raises:
        ValueError: values have another shape, or are negative or not finite where they are read.
    """
    n = values.shape[0] if values.ndim == 4 else 0
    if values.shape != (n,) * 4 or not n:
        raise ValueError(f"values must be (n, n, n, n), got {tuple(values.shape)}")
    filled = Disk(n).nearest_inside()
    table = values.detach().reshape(n * n, n * n)[filled][:, filled]
    if not bool((torch.isfinite(table) & (table >= 0)).all()):
        raise ValueError("values must be finite and >= 0 inside the unit circle")

    def evaluate(wi: Tensor, wo: Tensor) -> Tensor:
        wi, wo = torch.broadcast_tensors(wi, wo)
        pairs = [(a * b, table[o, i]) for o, a in _corners(wo, n) for i, b in _corners(wi, n)]
        value = torch.stack([weight * entry for weight, entry in pairs]).sum(0)
        return (value * ((wi[..., 2] > 0) & (wo[..., 2] > 0))).to(wi)

    return evaluate


def separate(name: str, brdf: Callable[[Tensor, Tensor], Tensor], isotropic: bool = True) -> Material:
    """Diffuse and specular colours around one monochrome shape, from RGB data f(wi, wo) -> (..., 3) [1/sr].

        gold = ptt.separate("gold", ptt.MERL.load("gold-metallic-paint.binary").evaluate)

    f ~ diffuse / pi + specular * shape: the diffuse part is the 2 % quantile of each colour over directions by
    projected solid angle, and the shape the best common factor of what is left, in the L2 norm. The largest albedo of
    the shape at 0, 30 and 60 degrees is 1, so that `specular` is an albedo too. Differences in colour between highlight
    and gloss are lost.

    Raises:
        ValueError: f returns another shape, or values that are not finite.
    """
    grid = Disk(TEXELS)
    directions = grid.directions().reshape(-1, 3)[grid.nearest_inside().unique()]
    values = brdf(*torch.broadcast_tensors(directions[None], directions[:, None]))
    if values.shape != (len(directions), len(directions), 3) or not bool(torch.isfinite(values).all()):
        raise ValueError(f"the BRDF {name!r} must return finite RGB (..., 3), got shape {tuple(values.shape)}")
    values = values.double().reshape(-1, 3)
    level = values.quantile(DIFFUSE, dim=0).clamp(0, 1 / math.pi)
    rest = (values - level).clamp(min=0)
    colour = torch.linalg.eigh(rest.T @ rest).eigenvectors[:, -1].abs()

    def scaled(scale: float) -> Callable[[Tensor, Tensor], Tensor]:
        def shape(wi: Tensor, wo: Tensor) -> Tensor:
            value: Tensor = (brdf(wi, wo) - level.to(wi)).clamp(min=0) @ (colour.to(wi) * scale)
            return value

        return shape

    out = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 0.75**0.5], [0.75**0.5, 0.0, 0.5]], dtype=torch.float64)
    size = float(albedo(scaled(1.0), out).max())
    diffuse = (level * math.pi).float()
    if size <= NOISE * math.pi * float(level.max()):
        return Material(diffuse)
    return Material(diffuse, (colour * size).float(), Named(name, scaled(1 / size), isotropic))


def _corners(directions: Tensor, n: int) -> list[tuple[Tensor, Tensor]]:
    """The four cells (...) around each direction and their bilinear weights (...)."""
    at = Disk(n).coordinates(directions)
    low = at.floor()
    t = at - low
    corners = []
    for j in (0, 1):
        for i in (0, 1):
            cell = (low + torch.tensor([j, i], device=low.device)).clamp(0, n - 1).long()
            weight = (t if j else 1 - t)[..., 0] * (t if i else 1 - t)[..., 1]
            corners.append((cell[..., 0] * n + cell[..., 1], weight))
    return corners
