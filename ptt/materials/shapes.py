"""Shapes: the monochrome BRDFs that materials put their colours around.

Every shape has `evaluate(wi, wo)`: local unit directions (..., 3), (..., 3) -> (...) [1/sr] without the cosine, zero
where either is at or below the horizon. `isotropic` says whether turning both about the normal changes nothing.

Parameters are numbers, or tensors of one element that may require gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ptt.ops import brdf, lobes
from ptt.ops.directions import turn
from ptt.ops.transforms import beneath, differentiated, is_batch

Number = float | Tensor


@dataclass(frozen=True)
class BlinnPhong:
    """Blinn and Phong's cos(th_h)^exponent, normalised (`ops.brdf.blinn_phong`); exponent 0..1e6, 0 is Lambert."""

    model: ClassVar[str] = "blinn-phong"
    isotropic: ClassVar[bool] = True
    exponent: Number

    def __post_init__(self) -> None:
        check_number("exponent", self.exponent, 0.0, 1e6)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        return brdf.blinn_phong(wi, wo, self.exponent)


@dataclass(frozen=True)
class CookTorrance:
    """Beckmann facets of slope m (1e-4..1) with Schlick reflectance f0 (0..1) (`ops.brdf.cook_torrance`)."""

    model: ClassVar[str] = "cook-torrance"
    isotropic: ClassVar[bool] = True
    f0: Number
    m: Number

    def __post_init__(self) -> None:
        check_number("f0", self.f0, 0.0, 1.0)
        check_number("m", self.m, 1e-4, 1.0)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        return brdf.cook_torrance(wi, wo, self.f0, self.m)


@dataclass(frozen=True)
class Ward:
    """Ward's bounded form with slopes ax along the tangent, ay along the bitangent (1e-4..1) (`ops.brdf.ward`).

    Without ay the shape is isotropic.
    """

    model: ClassVar[str] = "ward"
    ax: Number
    ay: Number | None = None

    def __post_init__(self) -> None:
        check_number("ax", self.ax, 1e-4, 1.0)
        if self.ay is not None:
            check_number("ay", self.ay, 1e-4, 1.0)

    @property
    def isotropic(self) -> bool:
        return self.ay is None

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        return brdf.ward(wi, wo, self.ax, self.ay)


@dataclass(frozen=True)
class GGX:
    """GGX facets with Schlick reflectance f0 (0..1); the slope is roughness (1e-4..1) squared (`ops.brdf.ggx`)."""

    model: ClassVar[str] = "ggx"
    isotropic: ClassVar[bool] = True
    f0: Number
    roughness: Number

    def __post_init__(self) -> None:
        check_number("f0", self.f0, 0.0, 1.0)
        check_number("roughness", self.roughness, 1e-4, 1.0)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        return brdf.ggx(wi, wo, self.f0, self.roughness)


@dataclass(frozen=True)
class Named:
    """A BRDF of the user's own, known by its name: shapes of one name are the same shape.

    function: f(wi, wo), as `evaluate`: reciprocal, non-negative, and isotropic unless `isotropic` is False. It is None
        in a model that was loaded, whose tensors hold what the model needs of it
    """

    model: ClassVar[str] = "named"
    name: str
    function: Callable[[Tensor, Tensor], Tensor] | None = field(default=None, compare=False)
    isotropic: bool = field(default=True, compare=False)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """The function's values (...) [1/sr], checked, and zero where a direction is at or below the horizon.

        Raises:
            ValueError: the function is missing, or returns negative or non-finite values, or another shape.
        """
        if self.function is None:
            lacking = "came from a saved model, without its function"
            raise ValueError(f"the BRDF {self.name!r} {lacking}: give its material again, in materials")
        value = self.function(wi, wo)
        expected = torch.broadcast_shapes(wi.shape, wo.shape)[:-1]
        if value.shape != expected:
            raise ValueError(f"the BRDF {self.name!r} must return {tuple(expected)}, got {tuple(value.shape)}")
        above = (wi[..., 2] > 0) & (wo[..., 2] > 0)
        value = torch.where(above, value, 0.0)
        if not bool((torch.isfinite(value) & (value >= 0)).all()):
            raise ValueError(f"the BRDF {self.name!r} must be finite and >= 0 above the horizon")
        return value


@dataclass(frozen=True)
class Blend:
    """The sum of shapes times weights >= 0: a shape between the BRDFs of a user's own space."""

    model: ClassVar[str] = "blend"
    shapes: tuple[Shape, ...]
    weights: tuple[Number, ...]

    def __post_init__(self) -> None:
        if not self.shapes or len(self.shapes) != len(self.weights):
            raise ValueError(f"weights must be one per shape, got {len(self.weights)} for {len(self.shapes)}")
        for weight in self.weights:
            check("weights", weight, 0.0, math.inf)

    @property
    def isotropic(self) -> bool:
        return all(shape.isotropic for shape in self.shapes)

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        values = [w * shape.evaluate(wi, wo) for w, shape in zip(self.weights, self.shapes, strict=True)]
        return torch.stack(values).sum(0)


Analytic = BlinnPhong | CookTorrance | Ward | GGX
Shape = Analytic | Named | Blend
ANALYTIC: dict[str, type[Analytic]] = {s.model: s for s in (BlinnPhong, CookTorrance, Ward, GGX)}


