"""The scenes, materials, lights and settings of bench/transfer.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import ptt

LIGHTS = {"uffizi": "uffizi.hdr", "grace": "grace_cross.hdr", "courtyard": "courtyard.exr"}
PAPER = ptt.Clusters(points=1000, eigenvectors=32, lighting=64)
OWN = ptt.Clusters(points=1000, eigenvectors=96, lighting=16)


@dataclass(frozen=True)
class Case:
    """A scene of the bench: its space, tensor, materials to try, and its row of Table 1.

    table: name, vertices, megabytes, hours (precomputation, compression), frames/s (view, and BRDF, and light)
    seconds: goal of precomputation and compression together
    vertices, samples: how many are compared, with how many paths of the reference at each. The parts of the engine
        touch, and some vertices in gaps err by most of their light: in a trial without the vertices of
        `ptt.finer_in_gaps` any 300 of 1,500 erred by 7 to 18 % of what bounces once, all by 11
    whole, maps: with which materials and under how many lights uncompressed, too
    """

    space: Callable[[], ptt.BRDFSpace]
    ranks: tuple[int, int, int]
    lobes: int
    functions: int
    materials: Callable[[], dict[str, ptt.Material]]
    table: tuple[str, float, float, tuple[float, float], tuple[float, float, float]]
    seconds: float | None = None
    vertices: int = 600
    samples: int = 16384
    whole: tuple[str, ...] = ("rough", "moderate", "mirror-like")
    maps: int = len(LIGHTS)


def blinn_phong_materials() -> dict[str, ptt.Material]:
    return {
        "rough": ptt.blinn_phong((0.45, 0.12, 0.1), 0.4, 8.0),
        "moderate": ptt.blinn_phong((0.3, 0.28, 0.24), 0.5, 24.0),
        "mirror-like": ptt.blinn_phong((0.1, 0.1, 0.12), 0.7, 150.0),
    }


def fitted_materials() -> dict[str, ptt.Material]:
    space = ptt.BRDFSpace.fitted()
    names = {
        "rough": "light-red-paint",
        "moderate": "violet-rubber",
        "metallic": "gold-metallic-paint",
        "mirror-like": "nickel",
    }
    return {kind: space.material(name) for kind, name in names.items()}


CASES = {
    "suzanne": Case(
        ptt.BRDFSpace.blinn_phong, (4, 40, 40), 3, 4, blinn_phong_materials,
        ("Airplane", 13100, 144, (2.5, 6.4), (139.5, 30.79, 5.91)), 300.0,
    ),
    "dragon": Case(
        ptt.BRDFSpace.fitted, (4, 16, 16), 4, 4, fitted_materials,
        ("Venus", 39700, 389, (5.0, 7.3), (57.09, 10.94, 2.62)), None, 300, whole=("rough", "moderate"),
    ),
    "engine": Case(
        ptt.BRDFSpace.fitted, (4, 8, 8), 4, 4, fitted_materials,
        ("Watch", 62100, 603, (15.7, 14.3), (43.06, 7.23, 1.53)), 1800.0, 1200, whole=("moderate",), maps=1,
    ),
}  # fmt: skip
