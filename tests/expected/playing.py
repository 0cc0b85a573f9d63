"""The trials of a sweep, run in processes of this machine without a results folder."""

from __future__ import annotations

import math
import signal
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import msgspec
import pyarrow as pa
from msgspec.structs import replace

from compose.recording.run import Run
from compose.sweep import trial as sweep_trial
from compose.sweep.cells import Cell, cells, setting_of, trial_seed
from compose.sweep.spec import Sweep
from compose.sweep.table import of_rows, schema_of
from compose.sweep.trial import Trial, TrialRow
from compose.sweep.trial_mission import run_in_process
from compose.sweep.worker import Chunk, TrialOptions, played
from tests.expected.results import SAMPLE, STRIDE

CHUNK = 4
"""The number of trials of a cell that a process runs at a time."""


DECISIONS: dict[tuple[int, int], str] = {}
"""The checksums of the decisions of sampled missions that this process has run, by cell and trial."""


def play(sweep: Sweep, jobs: int) -> tuple[pa.Table, list[str], float]:
    """Return the table of all trials of `sweep`, their decisions, and the time that they took.

    They run without the audit, in `jobs` processes. The decisions of a mission are a checksum of all its
    Commands, and empty of one that is not in the sample, or runs as processes.

    The time in s is that of the processor; of trials with kills, which run as processes, it is wall time. The
    processes are forked, so that they run the code as it is in this one, with any planted defect.
    """
    every = {cell.index: cell for cell in cells(sweep)}
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        done = list(pool.map(_rows, _chunks(sweep, list(every.values()))))
    rows = [row for some, _, _ in done for row in some]
    rows.sort(key=lambda row: (row.cell, row.trial))
    decided = {at: checksum for _, some, _ in done for at, checksum in some.items()}
    table = of_rows(rows, sweep, every, schema_of(sweep, list(every.values())))
    decisions = [decided.get((row.cell, row.trial), "") for row in rows]
    return table, decisions, math.fsum([cost for _, _, cost in done])


def _chunks(sweep: Sweep, every: list[Cell]) -> Iterator[Chunk]:
    """Yield the trials of all cells; those of the last cells, which may be the longest, first."""
    options = TrialOptions(False, sweep.trial_timeout, play=f"{__name__}:run_trial", draws=sweep.draws)
    for cell in reversed(every):
        setting = setting_of(sweep, cell)
        begin = cell.index * STRIDE
        for first in range(begin, begin + sweep.trials, CHUNK):
            trials = tuple(range(first, min(first + CHUNK, begin + sweep.trials)))
            seeds = tuple([trial_seed(sweep.seed, cell.key, trial) for trial in trials])
            table = cell.table if sweep.draws else {}
            yield Chunk(cell.index, trials, seeds, setting, options, table)


def run_trial(trial: Trial) -> TrialRow:
    """Run the trial, return its row, and keep the checksum of its decisions in DECISIONS."""
    if trial.kills is not None:
        return sweep_trial.run_trial(trial)
    done = run_in_process(trial.scenario, audit=False)
    number = trial.number - trial.cell * STRIDE
    if number < SAMPLE:
        DECISIONS[trial.cell, number] = decisions(done.run)
    return sweep_trial.row(trial, done.run, done.wall_s)


def decisions(run: Run) -> str:
    """Return a checksum of v, omega, phase and verdict of all Commands of a mission, 8 hexadecimal digits."""
    checksum = 0
    for tick in run.ticks:
        for robot in sorted(tick.commands):
            command = tick.commands[robot]
            decided = (command.v, command.omega, command.phase, command.verdict)
            checksum = zlib.crc32(msgspec.msgpack.encode(decided), checksum)
    return f"{checksum:08x}"


def _rows(chunk: Chunk) -> tuple[list[TrialRow], dict[tuple[int, int], str], float]:
    """Return the rows of a chunk, decisions, and the time of its trials in s. One that hangs is failed."""
    signal.signal(signal.SIGALRM, _hung)
    DECISIONS.clear()
    began, rows = time.process_time(), []
    for trial, seed in zip(chunk.trials, chunk.seeds, strict=True):
        signal.setitimer(signal.ITIMER_REAL, chunk.options.timeout)
        row = played(chunk, trial, seed)  # it catches the exception
        rows.append(replace(row, trial=trial - chunk.cell * STRIDE))
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    as_processes = math.fsum([row.wall_s or 0.0 for row in rows if row.kills is not None])
    return rows, dict(DECISIONS), as_processes or time.process_time() - began


def _hung(*_: Any) -> None:
    raise TimeoutError("it hangs")
