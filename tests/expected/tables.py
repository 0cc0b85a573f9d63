"""The tables of the documentation that are written from the expected results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from compose.sweep.statistics import wilson
from tests.expected.results import CellResults, Expected, Quantiles, read

OUTCOMES = ("localised", "undecided", "inconsistent", "wrong", "failed", "refused")
Column = tuple[str, Callable[[Sequence[CellResults]], str]]
POOLED_BY = {"partition": 0}
"""The index of the axis whose values are the rows, in sweeps with many equal cells; else each cell is."""


FEWEST_SHOWN = 40
"""The fewest trials of a cell of which a page shows results; else, it shows those of all cells together."""


def table(name: str) -> str:
    """Return the table of the sweep `name` in Markdown, with the command that compares it.

    It has the results of earlier runs with more trials; else, those of the cells.
    """
    file = read(name)
    assert file is not None
    of_file = f"{_number(file.trials)} trial{'s' if file.trials > 1 else ''} in each cell, seed {file.seed}"
    lines = [f"`uv run python -m tests.expected {name}`; its file has {of_file}, code of {file.commit}."]
    if file.notes:
        lines += [file.notes]
    if file.landed:
        lines += ["", *_landed(file)]
    else:
        few = file.trials < FEWEST_SHOWN and len(file.cell) > 1
        rows = {f"all {len(file.cell)} cells": file.cell} if few else _rows(file)
        columns = [column for column in _columns() if any(column[1](cells) for cells in rows.values())]
        lines += [
            "",
            _line([" ", *[head for head, _ in columns]]),
            _line(["---"] * (len(columns) + 1)),
            *[_line([row, *[of(cells) for _, of in columns]]) for row, cells in rows.items()],
        ]
    return "\n".join(lines)


HEADLINE = {
    "any-start": "exact sensors, any start",
    "anywhere": "exact sensors, any settings and start",
    "loss": "0 to 95 % of the reports lost",
    "delay": "reports late by up to 20 ticks, and other faults",
    "partition": "partitions of up to 50 ticks",
    "noise": "ranges of sigma 0 to 0.1 m, odometry of 0 to 5 %, outliers",
    "mismatch": "noise that nobody has told the robots",
    "mismatch-uwb": "uncalibrated radios and odometry",
    "group": "groups of 3 to 16 robots",
    "group-unanchored": "groups with robots without an anchor",
}
"""The sweeps of the summary, and what varies in each."""


def summary() -> str:
    """Return the table of the summary in Markdown: all cells of `assured` of a sweep together."""
    lines = [["sweep", "missions", "localised, %", "wrong claims, %", "ticks, median"], ["---"] * 5]
    for name, what in HEADLINE.items():
        file = read(name)
        assert file is not None
        cells = [one for one in file.cell if "planner.name = paper" not in one.label]
        trials = sum(one.trials for one in cells)
        localised = sum(one.outcomes.get("localised", 0) for one in cells)
        medians = [one.ticks.p50 for one in cells if one.ticks is not None]
        wrong = sum(one.wrong for one in cells)
        lines += [
            [
                *(f"`{name}`: {what}", _number(trials), _share(localised, trials), _share(wrong, trials)),
                f"{min(medians):.0f} to {max(medians):.0f}" if len(medians) > 1 else f"{medians[0]:.0f}",
            ]
        ]
    return "\n".join(map(_line, lines))


def link_attacks() -> str:
    """Return the table of attacks on one link of a pair in Markdown: how missions end."""
    file = read("link-attacks")
    assert file is not None
    outcomes = ("localised", "inconsistent", "undecided", "wrong")
    cells = [
        [one.label.removeprefix("attack = "), *[_counted(name)([one]) for name in outcomes]]
        for one in file.cell
    ]
    return "\n".join(map(_line, [["attack", *outcomes], ["---"] * 5, *cells]))


def _share(count: int, trials: int) -> str:
    """Return a share in percent with its 95 % interval."""
    interval = wilson(count, trials)
    return f"{100 * count / trials:.3g} ({100 * interval.low:.3g} to {100 * interval.high:.3g})"


def _rows(file: Expected) -> dict[str, list[CellResults]]:
    """Return the cells of each row, by the values of their axes."""
    rows: dict[str, list[CellResults]] = {}
    for cell in file.cell:
        values = [one.partition(" = ")[2] or one for one in cell.label.split("; ")]
        place = POOLED_BY.get(file.sweep)
        row = "; ".join(values) if place is None else f"{values[place]}, {{}} cells"
        rows.setdefault(row, []).append(cell)
    return {row.format(len(cells)): cells for row, cells in rows.items()}


def _columns() -> list[Column]:
    """Return the possible columns: their heads, and functions of the cells of a row."""
    return [
        *[(outcome, _counted(outcome)) for outcome in OUTCOMES],
        ("ticks, median / 95 % / largest", lambda cells: _quantiles([cell.ticks for cell in cells])),
        ("largest error, m", _largest_error),
        ("mean NEES", _nees),
        ("truth not held", _truth_lost),
        ("honest robots: right, undecided, wrong", _honest),
        (
            "share of the bound, median / 95 % / largest",
            lambda cells: _quantiles([cell.share for cell in cells]),
        ),
        ("over travel", lambda cells: _quantiles([cell.travel for cell in cells])),
    ]


def _counted(outcome: str) -> Callable[[Sequence[CellResults]], str]:
    def text(cells: Sequence[CellResults]) -> str:
        count = sum([cell.outcomes.get(outcome, 0) for cell in cells])
        return _number(count) if count else ""

    return text


def _quantiles(found: Sequence[Quantiles | None]) -> str:
    """Return the range over the cells of each order statistic."""
    known = [one for one in found if one is not None]
    if not known:
        return ""
    return " / ".join(
        [_range([getattr(one, name) for one in known]) for name in ("p50", "p95")]
        + [_number(max(one.max for one in known))]
    )


def _range(values: Sequence[float]) -> str:
    low, high = _number(min(values)), _number(max(values))
    return low if low == high else f"{low} to {high}"


def _number(value: float) -> str:
    return f"{int(value):,}".replace(",", " ") if value == int(value) else f"{value:.2f}"


def _largest_error(cells: Sequence[CellResults]) -> str:
    errors = [cell.error.max for cell in cells if cell.error is not None]
    return f"{max(errors):.1e}" if errors else ""


def _nees(cells: Sequence[CellResults]) -> str:
    found = [cell.nees for cell in cells if cell.nees is not None]
    return _range(found) if found else ""


def _truth_lost(cells: Sequence[CellResults]) -> str:
    lost = sum([cell.truth[0] - cell.truth[1] for cell in cells if cell.truth is not None])
    return str(lost) if lost else ""


def _honest(cells: Sequence[CellResults]) -> str:
    known = [cell.honest for cell in cells if cell.honest is not None]
    return ", ".join([str(sum(one)) for one in zip(*known, strict=True)]) if known else ""


def _landed(file: Expected) -> list[str]:
    """Return the table of earlier runs with more trials."""
    outcomes = Counter[str]()
    for one in file.landed:
        outcomes.update(one.outcomes)
    shown = [outcome for outcome in OUTCOMES if outcomes[outcome]]
    columns = [name for name in ("ticks", "nees", "other") if any(getattr(one, name) for one in file.landed)]
    heads = {"ticks": "ticks, median / 95 %", "nees": "mean NEES", "other": "also"}
    return [
        _line([" ", "trials", *shown, *[heads[name] for name in columns], "commit"]),
        _line(["---"] * (len(shown) + len(columns) + 3)),
        *[
            _line(
                [
                    one.label,
                    _number(one.trials),
                    *[_number(one.outcomes[outcome]) if outcome in one.outcomes else "" for outcome in shown],
                    *[getattr(one, name) for name in columns],
                    one.commit,
                ]
            )
            for one in file.landed
        ],
    ]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join([cell.replace("|", "\\|") for cell in cells]) + " |"
