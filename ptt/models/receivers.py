"""Receivers, the points that a model relights: where they are, how they are turned, and which region they belong to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from ptt.io.saved import Shapes
from ptt.materials.material import LayersAt, Material
from ptt.materials.varying import Map, SurfaceMaterial, Varying, from_config, looked_up, same, to_config
from ptt.ops.mesh import SEEN
from ptt.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Receivers:
    """The points of a scene that are relit, v of them, region by region.

    positions (v, 3): `Scene.points`
    frames (v, 3, 3): rows tangent, bitangent, normal; local = frames @ world
    colours (v, 3): linear base colour
    dips (v,): `Scene.dips`
    counts: number of points in each region, in the order of the names
    names, editable: those of the regions
    materials: default material of each region (`SurfaceMaterial`), by name; maps are values of the points, as `maps`
    maps (m, v): values of the maps of each point's own material, 1 where it has none
    uv (v, 2): texture coordinates; None where the scene has none
    glow (v, 3): radiance that the points send out by themselves; None where the scene has none
    """

    positions: Tensor
    frames: Tensor
    colours: Tensor
    dips: Tensor
    counts: tuple[int, ...]
    names: tuple[str, ...]
    editable: tuple[bool, ...]
    materials: dict[str, Any]
    maps: Tensor
    uv: Tensor | None = None
    glow: Tensor | None = None

    def __repr__(self) -> str:
        return f"Receivers({len(self)} points in {', '.join(self.names)})"

    @classmethod
    def of(cls, scene: Scene, index: Tensor | None = None) -> Receivers:
        """The receivers at all vertices of a scene, or at those that index (v,), ascending, holds."""
        at = torch.arange(len(scene.vertices)) if index is None else index
        counts = torch.bincount(scene.vertex_region[at], minlength=len(scene.regions))
        places = [x[at] for x in scene.vertex_places]
        most = max(len(material.maps) for material in scene.materials.values())
        maps = torch.ones(most, len(at), dtype=torch.float32)
        for number, material in enumerate(scene.materials.values()):
            own = scene.vertex_region[at] == number
            values = scene.map_values(material.maps, *(x[own] for x in places))
            maps[: len(values), own] = values
        return cls(
            positions=scene.points[at],
            frames=scene.frames[at],
            colours=scene.colours[at],
            dips=scene.dips[at],
            counts=tuple(counts.tolist()),
            names=tuple(region.name for region in scene.regions),
            editable=tuple(region.editable for region in scene.regions),
            materials=_with_maps(scene.materials, maps, counts.tolist()),
            maps=maps,
            uv=None if scene.uv is None else scene.uv[at],
            glow=scene.glow(*places),
        )

    def part(self, rows: slice) -> Receivers:
        """The receivers in a range of rows."""
        first, end, _ = rows.indices(len(self))
        counts = tuple(max(0, min(end, b) - max(first, a)) for a, b in self.spans)
        maps = self.maps[:, rows]
        return replace(
            self,
            positions=self.positions[rows],
            frames=self.frames[rows],
            colours=self.colours[rows],
            dips=self.dips[rows],
            counts=counts,
            materials=_with_maps(self.materials, maps, counts),
            maps=maps,
            uv=None if self.uv is None else self.uv[rows],
            glow=None if self.glow is None else self.glow[rows],
        )

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The range (first, end) of each region's points."""
        ends = accumulate(self.counts)
        return [(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    def at_points(self, name: str, material: Varying) -> SurfaceMaterial:
        """A material of a region with its maps as values at the points; the region's own one where it is the same.

        Raises:
            ValueError: a texture where the scene had no uv, or values of another number of vertices.
        """
        own = self.materials[name]
        if material is own:
            return own
        first, end = self.spans[self.names.index(name)]
        maps = [None if given is None else _of_region(self._values(given), first, end) for given in material.maps]
        here = material.with_maps(maps)
        return own if same(here, own) else here

    def _values(self, given: Map) -> Tensor:
        """A map's values (v,) at all points."""
        if isinstance(given, Tensor) and given.ndim == 1:
            if len(given) != len(self):
                raise ValueError(f"a map must have {len(self)} values, the model's points, got {len(given)}")
            return given.to(self.colours)
        return looked_up(given, self.uv)

    def layers_at(self, region: int, material: SurfaceMaterial) -> LayersAt:
        """The layers of a material (`at_points`) at the points of a region."""
        first, end = self.spans[region]
        count = end - first
        values = [self.colours.new_ones(count) if x is None else x[first:end] for x in material.maps]  # type: ignore[index]
        stacked = torch.stack(values) if values else self.colours.new_zeros(0, count)
        return material.at(stacked, self.colours[first:end])

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that are saved beside `config()`."""
        tensors = {"positions": self.positions, "frames": self.frames, "colours": self.colours, "dips": self.dips}
        optional = {"maps": self.maps if len(self.maps) else None, "uv": self.uv, "glow": self.glow}
        return tensors | {name: tensor for name, tensor in optional.items() if tensor is not None}

    def config(self) -> dict[str, Any]:
        """The plain values that are saved beside `tensors()`."""
        regions = zip(self.names, self.counts, self.editable, strict=True)
        described = []
        for name, count, editable in regions:
            material = to_config(self.materials[name])
            described.append({"name": name, "points": count, "editable": editable, "material": material})
        optional = {"uv": self.uv is not None, "glow": self.glow is not None}
        return {"regions": described, "maps": len(self.maps), "dips": True} | optional

    @classmethod
    def restore(cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Receivers:
        """The receivers of a config and tensors: the inverse of `config` and `tensors`."""
        regions = config["regions"]
        positions = tensors["positions"]
        maps = tensors.get("maps", positions.new_zeros(0, len(positions)))
        return cls(
            positions=positions,
            frames=tensors["frames"],
            colours=tensors["colours"],
            dips=tensors.get("dips", positions.new_full((len(positions),), SEEN)),  # those of older files are missing
            counts=tuple(r["points"] for r in regions),
            names=tuple(r["name"] for r in regions),
            editable=tuple(r["editable"] for r in regions),
            materials=_with_maps(
                {r["name"]: from_config(r["material"], maps) for r in regions}, maps, [r["points"] for r in regions]
            ),
            maps=maps,
            uv=tensors.get("uv"),
            glow=tensors.get("glow"),
        )

    @staticmethod
    def expected(config: Mapping[str, Any]) -> Shapes:
        """Types and shapes of the tensors that belong to a config."""
        v = sum(region["points"] for region in config["regions"])
        optional = {"maps": (config.get("maps"), v), "dips": (v,), "uv": (v, 2), "glow": (v, 3)}
        return {
            "positions": (torch.float32, (v, 3)),
            "frames": (torch.float32, (v, 3, 3)),
            "colours": (torch.float32, (v, 3)),
        } | {name: (torch.float32, shape) for name, shape in optional.items() if config.get(name)}


def _with_maps(
    materials: Mapping[str, SurfaceMaterial], maps: Tensor, counts: Sequence[int]
) -> dict[str, SurfaceMaterial]:
    """The materials of regions of so many points, with the rows of maps (m, v) in place of their own maps."""
    found: dict[str, SurfaceMaterial] = {}
    end = 0
    for (name, material), count in zip(materials.items(), counts, strict=True):
        end += count
        found[name] = material
        if not isinstance(material, Material):
            rows = [None if given is None else maps[k] for k, given in enumerate(material.maps)]
            found[name] = material.with_maps([None if x is None else _of_region(x, end - count, end) for x in rows])
    return found


def _of_region(values: Tensor, first: int, end: int) -> Tensor:
    """Values (v,) where those of other regions are the region's first: a map ranges as far as its region's values."""
    out = values[first : first + 1].expand(len(values)).clone() if end > first else torch.ones_like(values)
    out[first:end] = values[first:end]
    return out
