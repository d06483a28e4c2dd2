"""Clustered PCA (Sloan et al. 2003): points in clusters, each with a small linear basis of its own.

    x_v  ~  sum over e of  weights[v, e] bases[k(v), e]

A point belongs to the cluster that reconstructs it best, not to the one whose centre is nearest. Bases are uncentred:
zero is zero, and a mean that matters is the first eigenvector.
"""

from __future__ import annotations

import torch
from torch import Tensor

SWEEPS = 12  # at most, of assigning the points and fitting the bases: more take longer and leave less error
SETTLED = 1e-3  # sweeps end when one lowers the error by less than this share of it
ELEMENTS_AT_ONCE = 1 << 26  # of points times eigenvectors: 256 MB in float32
ROUNDING = 1e-13  # share of the largest eigenvalue of a float64 Gram matrix: smaller ones are rounding


def cluster(data: Tensor, count: int, eigenvectors: int, sweeps: int = SWEEPS) -> Tensor:
    """The cluster (v,) int64, 0..count-1, of every row of data (v, r).

    count: clusters; never more than distinct points come back, numbered without gaps
    eigenvectors: of each cluster's basis

    - deterministic: the start is the farthest-point seeding and a k-means; ties go to the lower number
    - the sum of squared errors never rises from sweep to sweep; an empty cluster starts anew from the worst point

    Raises:
        ValueError: no points, count < 1 or eigenvectors < 1.
    """
    if not len(data) or count < 1 or eigenvectors < 1:
        raise ValueError(f"needs points, count >= 1 and eigenvectors >= 1, got {len(data)}, {count}, {eigenvectors}")
    labels = _nearest_seeds(data, count)
    before = torch.inf
    for _ in range(sweeps):
        bases = torch.stack([basis(data[labels == k], eigenvectors) for k in range(int(labels.max()) + 1)])
        labels, errors = _assign(data, bases)
        after = float(errors.double().sum())
        if after >= before * (1 - SETTLED):
            break
        before = after
        labels = _reseeded(labels, errors, len(bases))
    return _numbered(labels)


def basis(data: Tensor, eigenvectors: int) -> Tensor:
    """Orthonormal rows (e, r), the leading right singular vectors of data (n, r); zero rows beyond its rank.

    They come from the float64 Gram matrix of the smaller side.
    """
    x = data.double()
    n, r = x.shape
    if n <= r:
        size, vectors = torch.linalg.eigh(x @ x.T)
        rows = vectors.flip(1)[:, :eigenvectors].T @ x
    else:
        size, vectors = torch.linalg.eigh(x.T @ x)
        rows = vectors.T.flip(0)[:eigenvectors]
    size = size.flip(0)[:eigenvectors].clamp(min=0)
    real = size > ROUNDING * size[:1]
    rows = torch.linalg.qr(rows.T)[0].T  # those of small eigenvalues come out of the Gram matrix askew
    out = data.new_zeros(eigenvectors, r)
    out[: len(rows)] = (rows * real[:, None]).to(data)
    return out


def _assign(data: Tensor, bases: Tensor) -> tuple[Tensor, Tensor]:
    """The number (v,) of the basis (k, e, r) that leaves least of each row, and its squared error (v,)."""
    k, e, _ = bases.shape
    whole = data.square().sum(1)
    labels = []
    errors = []
    step = max(1, ELEMENTS_AT_ONCE // (k * e))
    for rows, size in zip(data.split(step), whole.split(step), strict=True):
        caught = (rows @ bases.flatten(0, 1).T).square_().unflatten(1, (k, e)).sum(2)
        best = caught.max(1)
        labels.append(best.indices)
        errors.append((size - best.values).clamp(min=0))
    return torch.cat(labels), torch.cat(errors)


def _reseeded(labels: Tensor, errors: Tensor, count: int) -> Tensor:
    """The labels (v,) after every empty cluster has got one of the points that are reconstructed worst."""
    empty = torch.nonzero(torch.bincount(labels, minlength=count) == 0)[:, 0]
    worst = errors.argsort(descending=True, stable=True)[: len(empty)]
    return labels.scatter(0, worst, empty[: len(worst)])


def _nearest_seeds(data: Tensor, count: int, rounds: int = 8) -> Tensor:
    """Labels (v,) by k-means, started from points that lie far from each other."""
    seeds = [int(data.square().sum(1).argmax())]
    distance = (data - data[seeds[0]]).square().sum(1)
    while len(seeds) < min(count, len(data)) and float(distance.max()) > 0:
        seeds.append(int(distance.argmax()))
        distance = torch.minimum(distance, (data - data[seeds[-1]]).square().sum(1))
    centres = data[seeds]
    for _ in range(rounds):
        labels = torch.cdist(data, centres).argmin(1)
        sums = torch.zeros_like(centres).index_add_(0, labels, data)
        counts = torch.bincount(labels, minlength=len(centres))
        centres = torch.where(counts[:, None] > 0, sums / counts.clamp(min=1)[:, None], centres)
    return _numbered(labels)


def _numbered(labels: Tensor) -> Tensor:
    """Labels (v,) of the same clusters, whose numbers leave no gaps."""
    numbers: Tensor = labels.unique(return_inverse=True)[1]
    return numbers
