"""The compressed transfer of a scene: what `compress` makes, `save` writes and `TransferRelighter` evaluates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from ptt.io import saved
from ptt.materials.spaces import BRDFSpace
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.clustered_transfer import ClusteredTransfer
from ptt.models.receivers import Receivers
from ptt.models.slots import Slot, slots_of
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops.haar import Truncated
from ptt.ops.sparse import csr
from ptt.ops.sphere import Cube

KIND = "transfer model"
Highlights = Literal["lobes", "tensor"]
"""How points reflect glossily: by narrow lobes made for each material (`ptt.ops.gloss`), or by the BRDF tensor and its
lobes (Sun et al. 2007)."""


class SparseTransfer(NamedTuple):
    """T0 with few coefficients, row by row: rows (i, v) in this order, columns l ascending.

    kept (i, v) int32: coefficients in each row
    columns (n,) int16 or int32: their positions l
    values (n,): themselves [sr]
    """

    kept: Tensor
    columns: Tensor
    values: Tensor

    @classmethod
    def of(cls, truncated: Truncated, factors: int, length: int) -> SparseTransfer:
        """From ascending positions i * length + l, and values, (v, k) each."""
        factor = truncated.indices // length
        column = truncated.indices % length
        row = factor + factors * torch.arange(len(factor))[:, None]
        kept = torch.bincount(row.flatten(), minlength=factors * len(factor)).reshape(-1, factors)  # shape: (v, i)
        first = kept.T.flatten().cumsum(0).reshape(factors, -1).T - kept  # of each row (i, v) in the result
        place = (first - kept.cumsum(1) + kept).gather(1, factor.long()) + torch.arange(factor.shape[1])
        columns = torch.empty(place.numel(), dtype=_column_type(length))
        values = truncated.values.new_empty(place.numel())
        columns[place.flatten()] = column.flatten().to(columns.dtype)
        values[place.flatten()] = truncated.values.flatten()
        return cls(kept.T.int().contiguous(), columns, values)

    @classmethod
    def cat(cls, parts: Sequence[SparseTransfer]) -> SparseTransfer:
        """Those of several blocks of points, one after the other."""
        kept = torch.cat([part.kept for part in parts], 1)
        sizes = [part.kept.sum(1).tolist() for part in parts]
        columns = zip(*(part.columns.split(n) for part, n in zip(parts, sizes, strict=True)), strict=True)
        values = zip(*(part.values.split(n) for part, n in zip(parts, sizes, strict=True)), strict=True)
        return cls(kept, torch.cat([c for row in columns for c in row]), torch.cat([x for row in values for x in row]))

    def to_csr(self, length: int) -> Tensor:
        """A sparse CSR matrix (i * v, l)."""
        return csr(nn.functional.pad(self.kept.flatten().cumsum(0), (1, 0)), self.columns, self.values, length)


def _column_type(length: int) -> torch.dtype:
    return torch.int16 if length <= 1 << 15 else torch.int32


class TransferModel(nn.Module):
    """Transfer to the receivers, with the BRDF tensor and the basis of slots that it belongs to.

    receivers: names, counts and default materials of the regions
    brdf, basis: how points reflect, and how light is reflected on its way; basis is None without clusters
    regions: a `ClusteredTransfer` each, or none: then kept, columns, values are the `SparseTransfer` of all points
    positions (v, 3), frames (v, 3, 3), colours (v, 3), dips (v,): of the receivers
    resolution: cells along an edge of the cube map
    bounces: that are shown: 0 for direct light, 1 or 2
    truncation_error: relative L2 error of T0 that leaving out the other coefficients makes
    highlights: how points reflect glossily; with "lobes", the transfer is that of diffuse reflection alone
    """

    kept: Tensor
    columns: Tensor
    values: Tensor
    positions: Tensor
    frames: Tensor
    colours: Tensor
    dips: Tensor

    def __repr__(self) -> str:
        """A few lines: what it is of, and what it shows."""
        clusters = sum(region.clusters for region in self.clustered)
        kind = f"{clusters} clusters" if clusters else "direct light of each point"
        size = sum(buffer.numel() * buffer.element_size() for buffer in self.buffers()) / 1e6
        shapes = sorted({sample.model for sample in self.brdf.space.samples})
        by_tensor = f"a tensor and lobes of {self.brdf.angles} degrees"
        means = "narrow lobes" if self.highlights == "lobes" else by_tensor
        return (
            f"TransferModel of {len(self.positions)} points, {self.bounces} bounces, {kind}, {size:.0f} MB\n"
            f"  regions: {', '.join(self.receivers.names)}\n"
            f"  shows {', '.join(shapes)} ({len(self.brdf.space.samples)} samples) by {means}"
        )

    def __init__(
        self,
        receivers: Receivers,
        brdf: TensorBRDF,
        basis: BRDFBasis | None,
        resolution: int,
        bounces: int,
        sparse: SparseTransfer | None,
        regions: Sequence[ClusteredTransfer],
        truncation_error: float,
        highlights: Highlights = "tensor",
    ) -> None:
        super().__init__()
        self.receivers = receivers
        self.brdf = brdf
        self.basis = basis
        self.regions = nn.ModuleList(regions)
        self.resolution = resolution
        self.bounces = bounces
        self.truncation_error = truncation_error
        self.highlights = highlights
        for name, tensor in {**(sparse._asdict() if sparse else {}), **receivers.tensors()}.items():
            self.register_buffer(name, tensor)

    @property
    def grid(self) -> Cube:
        """The lighting's cube map."""
        return Cube(self.resolution)

    @property
    def slots(self) -> list[Slot]:
        """The ways light can be reflected on its path."""
        return slots_of(self.receivers, self.basis.mixture.shape[1]) if self.basis else []

    @property
    def clustered(self) -> list[ClusteredTransfer]:
        """`regions`, by their type."""
        return [region for region in self.regions if isinstance(region, ClusteredTransfer)]

    @property
    def bytes(self) -> int:
        """Size of all buffers."""
        return sum(buffer.numel() * buffer.element_size() for buffer in self.buffers())

    @property
    def by_region(self) -> dict[str, ClusteredTransfer]:
        """`regions` by their names; none of a model without clusters."""
        return dict(zip(self.receivers.names, self.clustered, strict=len(self.regions) > 0))

    def with_parts(
        self, brdf: TensorBRDF | None = None, regions: Mapping[str, ClusteredTransfer] | None = None
    ) -> TransferModel:
        """The same model with another BRDF tensor, or other clusters of some regions: the way back into a relighter.

        brdf, regions: what `with_tensorly` made of `brdf` and of `by_region`; what is left out stays, and is shared

        The transfer was compressed with the model's incident factors: the tensor is taken over to them
        (`TensorBRDF.over`), which is exact where it was decomposed anew or truncated.

        Raises:
            ValueError: a tensor of another space or with other lobes, or one that the incident factors do not span; a
                region without clusters, or clusters for other points, slots or incident factors.
        """
        parts = self.by_region
        for name, region in (regions or {}).items():
            if name not in parts:
                raise ValueError(f"no clusters of a region {name}; there are {', '.join(parts) or 'none'}")
            if _fit_for(region) != _fit_for(parts[name]):
                expected = f"{_fit_for(parts[name])} of region {name}"
                raise ValueError(f"clusters must have the points, slots, pairs and factors {expected}")
            parts[name] = region
        brdf = self.brdf if brdf is None else self._taken_over(brdf)
        sparse = None if parts else SparseTransfer(self.kept, self.columns, self.values)
        settings = self.resolution, self.bounces, sparse, list(parts.values()), self.truncation_error, self.highlights
        made = TransferModel(self.receivers, brdf, self.basis, *settings)
        for name in self.receivers.tensors():
            made.register_buffer(name, self.get_buffer(name))
        return made

    def _taken_over(self, brdf: TensorBRDF) -> TensorBRDF:
        if brdf.space.to_config() != self.brdf.space.to_config():
            raise ValueError("brdf must be of the model's space: see TensorBRDF.with_tensorly")
        if brdf.angles != self.brdf.angles:
            raise ValueError(f"brdf must have the lobes {self.brdf.angles} of the model, got {brdf.angles}")
        return brdf.over(self.brdf)

    def transfer(self) -> Tensor:
        """T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v), of a model without clusters."""
        return SparseTransfer(self.kept, self.columns, self.values).to_csr(self.grid.cells)

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file with the config in its header."""
        config = {
            "resolution": self.resolution,
            "bounces": self.bounces,
            "coefficients": None if len(self.regions) else len(self.values),
            "clustered": [region.config() for region in self.clustered],
            "functions": self.basis.mixture.shape[1] if self.basis else None,
            "truncation_error": self.truncation_error,
            "highlights": self.highlights,
            "ranks": list(self.brdf.core.shape),
            "disk": self.brdf.u_i.shape[1],
            "lobes": list(self.brdf.peaks.shape[1:]),
            "space": self.brdf.space.to_config(),
            **self.receivers.config(),
        }
        saved.save(path, KIND, config, self.state_dict())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> TransferModel:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing, damaged or not a transfer model; the message names what is wrong.
        """
        config, tensors = saved.load(path, KIND)
        with saved.describing(path):
            saved.check(tensors, _expected(config))
            space = BRDFSpace.from_config(config["space"])
            resolution = config["resolution"]
            brdf = TensorBRDF(space, **_under("brdf.", tensors))
            receivers = Receivers.restore(config, tensors)
            bounces = config["bounces"]
            error = config["truncation_error"]
            if config["clustered"]:
                basis = BRDFBasis(space, **_under("basis.", tensors))
                limits = Cube(resolution).cells, len(slots_of(receivers, config["functions"])), len(receivers)
                regions = [
                    ClusteredTransfer.restore(part, _under(f"regions.{r}.", tensors), *limits)
                    for r, part in enumerate(config["clustered"])
                ]
                return cls(receivers, brdf, basis, resolution, bounces, None, regions, error, config["highlights"])
            t0 = SparseTransfer(*(tensors[name] for name in SparseTransfer._fields))
            _check_rows(t0, Cube(resolution).cells)
            return cls(receivers, brdf, None, resolution, bounces, t0, [], error)


