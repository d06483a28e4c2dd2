"""Results as rows of bench/results/<topic>.csv, and the tables of README and docs that are drawn from them.

python -m bench.table        # redraw every table between `<!-- table: topic prefix -->` and `<!-- end -->`

`<!-- matrix: topic prefix -->` lays out rows named "prefix, row, column" as a table of that shape; what a paper reports
follows in brackets.
"""

from __future__ import annotations

import csv
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = ("what", "value", "unit", "goal", "paper", "peer", "limit", "how")


class Table:
    """The rows of one topic; `write` replaces the file."""

    def __init__(self, topic: str) -> None:
        self.path = ROOT / "bench" / "results" / f"{topic}.csv"
        self.rows: list[dict[str, str]] = []

    def row(self, what: str, value: float, unit: str, how: str, goal: str = "", **others: str) -> None:
        """One figure. goal: "<= x" or ">= x"; others: paper, peer, limit."""
        row = {"what": what, "value": f"{value:.4g}", "unit": unit, "goal": goal, **others, "how": how}
        self.rows.append({column: row.get(column, "") for column in COLUMNS})
        print(f"{what}: {value:.4g} {unit} {f'(goal {goal})' if goal else ''}", flush=True)

    def replace(self, name: str, names: Iterable[str] = ()) -> None:
        """Write these rows, whose names begin with "name, "; those that begin with other names stay as they are.

        names: all there are, in their order, others are dropped; default: those of the file, then this one.
        """
        old = list(csv.DictReader(self.path.open())) if self.path.exists() else []
        known = tuple(names) or (*(row["what"].split(", ")[0] for row in old), name)
        parts = {other: [row for row in old if row["what"].startswith(f"{other}, ")] for other in known}
        self.rows = [row for rows in (parts | {name: self.rows}).values() for row in rows]
        self.write()

    def write(self) -> None:
        """Replace the topic's file."""
        self.path.parent.mkdir(exist_ok=True)
        with self.path.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)


def median_seconds(function: Callable[[], object], repeats: int = 7) -> float:
    """Median time of a call, after one that is not counted."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def read_bandwidth() -> float:
    """Bytes a second that a sum over 400 MB reads: the machine's limit, as this process sees it."""
    data = torch.ones(100_000_000)
    return 4e8 / median_seconds(lambda: data.sum(), 5)


def setting() -> str:
    """Threads, torch and commit: what every timing depends on."""
    return f"{torch.get_num_threads()} threads, torch {torch.__version__}, commit {commit(ROOT)}"


def commit(checkout: Path) -> str:
    """The short name of the commit that is checked out there."""
    named = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=checkout, capture_output=True, text=True)
    return named.stdout.strip() or "none"


def draw(text: str) -> str:
    """Markdown with the tables between its markers drawn anew."""

    def table(match: re.Match[str]) -> str:
        kind = match[1]
        topic = match[2]
        prefix = match[3] or ""
        with (ROOT / "bench" / "results" / f"{topic}.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["what"].startswith(prefix)]
        lines = (_listed(rows) if kind == "table" else _laid_out(rows, prefix)) if rows else ["not measured yet"]
        return f"<!-- {kind}: {topic}{' ' + prefix if prefix else ''} -->\n" + "\n".join(lines) + "\n<!-- end -->"

    return re.sub(r"<!-- (table|matrix): (\w+)(?: ([^>]+?))? -->\n.*?<!-- end -->", table, text, flags=re.DOTALL)


def _listed(rows: list[dict[str, str]]) -> list[str]:
    shown = [c for c in COLUMNS if c not in ("how", "unit") and any(row[c] for row in rows)]
    cells = [[f"{r['value']} {r['unit']}".strip() if c == "value" else r[c] for c in shown] for r in rows]
    return _markdown(shown, cells)


def _laid_out(rows: list[dict[str, str]], prefix: str) -> list[str]:
    values = {
        tuple(row["what"].removeprefix(prefix + ", ").rsplit(", ", 1)): f"{row['value']} ({row['paper']})"
        if row["paper"]
        else row["value"]
        for row in rows
    }
    down, across = (list(dict.fromkeys(names)) for names in zip(*values, strict=True))
    return _markdown(["", *across], [[name, *(values.get((name, c), "") for c in across)] for name in down])


def _markdown(head: list[str], cells: list[list[str]]) -> list[str]:
    lines = [f"| {' | '.join(line)} |" for line in (head, *cells)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def main() -> None:
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("**/*.md")]:
        path.write_text(draw(path.read_text()))


if __name__ == "__main__":
    main()
