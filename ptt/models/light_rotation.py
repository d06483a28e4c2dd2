"""Light in the local frames of sampled normals (Wang et al. 2006), by one of three operators with the same meaning."""

from __future__ import annotations

import math
from collections.abc import Mapping
from os import PathLike
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from tqdm import tqdm

from ptt import threads
from ptt.io import saved
from ptt.models.cache import Cache, watched
from ptt.ops import native, plain, rotation
from ptt.ops.compiling import in_python, opaque, uncompiled
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.rotation import SAMPLES, Quantised, Resampling
from ptt.ops.transforms import beneath, differentiated, is_batch

Operator = Literal["factored", "resample", "matrix"]
"""The form of R = W_M S W_N^T.

factored: the three factors, one after the other; S is kept, 4 bytes for each of about 5 reads a cell.
resample: the same, but S is looked up anew for every light: there are no tables.
matrix: R itself, as in the paper, in 16 bits: about 66 numbers a cell; it alone can drop small ones.
"""

KIND = "light rotation"
FRAMES_AT_ONCE = 32  # whose matrices are formed together: more take more memory
LARGEST_INT16 = 32767  # what the largest number that R can have is stored as
# The buffers of each operator
TABLES = {"factored": ("starts", "reads"), "resample": (), "matrix": ("starts", "columns", "numbers", "unit")}


