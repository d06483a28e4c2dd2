"""Materials that vary over a surface: a few materials, and how much of each there is at a point.

    f(x, wi, wo) = sum over k of  a_k(x) [d_k colour(x) / pi + s_k f_k(wi, wo)]

Relighting is linear in the shares a_k, which textures give, so that whatever shows the few shows their mixture: two
materials side by side (`Mixed`; Ma et al. 2006, section 4.2), or metallic-roughness from textures (`MetalRough`), whose
roughness is interpolated between fixed ones. `Material` is the case of one that is the same everywhere.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ptt.materials import material as mat
from ptt.materials.material import DIELECTRIC, SMOOTHEST, Colour, LayersAt, Material, as_colour
from ptt.materials.shapes import GGX, check, check_number
from ptt.materials.textures import Texture
from ptt.ops import brdf

Map = Texture | Tensor
"""A value over a surface: a texture of one channel by the scene's uv, (h, w) that repeats, or (v,) of its vertices."""

KNOTS = (SMOOTHEST, 0.08, 0.12, 0.17, 0.22, 0.28, 0.35, 0.43, 0.52, 0.62, 0.74, 0.87, 1.0)
"""Roughnesses between which textures are interpolated. In a trial on a metal under three maps, between
two of them what is reflected errs by 2 % as a rule and 4.3 % at most; with ten, 0.4 beside 0.6, by 15 %."""


@dataclass(frozen=True, eq=False)
class Mixed:
    """Two materials on one surface, (1 - share) first + share second (Ma et al. 2006, 4.2).

    share: values in 0..1, a texture (h, w) by the scene's uv, or (v,) at the scene's vertices

    Raises:
        ValueError: share has another shape or is out of its range.
    """

    first: Material
    second: Material
    share: Map

    def __post_init__(self) -> None:
        _check_map("share", self.share)

    @property
    def maps(self) -> tuple[Map | None, ...]:
        """The share."""
        return (self.share,)

    def with_maps(self, maps: Sequence[Map | None]) -> Mixed:
        """The same with another share."""
        (share,) = maps
        assert share is not None
        return replace(self, share=share)

    @property
    def layers(self) -> tuple[Material, ...]:
        """Those of the first, then those of the second."""
        return self.first.layers + self.second.layers

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """All layers together."""
        return (tuple(range(len(self.layers))),)

    def at(self, values: Tensor, colour: Tensor) -> LayersAt:
        """The layers at points, of the share there (1, n) and the base colour (n, 3)."""
        share = values[0].clamp(0, 1)[:, None].expand(-1, 3)
        shares = [1 - share] * len(self.first.layers) + [share] * len(self.second.layers)
        return LayersAt(torch.zeros_like(colour[:, 0], dtype=torch.int64), torch.stack(shares), colour)

    def evaluate(self, wi: Tensor, wo: Tensor, colour: Tensor, values: Tensor) -> Tensor:
        """The BRDF (n, 3) [1/sr] at points, for local unit directions (n, 3)."""
        first = self.first.evaluate(wi, wo, colour)
        return torch.lerp(first, self.second.evaluate(wi, wo, colour), values[0].clamp(0, 1)[:, None].to(first))


