"""Planners compared on the same missions: a sweep over planners for each scenario, a table and a figure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from compose.errors import UserError
from compose.figures.style import SWEEP_MEDIUM, look, save
from compose.recording.rows import csv_table
from compose.sweep import spec
from compose.sweep.axis_figures import STYLES
from compose.sweep.cells import Cell
from compose.sweep.execution import Results
from compose.sweep.spec import Sweep
from compose.sweep.statistics import WORSE, CellTrials, noted, quantile, wilson
from compose.terminal import tables
from protocol import files

Row = Mapping[str, Any]
"""The result of a planner in a scenario; docs/own-planner.md describes its columns, those of `arena.csv`."""
BASELINES = ("assured", "paper", "greedy", "fisher", "random")
"""The planners that are compared by default."""
TRIALS = 50
"""The default number of missions of each planner in each scenario."""
ARENA = "arena"
"""The name of the table and the figure."""
OF_CELL = ("trials", "localised", "undecided", "inconsistent", "wrong", "failed")
"""The columns that are those of a cell of a sweep."""
NOTE = (
    "All planners have the same missions. wrong: missions with a wrong claim; ticks: median of those that "
    "localised; more ticks: mean difference from the first planner in missions that both localised; nees: "
    "mean of the claims, and the 99 % band of consistent covariances. Other intervals have 95 %."
)


def sweeps(
    planners: Sequence[str],
    scenarios: Sequence[tuple[str, dict[str, Any]]],
    trials: int | None,
    seed: int | None,
) -> list[Sweep]:
    """Return a sweep over `planners` for each scenario, given by name and table. Raises UserError."""
    rows = [{"label": one, "set": {"planner": {"name": one}}} for one in planners or BASELINES]
    axis = {"name": "planners", "rows": rows, "paired": True}
    numbers = {"trials": TRIALS if trials is None else trials, "seed": seed or 0}
    found: dict[str, Sweep] = {}
    for name, base in scenarios:
        if name in found:
            raise UserError(f"arena: two scenarios are named '{name}'")
        table = {"name": ARENA, "scenario": name, **numbers, "axis": [axis]}
        found[name] = spec.validated(table, name, Path(), base=base)
    return [*found.values()]


def run(
    chosen: Sequence[Sweep], out: Path, play: Callable[[Sweep, Path], Results]
) -> tuple[list[Row], list[Results]]:
    """Run the sweeps by `play`, write table and figure to `out`, and return the rows and the results.

    After a sweep that is stopped, no other one runs. Raises UserError.
    """
    results: list[Results] = []
    for number, one in enumerate(chosen):
        results.append(play(one, out / f"{number}-{Path(one.source).stem}"))
        if results[-1].stopped is not None:
            break
    rows = [_row(one, cell) for one in results for cell in one.cells]
    table = csv_table(rows[0], [row.values() for row in rows])
    files.write(out / f"{ARENA}.csv", table)
    with look(SWEEP_MEDIUM):
        save(figure(rows), out / ARENA)
    return rows, results


def _row(results: Results, cell: Cell) -> Row:
    """Return the row of one planner. Raises UserError if the scenario is infeasible with it."""
    planner, one = results.sweep.axes[0].label(cell.place[0]), results.figures[cell.index]
    if one.refused is not None:
        raise UserError(f"{results.sweep.source}: {planner}: {one.refused}")
    less = next((one for one in results.differences if one.cell == cell.index), None)
    trials = CellTrials(results.of(cell.index))
    known, n = trials.known("ticks"), len(trials.outcomes)
    intervals = {
        "rate": (one.rate, one.rate_low, one.rate_high),
        "wrong_rate": wilson(one.wrong, n) if n else (None,) * 3,
        "ticks": quantile(known, 0.5) if len(known) else (None,) * 3,
        "more_ticks": (less.ticks, less.ticks_low, less.ticks_high) if less is not None else (None,) * 3,
        "nees": (one.nees_mean, one.nees_low, one.nees_high),
    }
    return {
        "scenario": results.sweep.source,
        "planner": planner,
        **{name: getattr(one, name) for name in OF_CELL},
        "pairs": less.both_localised if less is not None else None,
        **{
            name + end: value
            for name, interval in intervals.items()
            for end, value in zip(ENDS, interval, strict=True)
        },
    }


ENDS = ("", "_low", "_high")
"""The ends of the names of the columns of an estimate and of its bounds."""


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on the terminal."""
    forms = {
        "rate": "{:.2f}",
        "wrong_rate": "{:.3f}",
        "ticks": "{:.0f}",
        "more_ticks": "{:+.1f}",
        "nees": "{:.2f}",
    }
    cells = [
        [
            *(row["scenario"], row["planner"], f"{row['localised']}/{row['trials']}", str(row["wrong"])),
            *[_with_interval(form, *[row[name + end] for end in ENDS]) for name, form in forms.items()],
        ]
        for row in rows
    ]
    titles = ("localised", "wrong", *[name.replace("_", " ") for name in forms])
    return tables.shown(("scenario", "planner"), titles, cells)


def reasons(results: Sequence[Results]) -> Iterator[str]:
    """Yield why a mission of each planner did not localise, the worst first, as a line for the terminal."""
    for one in results:
        for cell in one.cells:
            worst = noted(one.of(cell.index))
            if worst is not None and worst.outcome in WORSE:
                planner = one.sweep.axes[0].label(cell.place[0])
                yield f"{one.sweep.source}, {planner}: trial {worst.trial}, {worst.outcome}: {worst.why}"


def _with_interval(form: str, value: float | None, low: float | None, high: float | None) -> str:
    if value is None:
        return "-"
    return form.format(value) + ("" if low is None else f" ({form} to {form})".format(low, high))


def figure(rows: Sequence[Row]) -> Figure:
    """Return the figure: the rates and the ticks of all planners, with their intervals."""
    planners = list(dict.fromkeys([row["planner"] for row in rows]))
    drawn = Figure(figsize=(7.2, 1.2 + 0.4 * len(planners)), layout="constrained")
    panels = {"rate": "localised, of all missions", "ticks": "ticks until localised, median"}
    for axes, (name, label) in zip(drawn.subplots(1, 2, sharey=True), panels.items(), strict=True):
        for number, scenario in enumerate(dict.fromkeys([row["scenario"] for row in rows])):
            colour, _, marker = STYLES[number % len(STYLES)]
            some = [row for row in rows if row["scenario"] == scenario]
            values = np.array([[row[name + end] for end in ENDS] for row in some], float).T
            places = [planners.index(row["planner"]) + 0.15 * number for row in some]
            bars = np.maximum(0.0, [values[0] - values[1], values[2] - values[0]])
            look: Any = {"color": colour, "marker": marker, "ls": "", "ms": 4, "label": scenario}
            axes.errorbar(values[0], places, xerr=bars, capsize=2.5, **look)
        axes.set_xlabel(f"{label} (95 % interval)")
        axes.grid(axis="x", lw=0.4, color="0.85")
        axes.set_yticks(range(len(planners)), planners)
    axes.invert_yaxis()
    drawn.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return drawn
