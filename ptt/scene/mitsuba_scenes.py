"""Scenes of Mitsuba 3: loaded by Mitsuba itself, then read object by object, so that units and colours are its own.

Each shape is a region. What a scene asks for and ptt has no counterpart of is left out with one warning that counts it;
`ptt.scene.mitsuba_materials` says which BSDFs are exact, `ptt.scene.mitsuba_shapes` how shapes become triangles.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ptt.light.environment import Environment
from ptt.materials.textures import Texture
from ptt.scene.camera import Camera
from ptt.scene.mitsuba_materials import Materials
from ptt.scene.mitsuba_probes import Array, children, number, numbers
from ptt.scene.mitsuba_shapes import GRIDS, closed, read_grid, read_mesh, with_look
from ptt.scene.mitsuba_textures import read_value
from ptt.scene.parts import Part
from ptt.scene.scene import Scene

OLDEST = 3, 9  # whose environment maps have a copied column on each side
VARIANT = "scalar_rgb"  # that files and dictionaries are loaded with
ROWS = 2048  # of an environment map at most, where it has fewer of its own
FINER = 8  # times as many rows as it has, at most


def from_mitsuba(scene: str | PathLike[str] | Mapping[str, Any] | Any) -> Scene:
    """The scene of Mitsuba 3: its shapes, materials, environment and camera.

    scene: an XML file, a dictionary as for `mi.load_dict`, or a scene that was loaded in the RGB variant that is set.
        Of a loaded scene, shapes that Mitsuba merged are one region; load it with `optimize=False` to keep them apart.

    The reference then agrees with Mitsuba's `path` of max_depth = bounces + 2, but for what the warning names.

    Example:
        >>> scene = ptt.from_mitsuba("kitchen/scene.xml")
        >>> radiance = ptt.reference.image(scene, scene.environment, scene.materials, scene.camera, bounces=2)

    Raises:
        ImportError: Mitsuba is not installed, or older than 3.9.
        ValueError: the file is missing, Mitsuba does not load it, it is no scene of an RGB variant, none of its shapes
            has a counterpart, a mesh lacks what its textures need, or an environment map is not only turned.
    """
    try:
        import mitsuba as mi
    except ImportError as error:
        raise ImportError("from_mitsuba needs Mitsuba 3.9 or later: pip install ptt[mitsuba]") from error
    if tuple(map(int, str(mi.__version__).split(".")[:2])) < OLDEST:
        raise ImportError(f"from_mitsuba needs Mitsuba 3.9 or later, got {mi.__version__}: pip install ptt[mitsuba]")
    if isinstance(scene, str | PathLike | Mapping):
        name = "the dictionary" if isinstance(scene, Mapping) else Path(scene).name
        with _variant():
            loaded = _loaded(scene, name)
            return _read(loaded, name)
    if mi.variant() is None or not isinstance(scene, mi.Scene):
        raise ValueError(
            f"scene must be an XML file, a dictionary, or a mi.Scene of the variant that is set ({mi.variant()}), got "
            f"{type(scene).__name__}"
        )
    return _read(scene, "the scene")


@contextmanager
def _variant() -> Iterator[None]:
    """Mitsuba in an RGB variant: the one that is set, else `VARIANT`; the one that was set is set again."""
    import mitsuba as mi

    before = mi.variant()
    if before is None or not mi.is_rgb:
        mi.set_variant(VARIANT)
    try:
        yield
    finally:
        if before is not None and before != mi.variant():
            mi.set_variant(before)


def _loaded(given: str | PathLike[str] | Mapping[str, Any], name: str) -> Any:
    """The scene of a file or a dictionary, with its shapes apart."""
    import mitsuba as mi

    if not isinstance(given, Mapping) and not Path(given).is_file():
        raise ValueError(f"scene must be an existing XML file, got {os.fspath(given)}")
    try:
        if isinstance(given, Mapping):
            loaded = mi.load_dict(dict(given), parallel=False, optimize=False)
        else:
            loaded = mi.load_file(os.fspath(given), parallel=False, optimize=False)
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: Mitsuba does not load it: {' '.join(str(error).split())}") from error
    if not isinstance(loaded, mi.Scene):
        raise ValueError(f"{name} must hold a scene, got a {type(loaded).__name__}: put it into <scene>")
    return loaded


def _read(loaded: Any, name: str) -> Scene:
    """The scene of a loaded one."""
    import mitsuba as mi

    if not mi.is_rgb:
        raise ValueError(f"{name} is of the variant {mi.variant()}: load it in an RGB variant, such as {VARIANT}")
    losses = Counter[str]()
    environment = _environment(loaded, losses, name)
    camera = _camera(loaded, losses)
    parts = _parts(loaded, losses, name, camera)
    if losses:
        lost = ", ".join(f"{count} x {what}" for what, count in sorted(losses.items()))
        warnings.warn(f"{name} was read without {lost}", UserWarning, stacklevel=3)
    if not parts:
        raise ValueError(f"{name} shows no shape that ptt has a counterpart of: give it a mesh, sphere or rectangle")
    return Scene.from_parts(parts, environment, camera)


def _parts(loaded: Any, losses: Counter[str], name: str, camera: Camera | None) -> list[Part]:
    """A part for each shape; camera: may look at the insides of closed ones."""
    from trimesh.util import unique_name

    materials = Materials(losses)
    parts: dict[str, Part] = {}
    counts: dict[str | None, int] = {}
    for shape in loaded.shapes():
        kind = shape.class_name()
        if not shape.is_mesh() and kind not in GRIDS:
            losses[f"a shape ({kind})"] += 1
            continue
        look = materials.of(shape.bsdf())
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            losses["a medium"] += 1
        if look is None:
            continue
        own = unique_name(shape.id() or kind.lower(), set(parts), counts)
        try:
            part = read_mesh(shape, look.base) if shape.is_mesh() else read_grid(shape)
            part = with_look(part, look, losses)
        except ValueError as error:
            raise ValueError(f"{name}: shape {own!r} {error}") from None
        if look.two_sided and (_around(part, camera) or not closed(part)):
            losses["a back that is seen (twosided)"] += 1
        parts[own] = replace(part, name=own, glow=_glow(shape, losses))
    return list(parts.values())


def _around(part: Part, camera: Camera | None) -> bool:
    """Tell whether a camera stands within the bounds of a part."""
    low, high = part.vertices.aminmax(dim=0)
    return camera is not None and all(a < x < b for a, x, b in zip(low, camera.eye, high, strict=True))


def _glow(shape: Any, losses: Counter[str]) -> Texture | None:
    """What an area light sends out, the same everywhere; None for a shape that is none."""
    if shape.emitter() is None:
        return None
    losses["the light that glowing surfaces cast on others (they do glow)"] += 1
    value = read_value(children(shape.emitter())["radiance"], losses)
    if value.varies:
        losses["a texture of radiance, whose mean it has"] += 1
    return Texture(value.mean.expand(1, 1, 3))


def _environment(loaded: Any, losses: Counter[str], name: str) -> Environment | None:
    """The light from around; None where there is none. Other lights are counted."""
    environment = None
    for emitter in loaded.emitters():
        kind = emitter.class_name()
        if kind == "ConstantBackgroundEmitter":
            environment = Environment.constant(read_value(children(emitter)["radiance"], losses).mean)
        elif kind == "EnvironmentMapEmitter":
            environment = _map(emitter, name)
        elif kind != "AreaLight":
            losses[f"a light ({kind})"] += 1
    return environment


def _map(emitter: Any, name: str) -> Environment:
    """An `envmap`, turned as by its to_world.

    Its rows lie at v = r / (h - 1), from pole to pole, and ptt's at half texels: more rows are interpolated.

    Raises:
        ValueError: to_world is no rotation.
    """
    import mitsuba as mi

    parameters = mi.traverse(emitter)
    texels = torch.from_numpy(np.array(parameters["data"], dtype=np.float32))[:, 1:-1]  # without the copied columns
    turn = numbers(parameters["to_world"].matrix).reshape(4, 4)[:3, :3]
    u, size, v = np.linalg.svd(turn)
    if not np.allclose(size, 1, atol=1e-4):
        raise ValueError(f"{name}: the envmap's to_world scales by {size.tolist()}: give it a rotation alone")
    if np.linalg.det(turn) < 0:
        texels = texels.flip(1)
        v[:, 0] = -v[:, 0]
    height, width, _ = texels.shape
    rows = (height - 1) * max(1, min(FINER, ROWS // (height - 1)))
    y = (torch.arange(rows) + 0.5) * ((height - 1) / rows)
    texels = torch.lerp(texels[y.long()], texels[y.long() + 1], (y % 1)[:, None, None])
    if width % 2:
        texels = (3 * torch.stack((texels, texels), 2) + torch.stack((texels.roll(1, 1), texels.roll(-1, 1)), 2)) / 4
        texels = texels.flatten(1, 2)
    return Environment((texels * number(emitter, "scale")).contiguous(), torch.from_numpy(u @ v))


def _camera(loaded: Any, losses: Counter[str]) -> Camera | None:
    """The first camera with a perspective; None where there is none, and then all parts are framed."""
    import mitsuba as mi

    camera = None
    for sensor in loaded.sensors():
        kind = sensor.class_name()
        if kind not in ("PerspectiveCamera", "ThinLensCamera") or camera is not None:
            losses[f"a sensor ({kind})" if camera is None else "a further sensor"] += 1
            continue
        if kind == "ThinLensCamera":
            losses["the depth of field (thinlens)"] += 1
        parameters = mi.traverse(sensor)
        offsets = [value for key, value in parameters if key.startswith("principal_point_offset")]
        if any(numbers(x).any() for x in (*offsets, sensor.film().crop_offset())):
            losses["a part of the film (crop, principal_point_offset)"] += 1
        matrix = numbers(parameters["to_world"].matrix).reshape(4, 4)
        if np.linalg.det(matrix[:3, :3]) < 0:
            losses["a mirror image (the sensor's to_world)"] += 1
        camera = _pinhole(matrix, number(sensor, "x_fov"), numbers(sensor.film().size()), loaded.bbox().center())
    return camera


def _pinhole(matrix: Array, fov: float, size: Array, centre: Any) -> Camera:
    """The camera at a matrix (4, 4), which looks along z with y up; fov: the horizontal angle [degrees]."""
    eye = matrix[:3, 3]
    ahead = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    distance = float((numbers(centre) - eye) @ ahead)
    target = eye + ahead * (distance if distance > 0 else 1.0)
    width, height = (int(x) for x in size)
    vertical = 2 * math.degrees(math.atan(math.tan(math.radians(fov) / 2) * height / width))
    return Camera(tuple(eye.tolist()), tuple(target.tolist()), tuple(matrix[:3, 1].tolist()), vertical, width, height)
