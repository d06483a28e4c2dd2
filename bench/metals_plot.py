"""docs/images/metals_trade.png, from the rows of bench/results/metals.csv: error against frames a second by lobes.

python -m bench.metals_plot
"""

from __future__ import annotations

import csv

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot

from bench.metals import TRADED
from bench.metals_speed import COUNTS
from bench.table import ROOT

SCENE = "suzanne"


def main() -> None:
    with (ROOT / "bench" / "results" / "metals.csv").open() as file:
        values = {row["what"]: float(row["value"]) for row in csv.DictReader(file)}
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axis, instructions in zip(axes, ("AVX2", "AVX512"), strict=True):
        for key in TRADED:
            rates = [values[f"{SCENE}, {instructions}, {n} lobes, view"] for n in COUNTS]
            errors = [100 * values[f"{SCENE}, trade, {key}, {n} lobes, steep"] for n in COUNTS]
            (line,) = axis.plot(rates, errors, "o-", label=key)
            tensor = 100 * values[f"{SCENE}, uffizi, {key}, tensor, total, steep"]
            axis.plot(values[f"{SCENE}, {instructions}, tensor, view"], tensor, "x", color=line.get_color())
            for n, rate, error in zip(COUNTS, rates, errors, strict=True):
                axis.annotate(str(n), (rate, error), textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(title=f"{SCENE}, two bounces, {instructions}", xlabel="frames a second, view", xscale="log")
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="relative RMSE in total [%]")
    axes[0].legend(title="by lobes; x: tensor")
    figure.tight_layout()
    figure.savefig(ROOT / "docs" / "images" / "metals_trade.png", dpi=110)


if __name__ == "__main__":
    main()
