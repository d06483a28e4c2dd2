"""What the documentation shows is true: examples run, and the tables are those of the committed results."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import ptt
from bench import table

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = [f"ptt.ops{name}" for name in ("", ".geodesic", ".sphere", ".haar", ".octahedral", ".rotation")]


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name: str) -> None:
    import torch

    result = doctest.testmod(importlib.import_module(name), extraglobs={"torch": torch})
    assert result.attempted and not result.failed


@pytest.mark.parametrize("path", [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))], ids=lambda p: p.name)
def test_tables_are_drawn_from_the_results(path: Path) -> None:
    text = path.read_text()
    assert table.draw(text) == text, "run: python -m bench.table"
    assert "not measured yet" not in text, "a table names rows that are not there"


def test_the_citation_is_of_this_version() -> None:
    assert f"\nversion: {ptt.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_public_names_are_documented() -> None:
    for name in ptt.__all__:
        assert getattr(ptt, name).__doc__, name
