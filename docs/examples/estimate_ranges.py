"""Estimate the poses of two robots from recorded UWB ranges, and plot the errors.

`uv run docs/examples/estimate_ranges.py [FILE]` writes the figure to FILE (estimate.png).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import tandem

RECORDING = Path(__file__).parents[2] / "tests" / "data" / "uwb" / "tiers-a-b-30-s.pyfg"


def main(file: str = "estimate.png") -> None:
    """Estimate, print who claims when, and write the errors with the sigma of each position to `file`."""
    found = tandem.estimate(RECORDING, noise="uwb-calibrated")
    print(found)
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for robot in found.robots:
        rows = found.rows.where(robot=robot)
        (line,) = axes.semilogy(rows["t_s"], rows["position_error_m"], label=f"{robot}: error")
        sigma = np.sqrt(rows["xx"] + rows["yy"])
        axes.semilogy(rows["t_s"], sigma, "--", color=line.get_color(), label=f"{robot}: sigma")
        claimed = rows["t_s"][rows["claim"]]
        if len(claimed):
            axes.axvline(claimed[0], color=line.get_color(), linewidth=0.5)
    axes.set(xlabel="time [s]", ylabel="position [m]")
    axes.legend()
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "estimate.png")