@dataclass(frozen=True, eq=False, init=False)
class MetalRough:
    """The metallic-roughness material of glTF, over the base colour of the surface, with textures.

    base (3,): multiplies the base colour, 0..1
    metallic, roughness: 0..1; they multiply their maps
    reflectance (3,): what the dielectric reflects straight on
    metallic_map, roughness_map: a `Map` each, 0..1, or None for 1

        f = colour (1 - metallic) (1 - reflectance) / pi + GGX of f0 = reflectance (1 - metallic) + colour metallic

    with colour = base times the base colour. Schlick's reflectance is linear in f0: its layers are GGX with f0 of 1
    and of 0, at the roughnesses between which that of a point lies. Roughnesses below 0.03 become 0.03.

    Example:
        >>> worn = ptt.MetalRough(metallic=1.0, roughness=0.8, roughness_map=scratches)
        >>> relighter(light, {"cup": dataclasses.replace(worn, roughness=0.4)}, camera)

    Raises:
        ValueError: a value is out of its range, or a map has another shape.
    """

    base: Tensor
    metallic: float
    roughness: float
    reflectance: Tensor
    metallic_map: Map | None
    roughness_map: Map | None

    def __init__(
        self,
        base: Colour = 1.0,
        metallic: float = 1.0,
        roughness: float = 1.0,
        reflectance: Colour = DIELECTRIC,
        metallic_map: Map | None = None,
        roughness_map: Map | None = None,
    ) -> None:
        for name, number in (("metallic", metallic), ("roughness", roughness)):
            check_number(name, number, 0.0, 1.0)
        for name, given in (("metallic_map", metallic_map), ("roughness_map", roughness_map)):
            if given is not None:
                _check_map(name, given)
        values = {
            "base": as_colour("base", base, 1.0),
            "metallic": float(metallic),
            "roughness": float(roughness),
            "reflectance": as_colour("reflectance", reflectance, 1.0),
            "metallic_map": metallic_map,
            "roughness_map": roughness_map,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def maps(self) -> tuple[Map | None, ...]:
        """Those of metallic and roughness."""
        return self.metallic_map, self.roughness_map

    def with_maps(self, maps: Sequence[Map | None]) -> MetalRough:
        """The same with other maps of metallic and roughness."""
        metallic, roughness = maps
        return replace(self, metallic_map=metallic, roughness_map=roughness)

    @property
    def diffuse(self) -> Tensor:
        """The albedo (3,) of what is dull of it, over a white base colour, by the mean of its metallic map."""
        metallic = 1.0 if self.metallic_map is None else float(_texels(self.metallic_map).mean())
        return self._surface(self.base.new_tensor([[metallic], [1.0]]), torch.ones(1, 3))[2][0]

    @cached_property
    def knots(self) -> tuple[float, ...]:
        """The roughnesses of the layers: those of `KNOTS` around the texture's, or the only one."""
        if self.roughness_map is None:
            return (max(self.roughness, SMOOTHEST),)
        texels = _texels(self.roughness_map)
        low, high = (min(max(self.roughness * float(x), SMOOTHEST), 1.0) for x in (texels.min(), texels.max()))
        first = max(knot for knot in KNOTS if knot <= low)
        last = min(knot for knot in KNOTS if knot >= high)
        return tuple(knot for knot in KNOTS if first <= knot <= last)

    @cached_property
    def layers(self) -> tuple[Material, ...]:
        """For each roughness, GGX that reflects all straight on, and GGX that reflects grazing light alone."""
        return tuple(Material(1.0, 1.0, GGX(f0, knot)) for knot in self.knots for f0 in (1.0, 0.0))

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The layers of two roughnesses that lie side by side, or of the only one."""
        first = range(max(1, len(self.knots) - 1))
        return tuple(tuple(range(2 * k, min(2 * k + 4, len(self.layers)))) for k in first)

    def at(self, values: Tensor, colour: Tensor) -> LayersAt:
        """The layers at points, of the maps there (2, n) and the base colour (n, 3)."""
        roughness, f0, diffuse = self._surface(values, colour)
        if len(self.knots) == 1:
            return LayersAt(torch.zeros_like(colour[:, 0], dtype=torch.int64), torch.stack((f0, 1 - f0)), diffuse)
        knots = f0.new_tensor(self.knots)
        group = torch.searchsorted(knots, roughness, right=True).sub(1).clamp(0, len(knots) - 2)
        low, high = knots[group], knots[group + 1]
        share = ((roughness - low) / (high - low)).clamp(0, 1)[:, None]
        shares = torch.stack((f0 * (1 - share), (1 - f0) * (1 - share), f0 * share, (1 - f0) * share))
        return LayersAt(group, shares, diffuse)

    def evaluate(self, wi: Tensor, wo: Tensor, colour: Tensor, values: Tensor) -> Tensor:
        """The BRDF (n, 3) [1/sr] at points, for local unit directions (n, 3): exact, without layers."""
        roughness, f0, diffuse = self._surface(values, colour)
        all_of_it, grazing = (brdf.ggx(wi, wo, f, roughness)[:, None] for f in (1.0, 0.0))
        lambert = brdf.lambert(wi, wo)[:, None] * diffuse.to(wi)
        return lambert + grazing + f0.to(wi) * (all_of_it - grazing)

    def _surface(self, values: Tensor, colour: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Roughness (n,), reflectance straight on (n, 3), and the colour of the diffuse part (n, 3)."""
        colour = colour * self.base.to(colour)
        metallic = (self.metallic * values[0]).clamp(0, 1).to(colour)
        roughness = (self.roughness * values[1]).clamp(SMOOTHEST, 1).to(colour)
        reflectance = self.reflectance.to(colour)
        f0 = torch.lerp(reflectance.expand_as(colour), colour.clamp(0, 1), metallic[:, None])
        return roughness, f0, colour * (1 - metallic[:, None]) * (1 - reflectance)


MIXED, METAL_ROUGH = "mixed", "metal-rough"  # their models in a config
Varying = Mixed | MetalRough
SurfaceMaterial = Material | Varying
"""What a region may be made of."""


def _texels(given: Map) -> Tensor:
    return given.pixels if isinstance(given, Texture) else given


def _check_map(name: str, given: Map) -> None:
    texels = _texels(given)
    if not isinstance(texels, Tensor) or (isinstance(given, Texture) and texels.shape[2] != 1):
        raise ValueError(f"{name} must be a ptt.Texture of one channel, or a tensor (h, w) or (v,), got {given!r}")
    if not isinstance(given, Texture) and (texels.ndim not in (1, 2) or not texels.numel()):
        raise ValueError(f"{name} must be a texture (h, w) or of the vertices (v,), got {tuple(texels.shape)}")
    check(name, texels, 0.0, 1.0)


def materials_of_regions(own: Mapping[str, SurfaceMaterial], given: Mapping[str, Any]) -> dict[str, SurfaceMaterial]:
    """The material of every region, by name and in the order of `own`: the given one, else its own.

    Raises:
        ValueError: as for `check_materials`.
    """
    check_materials(own, given)
    return {name: given.get(name, material) for name, material in own.items()}


def check_materials(regions: Collection[str], given: object) -> None:
    """Refuse what does not map some of the regions, by name, to materials.

    Raises:
        ValueError: `given` is no mapping, no region has a given name, or a value is no material.
    """
    if not isinstance(given, Mapping):
        one = next(iter(regions))
        raise ValueError(
            f"materials must map regions to materials, as {{{one!r}: material}}, got {type(given).__name__}"
        )
    if unknown := [name for name in given if name not in regions]:
        raise ValueError(f"no region {', '.join(unknown)}; there are {', '.join(regions)}")
    if wrong := [name for name, material in given.items() if not isinstance(material, SurfaceMaterial)]:
        raise ValueError(f"materials must map regions to ptt.Material, got {type(given[wrong[0]]).__name__}")


def looked_up(given: Map, uv: Tensor | None) -> Tensor:
    """A texture's values (n,) at texture coordinates (n, 2); given: a map that is not of vertices.

    Raises:
        ValueError: there are no coordinates.
    """
    if uv is None:
        raise ValueError("a map (h, w) needs a scene with uv: give (v,), of the vertices, instead")
    texture = given if isinstance(given, Texture) else Texture(given[..., None])
    return texture.at(uv)[:, 0]


def all_shares(material: SurfaceMaterial, at: LayersAt) -> Tensor:
    """How much of each of a material's layers (k, n, 3) there is at points: 0 of those of other groups."""
    index = torch.tensor(material.groups, device=at.group.device)[at.group]  # shape: (n, m)
    shares = at.shares.new_zeros(len(material.layers), len(index), 3)
    return shares.scatter(0, index.T[..., None].expand(-1, -1, 3), at.shares)


def simplified(material: MetalRough, coloured: bool) -> SurfaceMaterial:
    """`metal_rough` in place of a material that is the same without maps, else that one.

    coloured: says whether the surface has a base colour of its own, which a metal's highlight shows
    """
    if any(given is not None for given in material.maps) or (coloured and material.metallic > 0):
        return material
    return mat.metal_rough(material.base, material.metallic, material.roughness, material.reflectance)


def describe(material: SurfaceMaterial) -> str:
    """A material in a few words: the models of its highlights."""
    if isinstance(material, Mixed):
        return f"{describe(material.first)} mixed with {describe(material.second)}"
    if isinstance(material, MetalRough):
        return "metal-rough" + " from textures" * any(given is not None for given in material.maps)
    return ", ".join(highlight.shape.model for highlight in material.highlights) or "lambert"


def same(a: SurfaceMaterial, b: SurfaceMaterial) -> bool:
    """Tell whether two materials reflect alike: of one kind, with equal values and maps."""
    if type(a) is not type(b) or to_config(a) != to_config(b):
        return False
    return all(map(same_map, a.maps, b.maps))


def same_map(a: Map | None, b: Map | None) -> bool:
    """Whether two maps have the same values, and textures wrap alike."""
    if isinstance(a, Texture) and isinstance(b, Texture):
        return a.wrap == b.wrap and torch.equal(a.pixels, b.pixels)
    return a is b or (isinstance(a, Tensor) and isinstance(b, Tensor) and torch.equal(a, b))


def to_config(material: SurfaceMaterial) -> dict[str, Any]:
    """A material as plain values (`ptt.materials.material.to_config`); of maps, whether there are any."""
    if isinstance(material, Mixed):
        return {"model": MIXED, "first": mat.to_config(material.first), "second": mat.to_config(material.second)}
    if isinstance(material, MetalRough):
        return {
            "model": METAL_ROUGH,
            "base": material.base.tolist(),
            "metallic": material.metallic,
            "roughness": material.roughness,
            "reflectance": material.reflectance.tolist(),
            "maps": [given is not None for given in material.maps],
        }
    return mat.to_config(material)


def from_config(config: Mapping[str, Any], maps: Tensor | None = None) -> SurfaceMaterial:
    """The material of a config, the inverse of `to_config`; maps (m, v): the values of its maps at vertices.

    Raises:
        ValueError: as `ptt.materials.material.from_config`.
    """
    values = dict(config)
    if config.get("model") == MIXED and maps is not None:
        return Mixed(mat.from_config(values["first"]), mat.from_config(values["second"]), maps[0])
    if config.get("model") != METAL_ROUGH:
        return mat.from_config(config)
    del values["model"]
    has = values.pop("maps", (False, False))
    valid = ("base", "metallic", "roughness", "reflectance")
    if unknown := [key for key in values if key not in valid]:
        raise ValueError(f"material: unknown {', '.join(map(repr, unknown))}; valid are {', '.join(valid)}")
    given = [maps[k] if there and maps is not None else None for k, there in enumerate(has)]
    return MetalRough(**values).with_maps(given)
