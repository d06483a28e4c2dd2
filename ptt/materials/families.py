"""Families: the analytic samples of one model in a space, and the shapes that lie between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ptt.materials import shapes
from ptt.materials.shapes import Analytic, Number, Shape
from ptt.ops.simplices import Simplices


def family_of(shape: Analytic) -> tuple[str, ...]:
    """What tells the families of a space apart: the model, and which parameters it has (Ward's may be one or two)."""
    return shape.model, *shapes.parameters(shape)


class Family:
    """Samples of one model of which one or two parameters vary, by their rows among the samples of a space.

    clamped: says whether a shape outside of the samples becomes the nearest one inside, or is refused

    Raises:
        ValueError: the samples cannot be triangulated.
    """

    def __init__(self, samples: Sequence[Analytic], rows: Sequence[int], clamped: bool) -> None:
        self.first = samples[0]
        self.rows = torch.tensor(rows)
        self.clamped = clamped
        table = [shapes.parameters(sample) for sample in samples]
        values = {name: {shapes.number(row[name]) for row in table} for name in table[0]}
        varying = tuple(name for name, different in values.items() if len(different) > 1)
        self.axes = varying or tuple(table[0])[:1]  # a single sample has its first parameter
        points = [[shapes.number(row[name]) for name in self.axes] for row in table]
        self.simplices = Simplices(torch.tensor(points, dtype=torch.float64))
        ends = zip(self.simplices.points.amin(0).tolist(), self.simplices.points.amax(0).tolist(), strict=True)
        self.bounds = dict(zip(self.axes, ends, strict=True))

    def weights(self, shape: Analytic) -> Tensor:
        """Weights (k,) float64 of the samples that interpolate a shape; differentiable in its parameters.

        Raises:
            ValueError: the shape lies outside of a family that does not clamp, or differs in a parameter that is fixed.
        """
        place = self._place(shapes.parameters(shape))
        points = self.simplices.points
        weights = self.simplices.weights(place)
        if self.clamped:
            return weights
        missed = (weights @ points - place).detach().abs() > 2e-6 * points.abs().amax(0)
        if bool(missed.any()):
            axes = ", ".join(self.axes)
            raise ValueError(f"({axes}) must lie between the samples of the model's space, got {place.tolist()}")
        return weights

    def at(self, given: Mapping[str, Number]) -> Shape:
        """The shape with these parameters, or the nearest one inside where the family clamps.

        Raises:
            ValueError: as `weights`.
        """
        shape = type(self.first)(**given)
        reached = self.weights(shape) @ self.simplices.points
        if not self.clamped:
            return shape
        inside: dict[str, Number] = dict(shapes.parameters(self.first))
        for name, value in zip(self.axes, reached, strict=True):
            wanted = given[name]
            inside[name] = value.to(wanted) if isinstance(wanted, Tensor) else shapes.number(value)
        return type(shape)(**inside)

    def _place(self, given: Mapping[str, Number]) -> Tensor:
        """Parameters as a point (d,) on the axes that vary."""
        first = shapes.parameters(self.first)
        for name, value in given.items():
            fixed = shapes.number(first[name])
            low, high = self.bounds.get(name, (fixed, fixed))
            wanted = shapes.number(value)
            if not self.clamped and not low * (1 - 1e-6) <= wanted <= high * (1 + 1e-6):
                raise ValueError(f"{name} must be in {low:g}..{high:g}, the model's space, got {wanted:g}")
        return torch.stack([torch.as_tensor(given[name], dtype=torch.float64).cpu() for name in self.axes])
