"""BRDF spaces: sampled shapes of one model, names for some of them, and how to move between (Sun 2007, section 4.2)."""

from __future__ import annotations

import csv
import difflib
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial import Delaunay
from torch import Tensor, nn

from ptt.materials import BlinnPhong, CookTorrance, Material, Shape

MERL_SCALE = 1.0, 1.15, 1.66  # of the colours: the published fits lack it


@dataclass(frozen=True)
class BlinnPhongSpace:
    """Blinn-Phong shapes between sampled exponents, linear in between.

    exponents: ascending, in 0..1e6. The default reaches from 1 to 64, four samples to a factor of two: sharper
        highlights do not fit a small tensor.
    """

    exponents: tuple[float, ...] = tuple(2 ** (k / 4) for k in range(25))

    def __post_init__(self) -> None:
        if not self.exponents or any(a >= b for a, b in pairwise(self.exponents)):
            raise ValueError(f"exponents must hold ascending values, got {self.exponents}")

    @property
    def samples(self) -> tuple[BlinnPhong, ...]:
        """The shapes that a tensor is fitted to, h of them."""
        return tuple(BlinnPhong(exponent) for exponent in self.exponents)

    def at(self, exponent: float) -> BlinnPhong:
        """The shape of an exponent.

        Raises:
            ValueError: it lies outside of the samples.
        """
        self.coordinates(shape := BlinnPhong(exponent))
        return shape

    def path(self, start: BlinnPhong, end: BlinnPhong, steps: int) -> list[BlinnPhong]:
        """Shapes from start to end, both included, evenly spaced in the exponent."""
        return [self.at(x) for x in torch.linspace(float(start.exponent), float(end.exponent), steps).tolist()]

    def coordinates(self, shape: Shape) -> Tensor:
        """Weights (h,) of the samples, float64, that interpolate a shape; differentiable in its exponent.

        Raises:
            ValueError: a shape of another model, or an exponent outside of the samples.
        """
        if not isinstance(shape, BlinnPhong):
            raise ValueError(f"the model's space holds blinn-phong shapes, got {shape.model}")
        nodes = torch.tensor(self.exponents, dtype=torch.float64)
        x = torch.as_tensor(shape.exponent, dtype=torch.float64).cpu()
        low, high, value = self.exponents[0], self.exponents[-1], float(x.detach())
        if not low * (1 - 1e-6) <= value <= high * (1 + 1e-6):
            raise ValueError(f"exponent must be in {low:g}..{high:g}, the model's space, got {value:g}")
        after = min(int((nodes <= value).sum()), len(nodes) - 1)
        before = max(after - 1, 0)
        ends = nn.functional.one_hot(torch.tensor([before, after]), len(nodes)).double()
        t = (x - nodes[before]) / (nodes[after] - nodes[before]) if before < after else x * 0
        return ends[0] + t * (ends[1] - ends[0])


