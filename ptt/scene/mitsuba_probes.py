"""What the objects of a loaded Mitsuba scene hold, and what they do not tell, for which they are asked."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ptt.materials.textures import Texture
from ptt.scene.mitsuba_brdfs import Beneath, BeneathRough, Facets

Array = NDArray[np.float64]
KNOTS = 64  # cosines at which Mitsuba keeps what a rough interface lets through


def numbers(value: Any) -> Array:
    """A value of Mitsuba's as a flat array."""
    return np.array(value, dtype=np.float64).ravel()


def number(thing: Any, name: str) -> float:
    """A parameter of an object of Mitsuba's that is one number."""
    import mitsuba as mi

    return float(numbers(mi.traverse(thing)[name])[0])


def children(thing: Any) -> dict[str, Any]:
    """The objects that an object of Mitsuba's has, by their names."""
    import mitsuba as mi

    class Callback(mi.TraversalCallback):
        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, mi.Object):
                found[name] = value

    found: dict[str, Any] = {}
    thing.traverse(Callback())
    return found


def look_up(texture: Any, uv: Array) -> Tensor:
    """The values (n, 3) of a loaded texture at Mitsuba's uv (n, 2)."""
    import drjit as dr
    import mitsuba as mi

    at = dr.zeros(mi.SurfaceInteraction3f)
    values = np.empty((len(uv), 3))
    for row, (u, v) in enumerate(uv.tolist()):
        at.uv = mi.Point2f(u, v)
        values[row] = numbers(texture.eval(at))
    return torch.from_numpy(values).float()


class Inside(NamedTuple):
    """What comes from beneath the interface of a plastic: strength shape(wi, wo) for a white inside.

    again: share of the light from inside that the interface sends back
    """

    shape: Beneath | BeneathRough
    strength: float
    again: float
    nonlinear: bool

    @classmethod
    def of(cls, eta: float, facets: Facets | None, nonlinear: bool) -> Inside:
        """The inside of a plastic, rough or smooth, by what Mitsuba's own reflects with a white and a grey inside."""
        white = _plastic(eta, facets, 1.0)
        ratio = matt(white, 1.0) / (2 * matt(_plastic(eta, facets, 0.5), 1.0))
        again = (ratio - 1) / (ratio - 0.5)
        shape: Beneath | BeneathRough = Beneath(eta)
        if facets is not None:
            cosines = np.linspace(0, 1, KNOTS).clip(1e-6)
            through = np.sqrt([matt(white, float(cos)) for cos in cosines])
            shape = BeneathRough(facets, eta, tuple((through / through[-1]).tolist()))
        straight = float(shape.through(torch.ones(())))
        return cls(shape, np.pi * matt(white, 1.0) / straight**2, again, nonlinear)

    def colour(self, reflectance: Tensor) -> Tensor:
        """What an inside of reflectance (..., 3) sends out, relative to white."""
        if not self.nonlinear:
            return reflectance
        return reflectance * (1 - self.again) / (1 - reflectance * self.again)

    @property
    def albedo(self) -> float:
        """The share of even light that `shape` reflects."""
        cosines = (torch.arange(256) + 0.5) / 256
        return float((2 * self.shape.through(cosines) * cosines).mean()) ** 2


def _plastic(eta: float, facets: Facets | None, reflectance: float) -> Any:
    """A plastic of Mitsuba's whose inside reflects this share of the light."""
    import mitsuba as mi

    inside = {"type": "rgb", "value": reflectance}
    plastic = {"type": "plastic", "int_ior": eta, "ext_ior": 1.0, "diffuse_reflectance": inside, "nonlinear": True}
    if facets is not None:
        kind = "ggx" if facets.ggx else "beckmann"
        plastic |= {"type": "roughplastic", "alpha": facets.alpha_u, "distribution": kind}
    return mi.load_dict(plastic)


def matt(bsdf: Any, cos: float) -> float:
    """The diffuse part of a BSDF [1/sr] for light from and to the direction of a cosine."""
    import drjit as dr
    import mitsuba as mi

    context = mi.BSDFContext()
    context.type_mask = +mi.BSDFFlags.DiffuseReflection
    at = dr.zeros(mi.SurfaceInteraction3f)
    at.wi = mi.Vector3f((1 - cos**2) ** 0.5, 0, cos)
    return float(numbers(bsdf.eval(context, at, at.wi))[0]) / cos


def shadowed(bsdf: Any, things: dict[str, Any], normals: Texture, matrix: Array) -> bool:
    """Tell whether a normal map does more than to bend the frame: it darkens, or flips normals.

    It is asked where its texture, over uv taken through the matrix (3, 3), bends the most, under random directions.
    """
    import drjit as dr
    import mitsuba as mi

    height, width, _ = normals.pixels.shape
    texel = int((2 * normals.pixels[..., :2] - 1).norm(dim=2).argmax())
    place = np.array([(texel % width + 0.5) / width, (texel // width + 0.5) / height, 1])
    at = dr.zeros(mi.SurfaceInteraction3f)
    at.uv = mi.Point2f(*(np.linalg.pinv(matrix) @ place)[:2])
    at.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    n = dr.normalize(mi.Vector3f(2 * mi.Vector3f(things["normalmap"].eval_3(at)) - 1))
    s = dr.normalize(mi.Vector3f(1, 0, 0) - n * n.x)
    frame = mi.Frame3f(s, dr.cross(n, s), n)
    context = mi.BSDFContext()
    directions = np.random.default_rng(0).normal(size=(64, 2, 3))
    directions[..., 2] = abs(directions[..., 2])
    for pair in directions:
        wi, wo = (dr.normalize(mi.Vector3f(*direction)) for direction in pair)
        at.wi = wi
        seen = numbers(bsdf.eval(context, at, wo))
        at.wi = frame.to_local(wi)
        bent = frame.to_local(wo)
        above = min(numbers(at.wi)[2], numbers(bent)[2]) > 0
        plain = numbers(things["nested_bsdf"].eval(context, at, bent)) if above else np.zeros(3)
        if not np.allclose(seen, plain, rtol=1e-2, atol=1e-5):
            return True
    return False
