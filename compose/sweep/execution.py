"""A sweep, from its spec to its results: what is left of it is played, and what there is gathered."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa

from compose.errors import BadSpec
from compose.sweep.cells import Cell, RefusedCell, setting_of
from compose.sweep.remaining_work import EngineFailed, TrialOptions, Work
from compose.sweep.results_folder import Folder, opened
from compose.sweep.spec import Sweep
from compose.sweep.statistics import CellSummary, counted, header, summary_csv
from compose.sweep.trial import TrialRow
from compose.sweep.worker import PLAY
from protocol import files
from protocol.network.inbox import Inbox, Interrupted

SUMMARY = "summary.csv"


class ExecutionOptions(msgspec.Struct, frozen=True):
    """Where and how trials are played; nothing in their rows depends on it but the wall time."""

    workers: int = os.cpu_count() or 1
    """threads, each with a process for trials, where there is no scheduler"""
    scheduler: str | None = None
    """the address of Dask's"""
    processes: bool = False
    """trials as processes over Zenoh"""
    audit: bool = True
    """judge every trial's journals"""
    play: str = PLAY
    retry: bool = False
    """play again what was lost before"""


class Progress(msgspec.Struct, frozen=True):
    """Who is told how the sweep goes on."""

    say: Callable[[str], None]
    begin: Callable[[int, int], None]
    """so many trials are done, of so many"""
    done: Callable[[int], None]
    """so many more are"""


class Results(msgspec.Struct, frozen=True):
    """What there is of a sweep."""

    sweep: Sweep
    cells: tuple[Cell, ...]
    table: pa.Table
    figures: dict[int, CellSummary]
    """of each cell"""
    stopped: str | None
    """why there is no more yet"""
    interrupted: bool
    """because somebody said so"""
    trials: int
    """in all cells that are not refused"""

    def of(self, *cells: int) -> pa.Table:
        """The trials of these cells."""
        return self.table.filter(pa.array(np.isin(self.table["cell"].to_numpy(), cells)))

    def settings(self, place: int) -> list[tuple[list[tuple[str, str]], list[int]]]:
        """Each choice of values of all axes but that at `place`: names and labels; its cells, along that."""
        others = [(i, axis) for i, axis in enumerate(self.sweep.axes) if i != place]
        found: dict[tuple[int, ...], list[int]] = {}
        for cell in self.cells:
            found.setdefault(tuple([cell.place[i] for i, _ in others]), []).append(cell.index)
        return [
            ([(axis.name, axis.label(value)) for (_, axis), value in zip(others, choice, strict=True)], cells)
            for choice, cells in found.items()
        ]


def sweep(sweep: Sweep, out: Path, means: ExecutionOptions, inbox: Inbox, progress: Progress) -> Results:
    """Play what has no row in `out` yet, and gather what there is then, however it ended.

    Raises UserError: of the spec, a cell that is not a scenario, `out` or the scheduler.
    """
    with opened(out, sweep) as folder:
        check_columns(sweep, folder.schema)
        if means.retry:
            folder.forget_lost()
        work = _left(folder, progress)
        stopped, interrupted = None, False
        if work:
            try:
                _play(folder, work, means, inbox, progress)
            except Interrupted as signal_name:
                stopped, interrupted = f"stopped by {signal_name}", True
            except EngineFailed as error:
                stopped = str(error)
            except BrokenPipeError:
                raise
            except OSError as error:
                stopped = f"cannot go on: {files.said(error)}"
        return _gathered(folder, stopped, interrupted)


def check_columns(sweep: Sweep, schema: pa.Schema) -> None:
    """Raises BadSpec where two columns of a table would be called the same."""
    for names in (schema.names, header(sweep)):
        for name, count in Counter(names).items():
            if count > 1:
                raise BadSpec(f"{sweep.source}: axis: {count} columns would be called '{name}'")


def _left(folder: Folder, progress: Progress) -> list[Work]:
    """What has to be played; only the settings of those cells are worked out."""
    sweep, refused = folder.sweep, dict(folder.refused)
    done = folder.done()
    beyond = sum([trial >= sweep.trials for trials in done.values() for trial in trials])
    if beyond:
        progress.say(f"{folder.path} holds {beyond} trials beyond {sweep.trials} a cell; they are kept")
    work = []
    count = 0
    for cell in folder.cells.values():
        if cell.index in refused:
            continue
        count += sweep.trials
        left = [trial for trial in range(sweep.trials) if trial not in done[cell.index]]
        if not left:
            continue
        setting = setting_of(sweep, cell)
        if isinstance(setting, RefusedCell):
            refused[cell.index] = setting.reason
            count -= sweep.trials
        else:
            work.append(Work(cell.index, cell.key, setting, left, cell.table))
    if len(refused) == len(folder.cells):
        first, reason = next(iter(refused.items()))
        raise BadSpec(f"{sweep.source}: no cell can be played; cell {first}: {reason}")
    folder.ask(refused)
    for part in folder.ignored:
        progress.say(f"{part} cannot be read: its trials are played again")
    progress.begin(count - sum([len(one.trials) for one in work]), count)
    return work


def _play(
    folder: Folder, work: list[Work], means: ExecutionOptions, inbox: Inbox, progress: Progress
) -> None:
    sweep = folder.sweep
    orders = TrialOptions(
        sweep.seed, means.processes, sweep.trial_timeout, means.play, means.audit, sweep.draws
    )

    def keep(rows: list[TrialRow]) -> None:
        folder.add(rows)
        progress.done(len(rows))

    from compose.sweep import cluster  # noqa: PLC0415  # Dask takes a second

    with cluster.connect(means.workers, means.scheduler) as client:
        cluster.play(client, work, orders, inbox, keep)


def _gathered(folder: Folder, stopped: str | None, interrupted: bool) -> Results:
    table = folder.table()
    cells = tuple(folder.cells.values())
    figures = _figures(table, cells, folder.refused)
    try:
        folder.gather(table)
        files.write(folder.path / SUMMARY, summary_csv(folder.sweep, cells, figures))
    except OSError as error:
        stopped = stopped or f"cannot be written: {files.said(error)}"
    trials = folder.sweep.trials * (len(cells) - len(folder.refused))
    return Results(folder.sweep, cells, table, figures, stopped, interrupted, trials)


def _figures(table: pa.Table, cells: tuple[Cell, ...], refused: Mapping[int, str]) -> dict[int, CellSummary]:
    ends = table["cell"].to_numpy().searchsorted([cell.index for cell in cells], side="right")
    begins = [0, *ends[:-1]]
    return {
        cell.index: counted(table.slice(begin, end - begin), refused.get(cell.index))
        for cell, begin, end in zip(cells, begins, ends, strict=True)
    }
