"""Files that are generated with their right answers, and the judgement over what ptt makes of them.

A file is valid, in forms that are rare, or damaged in one way. `generated_gltf`, `broken_gltf`, `generated_obj`,
`generated_ply`, `generated_hdr` and `generated_exr` draw them; they know what they wrote, and read nothing back.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import ptt

Array = NDArray[np.float64]
REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
WIDE = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
"""Primaries of Rec. 709 and 2020, which have one white: x and y of red, green, blue and white."""
CLOSE = 2e-5
"""Of positions as a share of the scene's size, of coordinates and colours as they are: float32 after a few sums."""


class Forms:
    """The rare forms of a file, as they are drawn."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self.drawn: list[str] = []

    def chance(self, form: str, share: float = 0.3) -> bool:
        """Draw whether the file has a form."""
        drawn = bool(self.random.random() < share)
        if drawn and form not in self.drawn:
            self.drawn.append(form)
        return drawn

    def one(self, *forms: str) -> str:
        """Draw one of several, the first of which is not rare."""
        drawn = str(self.random.choice(forms))
        if drawn != forms[0]:
            self.chance(drawn, 1)
        return drawn


class Region(NamedTuple):
    """A region that a file shows.

    polygons: corners (n, 8) of each, counter-clockwise from the front: position, texture coordinates with v up, linear
        colour; NaN is not looked at
    diffuse: of its material; None is not looked at
    """

    polygons: list[Array]
    diffuse: tuple[float, ...] | None = None


class Shapes(NamedTuple):
    """What a mesh file shows, region by region."""

    regions: list[Region]


class Sky(NamedTuple):
    """What a map holds.

    pixels (height, width, 3): linear, row 0 on top
    layer: to ask for
    close: the error that its compression makes, as a share of the largest value
    """

    pixels: Array
    layer: str | None = None
    close: float = 2e-6


class Case(NamedTuple):
    """A file.

    forms: the rare ones that it has
    answer: what it holds; None where it must be refused
    damage: what was done to it; then it may be refused by name as well, "" for nothing
    warns: a part of the warning that it must be read with
    """

    path: Path
    answer: Shapes | Sky | None
    forms: tuple[str, ...] = ()
    damage: str = ""
    warns: str = ""


class Verdict(NamedTuple):
    """What came of a file: "right", "refused" or "wrong", and why it is wrong."""

    outcome: str
    why: str = ""


def judge(case: Case) -> Verdict:
    """Read a file, and compare."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = _loaded(case)
        except ValueError as error:
            return _refused(case, str(error))
        except Exception as error:  # whatever it is, a reader must not raise it
            return Verdict("wrong", f"{type(error).__name__}: {error}")
    if case.answer is None:
        return Verdict("wrong", "it was read")
    messages = [str(warning.message) for warning in caught]
    strange = [str(warning.message) for warning in caught if warning.category is not UserWarning]
    if strange or (case.warns and not any(case.warns in message for message in messages)):
        return Verdict("wrong", f"warnings {messages}")
    if isinstance(found, ptt.Scene):
        assert isinstance(case.answer, Shapes)
        why = _shapes_differ(found, case.answer)
    else:
        assert isinstance(case.answer, Sky)
        why = _skies_differ(found, case.answer)
    return Verdict("wrong", why) if why else Verdict("right")


def survives(path: Path) -> Verdict:
    """Read a file of which nothing is known: all but reading it and refusing it by name is wrong."""
    verdict = judge(Case(path, None, damage="unknown"))
    return Verdict("right") if verdict.why == "it was read" else verdict


def _loaded(case: Case) -> ptt.Scene | ptt.Environment:
    if case.path.suffix in (".hdr", ".exr"):
        layer = case.answer.layer if isinstance(case.answer, Sky) else None
        return ptt.Environment.load(case.path, layout="latlong", layer=layer)
    return ptt.load_scene(case.path)


def _refused(case: Case, message: str) -> Verdict:
    if not case.damage:
        return Verdict("wrong", f"refused: {message}")
    return Verdict("refused") if case.path.name in message else Verdict("wrong", f"refused without its name: {message}")


def _skies_differ(light: ptt.Environment, sky: Sky) -> str:
    """Why a map is not what was written; "" where it is."""
    height, width, _ = sky.pixels.shape
    if light.map.shape != sky.pixels.shape:
        return f"{tuple(light.map.shape)} pixels in place of {sky.pixels.shape}"
    polar = (np.arange(height)[:, None] + 0.5) * (math.pi / height)
    around = (np.arange(width) + 0.5) * (2 * math.pi / width)
    x, y, z = np.broadcast_arrays(np.sin(polar) * np.sin(around), np.cos(polar), -np.sin(polar) * np.cos(around))
    seen = light.radiance(torch.from_numpy(np.stack((x, y, z), -1)).float()).double().numpy()
    largest = float(sky.pixels.max())
    texels = float(np.abs(light.map.double().numpy() - sky.pixels).max())
    directions = float(np.abs(seen - sky.pixels).max())
    if texels > sky.close * largest:
        return f"a texel is wrong by {texels:.2g} of {largest:.2g}"
    return f"a radiance is wrong by {directions:.2g}" if directions > (sky.close + 1e-4) * largest else ""


