"""Receivers, the points that a model relights: where they are, how they are turned, and which region they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from ptt.io.saved import Shapes
from ptt.materials import material as mat
from ptt.materials.material import Material
from ptt.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Receivers:
    """The points of a scene that are relit, v of them, region by region.

    positions (v, 3): `Scene.points`
    frames (v, 3, 3): rows tangent, bitangent, normal; local = frames @ world
    colours (v, 3): linear base colour
    counts: number of points in each region, in the order of the names
    names, editable: those of the regions
    materials: default Material of each region, by name
    """

    positions: Tensor
    frames: Tensor
    colours: Tensor
    counts: tuple[int, ...]
    names: tuple[str, ...]
    editable: tuple[bool, ...]
    materials: dict[str, Material]

    def __repr__(self) -> str:
        return f"Receivers({len(self)} points in {', '.join(self.names)})"

    @classmethod
    def of(cls, scene: Scene, index: Tensor | None = None) -> Receivers:
        """The receivers at all vertices of a scene, or at those that index (v,), ascending, holds."""
        at = torch.arange(len(scene.vertices)) if index is None else index
        counts = torch.bincount(scene.vertex_region[at], minlength=len(scene.regions))
        return cls(
            positions=scene.points[at],
            frames=scene.frames[at],
            colours=scene.colours[at],
            counts=tuple(counts.tolist()),
            names=tuple(region.name for region in scene.regions),
            editable=tuple(region.editable for region in scene.regions),
            materials=dict(scene.materials),
        )

    def part(self, rows: slice) -> Receivers:
        """The receivers in a range of rows."""
        first, end, _ = rows.indices(len(self))
        counts = tuple(max(0, min(end, b) - max(first, a)) for a, b in self.spans)
        return replace(
            self,
            positions=self.positions[rows],
            frames=self.frames[rows],
            colours=self.colours[rows],
            counts=counts,
        )

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The range (first, end) of each region's points."""
        ends = accumulate(self.counts)
        return [(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that are saved beside `config()`."""
        return {"positions": self.positions, "frames": self.frames, "colours": self.colours}

    def config(self) -> dict[str, Any]:
        """The plain values that are saved beside `tensors()`."""
        regions = zip(self.names, self.counts, self.editable, strict=True)
        described = []
        for name, count, editable in regions:
            material = mat.to_config(self.materials[name])
            described.append({"name": name, "points": count, "editable": editable, "material": material})
        return {"regions": described}

    @classmethod
    def restore(cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Receivers:
        """The receivers of a config and tensors: the inverse of `config` and `tensors`."""
        regions = config["regions"]
        return cls(
            positions=tensors["positions"],
            frames=tensors["frames"],
            colours=tensors["colours"],
            counts=tuple(r["points"] for r in regions),
            names=tuple(r["name"] for r in regions),
            editable=tuple(r["editable"] for r in regions),
            materials={r["name"]: mat.from_config(r["material"]) for r in regions},
        )

    @staticmethod
    def expected(config: Mapping[str, Any]) -> Shapes:
        """Types and shapes of the tensors that belong to a config."""
        v = sum(region["points"] for region in config["regions"])
        return {
            "positions": (torch.float32, (v, 3)),
            "frames": (torch.float32, (v, 3, 3)),
            "colours": (torch.float32, (v, 3)),
        }
