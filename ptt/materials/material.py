"""Materials: a diffuse colour, and highlights, each a colour around a monochrome shape."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from ptt.materials import shapes
from ptt.materials.shapes import GGX, BlinnPhong, CookTorrance, Number, Shape, Ward, check, check_number
from ptt.ops import brdf, kinds
from ptt.ops.transforms import beneath, differentiated

Colour = float | Sequence[float] | Tensor
DIELECTRIC = 0.04  # reflectance straight on of glass and plastic, whose index of refraction is 1.5
SHAPES: tuple[type, ...] = get_args(Shape)
SMOOTHEST = 0.03  # roughness of GGX that stands for 0: a narrower lobe is a mirror


class LayersAt(NamedTuple):
    """What is at n points of a surface.

    group (n,): which of its material's groups of layers
    shares (m, n, 3): how much of each layer of that group
    colour (n, 3): base colour that multiplies the layers' diffuse parts
    """

    group: Tensor
    shares: Tensor
    colour: Tensor


@dataclass(frozen=True, eq=False, init=False)
class Highlight:
    """colour * shape(wi, wo), in 1/sr, per colour; colour (3,): >= 0, and a number stands for grey."""

    colour: Tensor
    shape: Shape

    def __init__(self, colour: Colour, shape: Shape) -> None:
        kinds.check("shape", shape, SHAPES)
        object.__setattr__(self, "colour", as_colour("specular", colour, math.inf))
        object.__setattr__(self, "shape", shape)


@dataclass(frozen=True, eq=False, init=False)
class Material:
    """f(wi, wo) = diffuse / pi + the sum of highlights, colour * shape(wi, wo), in 1/sr, per colour.

    diffuse (3,): albedo, 0..1, multiplied by the base colour of the surface
    highlights: what is around it, most materials have one, Lambertian ones none

    Material(diffuse, specular, shape, *more) has a highlight of a colour and one of `ptt.materials.shapes`, and more.
    Numbers stand for grey. Tensors that require gradients are kept, so a loss on the radiance reaches them.

    Raises:
        ValueError: a weight is out of its range, specular is given without a shape, or the shape is none.
    """

    diffuse: Tensor
    highlights: tuple[Highlight, ...]

    def __init__(
        self, diffuse: Colour = 0.5, specular: Colour = 0.0, shape: Shape | None = None, *more: Highlight
    ) -> None:
        if shape is None and bool((beneath(as_colour("specular", specular, math.inf)) > 0).any()):
            raise ValueError("specular > 0 needs a shape, such as BlinnPhong(exponent) or GGX(f0, roughness)")
        first = () if shape is None else (Highlight(specular, shape),)
        object.__setattr__(self, "diffuse", as_colour("diffuse", diffuse, 1.0))
        object.__setattr__(self, "highlights", (*first, *more))

    @property
    def specular(self) -> Tensor:
        """The colour (3,) of the highlight, 0 where there is none.

        Raises:
            ValueError: there are several.
        """
        return self._only.colour if self.highlights else torch.zeros(3, dtype=torch.float32)

    @property
    def shape(self) -> Shape | None:
        """The shape of the highlight, None where there is none.

        Raises:
            ValueError: there are several.
        """
        return self._only.shape if self.highlights else None

    @property
    def _only(self) -> Highlight:
        if len(self.highlights) > 1:
            raise ValueError(f"the material has {len(self.highlights)} highlights: see Material.highlights")
        return self.highlights[0]

    @property
    def shining(self) -> tuple[Highlight, ...]:
        """The highlights that reflect light: their colours are not all 0."""
        return tuple(h for h in self.highlights if bool((beneath(h.colour) > 0).any()))

    def glossy(self, wi: Tensor, wo: Tensor) -> Tensor:
        """What its highlights reflect (..., 3) [1/sr], for local unit directions (..., 3)."""
        parts = [h.shape.evaluate(wi, wo)[..., None] * h.colour.to(wi) for h in self.highlights]
        return sum(parts[1:], parts[0])

    @property
    def isotropic(self) -> bool:
        """Tell whether a turn about the normal changes nothing."""
        return all(highlight.shape.isotropic for highlight in self.highlights)

    @property
    def layers(self) -> tuple[Material, ...]:
        """Materials with a highlight at most, whose sum it is; the first has the diffuse part."""
        first, *others = self.highlights or (None,)
        alone = Material(self.diffuse) if first is None else Material(self.diffuse, first.colour, first.shape)
        return (alone, *(Material(0.0, h.colour, h.shape) for h in others if h is not None))

    @property
    def maps(self) -> tuple[()]:
        """None: it is the same everywhere (see `ptt.materials.varying`)."""
        return ()

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """All layers together."""
        return (tuple(range(max(1, len(self.highlights)))),)

    def at(self, values: Tensor, colour: Tensor) -> LayersAt:
        """All of every layer at points of base colours (n, 3)."""
        shares = torch.ones_like(colour).expand(len(self.groups[0]), -1, -1)
        return LayersAt(torch.zeros_like(colour[:, 0], dtype=torch.int64), shares, colour)

    def evaluate(self, wi: Tensor, wo: Tensor, colour: Tensor | None = None, values: Tensor | None = None) -> Tensor:
        """The BRDF (..., 3) [1/sr] for local unit directions (..., 3); colour (..., 3) multiplies the diffuse part."""
        diffuse = self.diffuse if colour is None else self.diffuse * colour
        value = brdf.lambert(wi, wo)[..., None] * diffuse.to(wi)
        for highlight in self.highlights:
            value = value + highlight.shape.evaluate(wi, wo)[..., None] * highlight.colour.to(wi)
        return value


def lambert(diffuse: Colour = 0.5) -> Material:
    """A matt material of the given albedo."""
    return Material(diffuse)


def blinn_phong(diffuse: Colour = 0.5, specular: Colour = 0.5, exponent: Number = 20.0) -> Material:
    """A glossy material; exponent 1 is nearly matt, 200 a clear highlight."""
    return Material(diffuse, specular, BlinnPhong(exponent))


def cook_torrance(diffuse: Colour = 0.5, specular: Colour = 0.5, f0: Colour = 0.1, m: Number = 0.2) -> Material:
    """A microfacet material in the convention of Ngan et al. 2005; f0 may be a colour."""
    return _schlick(diffuse, specular, f0, lambda reflectance: CookTorrance(reflectance, m))


def ward(diffuse: Colour = 0.5, specular: Colour = 0.3, ax: Number = 0.2, ay: Number | None = None) -> Material:
    """Ward's model; with ay unlike ax an anisotropic one, brushed along the tangent if ax is the larger."""
    return Material(diffuse, specular, Ward(ax, ay))


