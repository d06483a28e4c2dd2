"""Rotation of functions on the sphere, in space and in the wavelet domain (Wang et al. 2006, sections 2 and 3).

A function on a square map of N = n x n cells, seen in a local frame, is a function on a map of M = m x m cells:

    R = W_M S W_N^T        (equations 4 and 5)

W the orthonormal Haar transforms (`ops.haar`), S the resampling: each cell of the local map is the mean of
samples x samples parts of it, all of one weight, each of which reads the cell of the source that it falls into.
Frames (f, 3, 3) have rows tangent, bitangent, normal: local = frame @ world. The source is usually `Octahedral(n)` in
world space, the target `HemiOctahedral(n // 2)` around the normal.

- Rows of S sum to 1. With 4 samples a constant of up to 20 significant bits (49 in float64) stays the same to the bit.
- R of the identity between equal grids is the identity.
- What light weighs (values times solid angles) is kept to a bound that falls with n.
- Rotating by A and then by B is rotating by B A, and back by A^T, to a bound that falls with n.

Example, the sphere turned by half a turn about y:
    >>> from ptt.ops.directions import turn
    >>> height = Octahedral(64).directions()[..., 2:]
    >>> turned = rotate(height, turn(1, 180))
    >>> bool((turned + height).abs().max() < 0.05)
    True
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import torch
from scipy.sparse import block_diag, csr_array
from torch import Tensor

from ptt.ops import haar
from ptt.ops.octahedral import Octahedral, mix
from ptt.ops.sparse import csr, product
from ptt.ops.sphere import Grid
from ptt.ops.table import Table, stored
from ptt.ops.transforms import active, beneath, outside

SAMPLES = 4  # along the edge of a target's cell
_LOOKUPS = 1 << 20  # a block
_COUNT = 8  # bits of a count in `Resampling.reads`


class Resampling(NamedTuple):
    """S: for every cell of the local maps, in the order (f, M), which cells of the source it is the mean of.

    starts (f * M + 1,) int64: where the reads of each cell begin
    reads (k,) int32: the source's cell * 256 + how many of the samples fall into it
    samples: along the edge of a cell; the counts of a cell sum to its square
    """

    starts: Tensor
    reads: Tensor
    samples: int

    @property
    def cells(self) -> Tensor:
        """(k,) int32, of the source."""
        return self.reads >> _COUNT

    def weights(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """(k,), which sum to 1 for every cell."""
        return (self.reads & (1 << _COUNT) - 1).to(dtype) / self.samples**2

    def part(self, first: int, end: int) -> Resampling:
        """The rows from first on, before end."""
        starts = self.starts[first : end + 1]
        return Resampling(starts - starts[0], self.reads[int(starts[0]) : int(starts[-1])], self.samples)

    def to_csr(self, source: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """A sparse matrix (f * M, source)."""
        return csr(self.starts, self.cells, self.weights(dtype), source)


def frames_of(normals: Tensor) -> Tensor:
    """Frames (..., 3, 3) around normals (..., 3), one for each: any length but 0.

    Smooth but across z = 0, where they jump (Duff et al. 2017, *Building an Orthonormal Basis, Revisited*).

    Raises:
        ValueError: a normal is zero or not finite.
    """
    length = normals.double().norm(dim=-1, keepdim=True)
    if bad := int((~(length > 0) | ~length.isfinite()).sum()):
        raise ValueError(f"normals must be finite and not zero: {bad} of {length.numel()} are not")
    x, y, z = (normals.double() / length).unbind(-1)
    sign = torch.ones_like(z).copysign(z)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    bitangent = torch.stack((b, sign + y * y * a, -y), -1)
    return torch.stack((tangent, bitangent, torch.stack((x, y, z), -1)), -2).to(normals)


def resampling(source: Grid, target: Grid, frames: Tensor, samples: int = SAMPLES) -> Resampling:
    """S of frames (f, 3, 3), from a source grid around the world to a target around each frame.

    Raises:
        ValueError: samples is not in 1..15, or frames are not orthonormal.
    """
    check_frames(frames)
    if not 1 <= samples <= 15:
        raise ValueError(f"samples must be in 1..15, got {samples}")
    local = target.samples(samples).double()
    parts = [_merged(source.cell(local @ some), samples**2) for some in _blocks(frames.double(), len(local))]
    counts = torch.cat([kept for _, kept in parts])
    return Resampling(
        torch.nn.functional.pad(counts.cumsum(0), (1, 0)), torch.cat([reads for reads, _ in parts]), samples
    )


def resample(values: Tensor, s: Resampling) -> Tensor:
    """Local maps (f * M, c) of a source's values (N, c); differentiable in them."""
    if active():  # the function below has no tangents, and takes batches one by one
        tables = Resampling(beneath(s.starts), beneath(s.reads), s.samples)
        return product(outside(tables.to_csr, len(values), values.dtype), values)
    return torch.nn.functional.embedding_bag(
        s.cells.long(),
        values,
        s.starts,
        mode="sum",
        per_sample_weights=s.weights(values.dtype),
        include_last_offset=True,
    )


