"""BRDF spaces: sets of sampled shapes, and the coordinates of any shape between the samples."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from ptt.materials import BlinnPhong, CookTorrance, Material, Shape


def _geometric(low: float, high: float, count: int) -> tuple[float, ...]:
    return tuple(low * (high / low) ** (k / (count - 1)) for k in range(count))


@dataclass(frozen=True)
class BlinnPhongSpace:
    """Blinn-Phong shapes by exponent, linear between samples (Sun et al. 2007, section 4.2).

    exponents: ascending, >= 0. The default reaches from 1 to 64: sharper highlights than that do not fit a small
    tensor.
    """

    model: ClassVar[str] = BlinnPhong.model
    exponents: tuple[float, ...] = _geometric(1.0, 64.0, 25)

    def __post_init__(self) -> None:
        _check_nodes("exponents", self.exponents)

    @property
    def samples(self) -> tuple[Shape, ...]:
        return tuple(BlinnPhong(n) for n in self.exponents)

    def coordinates(self, shape: Shape) -> Tensor:
        """Weights (h,) of the samples, float32; differentiable in the exponent.

        Raises:
            ValueError: another model, or an exponent outside of the samples.
        """
        if not isinstance(shape, BlinnPhong):
            raise ValueError(f"the space holds blinn-phong shapes, got {shape.model}")
        return _hats("exponent", shape.exponent, self.exponents)


@dataclass(frozen=True)
class CookTorranceSpace:
    """Cook-Torrance shapes by reflectance f0 and slope m, bilinear between samples.

    Schlick's reflectance is linear in f0, so two samples of it are exact. m: ascending, in 1e-4..1.
    """

    model: ClassVar[str] = CookTorrance.model
    f0: tuple[float, ...] = (0.0, 1.0)
    m: tuple[float, ...] = _geometric(0.2, 0.6, 12)

    def __post_init__(self) -> None:
        _check_nodes("f0", self.f0)
        _check_nodes("m", self.m)

    @property
    def samples(self) -> tuple[Shape, ...]:
        return tuple(CookTorrance(f0, m) for f0 in self.f0 for m in self.m)

    def coordinates(self, shape: Shape) -> Tensor:
        """Weights (h,) of the samples, float32; differentiable in f0 and m.

        Raises:
            ValueError: another model, or parameters outside of the samples.
        """
        if not isinstance(shape, CookTorrance):
            raise ValueError(f"the space holds cook-torrance shapes, got {shape.model}")
        return torch.outer(_hats("f0", shape.f0, self.f0), _hats("m", shape.m, self.m)).flatten()


Space = BlinnPhongSpace | CookTorranceSpace
SPACES: dict[str, type[BlinnPhongSpace] | type[CookTorranceSpace]] = {
    cls.model: cls for cls in (BlinnPhongSpace, CookTorranceSpace)
}


def space_for(materials: list[Material]) -> Space:
    """The default space that holds the shapes of all materials; Blinn-Phong if none has a shape.

    Raises:
        ValueError: the materials mix models; one transfer model serves one space.
    """
    models = sorted({material.shape.model for material in materials if material.shape})
    if len(models) > 1:
        raise ValueError(f"materials must share one specular model, got {', '.join(models)}")
    return SPACES[models[0] if models else BlinnPhong.model]()


def to_config(space: Space) -> dict[str, Any]:
    """A space as plain numbers; `from_config` is its inverse."""
    return {"model": space.model, **asdict(space)}


def from_config(config: dict[str, Any]) -> Space:
    """The space that `to_config` describes.

    Raises:
        ValueError: an unknown model; the message lists the valid ones.
    """
    nodes = {name: tuple(values) for name, values in config.items() if name != "model"}
    if config.get("model") not in SPACES:
        raise ValueError(f"model must be one of {', '.join(SPACES)}, got {config.get('model')!r}")
    return SPACES[config["model"]](**nodes)


def _hats(name: str, value: float | Tensor, nodes: tuple[float, ...]) -> Tensor:
    """Piecewise linear interpolation weights (n,) over ascending nodes."""
    x, at = torch.as_tensor(value, dtype=torch.float64).cpu(), torch.tensor(nodes, dtype=torch.float64)
    if not nodes[0] - 1e-6 <= float(x.detach()) <= nodes[-1] * (1 + 1e-6):
        raise ValueError(
            f"{name} must be in {nodes[0]:g}..{nodes[-1]:g}, the range of the space, got {float(x.detach()):g}"
        )
    if len(nodes) == 1:
        return torch.ones(1)
    k = int(torch.searchsorted(at, x.detach()).clamp(1, len(nodes) - 1))
    t = (x - at[k - 1]) / (at[k] - at[k - 1])
    hat = torch.zeros(len(nodes), dtype=torch.float64)
    hat[k - 1] = 1.0
    step = torch.zeros_like(hat)
    step[k - 1], step[k] = -1.0, 1.0
    return (hat + t * step).float()


def _check_nodes(name: str, nodes: tuple[float, ...]) -> None:
    if not nodes or any(a >= b for a, b in zip(nodes, nodes[1:], strict=False)):
        raise ValueError(f"{name} must hold ascending values, got {nodes}")