def ggx(diffuse: Colour = 0.5, specular: Colour = 1.0, f0: Colour = 0.04, roughness: Number = 0.5) -> Material:
    """Today's microfacet model: a dielectric with specular 1 and f0 0.04, a metal with diffuse 0 and a coloured f0."""
    return _schlick(diffuse, specular, f0, lambda reflectance: GGX(reflectance, roughness))


def metal_rough(
    base: Colour = 0.8, metallic: float = 0.0, roughness: float = 0.5, reflectance: Colour = DIELECTRIC
) -> Material:
    """The metallic-roughness material of glTF, Blender and others, as GGX over a diffuse part.

    base (3,): albedo of the dielectric, what the metal reflects straight on
    metallic: 0 for a dielectric, 1 for a metal, and linear in between
    roughness: 0..1; below 0.03 it is 0.03
    reflectance (3,): what the dielectric reflects straight on

        f = base (1 - metallic) (1 - reflectance) / pi + GGX of f0 = reflectance (1 - metallic) + base metallic
    """
    check_number("metallic", metallic, 0.0, 1.0)
    check_number("roughness", roughness, 0.0, 1.0)
    colour = as_colour("base", base, 1.0)
    straight = as_colour("reflectance", reflectance, 1.0)
    f0 = torch.lerp(straight, colour, float(metallic))
    one = bool((f0 == f0[0]).all()) and not differentiated(f0)
    return ggx((1 - metallic) * (1 - straight) * colour, 1.0, float(f0[0]) if one else f0, max(roughness, SMOOTHEST))


def _schlick(diffuse: Colour, specular: Colour, f0: Colour, shape: Callable[[Number], Shape]) -> Material:
    """A material of Schlick's reflectance in colour: f0 shape(1) + (1 - f0) shape(0), since it is linear in f0."""
    if torch.as_tensor(f0).numel() == 1:
        return Material(diffuse, specular, shape(f0))  # type: ignore[arg-type]
    f0 = as_colour("f0", f0, 1.0)
    weight = as_colour("specular", specular, math.inf)
    return Material(diffuse, weight * f0, shape(1.0), Highlight(weight * (1 - f0), shape(0.0)))


def to_config(material: Material) -> dict[str, Any]:
    """A material as plain values, e.g. {"model": "blinn-phong", "diffuse": [..], "specular": [..], "exponent": 20}."""
    diffuse = {"diffuse": material.diffuse.tolist()}
    highlights = [shapes.to_config(h.shape) | {"specular": h.colour.tolist()} for h in material.highlights]
    if not highlights:
        return {"model": "lambert"} | diffuse
    return highlights[0] | diffuse if len(highlights) == 1 else {"model": SEVERAL, "highlights": highlights} | diffuse


SEVERAL = "highlights"  # the model of materials with several
# The function that makes a material of each other model, by the name in a config
MODELS: dict[str, Callable[..., Material]] = {
    "lambert": lambert,
    BlinnPhong.model: blinn_phong,
    CookTorrance.model: cook_torrance,
    Ward.model: ward,
    GGX.model: ggx,
}
NAMES = (*MODELS, SEVERAL, shapes.Named.model, shapes.Blend.model)
"""The models of all configs."""


def from_config(config: Mapping[str, Any]) -> Material:
    """The material of a config, the inverse of `to_config`; keys that are left out have the model's defaults.

    Raises:
        ValueError: an unknown model, or a key that the model does not have; the message lists the valid ones.
    """
    values = dict(config)
    model = values.pop("model", None)
    if model not in NAMES:
        raise ValueError(f"material.model must be one of {', '.join(MODELS)}, got {model!r}")
    if model == SEVERAL:
        first, *more = (from_config(highlight).highlights[0] for highlight in values["highlights"])
        return Material(values.get("diffuse", 0.5), first.colour, first.shape, *more)
    if model not in MODELS:
        diffuse = values.pop("diffuse", 0.5)
        specular = values.pop("specular", 0.5)
        return Material(diffuse, specular, shapes.from_config({"model": model, **values}))
    valid = inspect.signature(MODELS[model]).parameters
    if unknown := [key for key in values if key not in valid]:
        raise ValueError(f"material: unknown {', '.join(map(repr, unknown))}; valid are {', '.join(valid)}")
    return MODELS[model](**values)


def as_colour(name: str, value: Colour, high: float) -> Tensor:
    """A colour (3,), checked to lie in 0..high."""
    try:
        colour = torch.as_tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be one number or (3,) linear RGB, got {value!r}") from error
    if colour.ndim == 0:
        colour = colour.expand(3)
    if colour.shape != (3,):
        raise ValueError(f"{name} must be one number or (3,) linear RGB, got shape {tuple(colour.shape)}")
    check(name, colour, 0.0, high)
    return colour
