"""BRDF spaces: sampled shapes of one model, names for some of them, and the shapes between them (Sun 2007, 4.2)."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import resources
from itertools import groupby, pairwise
from typing import Any, overload

import torch
from torch import Tensor, nn

from ptt.materials import material as mat
from ptt.materials import shapes
from ptt.materials.families import Family, family_of
from ptt.materials.material import Highlight, Material
from ptt.materials.shapes import GGX, Analytic, Blend, BlinnPhong, CookTorrance, Named, Number, Shape, Ward, number
from ptt.materials.varying import SurfaceMaterial

BRDF = Callable[[Tensor, Tensor], Tensor]  # f(wi, wo): (..., 3), (..., 3) -> (...) [1/sr]
MERL_SCALE = 1.0, 1.15, 1.66  # of red, green and blue in MERL's tables: the published fits lack it
EXPONENTS = tuple(200 ** (k / 40) for k in range(41))  # 1..200, a seventh apart
MODERATE = tuple(2 ** (k / 4) for k in range(25))  # 1..64: exponents that a tensor shows well without lobes
SLOPES = tuple(0.03 * 30 ** (k / 24) for k in range(25))  # 0.03..0.9
ROUGHNESSES = tuple(0.1 ** (1 - k / 24) for k in range(25))  # 0.1..1


@dataclass(frozen=True, eq=False)
class BRDFSpace:
    """Sampled shapes of analytic models, with all shapes of each between them, and any number of named BRDFs.

    samples (h): analytic shapes, of each model such that one or two parameters vary, and `Named` ones of the user's own
    materials: the materials that `material` and `path` know, by name
    clamped: says whether an analytic shape outside of the samples becomes the nearest one inside, or is refused

    Between analytic samples the space is linear: along exponents, bilinear on a grid (Ward's slopes, GGX), barycentric
    in a plane that is triangulated otherwise.

        space = BRDFSpace.fitted()
        space.material("gold-metallic-paint")
        space.at(F0=0.4, m=0.2)
        space.path("gold-metallic-paint", "chrome", steps=24)       # an animation

    Raises:
        ValueError: there are no samples, those of a model cannot be triangulated, or there is the same sample twice.

    Sun et al. 2007, section 4.2.
    """

    samples: tuple[Shape, ...]
    materials: Mapping[str, Material] = field(default_factory=dict)
    clamped: bool = False

    def __post_init__(self) -> None:
        if not self.samples or any(isinstance(s, Blend) for s in self.samples):
            raise ValueError("samples must hold at least one shape, and no Blend")
        if len({str(shapes.to_config(s)) for s in self.samples}) < len(self.samples):
            raise ValueError("samples must differ, got the same parameters or the same name twice")
        _ = self._families  # samples that cannot be triangulated are refused now

    @classmethod
    def blinn_phong(cls, exponents: Sequence[float] = EXPONENTS) -> BRDFSpace:
        """Blinn-Phong shapes of ascending exponents; the default has 41 in 1..200, where the paper has every integer.

        Raises:
            ValueError: the exponents do not ascend, or leave 0..1e6.
        """
        if not exponents or any(a >= b for a, b in pairwise(exponents)):
            raise ValueError(f"exponents must hold ascending values, got {tuple(exponents)}")
        return cls(tuple(BlinnPhong(float(n)) for n in exponents))

    @classmethod
    @cache
    def fitted(cls) -> BRDFSpace:
        """The 86 Cook-Torrance materials of Ngan et al. 2005 (`ptt/data/README.md`), in MERL's colours."""
        text = resources.files("ptt").joinpath("data", "ngan_cooktorrance.csv").read_text()

        def colour(row: dict[str, str], key: str) -> list[float]:
            return [scale * float(row[f"{key}_{c}"]) for scale, c in zip(MERL_SCALE, "rgb", strict=True)]

        def material(row: dict[str, str]) -> Material:
            diffuse = colour(row, "kd")
            specular = colour(row, "ks")
            return Material(diffuse, specular, CookTorrance(float(row["F0"]), float(row["m"])))

        named = {row["material"]: material(row) for row in csv.DictReader(text.splitlines())}
        return cls(tuple(m.shape for m in named.values() if m.shape), named, clamped=True)

    @classmethod
    def ward(cls, slopes: Sequence[float] | None = None, anisotropic: bool = False) -> BRDFSpace:
        """Ward shapes of the given slopes, 25 in 0.03..0.9 by default; anisotropic: of all pairs, by default of 7."""
        if anisotropic:
            slopes = slopes or SLOPES[::4]
            return cls(tuple(Ward(x, y) for x in slopes for y in slopes))
        return cls(tuple(Ward(x) for x in slopes or SLOPES))

    @classmethod
    def ggx(cls, roughnesses: Sequence[float] = ROUGHNESSES) -> BRDFSpace:
        """GGX shapes of the given roughnesses with F0 0 and 1: Schlick's reflectance is linear in between."""
        return cls(tuple(GGX(f0, r) for r in roughnesses for f0 in (0.0, 1.0)))

    @classmethod
    def holding(cls, chosen: Iterable[SurfaceMaterial | BRDFSpace]) -> BRDFSpace:
        """The space that holds some materials, with all shapes of their models, and other spaces; Blinn-Phong for none.

        Raises:
            ValueError: a material has a `Blend`, or what is chosen is neither a material nor a space.
        """
        chosen = list(chosen)
        if wrong := [one for one in chosen if not isinstance(one, SurfaceMaterial | BRDFSpace)]:
            raise ValueError(f"a space holds materials and spaces, got {type(wrong[0]).__name__}")
        spaces = [one for one in chosen if isinstance(one, BRDFSpace)]
        layers = [layer for one in chosen if not isinstance(one, BRDFSpace) for layer in one.layers]
        every = [highlight.shape for layer in layers for highlight in layer.highlights]
        if blends := [shape for shape in every if isinstance(shape, Blend)]:
            raise ValueError(f"a space of its own is for analytic and named shapes, got {blends[0]}")
        parts = [*map(cls._of_family, _by_family(every)), *spaces]
        named = [shape for shape in every if isinstance(shape, Named)]
        parts = parts or ([] if named else [cls.blinn_phong()])
        samples = {str(shapes.to_config(s)): s for s in [*(s for part in parts for s in part.samples), *named]}
        known = {name: material for part in parts for name, material in part.materials.items()}
        return cls(tuple(samples.values()), known, any(part.clamped for part in parts))

    @classmethod
    def _of_family(cls, own: Sequence[Analytic]) -> BRDFSpace:
        """The usual space of a family, as far as some shapes of it reach."""
        match own[0]:
            case BlinnPhong():
                return cls.blinn_phong(_reaching(EXPONENTS, _values(own, "exponent")))
            case GGX():
                return cls.ggx(_reaching(ROUGHNESSES, _values(own, "roughness")))
            case Ward():
                brushed = "ay" in shapes.parameters(own[0])
                slopes = _reaching(SLOPES[::4] if brushed else SLOPES, _values(own, "ax", "ay"), 1.0)
                return cls.ward(slopes, brushed)
        return cls.fitted()

    @classmethod
    def user(cls, brdfs: Mapping[str, BRDF | Material]) -> BRDFSpace:
        """BRDFs of one's own by name: functions f(wi, wo) (..., 3), (..., 3) -> (...) [1/sr], or materials.

        `ptt.separate` makes a material of RGB data, `ptt.tabulated` a function of a table.
        """
        named = {name: _named_material(name, given) for name, given in brdfs.items()}
        return cls(tuple(h.shape for material in named.values() for h in material.highlights), named)

    @property
    def isotropic(self) -> bool:
        """Tell whether every sample is isotropic."""
        return all(shape.isotropic for shape in self.samples)

    def with_brdf(self, name: str, brdf: BRDF | Material) -> BRDFSpace:
        """The space with more samples: a function f(wi, wo), or the shapes of a material's highlights, by name.

        Raises:
            ValueError: the name is taken, the material has no shape, or the function returns values that no BRDF has.
        """
        if name in self.materials:
            raise ValueError(f"name {name!r} is taken: the space has a material of that name")
        material = _named_material(name, brdf)
        samples = (*self.samples, *(highlight.shape for highlight in material.highlights))
        return replace(self, samples=samples, materials={**self.materials, name: material})

    def material(self, name: str) -> Material:
        """The material of that name.

        Raises:
            ValueError: no material has that name; the message suggests the nearest ones.
        """
        if name not in self.materials:
            near = difflib.get_close_matches(name, self.materials, 5, 0.3)
            raise ValueError(f"no material {name!r} among {len(self.materials)}; near it: {', '.join(near) or 'none'}")
        return self.materials[name]

    def at(self, **parameters: Number) -> Shape:
        """The analytic shape with these parameters: `space.at(F0=0.4, m=0.2)` (or f0).

        Raises:
            ValueError: parameters are unknown or missing, or lie outside of a space that does not clamp.
        """
        if not self._families:
            raise ValueError(f"the space holds BRDFs by name, not by parameters: {', '.join(self.materials)}")
        given = {name.lower(): value for name, value in parameters.items()}
        own = [f for f in self._families.values() if shapes.parameters(f.first).keys() == given.keys()]
        if len(own) != 1 or len(given) < len(parameters):
            valid = " or ".join(", ".join(shapes.parameters(f.first)) for f in self._families.values())
            raise ValueError(f"parameters must be {valid}, got {', '.join(parameters) or 'none'}")
        return own[0].at(given)

    @overload
    def path(self, start: Shape, end: Shape, steps: int) -> list[Shape]: ...
    @overload
    def path(self, start: Material | str, end: Material | str, steps: int) -> list[Material]: ...
    def path(self, start: Shape | Material | str, end: Shape | Material | str, steps: int) -> list[Any]:
        """Even steps from start to end, both included: shapes between shapes, materials between materials or names.

        Analytic shapes move along a line through their parameters, named BRDFs blend.

        Raises:
            ValueError: steps are fewer than two, a name is unknown, or an end lies outside of the space.
        """
        if steps < 2:
            raise ValueError(f"steps must be at least 2, got {steps}")
        start = self.material(start) if isinstance(start, str) else start
        end = self.material(end) if isinstance(end, str) else end
        along = torch.linspace(0, 1, steps, dtype=torch.float64).tolist()
        if isinstance(start, Material) and isinstance(end, Material):
            return [self._material_between(start, end, t) for t in along]
        if isinstance(start, Material) or isinstance(end, Material):
            raise ValueError("start and end must both be shapes, or both materials or names")
        return [self._between(start, end, t) for t in along]

    def coordinates(self, shape: Shape) -> Tensor:
        """Weights (h,) of the samples, float64, that interpolate a shape; differentiable in its parameters.

        They are >= 0, at most four of them are not zero, and they sum to 1 (those of a `Blend`: to its weights' sum).

        Raises:
            ValueError: the shape is of another model, its name unknown, or its parameters outside of the samples.
        """
        if isinstance(shape, Blend):
            parts = zip(shape.weights, shape.shapes, strict=True)
            return torch.stack([torch.as_tensor(w).cpu() * self.coordinates(s) for w, s in parts]).sum(0)
        if isinstance(shape, Named):
            return self._by_name(shape.name)
        family = self._family(shape)
        weights = family.weights(shape)
        if len(weights) == len(self.samples):
            return weights
        return torch.zeros(len(self.samples), dtype=torch.float64).index_put((family.rows,), weights)

    def coloured(self, material: Material) -> Tensor:
        """Weights (h, 3) of the samples, float64, that interpolate what a material has around its diffuse part.

        Differentiable in the colours of its highlights and in the parameters of their shapes.

        Raises:
            ValueError: as `coordinates`.
        """
        return self.mixed(self.highlights(material))

    def highlights(self, material: Material) -> list[tuple[Tensor, Tensor]]:
        """The coordinates (h,) and the colour (3,) of each highlight of a material."""
        return [(self.coordinates(highlight.shape), highlight.colour) for highlight in material.highlights]

    def mixed(self, highlights: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
        """Weights (h, 3) of the samples, of the coordinates and colours of highlights."""
        parts = [weights[:, None] * colour.to(weights) for weights, colour in highlights]
        return sum(parts[1:], parts[0]) if parts else torch.zeros(len(self.samples), 3, dtype=torch.float64)

    def resolved(self, shape: Shape | Tensor) -> Tensor:
        """The coordinates (h,) of a shape; a tensor is taken for coordinates."""
        return shape if isinstance(shape, Tensor) else self.coordinates(shape)

    def to_config(self) -> dict[str, Any]:
        """The space as plain values; functions of named BRDFs are left out."""
        materials = {name: mat.to_config(material) for name, material in self.materials.items()}
        samples = [shapes.to_config(shape) for shape in self.samples]
        return {"samples": samples, "materials": materials, "clamped": self.clamped}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> BRDFSpace:
        """The space of a config, the inverse of `to_config`; named BRDFs come back without their functions."""
        materials = {name: mat.from_config(material) for name, material in config["materials"].items()}
        return cls(tuple(shapes.from_config(s) for s in config["samples"]), materials, config["clamped"])

    def _by_name(self, name: str) -> Tensor:
        """The coordinates (h,) of a named BRDF."""
        names = [s.name if isinstance(s, Named) else None for s in self.samples]
        if name not in names:
            known = ", ".join(n for n in names if n) or "none"
            raise ValueError(f"no BRDF {name!r} in the space, whose named ones are: {known}; see with_brdf")
        return nn.functional.one_hot(torch.tensor(names.index(name)), len(names)).double()

    def _family(self, shape: Analytic) -> Family:
        """The family of a shape.

        Raises:
            ValueError: the space has none of its model, or of its parameters.
        """
        if family_of(shape) in self._families:
            return self._families[family_of(shape)]
        for family in self._families.values():
            if family.first.model == shape.model:
                valid, got = (", ".join(shapes.parameters(s)) for s in (family.first, shape))
                raise ValueError(f"{shape.model} must have {valid} here, got {got}")
        other = "compress with editable=[...] that names it, or fit a space that holds it"
        raise ValueError(f"the model's space holds {self._models} shapes, got {shape.model}: {other}")

    def _between(self, start: Shape, end: Shape, t: float) -> Shape:
        """The shape at t in 0..1 of the way."""
        for shape in (start, end):
            self.coordinates(shape)  # refuses what is not in the space
        if isinstance(start, Named | Blend) or isinstance(end, Named | Blend):
            return Blend((start, end), (1 - t, t))
        if family_of(start) != family_of(end):
            return Blend((start, end), (1 - t, t))
        along: dict[str, Number] = {}
        for (name, first), last in zip(shapes.parameters(start).items(), shapes.parameters(end).values(), strict=True):
            a = shapes.number(first)
            along[name] = a + t * (shapes.number(last) - a)
        return self._family(start).at(along)

    def _material_between(self, start: Material, end: Material, t: float) -> Material:
        if start.shape is None or end.shape is None:
            raise ValueError("both materials of a path must have a shape")
        diffuse = torch.lerp(start.diffuse, end.diffuse, t)
        specular = torch.lerp(start.specular, end.specular, t)
        return Material(diffuse, specular, self._between(start.shape, end.shape, t))

    @property
    def _models(self) -> str:
        return ", ".join(sorted({shape.model for shape in self.samples}))

    @cached_property
    def _families(self) -> dict[tuple[str, ...], Family]:
        """The analytic samples, by model."""
        rows: dict[tuple[str, ...], list[int]] = {}
        analytic = {row: sample for row, sample in enumerate(self.samples) if isinstance(sample, Analytic)}
        for row, sample in analytic.items():
            rows.setdefault(family_of(sample), []).append(row)
        return {key: Family([analytic[row] for row in own], own, self.clamped) for key, own in rows.items()}


def fitted(name: str) -> Material:
    """A measured material by its MERL name, as fitted by Ngan et al. 2005: `ptt.fitted("gold-metallic-paint")`.

    Raises:
        ValueError: no material has that name; the message suggests the nearest ones.
    """
    return BRDFSpace.fitted().material(name)


def _by_family(every: Iterable[Shape]) -> list[list[Analytic]]:
    """The analytic shapes, family by family."""
    analytic = sorted((shape for shape in every if isinstance(shape, Analytic)), key=family_of)
    return [list(own) for _, own in groupby(analytic, family_of)]


def _values(own: Iterable[Analytic], *names: str) -> list[float]:
    """The parameters of those names of some shapes."""
    given = [getattr(shape, name) for shape in own for name in names]
    return [number(value) for value in given if value is not None]


def _reaching(values: Sequence[float], wanted: Sequence[float], most: float = math.inf) -> tuple[float, ...]:
    """Ascending values, and as many more at the same ratio, down to 1e-3 of the first, as reach all that are wanted."""
    ratio = values[1] / values[0]
    found = list(values)
    while max(wanted) > found[-1] * (1 + 1e-6):
        found.append(min(found[-1] * ratio, most))
    while min(wanted) < found[0] * (1 - 1e-6) and found[0] > 1e-3 * values[0]:
        found.insert(0, found[0] / ratio)
    return tuple(found)


def _named_material(name: str, given: BRDF | Material) -> Material:
    """A material whose shapes have the given name, and that and a number, so that edits of its colours keep them."""
    if not isinstance(given, Material):
        isotropic = shapes.looks_isotropic(Named(name, given))
        return Material(0.0, 1.0, Named(name, given, isotropic))
    if not given.highlights:
        raise ValueError(f"material {name!r} must have a shape")
    names = [name, *(f"{name}/{k}" for k in range(2, len(given.highlights) + 1))]
    highlights = [
        Highlight(one.colour, Named(label, one.shape.evaluate, one.shape.isotropic))
        for label, one in zip(names, given.highlights, strict=True)
    ]
    return Material(given.diffuse, 0.0, None, *highlights)
