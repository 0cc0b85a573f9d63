"""Sweep the loss of reports, and plot how much longer a mission takes.

`uv run docs/examples/loss_sweep.py [FILE]` writes the figure to FILE (loss.png). The points are medians, and
the bars the quarter and three quarters of all trials.
"""

from __future__ import annotations

import sys

import numpy as np
from matplotlib.figure import Figure

import tandem

LOSS = (0.0, 0.5, 0.8, 0.9, 0.95)
"""The probability with which a report is lost, in each direction."""


def main(file: str = "loss.png", trials: int = 20, workers: int | None = None) -> None:
    """Run `trials` missions from the same random starts for each loss, and write the figure to `file`."""
    results = tandem.sweep("random", {"fault[0].loss": LOSS}, paired=True, trials=trials, workers=workers)
    print(results, "rate of localised trials:", *results.cells["rate"])
    quartiles = []
    for cell in results.cells["cell"]:
        ticks = results.trials.where(cell=cell, outcome="localised")["ticks"]
        quartiles.append(np.percentile(ticks, (25, 50, 75)))
    low, median, high = np.transpose(quartiles)
    figure = Figure(figsize=(5.0, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.errorbar(
        results.cells["fault[0].loss"], median, [median - low, high - median], marker="o", capsize=3
    )
    axes.set(xlabel="loss of reports", ylabel="ticks until both robots are localised")
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "loss.png")