def resampled_values(values: Tensor, s: Resampling, cells: int, storage: torch.dtype = torch.float16) -> Table:
    """Local maps (f, c, cells) of a source's values (N, c), as `ops.table.stored` keeps them."""
    return stored(resample(values, s).reshape(-1, cells, values.shape[1]).transpose(1, 2), storage)


def rotate(
    values: Tensor, frame: Tensor, target: Grid | None = None, samples: int = SAMPLES, source: Grid | None = None
) -> Tensor:
    """A function on the sphere, values (*source.shape, c), as it is seen in a frame (3, 3).

    The value in the local direction d is that in the world's direction frame^T d. Differentiable in the values.

    target: grid of the result (*shape, c); None for the source's own
    source: None for `Octahedral(n)` of values (n, n, c); `Geodesic` rotates what the triangular basis stands for

    Raises:
        ValueError: values have another shape than the source, or the frame is not orthonormal.
    """
    if source is None:
        if values.ndim != 3 or values.shape[0] != values.shape[1]:
            raise ValueError(f"values must be (n, n, c) on an octahedral map, got {tuple(values.shape)}")
        source = Octahedral(len(values))
    if tuple(values.shape[:-1]) != source.shape:
        raise ValueError(f"values must be (*{source.shape}, c), got {tuple(values.shape)}")
    target = target or source
    s = resampling(source, target, frame[None], samples)
    return resample(values.reshape(source.cells, -1), s).reshape(*target.shape, -1)


def local_light(coefficients: Tensor, s: Resampling, m: int) -> Tensor:
    """W_M S W_N^T L: Haar coefficients (f, M, c) in local frames from those of the source (c, n, n); exact.

    Differentiable in the coefficients.
    """
    values = haar.synthesise(coefficients).flatten(1).T
    return local_coefficients(resample(values.contiguous(), s), m)


def local_coefficients(values: Tensor, m: int) -> Tensor:
    """Haar coefficients (f, M, c) of local maps (f * M, c)."""
    maps = values.reshape(-1, m, m, values.shape[1]).movedim(-1, 1)
    return haar.analyse(maps).flatten(2).transpose(1, 2)


def resampled_light(coefficients: Tensor, frames: Tensor, target: Grid, samples: int = SAMPLES) -> Tensor:
    """As `local_light` of `resampling`, without tables: the samples are looked up anew. Differentiable."""
    source = Octahedral(coefficients.shape[-1])
    values = haar.synthesise(coefficients).flatten(1).T.contiguous()
    m = target.shape[-1]
    local = target.samples(samples).to(values)
    parts = []
    for some in _blocks(frames.to(values), len(local)):
        cell = source.cell(local @ some).reshape(-1, samples**2)
        parts.append(mix(values, cell, torch.full_like(cell, 1 / samples**2, dtype=values.dtype)))
    return local_coefficients(torch.cat(parts), m)