def _shapes_differ(scene: ptt.Scene, shapes: Shapes) -> str:
    """Why a scene is not what was written; "" where it is."""
    if len(scene.regions) != len(shapes.regions):
        return f"{len(scene.regions)} regions in place of {len(shapes.regions)}"
    uv = torch.zeros(len(scene.vertices), 2) if scene.uv is None else scene.uv
    rounded = float(scene.vertices.abs().max()) * float(np.finfo(np.float32).eps)
    rows = torch.cat((scene.vertices.double() + scene.offset, uv.double(), scene.colours.double()), 1).numpy()
    for number, (region, wanted) in enumerate(zip(scene.regions, shapes.regions, strict=True)):
        faces = scene.faces[scene.face_region == number].numpy()
        if why := _polygons_differ(rows[faces], wanted.polygons, rounded):
            return f"region {region.name}: {why}"
        diffuse = getattr(scene.materials[region.name], "diffuse", None)
        if wanted.diffuse is not None and (diffuse is None or not np.allclose(diffuse, wanted.diffuse, atol=1e-6)):
            return f"region {region.name}: diffuse {diffuse} in place of {wanted.diffuse}"
    return ""


def _polygons_differ(triangles: Array, polygons: list[Array], rounded: float) -> str:
    """Why triangles (t, 3, 8), their positions rounded by as much, are not these polygons, cut; "" where they are."""
    wanted = np.unique(np.concatenate(polygons), axis=0)
    size = np.ptp(wanted[:, :3], axis=0).max() + rounded / CLOSE
    scale = np.array([size] * 3 + [max(1.0, float(np.abs(np.nan_to_num(wanted[:, 3:5])).max()))] * 2 + [1.0] * 3)

    def numbered(corners: Array) -> NDArray[np.int64]:
        """The rows of `wanted` that corners (c, 8) are."""
        gaps = np.nan_to_num(np.abs(corners[:, None] - wanted) / scale).max(2)
        return np.where(gaps.min(1) < CLOSE, gaps.argmin(1), -1)

    left = Counter(_turned(numbered(triangle)) for triangle in triangles)
    if any(-1 in triangle for triangle in left):
        return "a corner is none of the file's"
    for polygon in polygons:
        corners = numbered(polygon)
        own = [tuple(corners)] if len(corners) == 3 else [t for t in left.elements() if set(t) <= set(corners)]
        for triangle in own:
            left[_turned(np.array(triangle))] -= 1
        if len(own) != len(corners) - 2 or not _fill(own, corners, wanted):
            return f"a polygon of {len(corners)} corners is cut into {len(own)} triangles, or wrongly"
    if any(left.values()):
        return f"{sum(abs(n) for n in left.values())} triangles are missing, or too many"
    return ""


def _turned(triangle: NDArray[np.int64]) -> tuple[int, ...]:
    """The same triangle from its least corner on."""
    return tuple(np.roll(triangle, -int(triangle.argmin())).tolist())


def _fill(triangles: list[tuple[int, ...]], polygon: NDArray[np.int64], rows: Array) -> bool:
    """Tell whether triangles have the polygon's edges and area, and all its side in front."""
    edges = Counter(edge for t in triangles for edge in zip(t, (*t[1:], t[0]), strict=True))
    net = Counter({edge: count - edges[edge[::-1]] for edge, count in edges.items()})
    around = Counter(zip(polygon.tolist(), np.roll(polygon, -1).tolist(), strict=True))
    whole = area(rows[polygon, :3])
    parts = [area(rows[list(t), :3]) for t in triangles]
    covered = math.isclose(
        sum(float(np.linalg.norm(part)) for part in parts), float(np.linalg.norm(whole)), rel_tol=1e-4
    )
    return {k: n for k, n in net.items() if n > 0} == dict(around) and covered and all(p @ whole > 0 for p in parts)


def area(corners: Array) -> Array:
    """The vector area (3,) of a flat polygon (n, 3)."""
    fan = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0])
    vector: Array = fan.sum(0) / 2
    return vector


def polygons(forms: Forms, count: int) -> list[Array]:
    """Flat polygons (n, 3) in space: triangles, convex ones and stars, rounded to five digits."""
    random = forms.random
    found = []
    for _ in range(count):
        corners = int(random.integers(3, 8))
        star = corners > 4 and forms.chance("concave polygons")
        angles = (np.arange(corners) + random.uniform(0, 0.5, corners)) * (2 * np.pi / corners)
        radii = np.where(np.arange(corners) % 2, 0.35, 1.0) if star else np.ones(corners)
        plane = np.linalg.qr(random.normal(size=(3, 3)))[0][:2]
        flat = np.stack((np.cos(angles), np.sin(angles)), 1) * radii[:, None]
        found.append((flat @ plane + random.uniform(-4, 4, 3)).round(5))
    return found


def linear(encoded: Array) -> Array:
    """Linear values of sRGB ones (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def xyz(primaries: tuple[float, ...]) -> Array:
    """The matrix (3, 3) from RGB to XYZ; white has Y = 1 (SMPTE RP 177)."""
    red, green, blue, white = (
        np.array((x, y, 1 - x - y)) for x, y in zip(primaries[::2], primaries[1::2], strict=True)
    )
    columns = np.stack((red, green, blue), 1)
    matrix: Array = columns @ np.diag(np.linalg.inv(columns) @ (white / white[1]))
    return matrix


def rgb(primaries: tuple[float, ...]) -> Array:
    """The matrix (3, 3) from XYZ to RGB."""
    return np.linalg.inv(xyz(primaries)).astype(np.float64)
