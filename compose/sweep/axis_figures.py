"""The figures of a sweep: a rate or quantiles of its trials over each axis, with 95 % intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from compose.figures.style import SWEEP_MEDIUM, look, save
from compose.sweep.execution import Results
from compose.sweep.spec import Axis, Sweep
from compose.sweep.statistics import CellTrials, Interval, quantile, wilson

STYLES = (
    ("#0b3c6f", "-", "o"),
    ("#d9541e", "--", "s"),
    ("#3f8f5a", "-.", "^"),
    ("#8a8a8a", ":", "D"),
    ("#8e5ea2", (0, (5, 1)), "v"),
    ("#c9a227", (0, (3, 1, 1, 1)), "P"),
)
"""The colour, line and marker of each line of a figure, distinguishable without colour."""
QUANTILES = {"median": 0.5, "95 %": 0.95}
"""The quantiles of a figure, by the name in its legend."""
LOGARITHMIC = 20.0
"""The ratio of the largest to the smallest value from which on an axis is logarithmic."""
FITTING = 60
"""The total length in characters up to which the labels below an axis are horizontal."""
WIDEST_LEGEND, BESIDE_LABEL = 104, 9
"""The length in characters of the widest row of a legend, and of the marker beside each label."""
_AXIS_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?").fullmatch
POINTS_SPREAD = 0.45
"""The fraction of the space of a label over which the points of several lines are spread."""


class FigurePoint(NamedTuple):
    """A point of a figure: an estimate from the trials of some cells, with the bounds of its interval."""

    line: str
    """The name of its line."""
    value: int
    """The index of the value of the axis."""
    quantity: str
    """The name of the quantile; empty for a rate."""
    estimate: float
    low: float
    """The lower bound; NaN if it is unknown."""
    high: float
    """The upper bound, likewise."""


class Statistic(NamedTuple):
    """A rate or quantiles of trials."""

    label: str
    """The label of the vertical axis."""
    outcome: str = ""
    """The outcome of a rate, among all trials that ran; empty for the quantiles of a column."""
    column: str = ""
    """The column whose QUANTILES are drawn."""

    def estimates(self, trials: CellTrials) -> dict[str, Interval]:
        """Return the estimates from `trials` by their names; none if there are none."""
        if self.outcome:
            n = len(trials.outcomes)
            return {"": wilson(trials.outcomes.count(self.outcome), n)} if n else {}
        known = trials.known(self.column)
        return {name: quantile(known, p) for name, p in QUANTILES.items()} if len(known) else {}


STATISTICS = {
    "success": Statistic("localised, of all trials", "localised"),
    "inconsistent": Statistic("inconsistent, of all trials", "inconsistent"),
    "wrong": Statistic("wrong, of all trials", "wrong"),
    "ticks": Statistic("ticks until localised", column="ticks"),
    "wall": Statistic("wall time [s]", column="wall_s"),
}
"""The figures over an axis, by the start of their file names; the wall time is that of sweeps with kills."""


def draw(results: Results, folder: Path) -> None:
    """Draw all figures of the sweep into `folder`, each as SVG, PDF and PNG."""
    folder.mkdir(exist_ok=True)
    trials = CellTrials(results.table)
    drawn = {"success", "ticks", *trials.outcomes, *(["wall"] if len(trials.known("kills")) else [])}
    with look(SWEEP_MEDIUM):
        for place, axis in enumerate(results.sweep.axes):
            name = re.sub(r"[^A-Za-z0-9_-]+", "-", axis.name).strip("-")
            for title, statistic in STATISTICS.items():
                if len(axis.values) > 1 and title in drawn:
                    figure = over_axis(results.sweep, place, statistic, points(results, place, statistic))
                    save(figure, folder / f"{title}-{name}")


def points(results: Results, place: int, statistic: Statistic) -> list[FigurePoint]:
    """Return the points of `statistic` over the axis at index `place`.

    There is a line for each combination of values of the distinguished axes; cells of the others are pooled.
    """
    axes, distinguished = results.sweep.axes, _distinguished(results.sweep, place)
    found = []
    for *choice, x in product(*[range(len(axes[i].values)) for i in (*distinguished, place)]):
        pooled = [
            cell.index
            for cell in results.cells
            if [cell.place[i] for i in (*distinguished, place)] == [*choice, x]
        ]
        line = ", ".join([_named(axes[i], value) for i, value in zip(distinguished, choice, strict=True)])
        estimates = statistic.estimates(CellTrials(results.of(*pooled)))
        found += [FigurePoint(line, x, name, *estimate) for name, estimate in estimates.items()]
    return found


def over_axis(sweep: Sweep, place: int, statistic: Statistic, points: Sequence[FigurePoint]) -> Figure:
    """Return the figure of `points` over the axis at index `place`. Points over numbers are joined."""
    axis = sweep.axes[place]
    figure, axes, at = _against(axis)
    joined = _numbers(axis) is not None
    lines = list(dict.fromkeys(point.line for point in points))
    quantities = list(dict.fromkeys(point.quantity for point in points))
    bounded = any(not math.isnan(point.low) for point in points)
    for (i, line), (rank, quantity) in product(enumerate(lines), enumerate(quantities)):
        colour, style, marker = STYLES[i]
        shown = [point for point in points if (point.line, point.quantity) == (line, quantity)]
        aside = 0.0 if joined else POINTS_SPREAD / len(lines) * (i - 0.5 * (len(lines) - 1))
        values = np.array([point[3:] for point in shown]).T.reshape(3, -1)
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 4, "ls": style if joined else ""}
        look |= {"mfc": "white", "lw": 0.7} if rank else {"mfc": colour, "lw": 1.2, "label": line}
        if bounded:
            bars = np.maximum(0.0, [values[0] - values[1], values[2] - values[0]])
            look |= {"yerr": bars, "capsize": 2.5}
        axes.errorbar([at[point.value] + aside for point in shown], values[0], **look)
    for rank, quantity in enumerate(filter(None, quantities)):
        face, name = "white" if rank else "0.3", quantity.replace("%", "% quantile")
        axes.plot([], [], "o", color="0.3", ms=4, mfc=face, label=name)
    axes.set_ylabel(f"{statistic.label} (95 % interval)" if bounded else statistic.label)
    if not points:
        axes.annotate("no such trial", (0.5, 0.5), xycoords="axes fraction", ha="center")
    elif statistic.column == "ticks":
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:.0f}")
        axes.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.0, 0.4)))
        axes.grid(axis="y", which="minor", lw=0.25, color="0.9")
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        others = [one for one in sweep.axes if one is not axis and len(one.values) > 1]
        unpaired = ", ".join([one.name for one in others if not one.paired])
        columns = next((n for n in (4, 2) if n * (BESIDE_LABEL + max(map(len, labels))) <= WIDEST_LEGEND), 1)
        title = f"other random draws at each value of {unpaired}" if unpaired else None
        look = {"loc": "outside upper center", "ncols": min(columns, len(labels)), "frameon": False}
        figure.legend(handles, labels, title=title, **look)
    return figure


def _distinguished(sweep: Sweep, place: int) -> tuple[int, ...]:
    """Return the indices of the axes that get separate lines in a figure over the axis at index `place`.

    Paired axes come first. An axis is added if there is still a style for every combination.
    """
    axes = sweep.axes
    others = [i for i, axis in enumerate(axes) if i != place and len(axis.values) > 1]
    distinguished: list[int] = []
    for i in sorted(others, key=lambda i: (not axes[i].paired, i)):
        if math.prod([len(axes[k].values) for k in (*distinguished, i)]) <= len(STYLES):
            distinguished.append(i)
    return tuple(distinguished)


def _named(axis: Axis, i: int) -> str:
    """Return the name of a value for a legend; a number gets the name of its axis, such as `seed = 3`."""
    return axis.label(i) if _numbers(axis) is None else f"{axis.name.rpartition('.')[2]} = {axis.label(i)}"


def _against(axis: Axis) -> tuple[Figure, Axes, list[float]]:
    """Return a figure with the values of `axis` along the horizontal axis, and their positions."""
    numbers = _numbers(axis)
    labels = [axis.label(i) for i in range(len(axis.values))]
    crowded = numbers is None and sum(map(len, labels)) > FITTING
    figure = Figure(figsize=(7.2, 5.0 if crowded else 3.6), layout="constrained")
    axes = figure.subplots()
    name = axis.name.replace("-", " ")
    axes.set_xlabel(name if axis.paired else f"{name} (other random draws at each value)")
    axes.grid(axis="y", lw=0.4, color="0.85")
    if numbers is not None:
        if min(numbers) > 0.0 and max(numbers) >= LOGARITHMIC * min(numbers):
            axes.set_xscale("log")
        return figure, axes, numbers
    axes.set_xticks(
        range(len(labels)), labels, rotation=40 if crowded else 0, ha="right" if crowded else "center"
    )
    axes.set_xlim(-0.5, len(labels) - 0.5)
    return figure, axes, [float(i) for i in range(len(labels))]


def _numbers(axis: Axis) -> list[float] | None:
    """Return the values or labels of the axis as numbers; None if they are not numbers."""
    if axis.labels is not None:
        return [float(label) for label in axis.labels] if all(map(_AXIS_NUMBER, axis.labels)) else None
    if len(axis.fields) > 1:
        return None
    values = [value for (value,) in axis.values]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        return None
    return [float(value) for value in values]