@cache
def haar_matrix(n: int) -> Tensor:
    """W_N^T (N, N), sparse CSR, float64: row t holds the value in cell t of every basis function of `ops.haar`."""
    at = torch.arange(n)
    row, column = (x.flatten() for x in torch.meshgrid(at, at, indexing="ij"))
    columns = [torch.zeros_like(row)]
    values = [torch.full(row.shape, 1 / n, dtype=torch.float64)]
    h = 1
    while h < n:
        i = row * h // n
        k = column * h // n
        down, right = (1 - 2 * (x * 2 * h // n % 2).double() for x in (row, column))
        columns += [i * n + h + k, (h + i) * n + k, (h + i) * n + h + k]
        values += [right * h / n, down * h / n, right * down * h / n]
        h *= 2
    place, order = torch.stack(columns, 1).sort(1)
    starts = torch.arange(n * n + 1) * len(columns)
    return csr(starts, place.flatten(), torch.stack(values, 1).gather(1, order).flatten(), n * n)


def matrices(s: Resampling, n: int, m: int) -> Tensor:
    """R (f * M, N), sparse CSR, float64, of S: the product of three sparse matrices.

    By scipy: torch's product of two sparse matrices does not give back the memory of the result.
    """
    frames = (len(s.starts) - 1) // m**2
    analysis = scipy_csr(haar_matrix(m)).T.tocsr()
    product = block_diag([analysis] * frames, format="csr") @ (scipy_csr(s.to_csr(n * n)) @ scipy_csr(haar_matrix(n)))
    product.sort_indices()
    starts, columns, values = (torch.from_numpy(x) for x in (product.indptr, product.indices, product.data))
    return csr(starts, columns, values, n * n)


class Quantised(NamedTuple):
    """R in 16 bits (section 3, "Precomputing Rotation Matrices"): value = number * unit, row by row.

    starts (f * M + 1,) int64; columns (k,) int16 or int32: of the source's coefficients; numbers (k,) int16
    """

    starts: Tensor
    columns: Tensor
    numbers: Tensor
    unit: float

    def to_csr(self, source: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """A sparse matrix (f * M, source)."""
        return csr(self.starts, self.columns, self.numbers.to(dtype) * self.unit, source)


def quantised(s: Resampling, n: int, m: int, unit: float, threshold: int) -> Quantised:
    """R of S in whole numbers of a unit; those of a magnitude below the threshold are dropped, and zeros always."""
    matrix = matrices(s, n, m)
    numbers = (matrix.values() / unit).round()
    kept = numbers.abs() >= max(1, threshold)
    count = torch.nn.functional.pad(kept.cumsum(0), (1, 0))
    columns = matrix.col_indices()[kept].to(column_type(n))
    return Quantised(count[matrix.crow_indices().long()], columns, numbers[kept].to(torch.int16), unit)


def column_type(n: int) -> torch.dtype:
    """The type of the columns of R, of a source of n * n cells."""
    return torch.int16 if n * n <= 1 << 15 else torch.int32


def rotated_light(coefficients: Tensor, matrix: Tensor, m: int) -> Tensor:
    """R L: Haar coefficients (f, M, c) in local frames from those of the source (c, n, n), R sparse (f * M, N)."""
    light = product(matrix, coefficients.flatten(1).T)
    return light.reshape(-1, m * m, len(coefficients))


def check_frames(frames: Tensor) -> None:
    """Refuse what is not (f >= 1, 3, 3) with orthonormal rows.

    Raises:
        ValueError: naming the largest deviation.
    """
    if frames.ndim != 3 or frames.shape[1:] != (3, 3) or not len(frames):
        raise ValueError(f"frames must be (f, 3, 3), at least one, got {tuple(frames.shape)}")
    one = torch.eye(3, dtype=torch.float64, device=frames.device)
    off = float((frames.double() @ frames.double().transpose(1, 2) - one).abs().amax())
    if not off < 1e-4:
        raise ValueError(
            f"frames must have orthonormal rows tangent, bitangent, normal: off by {off:.2g}; see frames_of"
        )


def _blocks(frames: Tensor, each: int) -> Iterator[Tensor]:
    """Frames in blocks of about `_LOOKUPS` samples."""
    yield from frames.split(max(1, _LOOKUPS // each))


def _merged(cell: Tensor, each: int) -> tuple[Tensor, Tensor]:
    """Reads (k,) int32 of the cells (f, M * each) of samples, and how many each cell of the target has (f * M,)."""
    ordered = cell.int().reshape(-1, each).sort(1).values
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
    at = first.flatten().nonzero()[:, 0]
    counts = torch.diff(at, append=at.new_tensor([first.numel()]))
    return ordered.flatten()[at] << _COUNT | counts.int(), first.sum(1)


def scipy_csr(matrix: Tensor) -> csr_array:
    """A sparse CSR matrix as scipy's."""
    parts = (x.numpy() for x in (matrix.values(), matrix.col_indices(), matrix.crow_indices()))
    return csr_array(tuple(parts), shape=tuple(matrix.shape))
