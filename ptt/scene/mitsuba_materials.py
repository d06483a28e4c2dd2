"""The BSDFs of a loaded Mitsuba scene as materials: exact where ptt can hold them, else the nearest, and what is lost.

Exact: diffuse, rough conductors and dielectrics, rough plastic, principled, twosided and blends of these, normal maps
without Mitsuba's shadowing function. What is not exact is counted by name in `losses`, once for each BSDF:

- mirrors (smooth conductors, plastic, dielectrics) are GGX of roughness 0.03
- the diffuse part of plastic with a texture is matt, of the same albedo: textures multiply matt parts alone
- principled with textures is metallic-roughness (`MetalRough`), which has no clear coat, sheen or anisotropy
- other textures are replaced by their mean
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ptt.materials.material import SMOOTHEST, Highlight, Material, ggx, lambert
from ptt.materials.shapes import GGX
from ptt.materials.textures import Texture
from ptt.materials.varying import MetalRough, Mixed, SurfaceMaterial
from ptt.scene.mitsuba_brdfs import (
    ConductorFacets,
    DielectricFacets,
    Facets,
    GrazingFacets,
    PrincipledCoat,
    PrincipledDiffuse,
    PrincipledSheen,
    fresnel,
    fresnel_conductor,
    named,
)
from ptt.scene.mitsuba_probes import Array, Inside, children, number, shadowed
from ptt.scene.mitsuba_textures import Value, read_value

LUMINANCE = 0.212671, 0.715160, 0.072169  # of linear RGB, as Mitsuba has it
MIRROR = "a mirror, which is GGX of roughness 0.03"
WHITE = torch.ones(3)


class Look(NamedTuple):
    """How a shape looks: its material, and what it has over texture coordinates.

    base: the base colour where it varies, else None
    normals (h, w, 3): x along u, y across it, z out of the surface
    heights (h, w, 1): of a bump map [units of the world]
    matrix (3, 3): takes Mitsuba's uv to those of all textures; None where there are none
    two_sided: says whether it reflects on its back, too
    """

    material: SurfaceMaterial
    base: Value | None = None
    normals: Texture | None = None
    heights: Texture | None = None
    matrix: Array | None = None
    two_sided: bool = False


class Materials:
    """The looks of a scene's BSDFs, each read once; losses: what is left out is counted there."""

    def __init__(self, losses: Counter[str]) -> None:
        self.losses = losses
        self._looks: dict[Any, Look | None] = {}
        self._readers: dict[str, Callable[[Any], Look]] = {
            "SmoothDiffuse": self._diffuse,
            "SmoothConductor": self._conductor,
            "RoughConductor": self._conductor,
            "SmoothPlastic": self._plastic,
            "RoughPlastic": self._plastic,
            "SmoothDielectric": self._dielectric,
            "ThinDielectric": self._dielectric,
            "RoughDielectric": self._dielectric,
            "Principled": self._principled,
            "NormalMap": self._normal_map,
            "BumpMap": self._bump_map,
            "BlendBSDF": self._blend,
            "TwoSidedBRDF": self._two_sided,
            "MaskBSDF": self._mask,
        }

    def of(self, bsdf: Any) -> Look | None:
        """The look of a BSDF; None for one that shows no surface. One of an unknown kind is matt grey."""
        if bsdf not in self._looks:
            name = bsdf.class_name()
            if name == "Null":
                self.losses["an invisible surface (null)"] += 1
                self._looks[bsdf] = None
            elif name in self._readers:
                self._looks[bsdf] = self._readers[name](bsdf)
            else:
                self.losses[f"a bsdf, which is matt grey ({name})"] += 1
                self._looks[bsdf] = Look(lambert(0.5))
        return self._looks[bsdf]

    def _diffuse(self, bsdf: Any) -> Look:
        value = self._value(children(bsdf)["reflectance"])
        return _over(value) if value.varies else Look(Material(value.mean))

    def _conductor(self, bsdf: Any) -> Look:
        things = children(bsdf)
        eta = self._constant(things, "eta").tolist()
        k = self._constant(things, "k").tolist()
        specular = self._constant(things, "specular_reflectance")
        if bsdf.class_name() == "SmoothConductor":
            self.losses[MIRROR] += 1
            straight = [float(fresnel_conductor(torch.ones(()), *pair)) for pair in zip(eta, k, strict=True)]
            return Look(ggx(0.0, specular, torch.tensor(straight).clamp(0, 1), SMOOTHEST))
        facets = self._facets(bsdf, things)
        shapes = [named(ConductorFacets(facets, *pair), _isotropic(facets)) for pair in zip(eta, k, strict=True)]
        if len(set(shapes)) == 1:
            return Look(Material(0.0, specular, shapes[0]))
        return Look(_material(0.0, [Highlight(c, shape) for c, shape in zip(specular.diag(), shapes, strict=True)]))

    def _dielectric(self, bsdf: Any) -> Look:
        """What a dielectric reflects on its outside."""
        name = bsdf.class_name()
        self.losses[f"light through a surface ({name})"] += 1
        things = children(bsdf)
        specular = self._constant(things, "specular_reflectance")
        eta = number(bsdf, "eta")
        if name == "RoughDielectric":
            facets = self._facets(bsdf, things)
            return Look(Material(0.0, specular, named(DielectricFacets(facets, eta), _isotropic(facets))))
        self.losses[MIRROR] += 1
        straight = float(fresnel(torch.ones(()), eta))
        if name == "ThinDielectric":
            straight = 2 * straight / (1 + straight)
        return Look(ggx(0.0, specular, straight, SMOOTHEST))

    def _plastic(self, bsdf: Any) -> Look:
        things = children(bsdf)
        eta = number(bsdf, "eta")
        specular = self._constant(things, "specular_reflectance")
        facets = self._facets(bsdf, things) if bsdf.class_name() == "RoughPlastic" else None
        if facets is None:
            self.losses[MIRROR] += 1
            coat = Highlight(specular, GGX(float(fresnel(torch.ones(()), eta)), SMOOTHEST))
        else:
            coat = Highlight(specular, named(DielectricFacets(facets, eta)))
        value = self._value(things["diffuse_reflectance"])
        inside = Inside.of(eta, facets, nonlinear="nonlinear = 1" in str(bsdf))
        if not value.varies:
            matt = Highlight(inside.strength * inside.colour(value.mean), named(inside.shape))
            return Look(_material(0.0, [coat, matt]))
        self.losses["the exact diffuse part of plastic with a texture, which is matt"] += 1
        if value.texture is not None:
            value = value._replace(texture=_of_pixels(value.texture, inside.colour))
        return _over(value)._replace(material=_material(inside.strength * inside.albedo, [coat]))

    def _principled(self, bsdf: Any) -> Look:
        things = children(bsdf)
        values = {name: self._value(things[name]) for name in ("base_color", "metallic", "roughness")}
        rest = {
            name: _grey(self._constant(things, name)) for name in things if name not in (*values, "specular", "eta")
        }
        eta = self._eta(bsdf)
        if rest["spec_trans"]:
            self.losses["light through a surface (Principled)"] += 1
        if any(value.varies for value in values.values()):
            return self._metal_rough(values, rest, eta)
        base = values["base_color"].mean
        metallic, roughness = (_grey(values[name].mean) for name in ("metallic", "roughness"))
        tint = rest["spec_tint"]
        luminance = _grey(base)
        tinted = base / luminance if luminance > 0 else WHITE
        matt = (1 - metallic) * (1 - rest["spec_trans"])
        sheen = rest["sheen"] * (1 - metallic) * torch.lerp(WHITE, tinted, rest["sheen_tint"])
        coat = PrincipledCoat(0.1 + (0.001 - 0.1) * rest["clearcoat_gloss"])
        highlights = [
            Highlight(matt * base, named(PrincipledDiffuse(roughness, rest["flatness"]))),
            Highlight(sheen * (matt > 0), named(PrincipledSheen())),
            Highlight(rest["clearcoat"], named(coat)),
        ]
        if eta != 1:
            facets = _disney_facets(roughness, rest["anisotropic"])
            straight = metallic * base + (1 - metallic) * tint * tinted * ((eta - 1) / (eta + 1)) ** 2
            grazing = (metallic + (1 - metallic) * tint - straight).clamp(min=0)
            parts = (
                ((1 - metallic) * (1 - tint) * WHITE, DielectricFacets(facets, eta)),
                (straight, facets),
                (grazing, GrazingFacets(facets, eta)),
            )
            highlights += [Highlight(colour, named(part, _isotropic(facets))) for colour, part in parts]
        return Look(_material(0.0, [h for h in highlights if bool((h.colour > 0).any())]))

    def _metal_rough(self, values: dict[str, Value], rest: dict[str, float], eta: float) -> Look:
        """The nearest to principled with textures."""
        self.losses["the exact form of principled with textures, which is metallic-roughness"] += 1
        for name in ("anisotropic", "clearcoat", "flatness", "sheen", "spec_tint"):
            if rest[name]:
                self.losses[f"{name} of principled with textures"] += 1
        base = values["base_color"]
        matrix = base.matrix if base.texture else None
        maps: dict[str, Any] = {}
        for name in ("metallic", "roughness"):
            value = self._alike(values[name], matrix, name)
            maps[name] = 1.0 if value.texture else _grey(value.mean)
            if value.texture:
                matrix = value.matrix
                maps[f"{name}_map"] = _map(value.texture)
        own = MetalRough(1.0 if base.varies else base.mean, reflectance=((eta - 1) / (eta + 1)) ** 2, **maps)
        return Look(own, _rgb(base) if base.varies else None, matrix=matrix)

    def _eta(self, bsdf: Any) -> float:
        """The index of refraction of a principled BSDF, given or by its reflectance straight on."""
        import mitsuba as mi

        if "eta" in mi.traverse(bsdf):
            return number(bsdf, "eta")
        return float(2 / (1 - np.sqrt(0.08 * number(bsdf, "specular"))) - 1)

    def _normal_map(self, bsdf: Any) -> Look:
        things = children(bsdf)
        look = self._flat(things["nested_bsdf"])
        value = self._alike(self._value(things["normalmap"]), look.matrix, "a normal map")
        if value.texture is None:
            self.losses["a normal map without a bitmap of its own"] += 1
            return look
        coloured = look.base is not None and look.base.attribute is not None  # which Mitsuba reads on a mesh alone
        if coloured or shadowed(bsdf, things, value.texture, value.matrix):
            self.losses["a normal map's softer shadows and flips (use_shadowing_function, flip_invalid_normals)"] += 1
        pixels = 2 * value.texture.pixels - 1
        return look._replace(normals=Texture(pixels, value.texture.wrap), matrix=value.matrix)

    def _bump_map(self, bsdf: Any) -> Look:
        things = children(bsdf)
        look = self._flat(things["nested_bsdf"])
        value = self._alike(self._value(things["nested_texture"]), look.matrix, "a bump map")
        if value.texture is None:
            self.losses["a bump map without a bitmap of its own"] += 1
            return look
        self.losses["a bump map's slopes within texels, which are interpolated"] += 1
        heights = Texture(_one_channel(value.texture.pixels) * number(bsdf, "scale"), value.texture.wrap)
        return look._replace(heights=heights, matrix=value.matrix)

    def _blend(self, bsdf: Any) -> Look:
        things = children(bsdf)
        weight = self._value(things["weight"])
        first = self._flat(things["bsdf_0"])
        second = self._flat(things["bsdf_1"])
        two_sided = first.two_sided and second.two_sided
        if any(isinstance(look.material, MetalRough | Mixed) for look in (first, second)):
            self.losses["the lesser of two blended materials, one of which varies by itself"] += 1
            return first if _grey(weight.mean) < 0.5 else second
        if first.base is not None or second.base is not None:
            first, second = self._one_base(first, second)
        base = first.base or second.base
        matrix = base.matrix if base is not None and base.texture else None
        weight = self._alike(weight, matrix, "the weight of a blend")
        a, b = first.material, second.material
        assert isinstance(a, Material) and isinstance(b, Material)
        if weight.texture is not None:
            mixed = Mixed(a, b, _map(weight.texture))
            return Look(mixed, base, matrix=weight.matrix, two_sided=two_sided)
        share = min(max(_grey(weight.mean), 0.0), 1.0)
        highlights = [Highlight(h.colour * (1 - share), h.shape) for h in a.highlights]
        highlights += [Highlight(h.colour * share, h.shape) for h in b.highlights]
        both = _material(torch.lerp(a.diffuse, b.diffuse, share), highlights)
        return Look(both, base, matrix=matrix, two_sided=two_sided)

    def _one_base(self, first: Look, second: Look) -> tuple[Look, Look]:
        """Two looks of which one's base colour is good for both: the other has none, or no diffuse part."""
        plain = [_without_base(look) for look in (first, second)]
        if not _has_matt_part(second):
            return first, plain[1]
        if not _has_matt_part(first):
            return plain[0], second
        self.losses["the textures of two blended materials, which have their means"] += 1
        return plain[0], plain[1]

    def _two_sided(self, bsdf: Any) -> Look:
        things = children(bsdf)
        if things["brdf_0"] != things["brdf_1"]:
            self.losses["another bsdf on the back (twosided)"] += 1
        return self._nested(things["brdf_0"])._replace(two_sided=True)

    def _mask(self, bsdf: Any) -> Look:
        self.losses["transparency (mask)"] += 1
        return self._nested(children(bsdf)["nested_bsdf"])

    def _nested(self, bsdf: Any) -> Look:
        """The look of a BSDF inside another; black where it shows no surface."""
        return self.of(bsdf) or Look(Material(0.0))

    def _flat(self, bsdf: Any) -> Look:
        """The look of a BSDF that another bends or blends, without normals of its own."""
        look = self._nested(bsdf)
        if look.normals is None and look.heights is None:
            return look
        self.losses["a normal or bump map inside another, or inside a blend"] += 1
        return look._replace(normals=None, heights=None)

    def _value(self, texture: Any) -> Value:
        return read_value(texture, self.losses)

    def _constant(self, things: dict[str, Any], name: str) -> Tensor:
        """The value (3,) of a parameter that has to be the same everywhere; 1 where it is not given."""
        if name not in things:
            return WHITE
        value = self._value(things[name])
        if value.varies:
            self.losses[f"a texture of {name}, whose mean it has"] += 1
        return value.mean

    def _alike(self, value: Value, matrix: Array | None, what: str) -> Value:
        """The value, or its mean where it has other coordinates than the textures before it."""
        if value.attribute is None and (value.texture is None or matrix is None or np.allclose(value.matrix, matrix)):
            return value
        self.losses[f"{what} over coordinates of its own"] += 1
        return Value(value.mean)

    def _facets(self, bsdf: Any, things: dict[str, Any]) -> Facets:
        """The facets of a rough BSDF."""
        names = ("alpha_u", "alpha_v") if "alpha_u" in things else ("alpha", "alpha")
        slopes = {n: _grey(self._constant(things, n)) if n in things else number(bsdf, n) for n in set(names)}
        if min(slopes.values()) < SMOOTHEST**2:
            self.losses[MIRROR] += 1
        u, v = (max(slopes[name], SMOOTHEST**2) for name in names)
        return Facets(u, v, "distribution = ggx" in str(bsdf))


