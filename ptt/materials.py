"""Materials: a diffuse and a specular colour around a monochrome shape."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from torch import Tensor

from ptt.ops import brdf

Colour = float | Sequence[float] | Tensor


@dataclass(frozen=True)
class BlinnPhong:
    """The shape cos(th_h)^exponent, normalised (`ops.brdf.blinn_phong`); exponent 0..1e6, 0 is Lambert."""

    model: ClassVar[str] = "blinn-phong"
    exponent: float | Tensor

    def __post_init__(self) -> None:
        _check("exponent", self.exponent, 0.0, 1e6)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """(..., 3), (..., 3) local unit directions -> (...) [1/sr]."""
        return brdf.blinn_phong(wi, wo, self.exponent)


@dataclass(frozen=True)
class CookTorrance:
    """Beckmann facets of slope m (1e-4..1) with Schlick reflectance f0 (0..1) (`ops.brdf.cook_torrance`)."""

    model: ClassVar[str] = "cook-torrance"
    f0: float | Tensor
    m: float | Tensor

    def __post_init__(self) -> None:
        _check("f0", self.f0, 0.0, 1.0)
        _check("m", self.m, 1e-4, 1.0)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """(..., 3), (..., 3) local unit directions -> (...) [1/sr]."""
        return brdf.cook_torrance(wi, wo, self.f0, self.m)


Shape = BlinnPhong | CookTorrance


@dataclass(frozen=True, eq=False)
class Material:
    """f(wi, wo) = diffuse / pi + specular * shape(wi, wo), in 1/sr, per colour.

    diffuse (3,): albedo, 0..1, multiplied by the base colour of the surface
    specular (3,): weight of the shape, >= 0
    shape: BlinnPhong, CookTorrance, or None for a Lambertian surface

    Numbers stand for grey. Tensors that require gradients are kept, so a loss on the radiance reaches them.

    Raises:
        ValueError: a weight is out of its range, or specular is given without a shape.
    """

    diffuse: Tensor
    specular: Tensor
    shape: Shape | None = None

    def __init__(self, diffuse: Colour = 0.5, specular: Colour = 0.0, shape: Shape | None = None) -> None:
        object.__setattr__(self, "diffuse", _colour("diffuse", diffuse, 1.0))
        object.__setattr__(self, "specular", _colour("specular", specular, math.inf))
        object.__setattr__(self, "shape", shape)
        if shape is None and bool((self.specular > 0).any()):
            raise ValueError("specular > 0 needs a shape: BlinnPhong(exponent) or CookTorrance(f0, m)")

    def evaluate(self, wi: Tensor, wo: Tensor, colour: Tensor | None = None) -> Tensor:
        """The BRDF (..., 3) [1/sr] for local unit directions (..., 3); colour (..., 3) multiplies the diffuse part."""
        diffuse = self.diffuse if colour is None else self.diffuse * colour
        value = brdf.lambert(wi, wo)[..., None] * diffuse.to(wi)
        if self.shape is not None:
            value = value + self.shape.evaluate(wi, wo)[..., None] * self.specular.to(wi)
        return value


def lambert(diffuse: Colour = 0.5) -> Material:
    """A matt material of the given albedo."""
    return Material(diffuse)


def blinn_phong(diffuse: Colour = 0.5, specular: Colour = 0.5, exponent: float | Tensor = 20.0) -> Material:
    """A glossy material; exponent 1 is nearly matt, 200 a clear highlight."""
    return Material(diffuse, specular, BlinnPhong(exponent))


def cook_torrance(
    diffuse: Colour = 0.5, specular: Colour = 0.5, f0: float | Tensor = 0.1, m: float | Tensor = 0.2
) -> Material:
    """A microfacet material in the convention of Ngan et al. 2005."""
    return Material(diffuse, specular, CookTorrance(f0, m))


def to_config(material: Material) -> dict[str, Any]:
    """A material as plain numbers, e.g. {"model": "blinn-phong", "diffuse": [..], "specular": [..], "exponent": 20}."""
    shape = material.shape
    parameters = {f.name: float(getattr(shape, f.name)) for f in fields(shape)} if shape else {}
    specular = {"specular": material.specular.tolist()} if shape else {}
    model = shape.model if shape else "lambert"
    return {"model": model, "diffuse": material.diffuse.tolist(), **specular, **parameters}


MODELS: dict[str, Callable[..., Material]] = {
    "lambert": lambert,
    BlinnPhong.model: blinn_phong,
    CookTorrance.model: cook_torrance,
}


def from_config(config: Mapping[str, Any]) -> Material:
    """The inverse of `to_config`; what is left out has the default of the model's function.

    Raises:
        ValueError: an unknown model, or a key that the model does not have; the message lists the valid ones.
    """
    model = config.get("model")
    if model not in MODELS:
        raise ValueError(f"material.model must be one of {', '.join(MODELS)}, got {model!r}")
    values = {key: value for key, value in config.items() if key != "model"}
    valid = inspect.signature(MODELS[model]).parameters
    if unknown := [key for key in values if key not in valid]:
        raise ValueError(f"material: unknown {', '.join(map(repr, unknown))}; valid are {', '.join(valid)}")
    return MODELS[model](**values)


def _colour(name: str, value: Colour, high: float) -> Tensor:
    colour = torch.as_tensor(value, dtype=torch.float32)
    if colour.ndim == 0:
        colour = colour.expand(3)
    if colour.shape != (3,):
        raise ValueError(f"{name} must be one number or (3,) linear RGB, got shape {tuple(colour.shape)}")
    _check(name, colour, 0.0, high)
    return colour


def _check(name: str, value: float | Tensor, low: float, high: float) -> None:
    v = torch.as_tensor(value).detach().double()
    rounded = 1e-6  # float32 may hold a bound a little beside itself
    if not bool((torch.isfinite(v) & (v >= low * (1 - rounded)) & (v <= high * (1 + rounded))).all()):
        bounds = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise ValueError(f"{name} must be finite and {bounds}, got {v.tolist()}")