def parameters(shape: Shape) -> dict[str, Number]:
    """The parameters of an analytic shape, by name, without those that are None; empty for other shapes."""
    if not isinstance(shape, Analytic):
        return {}
    return {f.name: value for f in fields(shape) if (value := getattr(shape, f.name)) is not None}


def to_config(shape: Shape) -> dict[str, Any]:
    """A shape as plain values, e.g. {"model": "ggx", "f0": 0.04, "roughness": 0.3}; functions are left out."""
    match shape:
        case Named(name):
            return {"model": shape.model, "name": name, "isotropic": shape.isotropic}
        case Blend(shapes, weights):
            return {
                "model": shape.model,
                "shapes": [to_config(s) for s in shapes],
                "weights": [number(w) for w in weights],
            }
    return {"model": shape.model, **{name: number(value) for name, value in parameters(shape).items()}}


def from_config(config: Mapping[str, Any]) -> Shape:
    """The shape of a config, the inverse of `to_config`.

    Raises:
        ValueError: the model is unknown, or does not take a value.
    """
    values = dict(config)
    model = values.pop("model", None)
    models: dict[str, Callable[..., Shape]] = {**ANALYTIC, Named.model: Named, Blend.model: _blend}
    if model not in models:
        raise ValueError(f"shape.model must be one of {', '.join(models)}, got {model!r}")
    try:
        return models[model](**values)
    except TypeError as error:
        raise ValueError(f"shape of model {model}: {error}") from error


def number(value: Number) -> float:
    """A parameter as a plain number, without its gradient.

    Raises:
        ValueError: it stands for a batch.
    """
    if isinstance(value, Tensor) and is_batch(value):
        raise ValueError("parameters of shapes cannot be a batch of torch.func.vmap: loop over them")
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def shape_key(shape: Shape) -> tuple[object, ...]:
    """A key that tells shapes apart, of plain numbers: later edits of a parameter do not change it."""
    match shape:
        case Named(name, function):
            return shape.model, name, function
        case Blend(parts, weights):
            return shape.model, *(shape_key(part) for part in parts), *(number(w) for w in weights)
    return shape.model, *((name, number(value)) for name, value in parameters(shape).items())


def carries_gradient(shape: Shape) -> bool:
    """Tell whether a parameter has a derivative that is asked for."""
    if isinstance(shape, Blend):
        return any(map(carries_gradient, shape.shapes)) or any(map(_differentiated, shape.weights))
    return any(map(_differentiated, parameters(shape).values()))


def _differentiated(value: Number) -> bool:
    return isinstance(value, Tensor) and differentiated(value)


def looks_isotropic(shape: Shape) -> bool:
    """Tell whether a fifth of a turn changes nothing at 4096 pairs of directions, near the mirror direction and far."""
    random = torch.Generator().manual_seed(0)
    wo, near = torch.randn(2, 4096, 3, generator=random, dtype=torch.float64)
    wo[:, 2].abs_()
    wo = torch.nn.functional.normalize(wo, dim=1)
    spread = torch.logspace(-3, 1, 4096, dtype=torch.float64)[:, None]
    wi = torch.nn.functional.normalize(lobes.mirror(wo) + spread * near, dim=1)
    fifth = turn(2, 72.0)
    value = shape.evaluate(wi, wo)
    turned = shape.evaluate(wi @ fifth.T, wo @ fifth.T)
    return bool(((turned - value).abs() <= 1e-3 * (value + turned) + 1e-6 * value.max()).all())


def check(name: str, value: Number | Sequence[float], low: float, high: float) -> None:
    """Raise ValueError unless every value is finite and within the bounds."""
    if isinstance(value, float):
        least, most, got = value, value, f"{value}"
    else:
        v = beneath(torch.as_tensor(value, dtype=torch.float64)).detach()
        least, most = (float(end) for end in v.aminmax())
        got = f"{v.tolist()}" if v.numel() <= 3 else f"values in {least:g}..{most:g}"
    rounded = 1e-6  # float32 may hold a bound a little beside itself
    if not (low * (1 - rounded) <= least and most <= high * (1 + rounded) and math.isfinite(most)):
        bounds = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise ValueError(f"{name} must be finite and {bounds}, got {got}")


def check_number(name: str, value: Number, low: float, high: float) -> None:
    """Raise ValueError unless a value is one number, finite and within the bounds."""
    if not isinstance(value, float) and torch.as_tensor(value).numel() != 1:
        raise ValueError(
            f"{name} must be one number, got {value}: a colour is for diffuse, specular and f0 of a material"
        )
    check(name, value, low, high)


def _blend(shapes: Sequence[Mapping[str, Any]], weights: Sequence[float]) -> Blend:
    """A blend from the configs of its shapes."""
    return Blend(tuple(from_config(s) for s in shapes), tuple(weights))


def reflecting_all(shape: Shape) -> Shape:
    """The shape with a reflectance of 1 straight on, where it has one."""
    return replace(shape, f0=1.0) if isinstance(shape, GGX | CookTorrance) else shape


def is_mirror_symmetric(shape: Shape) -> bool:
    """Tell whether a shape is known to be its own mirror image, along the tangent and along the bitangent."""
    return shape.isotropic or isinstance(shape, Ward)
