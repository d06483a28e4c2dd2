"""What is small and bright in a light, apart from the rest: lamps, of which each sends its power from one direction."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, radians
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ptt.ops.transforms import is_batch

MOST = 32  # lamps of a light
INNER, OUTER = 2.5, 5.0  # degrees: what a lamp has beyond the mean of the ring around it is its own
SMALL = 1.8  # degrees, the largest root mean square radius of a lamp: an even disk has as much
LEAST = 6e-3  # of the light's power: the least that a lamp has


class Lamps(NamedTuple):
    """Directions (m, 3), unit, and powers (m, c): radiance times solid angle.

    areas (m, k, 3), shares (m, k): directions within each lamp, and how much of its power comes from there, 1 in all
    """

    directions: Tensor
    powers: Tensor
    areas: Tensor
    shares: Tensor

    @classmethod
    def none(cls, like: Tensor) -> Lamps:
        """No lamps, in the type of a tensor."""
        return cls(like.new_zeros(0, 3), like.new_zeros(0, 3), like.new_zeros(0, 0, 3), like.new_zeros(0, 0))

    def irradiance(self, normal: Tensor, through: Tensor | None = None) -> Tensor:
        """What arrives (n, c) at points with normals (3, n) that see some of each lamp (m, n), None for all of it."""
        cosine = (self.directions @ normal).clamp(min=0)
        return (cosine if through is None else cosine * through).T @ self.powers

    @classmethod
    def together(cls, several: Sequence[Lamps]) -> Lamps:
        """The lamps of several lights."""
        most = max(lamps.shares.shape[1] for lamps in several)
        areas = [pad(lamps.areas, (0, 0, 0, most - lamps.areas.shape[1])) for lamps in several]
        shares = [pad(lamps.shares, (0, most - lamps.shares.shape[1])) for lamps in several]
        own = ([lamps.directions for lamps in several], [lamps.powers for lamps in several], areas, shares)
        return cls(*(torch.cat(parts) for parts in own))


def apart(light: Tensor, directions: Tensor, solid_angles: Tensor) -> tuple[Lamps, Tensor]:
    """The lamps of a light (n, 3), and the light without them, over cells of directions (n, 3), solid angles (n, 1).

    A lamp is what a disk about a bright cell has beyond the mean of the ring around the disk, if that is a share of the
    whole light that matters, and lies close together; a bright area becomes several. Both parts are at least 0, and add
    up to the light; they are differentiable in it, for lamps that stay where they are.
    """
    if is_batch(light):
        raise ValueError(
            "maps cannot be a batch of torch.func.vmap where lamps are kept apart: loop over them, compress with "
            'highlights="tensor", or make an EnvMapRelighter with lamps=False, a TripleProductRelighter with '
            'highlights="triangles"'
        )
    rest = light
    power = (light.detach() * solid_angles).sum(1)
    least = LEAST * float(power.sum())
    brightness = light.detach().sum(1)
    disk = 2 * torch.pi * (1 - cos(radians(INNER))) + float(solid_angles.max())
    found: list[Lamps] = []
    while len(found) < MOST:
        brightest = int(brightness.argmax())
        if float(brightness[brightest]) * disk < least or least <= 0:
            break
        axis, inner, own = _lamp(rest, directions, solid_angles, directions[brightest])
        mass = own.detach().sum(1)
        spread = (directions[inner] - axis).square().sum(1) @ mass / mass.sum().clamp(min=1e-30)
        if float(mass.sum()) >= least and float(spread) <= radians(SMALL) ** 2:
            found.append(Lamps(axis[None], own.sum(0)[None], directions[inner][None], (mass / mass.sum())[None]))
            rest = rest.index_add(0, inner, -own / solid_angles[inner])
        brightness[inner] = 0.0
        brightness[brightest] = 0.0
    if not found:
        return Lamps.none(light), light
    return Lamps.together(found), rest.clamp(min=0)


def _lamp(light: Tensor, directions: Tensor, solid_angles: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mean direction (3,) of the lamp about an axis, the cells (k,) of its disk, and what it has of each (k, 3)."""
    for _ in range(3):
        cosine = directions @ axis
        inner = torch.nonzero(cosine > cos(radians(INNER)))[:, 0]
        ring = torch.nonzero((cosine <= cos(radians(INNER))) & (cosine > cos(radians(OUTER))))[:, 0]
        around = (light[ring] * solid_angles[ring]).sum(0) / solid_angles[ring].sum()
        own = (light[inner] - around).clamp(min=0) * solid_angles[inner]
        mean = own.detach().sum(1) @ directions[inner]
        axis = mean / mean.norm().clamp(min=1e-30)
    return axis, inner, own
