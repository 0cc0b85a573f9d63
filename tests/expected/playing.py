"""The trials of a sweep, run in processes of this machine without a results folder."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import pyarrow as pa
from msgspec.structs import replace

from compose.sweep.cells import Cell, RefusedCell, cells, setting_of, trial_seed
from compose.sweep.spec import Sweep
from compose.sweep.table import of_rows, schema_of
from compose.sweep.trial import TrialRow
from compose.sweep.worker import Chunk, played
from tests.expected.results import STRIDE

CHUNK = 4
"""The number of trials of a cell that a process runs at a time."""


def play(sweep: Sweep, jobs: int) -> tuple[pa.Table, float]:
    """Return the table of all trials of `sweep`, run without the audit in `jobs` processes, and their time.

    The time in s is that of the processor; of trials with kills, which run as processes, it is wall time. The
    processes are forked, so that they run the code as it is in this one, with any planted defect.
    """
    every = {cell.index: cell for cell in cells(sweep)}
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        done = list(pool.map(_rows, _chunks(sweep, list(every.values()))))
    rows = [row for some, _ in done for row in some]
    rows.sort(key=lambda row: (row.cell, row.trial))
    table = of_rows(rows, sweep, every, schema_of(sweep, list(every.values())))
    return table, math.fsum([cost for _, cost in done])


def _chunks(sweep: Sweep, every: list[Cell]) -> Iterator[Chunk]:
    """Yield the trials of all cells; those of the last cells, which may be the longest, first."""
    for cell in reversed(every):
        setting = setting_of(sweep, cell)
        assert not isinstance(setting, RefusedCell)
        begin = cell.index * STRIDE
        for first in range(begin, begin + sweep.trials, CHUNK):
            trials = tuple(range(first, min(first + CHUNK, begin + sweep.trials)))
            seeds = tuple([trial_seed(sweep.seed, cell.key, trial) for trial in trials])
            table = cell.table if sweep.draws else {}
            yield Chunk(
                cell.index, trials, seeds, setting, False, sweep.trial_timeout, draws=sweep.draws, table=table
            )


def _rows(chunk: Chunk) -> tuple[list[TrialRow], float]:
    """Return the rows of a chunk, and the time that its trials took in s. One that hangs is failed."""
    signal.signal(signal.SIGALRM, _hung)
    began, rows = time.process_time(), []
    for trial, seed in zip(chunk.trials, chunk.seeds, strict=True):
        signal.setitimer(signal.ITIMER_REAL, chunk.timeout)
        row = played(chunk, trial, seed)  # it catches the exception
        rows.append(replace(row, trial=trial - chunk.cell * STRIDE))
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    as_processes = math.fsum([row.wall_s or 0.0 for row in rows if row.kills is not None])
    return rows, as_processes or time.process_time() - began


def _hung(*_: Any) -> None:
    raise TimeoutError("it hangs")
