"""The execution of a sweep: run the trials without a row, then collect the results."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa

from compose.errors import BadSpec, Unworkable
from compose.recording.rows import csv_text
from compose.scenario.scenario_file import trust_classes
from compose.sweep import SUMMARY_CSV
from compose.sweep.cells import Cell, setting_of, trial_seed
from compose.sweep.paired_differences import PairedDifference, paired_differences
from compose.sweep.results_folder import Folder, opened
from compose.sweep.spec import Sweep
from compose.sweep.statistics import CellSummary, by_cell, counted, header, summary_csv
from compose.sweep.trial import TrialRow
from compose.sweep.worker import PLAY, Chunk, TrialOptions
from protocol import files
from protocol.network.inbox import Inbox, Interrupted

DIFFERENCES = "differences.csv"
"""The name of the table of differences between cells of paired axes."""


class EngineFailed(Exception):
    """The sweep cannot continue. The text gives the reason."""


class ExecutionOptions(msgspec.Struct, frozen=True):
    """Options of execution. In the rows of trials, only the wall time depends on them."""

    workers: int = os.cpu_count() or 1
    """number of worker threads without a scheduler; each has one process for trials"""
    scheduler: str | None = None
    """address of a Dask scheduler; None to run on this machine"""
    processes: bool = False
    """true to run trials as processes over Zenoh"""
    audit: bool = True
    """true to audit the journals of every trial"""
    play: str = PLAY
    """function that runs a trial, as module:function"""
    retry: bool = False
    """true to run trials again that were lost earlier"""


class Progress(msgspec.Struct, frozen=True):
    """The callbacks that show the progress of a sweep."""

    say: Callable[[str], None]
    """callback for a line of text"""
    begin: Callable[[int, int], None]
    """callback at the start, with the number of completed trials and of all trials"""
    done: Callable[[int], None]
    """callback after a chunk, with the number of trials that it completed"""


class Results(msgspec.Struct, frozen=True):
    """The results of a sweep, which may be incomplete."""

    sweep: Sweep
    cells: tuple[Cell, ...]
    table: pa.Table
    """one row per trial"""
    figures: dict[int, CellSummary]
    """statistics of each cell, by its index"""
    stopped: str | None
    """reason why the sweep is incomplete; None if it is complete"""
    interrupted: bool
    """true if a signal stopped the sweep"""
    trials: int
    """number of trials of all cells that are not refused"""
    differences: tuple[PairedDifference, ...] = ()
    """differences between the cells of paired axes"""

    def of(self, *cells: int) -> pa.Table:
        """Return the rows of the trials of these cells."""
        return self.table.filter(pa.array(np.isin(self.table["cell"].to_numpy(), cells)))


def sweep(
    sweep: Sweep,
    out: Path,
    means: ExecutionOptions,
    inbox: Inbox,
    progress: Progress,
    take_signals: Callable[[], None] = lambda: None,
) -> Results:
    """Run the trials without a row in the folder `out`, and return the results.

    The results are collected even if the sweep is stopped. `take_signals` is called when trials begin: from
    then on, `inbox` must receive the signals. Raises UserError if the sweep, the scenario of a cell, `out` or
    the scheduler is unusable.
    """
    with opened(out, sweep) as folder:
        check_columns(sweep, folder.schema)
        if means.retry:
            folder.forget_lost()
        work = _left(folder, means, progress)
        stopped, interrupted = None, False
        if work:
            try:
                _play(folder, work, means, inbox, progress, take_signals)
            except Interrupted as signal_name:
                stopped, interrupted = f"stopped by {signal_name}", True
            except EngineFailed as error:
                stopped = str(error)
            except BrokenPipeError:
                raise
            except OSError as error:
                stopped = f"cannot continue: {files.error_text(error)}"
        return _gathered(folder, stopped, interrupted)


def check_columns(sweep: Sweep, schema: pa.Schema) -> None:
    """Raise BadSpec if two columns of a table would have the same name."""
    for names in (schema.names, header(sweep)):
        for name, count in Counter(names).items():
            if count > 1:
                raise BadSpec(f"{sweep.source}: axis: {count} columns would have the name '{name}'")


def _left(folder: Folder, means: ExecutionOptions, progress: Progress) -> list[Chunk]:
    """Return the trials of each cell that still have to run. Only the scenarios of these cells are validated.

    Raises BadSpec if all cells are refused.
    """
    sweep, refused, done = folder.sweep, dict(folder.refused), folder.done()
    surplus = sum([trial >= sweep.trials for trials in done.values() for trial in trials])
    if surplus:
        progress.say(f"{folder.path} holds {surplus} trials beyond the {sweep.trials} per cell; kept")
    options = TrialOptions(means.processes, sweep.trial_timeout, means.play, means.audit, sweep.draws)
    work = []
    for cell in folder.cells.values():
        left = [trial for trial in range(sweep.trials) if trial not in done[cell.index]]
        if not left or cell.index in refused:
            continue
        trust_classes(cell.table)  # of the user's sweep: a folder with another one is refused
        try:
            setting = setting_of(sweep, cell)
        except Unworkable as error:
            refused[cell.index] = str(error)
            continue
        seeds = tuple([trial_seed(sweep.seed, cell.key, trial) for trial in left])
        table = cell.table if sweep.draws else {}
        work.append(Chunk(cell.index, tuple(left), seeds, setting, options, table))
    if len(refused) == len(folder.cells):
        first, reason = next(iter(refused.items()))
        raise BadSpec(f"{sweep.source}: no cell can run; cell {first}: {reason}")
    folder.ask(refused)
    for part in folder.ignored:
        progress.say(f"{part} cannot be read: its trials will run again")
    progress.begin(folder.trials - sum([len(one.trials) for one in work]), folder.trials)
    return work


def _play(
    folder: Folder,
    work: list[Chunk],
    means: ExecutionOptions,
    inbox: Inbox,
    progress: Progress,
    take_signals: Callable[[], None],
) -> None:
    """Run `work`, and store its rows in `folder` as chunks complete.

    Raises Interrupted on a signal, EngineFailed if the scheduler is lost, and UserError if it is unreachable.
    """

    def store(rows: list[TrialRow]) -> None:
        folder.add(rows)
        progress.done(len(rows))

    from compose.sweep import cluster  # noqa: PLC0415  # importing Dask takes a second

    pa.array([])  # its first call imports pandas, where it is installed: another second
    with cluster.connect(means.workers, means.scheduler, inbox.say) as (client, threads):
        take_signals()
        cluster.play(client, threads, work, inbox, store)


def _gathered(folder: Folder, stopped: str | None, interrupted: bool) -> Results:
    """Write the tables of trials and cells, and return the results. A failure to write sets `stopped`."""
    table = folder.table()
    cells = tuple(folder.cells.values())
    figures = {i: counted(one, folder.refused.get(i)) for i, one in by_cell(table, cells).items()}
    differences = paired_differences(folder.sweep, cells, table)
    try:
        folder.gather(table)
        files.write(folder.path / SUMMARY_CSV, summary_csv(folder.sweep, cells, figures))
        if differences:
            files.write(folder.path / DIFFERENCES, csv_text(PairedDifference, differences))
    except OSError as error:
        stopped = stopped or f"cannot be written: {files.error_text(error)}"
    return Results(folder.sweep, cells, table, figures, stopped, interrupted, folder.trials, differences)
