"""docs/equations.md: its names import, the tests that it cites exist, and no numbered equation is left out."""

from __future__ import annotations

import ast
import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "equations.md").read_text()

LAST = {"Sun et al. 2007": 4, "Wang et al. 2006": 7, "Ma et al. 2006": 7}
"""The last numbered equation of each paper: Sun's U = U^I0 + U^I1 + U^I2 in section 3.3, Wang's B = F_r . (R x L) in
section 2, Ma's integral over Omega_x in section 3.2."""

UNNUMBERED = "Without a number"


def rows(title: str) -> list[list[str]]:
    """The six cells of every row below a heading."""
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.mark.parametrize("title", LAST)
def test_every_numbered_equation_is_listed(title: str) -> None:
    assert [int(number) for number, *_ in rows(title)] == list(range(1, LAST[title] + 1))


@pytest.mark.parametrize("title", [*LAST, UNNUMBERED])
def test_every_row_names_a_function_and_a_test_or_says_that_there_is_none(title: str) -> None:
    for row in rows(title):
        assert len(row) == 6, row
        _, section, equation, function, test, _ = row
        assert section and equation
        assert "`ptt." in function or function.startswith("not computed: "), function
        assert re.search(r"`tests/\S+\.py::\w+`", test) or test == "no test", test


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(ptt\.[\w.]+)`", PAGE))))
def test_names_import(name: str) -> None:
    pkgutil.resolve_name(name)


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(tests/\S+\.py)::\w+`", PAGE))))
def test_cited_tests_exist(path: str) -> None:
    defined = {node.name for node in ast.parse((ROOT / path).read_text()).body if isinstance(node, ast.FunctionDef)}
    assert set(re.findall(rf"`{path}::(\w+)`", PAGE)) <= defined
