"""Measured BRDFs as coloured shapes: the light that `ptt.separate` misplaces, of fits and files, for bench.metals."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

import ptt
from bench.table import Table

GOAL = "<= 0.05"
ONE = 10.0  # an error that one colour meets


def measured(table: Table, count: int | None = None) -> None:
    """Errors of the neural fits of MERL, and of files in its format that are written of them, the first so many."""
    path = Path(os.environ["PTT_DATA"]) / "brdf" / "merl_nbrdf.npz"
    for name in ptt.NeuralBRDF.names(path)[:count]:
        fit = ptt.NeuralBRDF.load(path, name)
        _separated(table, f"measured, {name}, fit", name, fit.evaluate)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "table.binary"
            ptt.MERL.write(file, fit.evaluate)
            _separated(table, f"measured, {name}, file", name, ptt.MERL.load(file).evaluate)


def _separated(table: Table, what: str, name: str, brdf: Callable[[Tensor, Tensor], Tensor]) -> None:
    found = ptt.separate(name, brdf)
    alone = ptt.separation_error(ptt.separate(name, brdf, error=ONE), brdf)
    how = f"{len(found.highlights)} coloured shapes; with one {alone:.3f}"
    table.row(what, ptt.separation_error(found, brdf), "of its light misplaced", how, GOAL)