def _fit_for(region: ClusteredTransfer) -> tuple[int, list[int], list[list[int]], int]:
    """The points, slots and pairs, and how many incident factors the clusters of a region are for."""
    return region.points, region.slots, region.pairs, region.direct.shape[2] // region.eigenvectors


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


def _check_rows(t0: SparseTransfer, length: int) -> None:
    """A wrong row or column would read foreign memory."""
    if int(t0.kept.min()) < 0 or int(t0.kept.sum()) != len(t0.columns):
        raise ValueError(
            f"holds wrong rows: kept must be at least 0 and sum to {len(t0.columns)}, got {int(t0.kept.sum())}"
        )
    if int(t0.columns.min()) < 0 or int(t0.columns.max()) >= length:
        raise ValueError(f"holds wrong columns: columns must be in 0..{length - 1}")


def _expected(config: dict[str, Any]) -> saved.Shapes:
    h, o, i = config["ranks"]
    n = config["disk"]
    samples = len(config["space"]["samples"])
    expected = {
        "brdf.core": (torch.float32, (h, o, i)),
        "brdf.u_h": (torch.float32, (samples, h)),
        "brdf.u_o": (torch.float32, (o, n, n)),
        "brdf.u_i": (torch.float32, (i, n, n)),
        "brdf.peaks": (torch.float32, (samples, *config["lobes"])),
        "brdf.axes": (torch.float32, (2, config["lobes"][0], config["lobes"][2])),
        "brdf.error": (torch.float32, (samples,)),
        **Receivers.expected(config),
    }
    if not config["clustered"]:
        v = sum(region["points"] for region in config["regions"])
        count = config["coefficients"]
        return expected | {
            "kept": (torch.int32, (1 + i, v)),
            "columns": (_column_type(Cube(config["resolution"]).cells), (count,)),
            "values": (torch.float32, (count,)),
        }
    p = config["functions"]
    expected |= {
        "basis.mixture": (torch.float32, (samples, p)),
        "basis.table": (torch.float32, (samples, p)),
        "basis.error": (torch.float32, (samples,)),
    }
    for r, (part, region) in enumerate(zip(config["clustered"], config["regions"], strict=True)):
        factors = 1 if config["highlights"] == "lobes" else 1 + i
        shapes = ClusteredTransfer.expected(part, region["points"], factors)
        expected |= {f"regions.{r}.{name}": shape for name, shape in shapes.items()}
    return expected
