"""Materials from one's own data: a table becomes a function, an RGB function becomes colours around one shape."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ptt.materials.material import Highlight, Material
from ptt.materials.shapes import Named
from ptt.ops.albedo import albedo, nodes
from ptt.ops.constants import TINY
from ptt.ops.directions import unit
from ptt.ops.sphere import Disk

DIFFUSE = 0.02  # quantile of a measured BRDF that counts as its diffuse part: the least values are noise
NOISE = 1e-6  # share of the diffuse part: a shape whose albedo is no more is rounding
TEXELS = 20  # across the disk on which the diffuse part is found: finer ones take longer, as the fourth power
ERROR = 0.05  # default, of separated colours
UPDATES = 100  # of two colours
LEAST = 1e-2  # of each channel, in the colours that updates begin with: they multiply
QUADRATURE = (1e-4, 48, 24)  # of light that leaves in one direction (`albedo.nodes`)
OUT = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 0.75**0.5], [0.75**0.5, 0.0, 0.5]], dtype=torch.float64)


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


def separate(
    name: str, brdf: Callable[[Tensor, Tensor], Tensor], isotropic: bool = True, error: float = ERROR
) -> Material:
    """Diffuse and specular colours around monochrome shapes, from RGB data f(wi, wo) -> (..., 3) [1/sr].

        silk = ptt.separate("silk", ptt.MERL.load("blue-metallic-paint.binary").evaluate)
        ptt.separation_error(silk, ptt.MERL.load("blue-metallic-paint.binary").evaluate)  # 0.01

    f ~ diffuse / pi + the sum of specular_k * shape_k: the diffuse part is the 2 % quantile of each colour over
    directions by projected solid angle. What is left is one colour times a shape where `separation_error` is at most
    `error` then; else two, the best whose colours and shapes are not negative (Lee and Seung 1999), directions weighing
    as the light that goes there; else red, green and blue, which leave no error but below the quantile. The largest
    albedo of a shape at 0, 30 and 60 degrees is 1, so that `specular` is an albedo too. Shapes after the first are
    called "name/2" and "name/3".

    Raises:
        ValueError: f returns another shape, or values that are not finite; error is negative.
    """
    if not error >= 0:
        raise ValueError(f"error must be >= 0, got {error}")
    values = _checked(name, brdf, *_disk_pairs())
    level = values.quantile(DIFFUSE, dim=0).clamp(0, 1 / math.pi)
    diffuse = (level * math.pi).float()
    wi, wo, weights = _pairs(isotropic)
    values = _checked(name, brdf, wi, wo)
    rest = (values - level).clamp(min=0)
    if float(weights @ rest.mean(1)) <= NOISE * float(level.max()):
        return Material(diffuse)
    for terms in (1, 2, 3):
        colours = _colours(rest, weights, terms)
        material = Material(diffuse, 0.0, None, *_highlights(name, brdf, level, colours, isotropic))
        if terms == 3 or _misplaced(material.evaluate(wi, wo), values, weights) <= error:
            break
    return material


def separation_error(material: Material, brdf: Callable[[Tensor, Tensor], Tensor], isotropic: bool = True) -> float:
    """How much of the light that RGB data f(wi, wo) -> (..., 3) [1/sr] reflect of a white sky a material misplaces.

    That is the integral of |difference| over that of f, all colours together, for light that leaves at ten angles to
    the normal from 0 to 80 degrees (if not isotropic, at 8 azimuths each).
    """
    wi, wo, weights = _pairs(isotropic)
    return _misplaced(material.evaluate(wi, wo), _checked("brdf", brdf, wi, wo), weights)


def _misplaced(shown: Tensor, values: Tensor, weights: Tensor) -> float:
    """The sum of differences from values (m, 3) over that of the values, by weights (m,)."""
    return float((weights @ (shown - values).abs()).sum() / (weights @ values).sum().clamp(min=TINY))


def _highlights(
    name: str, brdf: Callable[[Tensor, Tensor], Tensor], level: Tensor, colours: Tensor, isotropic: bool
) -> list[Highlight]:
    """What f has above a level (3,), in colours (k, 3): each around the part of it that is of its colour."""

    def part(k: int, scale: float) -> Callable[[Tensor, Tensor], Tensor]:
        def shape(wi: Tensor, wo: Tensor) -> Tensor:
            rest = (brdf(wi, wo) - level.to(wi)).clamp(min=0)
            value: Tensor = _parts(rest, colours.to(wi))[..., k] * scale
            return value

        return shape

    found: list[Highlight] = []
    for k, colour in enumerate(colours):
        size = float(albedo(part(k, 1.0), OUT).max())
        if size > NOISE * math.pi * float(level.max()):
            label = f"{name}/{len(found) + 1}" if found else name
            found.append(Highlight((colour * size).float(), Named(label, part(k, 1 / size), isotropic)))
    return found


def _colours(rest: Tensor, weights: Tensor, terms: int) -> Tensor:
    """Unit colours (k, 3) >= 0, the best for samples (m, 3) that weigh as their light, by weights (m,)."""
    if terms == 3:
        return torch.eye(3).to(rest)
    scaled = rest * (weights / rest.norm(dim=1).clamp(min=TINY)).sqrt()[:, None]
    vectors: Tensor = torch.linalg.eigh(scaled.T @ scaled).eigenvectors
    first, second = vectors[:, -1].abs(), vectors[:, -2]
    if terms == 1:
        return first[None]
    colours: Tensor = unit(torch.stack((first + second, first - second)).clamp(min=LEAST))
    for _ in range(UPDATES):
        parts = _parts(scaled, colours)
        updated = colours * (parts.T @ scaled) / (parts.T @ parts @ colours).clamp(min=TINY)
        colours = unit(updated.clamp(min=TINY))
    return colours


def _parts(rest: Tensor, colours: Tensor) -> Tensor:
    """How much (..., k) >= 0 of one, two or three unit colours (k, 3) >= 0 is nearest to values (..., 3) >= 0."""
    if len(colours) != 2:
        return rest @ colours.T  # of three, which are red, green and blue
    along = rest @ colours.T
    cosine = colours[0] @ colours[1]
    both = (along - cosine * along.flip(-1)) / (1 - cosine**2).clamp(min=TINY)
    return torch.where(both.flip(-1) < 0, along, both).clamp(min=0) * (both >= 0)


def _checked(name: str, brdf: Callable[[Tensor, Tensor], Tensor], wi: Tensor, wo: Tensor) -> Tensor:
    """RGB values (m, 3) float64 of a BRDF."""
    values = brdf(wi, wo)
    if values.shape != wi.shape or not bool(torch.isfinite(values).all()):
        raise ValueError(f"the BRDF {name!r} must return finite RGB (..., 3), got shape {tuple(values.shape)}")
    return values.double()


def _disk_pairs() -> tuple[Tensor, Tensor]:
    """Pairs of directions (m, 3), evenly by projected solid angle."""
    grid = Disk(TEXELS)
    directions = grid.directions().reshape(-1, 3)[grid.nearest_inside().unique()]
    wi, wo = torch.broadcast_tensors(directions[None], directions[:, None])
    return wi.reshape(-1, 3), wo.reshape(-1, 3)


def _pairs(isotropic: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Directions wi and wo (m, 3), and weights (m,): cos(wi) dwi over the number of wo."""
    tilts = torch.linspace(0, math.radians(80), 10, dtype=torch.float64)
    turns = torch.arange(1 if isotropic else 8, dtype=torch.float64) * (math.pi / 8)
    tilt, turn = torch.cartesian_prod(tilts, turns).unbind(1)
    wo = torch.stack((tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()), 1)
    wi, weights = nodes(wo, *QUADRATURE)
    return wi.flatten(0, 1), wo[:, None].expand_as(wi).flatten(0, 1), weights.flatten() / len(wo)


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