@dataclass(frozen=True)
class CookTorranceSpace:
    """Cook-Torrance shapes triangulated in the plane of (f0, m): barycentric inside their hull, clamped to it outside.

    names, f0, m, diffuse, specular: of each sample; the names and colours are those that `material` gives.
    """

    names: tuple[str, ...]
    f0: tuple[float, ...]
    m: tuple[float, ...]
    diffuse: tuple[tuple[float, ...], ...]
    specular: tuple[tuple[float, ...], ...]

    @classmethod
    @cache
    def fitted(cls) -> CookTorranceSpace:
        """The 86 materials of Ngan et al. 2005 (`ptt/data/README.md`), in MERL's colours."""
        text = resources.files("ptt").joinpath("data", "ngan_cooktorrance.csv").read_text()
        rows = list(csv.DictReader(text.splitlines()))

        def colours(name: str) -> tuple[tuple[float, ...], ...]:
            scaled = zip("rgb", MERL_SCALE, strict=True)
            columns = [[scale * float(row[f"{name}_{c}"]) for row in rows] for c, scale in scaled]
            return tuple(zip(*columns, strict=True))

        f0, m = (tuple(float(row[key]) for row in rows) for key in ("F0", "m"))
        return cls(tuple(row["material"] for row in rows), f0, m, colours("kd"), colours("ks"))

    @property
    def samples(self) -> tuple[CookTorrance, ...]:
        """The shapes, h of them."""
        return tuple(CookTorrance(f0, m) for f0, m in zip(self.f0, self.m, strict=True))

    def material(self, name: str) -> Material:
        """The material of that name.

        Raises:
            ValueError: no such name; the message suggests the nearest ones.
        """
        if name not in self.names:
            near = difflib.get_close_matches(name, self.names, 5, 0.3)
            raise ValueError(f"no material {name!r} among {len(self.names)}; near it: {', '.join(near) or 'none'}")
        h = self.names.index(name)
        return Material(self.diffuse[h], self.specular[h], self.samples[h])

    def at(self, f0: float, m: float) -> CookTorrance:
        """The shape at a point of the plane; outside of the hull, that of the nearest point in it."""
        f0, m = (self.coordinates(CookTorrance(f0, m)) @ self._plane).tolist()
        return CookTorrance(f0, m)

    def path(self, start: CookTorrance, end: CookTorrance, steps: int) -> list[CookTorrance]:
        """Shapes from start to end, both included, evenly spaced in the plane."""
        ends = torch.tensor([[float(s.f0), float(s.m)] for s in (start, end)], dtype=torch.float64)
        along = torch.linspace(0, 1, steps, dtype=torch.float64)[:, None]
        return [self.at(*point) for point in (ends[0] + along * (ends[1] - ends[0])).tolist()]

    def coordinates(self, shape: Shape) -> Tensor:
        """Weights (h,) of the samples, float64: at most three, >= 0, that sum to 1; differentiable in f0 and m.

        Raises:
            ValueError: a shape of another model.
        """
        if not isinstance(shape, CookTorrance):
            raise ValueError(f"the model's space holds cook-torrance shapes, got {shape.model}")
        point = torch.stack([torch.as_tensor(x, dtype=torch.float64).cpu() for x in (shape.f0, shape.m)])
        triangle = int(self._triangles.find_simplex(point.detach().numpy(), tol=1e-9))
        if triangle < 0:
            return self._on_hull(point)
        corners = torch.from_numpy(self._triangles.simplices[triangle].astype(np.int64))
        a, b, c = self._plane[corners]
        u, v = torch.linalg.solve(torch.stack((b - a, c - a), 1), point - a)
        weights = torch.stack((1 - u - v, u, v)).clamp(min=0)
        return torch.zeros(len(self.f0), dtype=torch.float64).index_put((corners,), weights / weights.sum())

    def _on_hull(self, point: Tensor) -> Tensor:
        """Weights of the nearest point on the hull's edges."""
        edges = torch.from_numpy(self._triangles.convex_hull.astype(np.int64))
        a, b = self._plane[edges].unbind(1)
        t = (((point - a) * (b - a)).sum(1) / (b - a).square().sum(1)).clamp(0, 1)
        nearest = int((a + t[:, None] * (b - a) - point).norm(dim=1).argmin())
        weights = torch.stack((1 - t[nearest], t[nearest]))
        return torch.zeros(len(self.f0), dtype=torch.float64).index_put((edges[nearest],), weights)

    @cached_property
    def _plane(self) -> Tensor:
        return torch.tensor([self.f0, self.m], dtype=torch.float64).T.contiguous()

    @cached_property
    def _triangles(self) -> Delaunay:
        return Delaunay(self._plane.numpy())


def fitted(name: str) -> Material:
    """A measured material by its MERL name, as fitted by Ngan et al. 2005: `ptt.fitted("gold-metallic-paint")`.

    Raises:
        ValueError: no such name; the message suggests the nearest ones.
    """
    return CookTorranceSpace.fitted().material(name)
