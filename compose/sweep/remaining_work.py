"""The trials that a sweep still has to run, and their division into chunks.

The sizes of chunks, and the workers that run them, depend on how long trials take; trials themselves do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from compose.scenario.scenario_file import ScenarioTemplate
from compose.sweep.cells import trial_seed
from compose.sweep.trial import TrialRow
from compose.sweep.worker import Chunk, TrialOptions

CHUNK_S = 1.0
"""The wall time in s that a chunk should take: long compared to its overhead, short enough to lose."""
MAX_CHUNK = 1000
"""The largest number of trials in a chunk."""
FIRST_CHUNK = 8
"""The number of trials in a chunk while their duration is unknown.

It is 1 for trials as processes, each of which takes most of a second.
"""
FADES = 0.8
"""The factor by which earlier durations of trials lose weight with each chunk that completes."""


class EngineFailed(Exception):
    """The sweep cannot continue. The text gives the reason."""


class Work(msgspec.Struct):
    """The trials that a cell still has to run, and how long its trials have taken."""

    cell: int
    key: str
    """key of the cell, from which the seeds of its trials are derived"""
    setting: ScenarioTemplate
    trials: list[int]
    """indices of the trials to run"""
    table: dict[str, Any]
    """parsed table of the cell's scenario file"""
    given: int = 0
    """number of trials that have been put into chunks"""
    played: float = 0.0
    """number of completed trials, weighted by FADES"""
    played_s: float = 0.0
    """wall time in s of the completed trials, weighted in the same way"""

    def took(self, rows: Sequence[TrialRow], timeout: float) -> None:
        """Update the mean duration of trials with the rows of a chunk.

        A trial that was lost with its process counts as `timeout` s, a refused one as 0 s.
        """
        unknown = [0.0 if row.outcome == "refused" else timeout for row in rows if row.wall_s is None]
        known = [row.wall_s for row in rows if row.wall_s is not None]
        self.played = FADES * self.played + len(rows)
        self.played_s = FADES * self.played_s + sum(known) + sum(unknown)

    def size(self, threads: int, first: int) -> int:
        """Return the size of the next chunk for `threads` worker threads, in trials.

        It is `first` until a chunk has completed. It decreases towards the end to give all threads work.
        """
        share = math.ceil((len(self.trials) - self.given) / (2 * threads))
        if not self.played:
            return min(first, share)
        fitting = CHUNK_S * self.played / max(self.played_s, 1e-9)
        return max(1, min(round(fitting), share, MAX_CHUNK))


def chunks_of(
    work: Sequence[Work], orders: TrialOptions, threads: Callable[[], int]
) -> Iterator[tuple[Chunk, Work]]:
    """Yield all trials of `work` as chunks, each with its source.

    The size of a chunk is decided when it is requested, from the durations known by then.
    """
    for source in work:
        while source.given < len(source.trials):
            slow = orders.processes or source.setting.file.kill
            size = source.size(threads(), 1 if slow else FIRST_CHUNK)
            trials = tuple(source.trials[source.given : source.given + size])
            source.given += size
            seeds = tuple([trial_seed(orders.seed, source.key, trial) for trial in trials])
            table = source.table if orders.draws else {}
            yield Chunk(source.cell, trials, seeds, source.setting, orders, table), source