@in_python
class LightRotation(nn.Module):
    """rotation(coefficients (c, n, n)) -> local light (f, M, c), both in Haar coefficients (`ops.haar`).

    n: cells along an edge of the light's map, `Octahedral(n)`
    m: cells along an edge of the local maps, `HemiOctahedral(m)`; M = m * m
    operator: "factored", "resample" or "matrix" (`Operator`)
    samples: reads of the light's map along the edge of a local cell
    frames (f, 3, 3): rows tangent, bitangent, normal
    tables: those of the operator, as `build` makes them
    normals: cells along an edge of the octahedral map of normals that the frames stand for; None for other frames
    compiled: says whether kernels in C++ do the work; without, torch's functions do

    The rotation is differentiable in the coefficients.

    Example:
        >>> rotate = LightRotation.build(16, normals=8)
        >>> rotate(torch.ones(3, 16, 16)).shape
        torch.Size([64, 64, 3])
    """

    frames: Tensor
    starts: Tensor
    reads: Tensor
    columns: Tensor
    numbers: Tensor
    unit: Tensor

    def __init__(
        self,
        n: int,
        m: int,
        operator: Operator,
        samples: int,
        frames: Tensor,
        tables: Mapping[str, Tensor],
        normals: int | None = None,
        compiled: bool = True,
    ) -> None:
        super().__init__()
        self.n = n
        self.m = m
        self.operator = operator
        self.samples = samples
        self.normals = normals
        self.compiled = compiled
        self._csr = Cache()
        for name, tensor in {"frames": frames, **tables}.items():
            self.register_buffer(name, tensor)

    @classmethod
    def build(
        cls,
        n: int = 64,
        normals: int = 32,
        *,
        frames: Tensor | None = None,
        m: int | None = None,
        operator: Operator = "factored",
        samples: int = SAMPLES,
        threshold: int = 1,
        compiled: bool = True,
        progress: bool = False,
    ) -> LightRotation:
        """The rotation of a light of n * n cells, n a power of two, with the tables of an operator.

        normals: cells along an edge of the octahedral map of normals, each with the frame of `rotation.frames_of`
        frames (f, 3, 3): rows tangent, bitangent, normal, in place of those
        m: default: n / 2, at which a local cell is as wide as 1.4 of the light's
        samples: 1..15; with 4 S has 4.8 reads a cell
        threshold: for "matrix": numbers below it are dropped, on a scale of 32767 for the largest that can be
        compiled: as above
        progress: show a bar, for "matrix"

        Raises:
            ValueError: n or m is no power of two, the operator is unknown, frames are not orthonormal, or the
                threshold leaves nothing.
        """
        m = n // 2 if m is None else m
        for name, size, least in (("n", n, 2), ("m", m, 1)):
            if size < least or size & (size - 1):
                raise ValueError(f"{name} must be a power of two, at least {least}, got {size}")
        if operator not in get_args(Operator):
            raise ValueError(f"operator must be one of {', '.join(get_args(Operator))}, got {operator!r}")
        if threshold < 1 or (operator != "matrix" and threshold > 1):
            raise ValueError(f'threshold must be at least 1, and is for "matrix" alone, got {threshold}')
        sampled: int | None = None
        if frames is None:
            sampled = normals
            frames = rotation.frames_of(Octahedral(normals).directions().reshape(-1, 3))
        rotation.check_frames(frames)
        tables: dict[str, Tensor] = {}
        if operator != "resample":
            s = rotation.resampling(Octahedral(n), HemiOctahedral(m), frames, samples)
            tables = {"starts": s.starts, "reads": s.reads}
        if operator == "matrix":
            tables = _matrices(s, n, m, threshold, compiled, progress)
        return cls(n, m, operator, samples, frames.float(), tables, sampled, compiled)

    @property
    def bytes(self) -> int:
        """The size of the tables, without the frames."""
        tables = [self.get_buffer(name) for name in TABLES[self.operator]]
        return sum(table.numel() * table.element_size() for table in tables)

    @uncompiled
    def forward(self, coefficients: Tensor) -> Tensor:
        """Local light (f, M, c) of a light (c, n, n), float32 or float64; 16-bit types are computed in float32.

        Raises:
            ValueError: coefficients have another shape or are not finite.
        """
        self._check(coefficients)
        light = coefficients.float() if coefficients.dtype.itemsize < 4 else coefficients
        return self._by_matrix(light) if self.operator == "matrix" else self._by_resampling(light)

    def _by_resampling(self, light: Tensor) -> Tensor:
        """W_M S W_N^T L."""
        ops = native if self.compiled else plain
        if self.operator == "resample":
            local: Tensor = ops.resampled_light(light, self.frames, HemiOctahedral(self.m), self.samples)
            return local
        local = ops.local_light(light, Resampling(self.starts, self.reads, self.samples), self.m)
        return local

    @uncompiled
    def _by_matrix(self, light: Tensor) -> Tensor:
        """R L."""
        matrix = Quantised(self.starts, self.columns, self.numbers, float(self.unit))
        if self.compiled and not differentiated(light) and not is_batch(light):
            return native.rotated_light(light, matrix, self.m)
        csr: Tensor = self._csr((watched(self), light.dtype), lambda: matrix.to_csr(self.n**2, light.dtype))
        return rotation.rotated_light(light, csr, self.m)

    @opaque
    def _check(self, coefficients: Tensor) -> None:
        if coefficients.ndim != 3 or coefficients.shape[1:] != (self.n, self.n):
            raise ValueError(f"coefficients must be (c, {self.n}, {self.n}), got {tuple(coefficients.shape)}")
        if not bool(beneath(coefficients).isfinite().all()):
            raise ValueError("coefficients must be finite")

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file, tables and all.

        Raises:
            ValueError: the file cannot be written.
        """
        config = {name: getattr(self, name) for name in ("n", "m", "operator", "samples", "normals")}
        sizes = {name: len(tensor) for name, tensor in self.state_dict().items() if tensor.ndim}
        saved.save(path, KIND, config | {"sizes": sizes}, self.state_dict())

    @classmethod
    def load(cls, path: str | PathLike[str], compiled: bool = True) -> LightRotation:
        """The rotation that `save` wrote.

        Raises:
            ValueError: the file is missing, cut short, or holds no light rotation.
        """
        config, tensors = saved.load(path, KIND)
        with saved.describing(path):
            n = config["n"]
            m = config["m"]
            operator = config["operator"]
            saved.check(tensors, _expected(config))
            _check_tables(tensors, n, operator, config["samples"])
            tables = {name: tensors[name] for name in TABLES[operator]}
            return cls(n, m, operator, config["samples"], tensors["frames"], tables, config["normals"], compiled)


def _matrices(s: Resampling, n: int, m: int, threshold: int, compiled: bool, progress: bool) -> dict[str, Tensor]:
    """The tables of "matrix": R of every frame in 16 bits, formed in blocks of frames."""
    rows = m**2
    frames = (len(s.starts) - 1) // rows
    unit = _unit(s, n, m)
    form = native.quantised if compiled else rotation.quantised
    parts = []
    with tqdm(total=frames, desc="matrices", unit=" frames", disable=not progress) as bar:
        for first in range(0, frames, FRAMES_AT_ONCE):
            threads.share()
            end = min(frames, first + FRAMES_AT_ONCE)
            parts.append(form(s.part(first * rows, end * rows), n, m, unit, threshold))
            bar.update(end - first)
    kept = [len(part.numbers) for part in parts]
    if not sum(kept):
        raise ValueError(f"threshold {threshold} leaves nothing: every number of the matrices is below it")
    starts = [part.starts[:-1] + sum(kept[:k]) for k, part in enumerate(parts)]
    return {
        "starts": torch.cat([*starts, torch.tensor([sum(kept)])]),
        "columns": torch.cat([part.columns for part in parts]),
        "numbers": torch.cat([part.numbers for part in parts]),
        "unit": torch.tensor(unit, dtype=torch.float64),
    }


def _unit(s: Resampling, n: int, m: int) -> float:
    """The value of 1 in the 16 bits of R, such that no number overflows.

    |R| <= |S|, and the rows of S sum to 1: the root of its largest column sum, over all frames, bounds every number.
    """
    rows = m**2
    largest = torch.zeros(n * n, dtype=torch.float64)  # sum of each column
    for first in range(0, len(s.starts) - 1, rows):
        some = s.part(first, first + rows)
        sums = torch.bincount(some.cells, some.weights(), minlength=n * n)
        largest = torch.maximum(largest, sums)
    return math.sqrt(float(largest.max())) / LARGEST_INT16


def _expected(config: Mapping[str, Any]) -> saved.Shapes:
    """Types and shapes of the tensors that belong to a config."""
    sizes = config["sizes"]
    f = sizes["frames"]
    column = torch.int16 if config["n"] ** 2 <= 1 << 15 else torch.int32
    tables: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        "starts": (torch.int64, (f * config["m"] ** 2 + 1,)),
        "reads": (torch.int32, (sizes.get("reads"),)),
        "columns": (column, (sizes.get("columns"),)),
        "numbers": (torch.int16, (sizes.get("columns"),)),
        "unit": (torch.float64, ()),
    }
    return {"frames": (torch.float32, (f, 3, 3))} | {name: tables[name] for name in TABLES[config["operator"]]}


def _check_tables(tensors: Mapping[str, Tensor], n: int, operator: Operator, samples: int) -> None:
    """Refuse wrong rows and columns: they would read foreign memory."""
    if operator == "resample":
        return
    starts = tensors["starts"]
    columns = tensors["columns" if operator == "matrix" else "reads"]
    if int(starts[0]) != 0 or int(starts[-1]) != len(columns) or bool((starts.diff() < 0).any()):
        raise ValueError(f"holds wrong rows: starts must rise from 0 to {len(columns)}")
    cells = columns if operator == "matrix" else Resampling(starts, columns, samples).cells
    if int(cells.min()) < 0 or int(cells.max()) >= n * n:
        raise ValueError(f"holds wrong columns: they must be in 0..{n * n - 1}")