def _over(value: Value) -> Look:
    """A matt look of a base colour that varies."""
    return Look(Material(1.0), _rgb(value), matrix=value.matrix if value.texture else None)


def _rgb(value: Value) -> Value:
    """The value with a texture of three channels."""
    if value.texture is None:
        return value
    return value._replace(texture=_of_pixels(value.texture, lambda pixels: pixels.expand(-1, -1, 3).clamp(min=0)))


def _map(texture: Texture) -> Texture:
    """A texture of one channel, 0..1."""
    return _of_pixels(texture, lambda pixels: _one_channel(pixels).clamp(0, 1))


def _of_pixels(texture: Texture, function: Callable[[Tensor], Tensor]) -> Texture:
    return Texture(function(texture.pixels).contiguous(), texture.wrap)


def _one_channel(pixels: Tensor) -> Tensor:
    """Pixels (h, w, 1): of colours their luminance, as Mitsuba reads them where it needs a number."""
    return pixels if pixels.shape[2] == 1 else (pixels @ pixels.new_tensor(LUMINANCE))[..., None]


def _grey(colour: Tensor) -> float:
    """The luminance of a colour (3,)."""
    return float(colour.double() @ torch.tensor(LUMINANCE, dtype=torch.float64))


def _has_matt_part(look: Look) -> bool:
    return isinstance(look.material, Material) and bool(look.material.diffuse.any())


def _without_base(look: Look) -> Look:
    """A look whose base colour is its mean."""
    if look.base is None:
        return look
    assert isinstance(look.material, Material)
    own = _material(look.material.diffuse * look.base.mean, look.material.highlights)
    return look._replace(material=own, base=None)


def _material(diffuse: Tensor | float, highlights: Sequence[Highlight]) -> Material:
    """A material of a diffuse part and highlights."""
    if not highlights:
        return Material(diffuse)
    first, *more = highlights
    return Material(diffuse, first.colour, first.shape, *more)


def _isotropic(facets: Facets) -> bool:
    return facets.alpha_u == facets.alpha_v


def _disney_facets(roughness: float, anisotropic: float) -> Facets:
    """The facets of principled's main lobe."""
    aspect = (1 - 0.9 * anisotropic) ** 0.5
    return Facets(max(0.001, roughness**2 / aspect), max(0.001, roughness**2 * aspect), True)
