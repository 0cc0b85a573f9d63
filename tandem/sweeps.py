"""A sweep: many trials of a scenario over axes of its fields, with a table of trials and one of cells."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from compose.errors import UserError
from compose.extras import need
from compose.launch.class_loader import need_module
from compose.recording.recording_files import folder_for
from compose.sweep import MOST_WORKERS, spec
from compose.sweep.cells import Cell, label, trial_table
from compose.sweep.spec import Sweep
from protocol.network.inbox import Inbox
from tandem.columns import Column, Table
from tandem.scenarios import Scenario, plain, scenario_of

if TYPE_CHECKING:
    from compose.sweep.execution import ExecutionOptions, Results
    from tandem.planning import Planner

DEFAULT_TRIALS = 20
"""The default number of trials per cell of a sweep that is given by a scenario and axes."""


class SweepIncomplete(RuntimeError):
    """A sweep was stopped before all of its trials had run; the text says why, and how to resume it."""


class SweepResults(msgspec.Struct, frozen=True, eq=False):
    """The results of a sweep, as tables of numpy arrays.

    A cell is one combination of values of the axes; each has as many trials.
    """

    sweep: Sweep
    """The validated sweep; it may change with any version."""
    trials: Table
    """One row per trial: the columns of `trials.parquet`."""
    cells: Table
    """One row per cell: the columns of `summary.csv`."""
    differences: Table
    """One row per cell of a paired axis and its first value: the columns of `differences.csv`."""
    results: Results
    """The results on which the command line works; they may change with any version."""

    def scenario(self, cell: int, trial: int) -> Scenario:
        """Return the scenario of one trial, with its seed, to run it again. Raises UserError."""
        found: Cell | None = next((one for one in self.results.cells if one.index == cell), None)
        if found is None:
            raise UserError(f"{self.sweep.source} has no cell {cell}")
        source = f"{self.sweep.source}: cell {cell} ({label(self.sweep, found)})"
        return Scenario.from_dict(trial_table(self.sweep, found, trial), source)

    def draw(self, folder: str | Path) -> Path:
        """Draw the figures of `tandem sweep` into `folder`, and return its path."""
        from compose.sweep import axis_figures  # noqa: PLC0415  # slow to import

        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        axis_figures.draw(self.results, out)
        return out

    def __repr__(self) -> str:
        return f"<SweepResults of {self.sweep.name}: {len(self.trials)} trials in {len(self.cells)} cells>"

    def _repr_html_(self) -> str:
        """Return the cells and their differences, as a notebook shows them."""
        statistics = next(iter(self.results.figures.values())).__struct_fields__
        names = [name for name in self.cells.columns if name in _SHOWN or name not in statistics]
        shown = Table({name: self.cells[name] for name in names})._repr_html_()
        return shown + self.differences._repr_html_() if len(self.differences) else shown


_SHOWN = ("trials", "localised", "wrong", "failed", "rate", "ticks_p50", "error_p50_m")
"""The statistics of a cell that a notebook shows."""


def sweep(
    base: Scenario | str | Path | Mapping[str, Any],
    axes: Mapping[str, Sequence[Any]] | None = None,
    *,
    trials: int | None = None,
    seed: int | None = None,
    paired: bool | Sequence[str] | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    processes: bool = False,
    audit: bool = True,
    progress: bool = False,
) -> SweepResults:
    """Run a sweep, and return its results.

    With `axes`, `base` is a scenario (as in `tandem.run`), and `axes` maps paths of its fields to their
    values. Without, `base` is a sweep: the name of one that ships with Tandem, the path of a file, or the
    content of one as a dict, whose `scenario` may be a Scenario.

    `trials` is the number of trials per cell, and the seeds of all trials follow from `seed`. Along a paired
    axis, trials with the same number have the same draws: by default, if its field changes none, such as that
    of the planner. `paired` names further fields of `axes`, or is True for all and False for none.

    `out` is the folder of the results, in which an unfinished sweep is resumed; without it, they are not
    written. `workers` is the number of processes (by default, one per core). The other arguments are flags of
    `tandem sweep`; `progress` shows a bar on standard output.

    Raises UserError for invalid arguments and without the extra `lab`, and SweepIncomplete.

    >>> import tandem
    >>> results = tandem.sweep("random", {"fault[0].loss": [0.0, 0.9]}, trials=2, workers=1)  # doctest: +SKIP
    >>> results.cells["rate"]  # doctest: +SKIP
    array([1., 1.])
    """
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    from compose.sweep import execution  # noqa: PLC0415  # slow to import, and optional

    options = _with_workers(execution.ExecutionOptions(processes=processes, audit=audit), workers)
    found = _sweep_of(base, axes, trials, seed, paired)
    with folder_for(None if out is None else Path(out)) as folder:
        return _results(_run(found, folder, options, visible=progress), kept=out is not None)


def arena(
    planners: str | type[Planner[Any, Any]] | Sequence[str | type[Planner[Any, Any]]] = (),
    scenarios: Scenario | str | Path | Sequence[Scenario | str | Path] = "noisy",
    *,
    trials: int | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> Table:
    """Run the same missions with each planner, and return a table: the columns of `arena.csv`.

    `planners` are names or classes, by default those of `tandem arena`; the first is the reference. `trials`
    is the number of missions of each planner in each scenario, whose seeds follow from `seed`. `out` is the
    folder for the table, its figure and the sweeps; the same call resumes an arena in it. Raises like
    `sweep`.

    >>> import tandem
    >>> table = tandem.arena(["assured", "fisher"], trials=2, workers=1)  # doctest: +SKIP
    >>> table["more_ticks"]  # doctest: +SKIP
    array([nan, -2.5])
    """
    need("distributed", "matplotlib", "pyarrow", "tomli_w")
    from compose.sweep import arena as found  # noqa: PLC0415  # slow to import, and optional
    from compose.sweep.execution import ExecutionOptions  # noqa: PLC0415  # likewise

    options = _with_workers(ExecutionOptions(audit=False), workers)
    given: Any = scenarios if isinstance(scenarios, list | tuple) else [scenarios]
    names = plain([planners] if isinstance(planners, str | type) else planners or [])
    for name in names:
        need_module(name)
    sweeps = found.sweeps(names, [(one.source, one.table) for one in map(scenario_of, given)], trials, seed)
    with folder_for(None if out is None else Path(out)) as folder:
        rows, results = found.run(sweeps, folder, lambda one, to: _run(one, to, options, visible=progress))
    _check_complete(results[-1], kept=out is not None)
    return Table({name: _array([row[name] for row in rows]) for name in rows[0]})


def _with_workers(options: ExecutionOptions, workers: int | None) -> ExecutionOptions:
    """Return `options` with this number of workers; None leaves them. Raises UserError."""
    if workers is None:
        return options
    if not isinstance(workers, int) or not 1 <= workers <= MOST_WORKERS:
        raise UserError(f"workers: {workers!r} is not a whole number from 1 to {MOST_WORKERS}")
    return msgspec.structs.replace(options, workers=workers)


def _sweep_of(
    base: Scenario | str | Path | Mapping[str, Any],
    axes: Mapping[str, Sequence[Any]] | None,
    trials: int | None,
    seed: int | None,
    paired: bool | Sequence[str] | None,
) -> Sweep:
    """Return the validated sweep. Raises UserError."""
    if axes is None and paired is not None:
        raise UserError("sweep: paired: it needs axes; an axis of a sweep file has a field 'paired'")
    if axes is not None:
        chosen = _paired(paired, axes)
        scenario = scenario_of(base)
        table: Mapping[str, Any] = {
            "name": scenario.name,
            "scenario": scenario,
            "trials": DEFAULT_TRIALS,
            "axis": [
                {"field": field, "values": plain([*values]), "paired": chosen[field]}
                for field, values in axes.items()
            ],
        }
    elif isinstance(base, Mapping):
        table = {name: one if isinstance(one, Scenario) else plain(one) for name, one in base.items()}
    elif isinstance(base, Scenario):
        raise UserError("sweep: a scenario needs axes, such as axes={'mission.period': [0.5, 1.0]}")
    else:
        return spec.load(str(base), trials=trials, seed=seed)
    for axis in table.get("axis", ()):
        for value in axis.get("values", ()):
            if isinstance(value, str):
                need_module(value)
    given, within = table.get("scenario"), None
    if isinstance(given, Scenario):
        table, within = {**table, "scenario": given.source}, given.table
    numbers = {name: value for name, value in (("trials", trials), ("seed", seed)) if value is not None}
    return spec.validated({**table, **numbers}, str(table.get("name", "sweep")), Path(), base=within)


def _paired(paired: bool | Sequence[str] | None, axes: Mapping[str, Any]) -> dict[str, bool | None]:
    """Return for each axis whether it is paired; None leaves that to its fields. Raises UserError."""
    if paired is None or isinstance(paired, bool):
        return dict.fromkeys(axes, paired)
    names = [paired] if isinstance(paired, str) else paired
    for name in names:
        if name not in axes:
            raise UserError(f"sweep: paired: '{name}' is none of the axes {', '.join(axes)}")
    return {field: True if field in names else None for field in axes}


def _run(found: Sweep, folder: Path, options: ExecutionOptions, *, visible: bool) -> Results:
    from compose.sweep import execution, report  # noqa: PLC0415  # slow to import, and optional

    inbox = Inbox("tandem.sweep")
    with report.progress(found.name, inbox.say, visible and sys.stdout.isatty()) as progress:
        return execution.sweep(found, folder, options, inbox, progress)


def _check_complete(results: Results, *, kept: bool) -> None:
    """Raise SweepIncomplete if the sweep was stopped; `kept` says whether its folder is."""
    if results.stopped is not None:
        how = (
            "the same call resumes the sweep" if kept else "with `out`, the same call would resume the sweep"
        )
        raise SweepIncomplete(
            f"{results.stopped}: {len(results.table)} of {results.trials} trials are done; {how}"
        )


def _results(results: Results, *, kept: bool) -> SweepResults:
    _check_complete(results, kept=kept)
    trials = {name: results.table[name].to_numpy() for name in results.table.schema.names}
    return SweepResults(
        results.sweep, Table(trials), Table(_cells(results)), Table(_differences(results)), results
    )


def _cells(results: Results) -> dict[str, Column]:
    """Return the columns of `summary.csv`, with the values of the axes as they were given."""
    from compose.sweep.statistics import columns_of  # noqa: PLC0415  # it needs the optional pyarrow

    columns: dict[str, list[Any]] = {"cell": [cell.index for cell in results.cells]}
    for place, axis in enumerate(results.sweep.axes):
        if axis.labels is not None:
            columns[axis.name] = [axis.labels[cell.place[place]] for cell in results.cells]
        for field in axis.fields:
            columns[field] = [cell.fields[field] for cell in results.cells]
    figures = [results.figures[cell.index] for cell in results.cells]
    for name in columns_of(results.sweep):
        columns[name] = [getattr(one, name) for one in figures]
    return {name: _array(values) for name, values in columns.items()}


def _differences(results: Results) -> dict[str, Column]:
    """Return the columns of `differences.csv`."""
    from compose.sweep.paired_differences import PairedDifference  # noqa: PLC0415  # as above

    return {
        name: _array([getattr(one, name) for one in results.differences])
        for name in PairedDifference.__struct_fields__
    }


def _array(values: list[Any]) -> Column:
    """Return `values` as numbers, with NaN for None, if they are numbers; else as objects."""
    if all(isinstance(value, bool | int) for value in values):
        return np.array(values)
    if all(value is None or isinstance(value, int | float) for value in values):
        return np.array([np.nan if value is None else value for value in values], float)
    column: Column = np.empty(len(values), object)
    column[:] = values
    return column
