"""Clustered PCA: subspaces are found, no start or sweep is worse than less, and bases are those of the SVD."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from torch import Tensor

from ptt.ops import cpca


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def subspaces(count: int, dimensions: int, r: int, points: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points (count * points, r) spread about the origin of random subspaces, and which one each lies in."""
    g = generator(seed)
    frames = torch.linalg.qr(torch.randn(count, r, dimensions, generator=g, dtype=torch.float64))[0]
    along = torch.randn(count, points, dimensions, generator=g, dtype=torch.float64)
    order = torch.randperm(count * points, generator=g)
    x = (along @ frames.mT).flatten(0, 1).float()
    return x[order], torch.arange(count).repeat_interleave(points)[order]


def left(data: Tensor, labels: Tensor, e: int) -> float:
    """The share of |data|^2 that the best basis of each cluster leaves, by float64 singular values."""
    x = data.double()
    sizes = [torch.linalg.svdvals(x[labels == k])[e:].square().sum() for k in labels.unique()]
    return float(torch.stack(sizes).sum() / x.square().sum())


def same_partition(a: Tensor, b: Tensor) -> bool:
    return bool(((a[:, None] == a) == (b[:, None] == b)).all())


def check_numbers(labels: Tensor, points: int, most: int) -> None:
    """int64, one a point, numbered 0, 1, ... without gaps, at most so many."""
    assert labels.dtype == torch.int64 and labels.shape == (points,)
    numbers = labels.unique()
    assert numbers.tolist() == list(range(len(numbers))) and len(numbers) <= most


@pytest.mark.parametrize(
    ("count", "e", "r", "seed"), [(2, 1, 2, 1), (3, 1, 3, 1), (3, 1, 3, 2), (5, 1, 6, 0), (3, 2, 3, 0)]
)
def test_subspaces_that_cross_are_found_where_centroids_find_nothing(count: int, e: int, r: int, seed: int) -> None:
    """Lines and planes through the origin: all points lie about one centre, so that k-means mixes what crosses there.

    With the right clusters nothing is left but float32 rounding, (6e-8)^2 of the data. k-means leaves over 1 %.
    """
    x, truth = subspaces(count, e, r, 60, seed)
    labels = cpca.cluster(x, count, e)
    assert left(x, labels, e) < 1e-12
    if e == 1:  # where planes cross, points belong to both
        away = x.norm(dim=1) > 1e-3
        assert same_partition(labels[away], truth[away])
    assert left(x, cpca._nearest_seeds(x, count), e) > 1e-2


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("n", "r", "count", "e"), [(150, 12, 5, 3), (40, 60, 4, 2), (200, 6, 12, 2)])
def test_never_worse_than_one_basis_nor_than_the_start(n: int, r: int, count: int, e: int, seed: int) -> None:
    """A cluster's own basis is the best for it, so any partition is at least as good as one basis for all points;
    and sweeps never raise the error: neither one more of them nor the k-means start is better."""
    x = torch.randn(n, r, generator=generator(seed)) * torch.logspace(0, -2, r) + 0.3
    after = left(x, cpca.cluster(x, count, e), e)
    assert after <= left(x, torch.zeros(n, dtype=torch.int64), e)
    assert after < left(x, cpca._nearest_seeds(x, count), e)
    errors = [left(x, cpca.cluster(x, count, e, sweeps=k), e) for k in range(5)]
    assert all(b <= a * (1 + 1e-5) for a, b in pairwise(errors))


def test_the_same_twice_to_the_bit_and_numbers_without_gaps() -> None:
    x = torch.randn(300, 20, generator=generator())
    labels = cpca.cluster(x, 7, 3)
    assert torch.equal(labels, cpca.cluster(x.clone(), 7, 3))
    check_numbers(labels, 300, 7)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_changes_nothing(scale: float) -> None:
    x, _ = subspaces(3, 1, 4, 50, 0)
    assert torch.equal(cpca.cluster(x * scale, 3, 1), cpca.cluster(x, 3, 1))


