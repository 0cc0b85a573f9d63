"""The figures of a sweep: success rate and ticks over each axis, and the time until robots meet.

Sweeps over attacks or kills have additional figures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from compose.figures.style import SWEEP_MEDIUM, look, save
from compose.sweep import attack_figures, crash_figures
from compose.sweep.execution import Results
from compose.sweep.spec import Axis
from compose.sweep.statistics import CellSummary, column, counted, orbited_over_t_max

STYLES = (
    ("#0b3c6f", "-", "o"),
    ("#d9541e", "--", "s"),
    ("#3f8f5a", "-.", "^"),
    ("#8a8a8a", ":", "D"),
    ("#8e5ea2", (0, (5, 1)), "v"),
    ("#c9a227", (0, (3, 1, 1, 1)), "P"),
)
"""The colour, line and marker of each line of a figure, distinguishable without colour."""
LOGARITHMIC = 20.0
"""The ratio of the largest to the smallest value from which on an axis is logarithmic."""
FITTING = 60
"""The total length in characters up to which the labels below an axis are horizontal."""
WIDEST_LEGEND = 96
"""The length in characters of the widest row of a legend."""
_AXIS_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?").fullmatch
POINTS_SPREAD = 0.45
"""The fraction of the space of a label over which the points of several lines are spread."""


def draw(results: Results, folder: Path) -> None:
    """Draw all figures of the sweep into `folder`, each as SVG, PDF and PNG."""
    folder.mkdir(exist_ok=True)
    with look(SWEEP_MEDIUM):
        for place, axis in enumerate(results.sweep.axes):
            if len(axis.values) > 1:
                name = re.sub(r"[^A-Za-z0-9_-]+", "-", axis.name).strip("-")
                save(_success(results, place), folder / f"success-{name}")
                save(ticks_against(results, place), folder / f"ticks-{name}")
        save(_meeting(results), folder / "meeting")
        if (attacks := attack_figures.attack_axis(results)) is not None:
            save(attack_figures.outcomes(results, attacks), folder / "attacks")
            if (roc := attack_figures.roc(results, attacks)) is not None:
                save(roc, folder / "roc")
        if (kill_ticks := crash_figures.kill_tick_axis(results)) is not None:
            save(crash_figures.costs(results, kill_ticks), folder / "crash")


def _success(results: Results, place: int) -> Figure:
    """Return the figure of the success rate over an axis, with 95 % Wilson intervals."""
    figure, axes, at = _against(results.sweep.axes[place])
    lines = list(_lines(results, place))
    for i, (label, tables) in enumerate(lines):
        colour, style, marker = STYLES[i]
        points = [
            (x, figures) for x, table in zip(at, tables, strict=True) if (figures := counted(table)).trials
        ]
        where = np.array([x for x, _ in points]) + _aside(results.sweep.axes[place], i, len(lines))
        rates, low, high = _rates([figures for _, figures in points])
        axes.errorbar(
            where,
            rates,
            yerr=[rates - low, high - rates],
            color=colour,
            ls=_joined(results.sweep.axes[place], style),
            marker=marker,
            ms=4,
            lw=1.2,
            capsize=2.5,
            label=label,
        )
    axes.set_ylabel("localised, of all trials (95 % interval)")
    axes.set_ylim(top=min(1.02, axes.get_ylim()[1]))
    _legend(figure, axes, _unpaired(results, place))
    return figure


def _rates(figures: Sequence[CellSummary]) -> tuple[Any, Any, Any]:
    """Return the rates and the bounds of their intervals, each of shape (points,)."""
    rows = [(one.rate or 0.0, one.rate_low or 0.0, one.rate_high or 0.0) for one in figures]
    rates, low, high = np.array(rows).reshape(-1, 3).T
    return rates, np.minimum(low, rates), np.maximum(high, rates)


def ticks_against(results: Results, place: int) -> Figure:
    """Return the figure of the ticks until localised over an axis: median, maximum and spread.

    The spread is a band from the 10th to the 90th percentile over a numeric axis, and a line up to the 95th
    percentile over an axis of names.
    """
    axis = results.sweep.axes[place]
    joined = _numbers(axis) is not None
    figure, axes, at = _against(axis)
    lines = list(_lines(results, place))
    for i, (label, tables) in enumerate(lines):
        colour, style, marker = STYLES[i]
        points = [
            (x, figures)
            for x, table in zip(at, tables, strict=True)
            if (figures := counted(table)).ticks_p50 is not None
        ]
        where = np.array([x for x, _ in points]) + _aside(axis, i, len(lines))
        low, middle, high, most, top = (
            np.array([getattr(figures, f"ticks_{name}") for _, figures in points], float)
            for name in ("p10", "p50", "p90", "p95", "max")
        )
        axes.plot(
            where, middle, color=colour, ls=_joined(axis, style), marker=marker, ms=4, label=label or "median"
        )
        if joined:
            axes.fill_between(where, low, high, color=colour, alpha=0.15, lw=0.0)
        else:
            axes.vlines(where, middle, most, color=colour, lw=1.2)
            axes.plot(where, most, color=colour, ls="", marker="_", ms=7)
        axes.plot(where, top, color=colour, ls="", marker=marker, ms=4, mfc="white")
    if joined:
        axes.fill_between([], [], color="0.3", alpha=0.15, lw=0.0, label="10 to 90 %")
    else:
        axes.plot([], [], color="0.3", ls="", marker="|", ms=8, label="up to 95 %")
    axes.plot([], [], color="0.3", ls="", marker="o", ms=4, mfc="white", label="maximum")
    axes.set_ylabel("ticks until localised (median)")
    if not any(counted(table).ticks_p50 is not None for _, tables in lines for table in tables):
        axes.annotate("none localised", (0.5, 0.5), xycoords="axes fraction", ha="center")
        return figure
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:.0f}")
    axes.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.0, 0.4)))
    axes.grid(axis="y", which="minor", lw=0.25, color="0.9")
    _legend(figure, axes, _unpaired(results, place))
    return figure


def _meeting(results: Results) -> Figure:
    """Return the figure of the share of trials in which phase 3 has begun, over time.

    One panel shows the time in s since the start, the other the time since both orbit, divided by T_max.
    """
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    since_release, in_orbit = figure.subplots(1, 2, sharey=True)
    groups = _groups(results)
    times = [
        (column(table, "meeting_tick") * column(table, "period_s"), orbited_over_t_max(table))
        for _, table in groups
    ]
    for k, axes in enumerate((since_release, in_orbit)):
        known = [values[k][~np.isnan(values[k])] for values in times]
        end = max([1.0, *[group_times.max() for group_times in known if len(group_times)]])
        for (label, table), group_times, (colour, style, _) in zip(groups, known, STYLES, strict=False):
            share = np.arange(len(group_times) + 1) / max(1, len(table))
            x, y = np.concatenate([[0.0], np.sort(group_times), [end]]), np.append(share, share[-1])
            axes.step(x, y, where="post", color=colour, ls=style, lw=1.3, label=label)
    in_orbit.axvline(1.0, color="0.2", lw=1.0)
    in_orbit.annotate(
        "$T_{max}$", (1.0, 0.02), parse_math=True, xytext=(-3, 0), textcoords="offset points", ha="right"
    )
    in_orbit.set_xlabel("from both in orbit to phase 3, over $T_{max}$", parse_math=True)
    since_release.set_xlabel("from start to phase 3 [s]")
    since_release.set_ylabel("share of all trials")
    since_release.set_ylim(0.0, 1.02)
    if len(groups) > 1:
        _legend(figure, since_release, _unpaired(results, None))
    return figure


def _groups(results: Results) -> list[tuple[str, pa.Table]]:
    """Return the trials of each line of the meeting figure, with its label.

    There is one line per cell if there are at most as many cells as styles, else one per distinguished group.
    """
    axes = results.sweep.axes
    run_cells = [cell for cell in results.cells if results.figures[cell.index].trials]
    if len(run_cells) <= len(STYLES):
        return [
            (
                ", ".join([_named(axis, i) for axis, i in zip(axes, cell.place, strict=True)]),
                results.of(cell.index),
            )
            for cell in run_cells
        ]
    groups = [(label, results.of(*chosen)) for label, chosen in _distinguished_cells(results, None)]
    return [(label, table) for label, table in groups if len(table)]


def _lines(results: Results, place: int) -> Iterator[tuple[str, list[pa.Table]]]:
    """Yield the lines of a figure over the axis `place`: a label, and the trials at each value."""
    for label, chosen in _distinguished_cells(results, place):
        yield (
            label,
            [
                results.of(*[i for i in chosen if results.cells[i].place[place] == x])
                for x in range(len(results.sweep.axes[place].values))
            ],
        )


def _distinguished_cells(results: Results, place: int | None) -> Iterator[tuple[str, set[int]]]:
    """Yield a label and the cells of each combination of values of the distinguished axes.

    The cells of the remaining axes are pooled.
    """
    axes, distinguished = results.sweep.axes, _distinguished(results, place)
    for choice in product(*[range(len(axes[i].values)) for i in distinguished]):
        label = ", ".join([_named(axes[i], value) for i, value in zip(distinguished, choice, strict=True)])
        yield (
            label,
            {cell.index for cell in results.cells if tuple([cell.place[i] for i in distinguished]) == choice},
        )


def _distinguished(results: Results, place: int | None) -> tuple[int, ...]:
    """Return the indices of the axes that get separate lines in a figure over the axis `place`.

    Paired axes come first. An axis is added if there is still a style for every combination.
    """
    axes = results.sweep.axes
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
    axes.set_xlabel(axis.name if axis.paired else f"{axis.name} (other draws at each value)")
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


def _joined(axis: Axis, style: Any) -> Any:
    """Return the line style between points: `style` on a numeric axis, none on an axis of names."""
    return style if _numbers(axis) is not None else ""


def _aside(axis: Axis, i: int, lines: int) -> float:
    """Return the horizontal offset of the points of line `i`; 0 on a numeric axis."""
    return 0.0 if _numbers(axis) is not None else POINTS_SPREAD / lines * (i - 0.5 * (lines - 1))


def _unpaired(results: Results, place: int | None) -> str | None:
    """Return the title of a legend whose lines have other draws, with their axes; None if all are paired."""
    axes = [axis for i, axis in enumerate(results.sweep.axes) if i != place and len(axis.values) > 1]
    names = [axis.name for axis in axes if not axis.paired]
    return f"other draws at each value of {', '.join(names)}" if names else None


def _legend(figure: Figure, axes: Axes, title: str | None) -> None:
    """Add a legend with this title above the axes, unless there are no labels."""
    handles, labels = axes.get_legend_handles_labels()
    if any(labels):
        longest = max(map(len, labels))
        columns = next((count for count in (4, 2) if count * longest < WIDEST_LEGEND), 1)
        figure.legend(
            handles,
            labels,
            title=title,
            loc="outside upper center",
            ncols=min(columns, len(labels)),
            frameon=False,
        )
