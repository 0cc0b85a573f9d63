"""The terminal output of a sweep: a progress bar, and at the end a table with one row per cell."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path

from rich import progress as bars
from rich.table import Column
from rich.text import Text

from compose.sweep import SUMMARY_CSV
from compose.sweep.cells import Cell
from compose.sweep.execution import Progress, Results
from compose.sweep.paired_differences import PairedDifference
from compose.sweep.results_folder import CELLS
from compose.sweep.statistics import COLUMNS, CellSummary, counted, noted
from compose.terminal import tables, text_width
from compose.terminal.invocation import program
from compose.terminal.text_width import tell
from protocol.output import one_line, say

RATE_OVER_S = 10.0
"""The time in s over which the rate of trials is averaged."""
NO_VALUE = "-"
"""The text of a value that does not apply."""
OUTCOME_COLUMNS = ("localised", "undecided", "inconsistent", "wrong", "failed")
"""The columns that count outcomes."""
COLUMN_NOTES = (
    ("rate_low", "rate: 95 % interval (Wilson)"),
    ("p50", "p50, p95, max: ticks of trials that localised"),
    ("error p50", "error: position error in m of the worse robot"),
    ("share p50", "share: tick of the last claim / the computed bound of the group"),
    ("corrected", "corrected: largest share of the corrected bound, where a robot was late"),
    ("travel p50", "travel: tick of the last claim / the tick by the real first meetings and travel alone"),
    ("honest", "honest: robots, but attackers and dead ones, with a right claim / none / a wrong claim"),
    ("found", "found: meetings with an attacker in which it was found / all of them"),
    ("within", "within: claims within 3 x accuracy"),
    ("nees low", "nees: mean, and the 99 % band for consistent covariances"),
)
"""The footnotes of the table, each with the column whose presence requires it."""
SHOWN_GROUP_COLUMNS = ("share p50", "share max", "corrected", "travel p50", "travel p95", "honest")
"""The additional columns of sweeps of groups."""
OF_ATTACKED_GROUP = ("found",)
"""The additional column of sweeps of groups with an attacker."""
OF_NOISE = ("within", "nees", "nees low", "nees high")
"""The additional columns of sweeps in which robots claim covariances."""
OF_DIFFERENCES = ("both", "ticks", "low", "high", "rate %", "low %", "high %")
"""The columns of the table of differences, after the names of the cells."""
DIFFERENCES_NOTE = (
    "both: trials that localised in both cells, of all with the same draws; ticks: mean difference of these; "
    "rate: difference of the shares of all that localised; low, high: 95 % intervals"
)
MOST_DIFFERENCES = 50
"""The largest number of differences that are shown; the file has all."""
MOST_ROWS = 100
"""The largest number of cells for which the table lists all cells, also those without a problem."""


class _Rate(bars.ProgressColumn):
    """The progress column with the number of trials per second."""

    def render(self, task: bars.Task) -> Text:
        """Return the rate as text; Rich calls this method."""
        return Text(f"{task.speed:.3g} trials/s" if task.speed else "")


@contextmanager
def progress(name: str, say: Callable[[str], None], visible: bool) -> Iterator[Progress]:
    """Yield the progress callbacks. If `visible`, they show a bar with the rate and the times."""
    bar = bars.Progress(
        bars.TextColumn("{task.description}"),
        bars.BarColumn(bar_width=None, table_column=Column(ratio=1)),
        bars.MofNCompleteColumn(),
        _Rate(Column(no_wrap=True)),
        bars.TimeElapsedColumn(Column(no_wrap=True)),
        bars.TextColumn("elapsed,"),
        bars.TimeRemainingColumn(table_column=Column(no_wrap=True)),
        bars.TextColumn("left"),
        console=tables.console(),
        disable=not visible,
        transient=True,
        expand=True,
        speed_estimate_period=RATE_OVER_S,
    )
    with bar:
        task = bar.add_task(name, total=None)

        def begin(done: int, total: int) -> None:
            bar.reset(task, total=total, completed=done)

        yield Progress(say, begin, lambda more: bar.advance(task, more))


def show(results: Results, out: Path, *, quiet: bool) -> None:
    """Print the results: with `quiet` only the counts, otherwise also the table and the trial to look at."""
    total = counted(results.table)
    outcomes = [(getattr(total, name), name) for name in OUTCOME_COLUMNS] + [
        (total.refused_trials, "refused")
    ]
    counts = ", ".join([f"{n} {name}" for n, name in outcomes if n])
    cells = "one cell" if len(results.cells) == 1 else f"{len(results.cells)} cells"
    tell(f"{results.sweep.name}: {counts} of {len(results.table)} trials in {cells}")
    note = noted(results.table)
    if total.audited:
        first = ""
        if note is not None and total.clean < total.audited:
            first = f"; trial {note.trial} of cell {note.cell}: {note.why}"
        tell(f"audited: {total.audited} of {total.trials} trials, {total.clean} clean{first}")
    if quiet:
        return
    shown = len(_shown(results))
    if shown:
        lines, columns = _lines(results)
        say("", *lines)
        _block(text_width.notes(COLUMN_NOTES, columns))
    if shown < len(results.cells):
        tell(f"{len(results.cells) - shown} cells without a problem are not listed; see {out / SUMMARY_CSV}")
    _block(_difference_lines(results))
    _block([line for reason in _refused(results) for line in text_width.wrapped(one_line(reason))])
    say("")
    if note is not None:
        why = f" ({note.why})" if note.why else ""
        how = f"{note.outcome} after {note.ticks} ticks" if note.ticks is not None else note.outcome
        tandem = program("tandem")
        file = shlex.quote(str(out / CELLS / f"{note.cell:03d}.toml"))
        tell(f"look at trial {note.trial} of cell {note.cell} first: {how}{why}; to run it again:")
        if results.sweep.draws:
            source = shlex.quote(results.sweep.source)
            say(f"  {tandem} sweep {source} --print-trial {note.cell}:{note.trial} > trial.toml")
            file = "trial.toml"
        name = f"recording-{results.sweep.name}-{note.cell}-{note.trial}"
        names = chain([name], (f"{name}-{number}" for number in count(2)))
        recording = next(name for name in names if not Path(name).exists())
        say(f"  {tandem} run {file} --seed {note.seed} --out {recording}")
    say(f"results: {out}")


def _difference_lines(results: Results) -> list[str]:
    """Return the lines of the differences between planners, and of the axes that are not paired."""
    planners = {axis.name for axis in results.sweep.axes if axis.of_planners}
    shown = [one for one in results.differences if one.axis in planners][:MOST_DIFFERENCES]
    found = []
    if shown:
        found += tables.shown(
            ["difference", "cells"], OF_DIFFERENCES, [_difference_row(one) for one in shown]
        )
        found += ["", *text_width.wrapped(DIFFERENCES_NOTE)]
    unpaired = [axis.name for axis in results.sweep.axes if not axis.paired and len(axis.values) > 1]
    if unpaired:
        found += text_width.wrapped(
            f"not paired: trials have other random draws at each value of {', '.join(unpaired)}, so cells "
            "also differ by chance"
        )
    return found


def _difference_row(one: PairedDifference) -> list[str]:
    rates = [None if value is None else 100.0 * value for value in (one.rate, one.rate_low, one.rate_high)]
    return [
        f"{one.value} - {one.reference}",
        f"{one.cell} - {one.reference_cell}",
        f"{one.both_localised}/{one.pairs}",
        *[
            "-" if value is None else f"{value:+.1f}"
            for value in (one.ticks, one.ticks_low, one.ticks_high, *rates)
        ],
    ]


def _block(lines: Sequence[str]) -> None:
    """Print `lines`, if there are any, after an empty line."""
    if lines:
        say("", *lines)


def _refused(results: Results) -> Iterator[str]:
    """Yield a line for each cell that cannot run, and one for the refused trials."""
    for index, figures in results.figures.items():
        if figures.refused is not None:
            yield f"cell {index} cannot run: {figures.refused}"
    outcomes = results.table["outcome"].to_pylist()
    if "refused" in outcomes:
        first = results.table.slice(outcomes.index("refused"), 1).to_pylist()[0]
        where = f"trial {first['trial']} of cell {first['cell']}"
        yield f"{outcomes.count('refused')} trials refused; the first is {where}: {first['reason']}"


def _lines(results: Results) -> tuple[list[str], Sequence[str]]:
    """Return the lines of the widest table that fits the terminal, and its columns."""
    names = ["cell", *[axis.name.rpartition(".")[2] for axis in results.sweep.axes]]
    rows = []
    for cell in _shown(results):
        axes = [axis.label(i) for axis, i in zip(results.sweep.axes, cell.place, strict=True)]
        rows.append(([str(cell.index), *axes], _figures(results.figures[cell.index])))
    return tables.widest(names, _choices(results), rows)


def _shown(results: Results) -> list[Cell]:
    """Return the cells to list: all, or those with a problem if there are more than MOST_ROWS cells."""
    return [
        cell
        for cell in results.cells
        for one in [results.figures[cell.index]]
        if len(results.cells) <= MOST_ROWS
        or (one.refused is not None or one.trials != one.localised or one.audited != one.clean)
    ]


def _choices(results: Results) -> list[list[str]]:
    """Return the possible choices of columns, the widest first. Outcomes are never dropped."""
    figures = results.figures.values()
    more = (
        *(SHOWN_GROUP_COLUMNS if results.sweep.of_group else ()),
        *(OF_ATTACKED_GROUP if any(one.attacker_met for one in figures) else ()),
        *(OF_NOISE if any(one.nees_mean is not None for one in figures) else ()),
    )
    return [
        [
            *[one.title for one in COLUMNS.values() if one.title and 0 <= one.rank <= most],
            *(more if most else ()),
        ]
        for most in range(max([one.rank for one in COLUMNS.values()]), -1, -1)
    ]


def _figures(figures: CellSummary) -> dict[str, str]:
    """Return the texts of the columns of a cell, by their titles."""
    texts = {
        shown.title: NO_VALUE if (value := getattr(figures, name)) is None else format(value, shown.form)
        for name, shown in COLUMNS.items()
        if shown.title
    }
    honest = (figures.honest_localised, figures.honest_undecided, figures.honest_wrong)
    return {
        **texts,
        "clean": texts["clean"] if figures.audited else NO_VALUE,
        "honest": NO_VALUE if None in honest else "/".join(map(str, honest)),
        "found": f"{figures.attacker_found}/{figures.attacker_met}" if figures.attacker_met else NO_VALUE,
    }
