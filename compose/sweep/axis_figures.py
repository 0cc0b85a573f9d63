"""Pictures of a sweep: success and ticks against each axis, and when robots met, against T_max."""

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

from compose.figures.style import look, save
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
"""colour, line, marker: of different lightness, and told apart without colour too"""
LOGARITHMIC = 20.0
"""an axis whose largest value is so many times its smallest"""
FITTING = 60
"""characters that stand side by side below an axis"""
BESIDE = 96
"""characters of a legend that stand side by side"""
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?").fullmatch
APART = 0.45
"""of the room that a name has, for what stands beside each other there"""


def draw(results: Results, folder: Path) -> None:
    """Draw them anew, each as SVG, PDF and PNG, into `folder`."""
    folder.mkdir(exist_ok=True)
    with look():
        for place, axis in enumerate(results.sweep.axes):
            if len(axis.values) > 1:
                name = re.sub(r"[^A-Za-z0-9_-]+", "-", axis.name).strip("-")
                save(_success(results, place), folder / f"success-{name}")
                save(ticks_against(results, place), folder / f"ticks-{name}")
        save(_meeting(results), folder / "meeting")
        if (of_lies := attack_figures.axis_of_lies(results)) is not None:
            save(attack_figures.outcomes(results, of_lies), folder / "attacks")
            if (roc := attack_figures.roc(results, of_lies)) is not None:
                save(roc, folder / "roc")
        if (of_ticks := crash_figures.axis_of_ticks(results)) is not None:
            save(crash_figures.costs(results, of_ticks), folder / "crash")


def _success(results: Results, place: int) -> Figure:
    """The rate of localised trials, with Wilson's interval."""
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
    _legend(figure, axes)
    return figure


def _rates(figures: Sequence[CellSummary]) -> tuple[Any, Any, Any]:
    rows = [(one.rate or 0.0, one.rate_low or 0.0, one.rate_high or 0.0) for one in figures]
    rates, low, high = np.array(rows).reshape(-1, 3).T
    return rates, np.minimum(low, rates), np.maximum(high, rates)


def ticks_against(results: Results, place: int) -> Figure:
    """Median and maximum of the ticks that trials took which localised; 10 to 90 %, or up to 95 %.

    Between numbers that is a band, above names a line.
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
    _legend(figure, axes)
    return figure


def _meeting(results: Results) -> Figure:
    """How many have met by when: in seconds since release; and of T_max since both orbit."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    since_release, in_orbit = figure.subplots(1, 2, sharey=True)
    groups = _groups(results)
    times = [
        (column(table, "meeting_tick") * column(table, "period_s"), orbited_over_t_max(table))
        for _, table in groups
    ]
    for k, axes in enumerate((since_release, in_orbit)):
        known = [values[k][~np.isnan(values[k])] for values in times]
        end = max([1.0, *[met.max() for met in known if len(met)]])
        for (label, table), met, (colour, style, _) in zip(groups, known, STYLES, strict=False):
            share = np.arange(len(met) + 1) / max(1, len(table))
            x, y = np.concatenate([[0.0], np.sort(met), [end]]), np.append(share, share[-1])
            axes.step(x, y, where="post", color=colour, ls=style, lw=1.3, label=label)
    in_orbit.axvline(1.0, color="0.2", lw=1.0)
    in_orbit.annotate(
        "$T_{max}$", (1.0, 0.02), parse_math=True, xytext=(-3, 0), textcoords="offset points", ha="right"
    )
    in_orbit.set_xlabel("from both in orbit to meeting, over $T_{max}$", parse_math=True)
    since_release.set_xlabel("from release to meeting [s]")
    since_release.set_ylabel("share of all trials")
    since_release.set_ylim(0.0, 1.02)
    if len(groups) > 1:
        _legend(figure, since_release)
    return figure


def _groups(results: Results) -> list[tuple[str, pa.Table]]:
    """Each cell on its own while there are few; else those told apart."""
    axes = results.sweep.axes
    played = [cell for cell in results.cells if results.figures[cell.index].trials]
    if len(played) <= len(STYLES):
        return [
            (
                ", ".join([_named(axis, i) for axis, i in zip(axes, cell.place, strict=True)]),
                results.of(cell.index),
            )
            for cell in played
        ]
    groups = [(label, results.of(*chosen)) for label, chosen in _apart(results, None)]
    return [(label, table) for label, table in groups if len(table)]


def _lines(results: Results, place: int) -> Iterator[tuple[str, list[pa.Table]]]:
    """The trials at each value of an axis, a line for whatever is told apart."""
    for label, chosen in _apart(results, place):
        yield (
            label,
            [
                results.of(*[i for i in chosen if results.cells[i].place[place] == x])
                for x in range(len(results.sweep.axes[place].values))
            ],
        )


def _apart(results: Results, place: int | None) -> Iterator[tuple[str, set[int]]]:
    """The cells of each choice of values of the axes told apart, and what to call it; the others pooled."""
    axes, apart = results.sweep.axes, _told_apart(results, place)
    for choice in product(*[range(len(axes[i].values)) for i in apart]):
        label = ", ".join([_named(axes[i], value) for i, value in zip(apart, choice, strict=True)])
        yield (
            label,
            {cell.index for cell in results.cells if tuple([cell.place[i] for i in apart]) == choice},
        )


def _told_apart(results: Results, place: int | None) -> tuple[int, ...]:
    """The other axes with few values, paired ones first, while there is a style for each choice of them."""
    axes = results.sweep.axes
    others = [i for i, axis in enumerate(axes) if i != place and len(axis.values) > 1]
    apart: list[int] = []
    for i in sorted(others, key=lambda i: (not axes[i].paired, i)):
        if math.prod([len(axes[k].values) for k in (*apart, i)]) <= len(STYLES):
            apart.append(i)
    return tuple(apart)


def _named(axis: Axis, i: int) -> str:
    """A value of the axis, where it stands alone."""
    return axis.label(i) if _numbers(axis) is None else f"{axis.name.rpartition('.')[2]} = {axis.label(i)}"


def _against(axis: Axis) -> tuple[Figure, Axes, list[float]]:
    """A picture with the values of an axis along it, and where they lie."""
    numbers = _numbers(axis)
    labels = [axis.label(i) for i in range(len(axis.values))]
    crowded = numbers is None and sum(map(len, labels)) > FITTING
    figure = Figure(figsize=(7.2, 5.0 if crowded else 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(axis.name)
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
    """The values of the axis, or what they are called, if they are numbers."""
    if axis.labels is not None:
        return [float(label) for label in axis.labels] if all(map(_NUMBER, axis.labels)) else None
    if len(axis.fields) > 1:
        return None
    values = [value for (value,) in axis.values]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        return None
    return [float(value) for value in values]


def _joined(axis: Axis, style: Any) -> Any:
    """Between numbers there is something; between names there is not."""
    return style if _numbers(axis) is not None else ""


def _aside(axis: Axis, i: int, lines: int) -> float:
    """How far beside a name the point of one of several lines stands."""
    return 0.0 if _numbers(axis) is not None else APART / lines * (i - 0.5 * (lines - 1))


def _legend(figure: Figure, axes: Axes) -> None:
    """Above, where it hides nothing; none where there is nothing to tell apart."""
    handles, labels = axes.get_legend_handles_labels()
    if any(labels):
        longest = max(map(len, labels))
        columns = next((count for count in (4, 2) if count * longest < BESIDE), 1)
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(columns, len(labels)), frameon=False
        )
