"""Three planners over five radio models: a sweep with a figure.

`uv run docs/examples/planners_and_radios.py [FILE]`, in a clone, writes the figure to FILE (radios.png): the
share of the missions that are localised, and the median of their ticks.
"""

from __future__ import annotations

import sys

import numpy as np
from matplotlib.figure import Figure

import tandem

PLANNERS = {"assured": "assured", "greedy": "greedy", "paper": "paper"}
RADIOS = {
    "disc": {"model": "disc"},
    "fading": {"model": "fading", "options": {"far": 1.0, "exponent": 1.0}},
    "log-distance": {"model": "log-distance", "options": {"half": 0.5}},
    "byte-rate": {"model": "byte-rate", "options": {"bytes_per_s": 150.0}},
    "collisions": {"model": "collisions", "options": {"slots": 2}},
}
"""The radio models, with the options that make them hard."""
SETTING = {"mission.noise": {"anchor_sigma": 0.01, "mutual_sigma": 0.01}, "mission.accuracy": 0.3}
"""Noise in m with which `paper` mostly reaches the accuracy in m."""
WIDTH = 0.27
"""The width of a bar; the bars of a radio begin 1 apart."""


def main(file: str = "radios.png", trials: int = 200, workers: int | None = None) -> None:
    """Run `trials` missions for each planner and radio, with the same starts, and draw both results."""
    base = tandem.Scenario.load("random").with_(SETTING)
    axes: list[dict[str, object]] = [
        {"name": "planner", "field": "planner.name", "values": [*PLANNERS.values()], "labels": [*PLANNERS]},
        {"name": "radio", "rows": [{"label": k, "set": {"world.radio": v}} for k, v in RADIOS.items()]},
    ]
    table = {"name": "radios", "scenario": base, "trials": trials}
    results = tandem.sweep({**table, "axis": [{**one, "paired": True} for one in axes]}, workers=workers)
    cells, less = results.cells, results.differences.where(axis="planner")
    rate, ticks = (np.reshape(cells[name], (len(PLANNERS), len(RADIOS))) for name in ("rate", "ticks_p50"))
    for i, name in enumerate(less["value"]):
        mean, low, high = (less[column][i] for column in ("ticks", "ticks_low", "ticks_high"))
        more, least, most = (100.0 * less[column][i] for column in ("rate", "rate_low", "rate_high"))
        found = f", {mean:+.1f} ticks ({low:+.1f} to {high:+.1f})" if less["both_localised"][i] else ""
        radio = [*RADIOS][less["cell"][i] % len(RADIOS)]
        print(f"{name} - assured, {radio}: localised {more:+.1f} % ({least:+.1f} to {most:+.1f}){found}")
    figure = Figure(figsize=(8.0, 3.5), layout="constrained")
    for axis, values, label in zip(
        figure.subplots(1, 2), (rate, ticks), ("share localised", "median of ticks"), strict=True
    ):
        for row, name in enumerate(PLANNERS):
            print(name, label, dict(zip(RADIOS, values[row].round(3).tolist(), strict=True)))
            axis.bar(np.arange(len(RADIOS)) + WIDTH * (row - 1), values[row], WIDTH, label=name)
        axis.set_xticks(range(len(RADIOS)), RADIOS, rotation=30)
        axis.set(ylabel=label, ylim=(0, None))
    axis.legend()
    figure.savefig(file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "radios.png")
