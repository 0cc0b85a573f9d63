"""What is left to do in a sweep, and how it is cut into chunks.

What a chunk holds, and who plays which, follows from how long trials take; what a trial is does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from compose.scenario.scenario_file import ScenarioTemplate
from compose.sweep.cells import trial_seed
from compose.sweep.draws import Draws
from compose.sweep.worker import Chunk

CHUNK_S = 1.0
"""what a chunk should last: long beside handing it out, short beside losing it"""
MAX_CHUNK = 1000
"""trials"""
FIRST_CHUNK = 8
"""trials, while nobody knows how long one takes; as processes one, which takes most of a second"""


FADES = 0.8
"""weight of what was known of the time that trials take, beside that of a chunk that has just ended"""


class EngineFailed(Exception):
    """The sweep cannot go on; the text says why."""


class Work(msgspec.Struct):
    """What is left to do in a cell."""

    cell: int
    key: str
    """of its seeds"""
    setting: ScenarioTemplate
    trials: list[int]
    table: dict[str, Any]
    """of its scenario's file"""
    given: int = 0
    """how many have been handed out"""
    played: float = 0.0
    """trials that have ended; the older, the less they count"""
    played_s: float = 0.0
    """s of wall time that those took"""

    def took(self, trials: int, wall_s: float) -> None:
        """Count `trials` that took `wall_s` in all: what comes next will take about as long."""
        self.played = FADES * self.played + trials
        self.played_s = FADES * self.played_s + wall_s

    def size(self, threads: int, first: int) -> int:
        """How many trials to hand out at once, so that near the end all threads have some."""
        share = math.ceil((len(self.trials) - self.given) / (2 * threads))
        if not self.played:
            return min(first, share)
        fitting = CHUNK_S * self.played / max(self.played_s, 1e-9)
        return max(1, min(round(fitting), share, MAX_CHUNK))


class TrialOptions(msgspec.Struct, frozen=True):
    """What holds for every trial of a sweep."""

    seed: int
    processes: bool
    timeout: float
    """s"""
    play: str
    audit: bool
    draws: Draws = Draws()


def chunks_of(
    work: Sequence[Work], orders: TrialOptions, threads: Callable[[], int]
) -> Iterator[tuple[Chunk, Work]]:
    """All of it, each chunk as large as fits when it is asked for."""
    for source in work:
        while source.given < len(source.trials):
            slow = orders.processes or source.setting.file.kill
            size = source.size(threads(), 1 if slow else FIRST_CHUNK)
            trials = tuple(source.trials[source.given : source.given + size])
            source.given += size
            seeds = tuple([trial_seed(orders.seed, source.key, trial) for trial in trials])
            yield (
                Chunk(
                    source.cell,
                    trials,
                    seeds,
                    source.setting,
                    orders.processes,
                    orders.timeout,
                    orders.play,
                    orders.audit,
                    orders.draws,
                    source.table if orders.draws else {},
                ),
                source,
            )