@pytest.mark.parametrize("count", [1, 4, 5, 40, 1000])
def test_more_clusters_than_distinct_points(count: int) -> None:
    """Four directions, ten times each: never more than four clusters, and twins together; with all four, no error."""
    few = torch.randn(4, 6, generator=generator())
    which = torch.arange(40) % 4
    labels = cpca.cluster(few[which], count, 1)
    check_numbers(labels, 40, min(count, 4))
    if count >= 4:
        assert same_partition(labels, which)
        assert left(few[which], labels, 1) < 1e-12


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("e", [1, 5, 9])
@pytest.mark.parametrize("kind", ["one point", "zeros", "some zeros", "rank one", "more eigenvectors than columns"])
def test_degenerate_data(kind: str, e: int, count: int) -> None:
    """Whatever the data, labels are complete; rank one, or as many eigenvectors as columns, leave no error."""
    random = torch.randn(30, 4, generator=generator())
    data = {
        "one point": random[:1],
        "zeros": torch.zeros(30, 4),
        "some zeros": random * (torch.arange(30) % 2)[:, None],
        "rank one": random[:, :1] * random[0],
        "more eigenvectors than columns": random,
    }[kind]
    labels = cpca.cluster(data, count, e)
    check_numbers(labels, len(data), count)
    bases = [cpca.basis(data[labels == k], e) for k in labels.unique()]
    assert all(b.isfinite().all() and b.shape == (e, 4) for b in bases)
    if kind == "zeros":
        assert not labels.any() and not bases[0].any()
    elif kind in ("one point", "rank one") or e >= 4:
        assert left(data, labels, e) < 1e-12


@pytest.mark.parametrize(("n", "r"), [(8, 30), (30, 8), (12, 12)])
def test_basis_spans_what_the_svd_spans(n: int, r: int) -> None:
    """Rows are singular vectors up to their sign: |v . v'| = 1. Their values differ by a third from one to the next."""
    u = torch.linalg.qr(torch.randn(n, min(n, r), generator=generator(), dtype=torch.float64))[0]
    v = torch.linalg.qr(torch.randn(r, min(n, r), generator=generator(1), dtype=torch.float64))[0]
    x = (u * 1.5 ** -torch.arange(min(n, r))) @ v.T
    found = cpca.basis(x, 5)
    expected = torch.linalg.svd(x)[2][:5]
    assert found.dtype == torch.float64
    assert torch.allclose((found @ expected.T).abs(), torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-11)
    single = cpca.basis(x.float(), 5)
    assert single.dtype == torch.float32
    assert torch.allclose((single.double() @ expected.T).abs(), torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-5)


@pytest.mark.parametrize("e", [2, 6, 20])
@pytest.mark.parametrize(("n", "r"), [(6, 40), (40, 6), (6, 6)])
def test_rows_of_a_basis_are_orthonormal_also_where_little_is_left(n: int, r: int, e: int) -> None:
    """Singular values 1 and five near 1e-6, whose squares are but 1e4 roundings of the first one's; to 1e-10."""
    k = min(n, r)
    u, v = (torch.linalg.qr(torch.randn(m, k, generator=generator(m), dtype=torch.float64))[0] for m in (n, r))
    x = u * torch.tensor([1.0] + [1e-6 * (1 + 1e-3 * j) for j in range(k - 1)], dtype=torch.float64) @ v.T
    rows = cpca.basis(x, e)
    expected = torch.zeros(e, dtype=torch.float64)
    expected[:k] = 1
    assert torch.allclose(rows @ rows.T, expected.diag(), rtol=0, atol=1e-10)
    if e >= k:
        assert (x - x @ rows.T @ rows).norm() < 1e-11


@pytest.mark.parametrize(("n", "r"), [(9, 20), (20, 9)])
def test_rows_beyond_the_rank_are_zero(n: int, r: int) -> None:
    """Rank 3 in float64: the Gram matrix' other eigenvalues are rounding, 1e-16 of the first, and below the cutoff."""
    a = torch.randn(n, 3, generator=generator())
    b = torch.randn(3, r, generator=generator(1))
    x = a.double() @ b.double()
    rows = cpca.basis(x, 7)
    assert torch.allclose(rows[:3] @ rows[:3].T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert not rows[3:].any()
    assert (x - x @ rows.T @ rows).norm() < 1e-12 * x.norm()


def test_refusals() -> None:
    for data, count, e in ((torch.zeros(0, 3), 1, 1), (torch.zeros(2, 3), 0, 1), (torch.zeros(2, 3), 1, 0)):
        with pytest.raises(ValueError, match=f"needs points, count >= 1 .* got {len(data)}, {count}, {e}"):
            cpca.cluster(data, count, e)
