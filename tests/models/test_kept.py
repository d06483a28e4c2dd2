"""Fits of spaces are found again by what they were made from, and never where that changed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import ptt
from ptt.ops import brdf, keeping

SPACE = ptt.BRDFSpace.blinn_phong((4.0, 8.0, 16.0))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keeping.folder.cache_clear()
    yield tmp_path / "ptt"
    keeping.folder.cache_clear()


def fitted(space: ptt.BRDFSpace = SPACE, rank: int = 6) -> ptt.TensorBRDF:
    return ptt.TensorBRDF.fit(space, ranks=(3, rank, rank), separated=1, resolution=16)


def files(folder: Path) -> int:
    return len(list(folder.iterdir()))


def test_a_fit_is_made_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = fitted()
    basis = ptt.BRDFBasis.fit(SPACE, 2)
    assert files(folder) == 2
    monkeypatch.delattr(ptt.TensorBRDF, "_fitted")
    monkeypatch.delattr(ptt.BRDFBasis, "_fitted")
    again = fitted(ptt.BRDFSpace.blinn_phong((4.0, 8.0, 16.0)))
    for one, other in zip(first.buffers(), again.buffers(), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(ptt.BRDFBasis.fit(SPACE, 2).table, basis.table)


def test_another_space_or_setting_is_another_fit(folder: Path) -> None:
    made = [fitted(), fitted(rank=5), fitted(ptt.BRDFSpace.blinn_phong((4.0, 8.0, 17.0)))]
    assert files(folder) == len(made)
    assert len({tuple(each.core.flatten().tolist()) for each in made}) == len(made)


def test_other_code_makes_it_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted()
    monkeypatch.setattr(keeping, "_code", lambda: b"other")
    fitted()
    assert files(folder) == 2


def test_a_damaged_file_is_made_anew_with_a_warning(folder: Path) -> None:
    first = fitted()
    [path] = folder.iterdir()
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.warns(UserWarning, match="is not a whole safetensors file.*; it is made anew"):
        again = fitted()
    assert torch.equal(first.core, again.core)
    assert torch.equal(fitted().core, first.core)


def test_functions_of_the_users_own_are_fitted_anew(folder: Path) -> None:
    """Nothing tells whether a function changed."""
    space = SPACE.with_brdf("mine", lambda wi, wo: brdf.lambert(wi, wo))
    fitted(space)
    assert not folder.exists() or not files(folder)


def test_places_differ_by_every_value(folder: Path) -> None:
    given = {"a": 1, "t": torch.arange(4.0)}
    others = [{"a": 2, "t": torch.arange(4.0)}, {"a": 1, "t": torch.arange(4.0) + 1}, {"a": 1, "t": torch.arange(4)}]
    assert keeping.place("x", given) == keeping.place("x", {"a": 1, "t": torch.arange(4.0)})
    assert len({keeping.place("x", each) for each in (given, *others)}) == 4
