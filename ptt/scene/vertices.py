"""A scene of other vertices: what is given for each of them goes along, maps of materials too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from torch import Tensor

from ptt.materials.varying import Map, SurfaceMaterial
from ptt.scene.scene import Scene

OWN = ("vertices", "normals", "tangents", "vertex_region", "colours", "uv", "tints")


def taken(scene: Scene, rows: Tensor, faces: Tensor) -> Scene:
    """The scene of some of its vertices (n,), by their numbers and in this order, and of faces (f, 3) among them."""
    given = {name: getattr(scene, name) for name in OWN}
    own: dict[str, Any] = {name: values[rows] for name, values in given.items() if values is not None}
    return replace(scene, faces=faces, materials=mapped(scene, lambda values: values[rows]), **own)


def mapped(scene: Scene, change: Callable[[Tensor], Tensor]) -> dict[str, SurfaceMaterial]:
    """The scene's materials, their maps of vertices changed."""

    def changed(given: Map | None) -> Map | None:
        return change(given) if isinstance(given, Tensor) and given.ndim == 1 else given

    return {
        name: material.with_maps([changed(given) for given in material.maps]) if material.maps else material
        for name, material in scene.materials.items()
    }
