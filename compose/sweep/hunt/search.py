"""The search: which inputs run next, what is kept of them, and when it ends."""

from __future__ import annotations

import multiprocessing
import random
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any, NamedTuple

from compose.launch.supervisor import ChildFailed
from compose.sweep.hunt import coverage
from compose.sweep.hunt.examination import Examined, examined, scenario_of
from compose.sweep.hunt.invariants import Breach
from compose.sweep.hunt.mutation import Known, Table, mutated, seeds, simpler
from compose.sweep.trial_mission import as_processes

BATCH = 16
"""The number of inputs that are drawn from one state of the corpus, so that the jobs do not matter."""
HANG_S = 600.0
"""The time in s after which an input counts as one that never ends."""
PROCESSES_EACH = 100
"""The number of runs after which an input with kills also runs as processes."""
NEWEST = 8
"""The number of the latest inputs of the corpus, of which every second input is a mutation."""


class Entry(NamedTuple):
    """An input of the corpus."""

    table: Table
    known: Known


class Found(NamedTuple):
    """An input that breaks an invariant."""

    table: Table
    breach: Breach
    runs: int
    """The number of the run that found it."""
    shrinking: int
    """The number of runs in which it was shrunk."""


class Reach(NamedTuple):
    """What the runs of a hunt have reached so far."""

    runs: int
    processes: int
    """The number of runs as processes."""
    refused: int
    """The number of inputs that no mission can have."""
    corpus: int
    """The number of inputs that reached something new."""
    seen: frozenset[str]


class Hunt:
    """The state of a hunt. It is the same for the same source, seed and number of runs."""

    def __init__(self, source: str, seed: int, jobs: int, *, guided: bool = True) -> None:
        """`guided` is whether inputs that reach something new are kept; otherwise, chance alone decides."""
        self.seeds = list(seeds(source))
        """The inputs with which the hunt begins, the source first."""
        self._seed, self._jobs, self._guided = seed, jobs, guided
        self._corpus: list[Entry] = []
        self._seen: set[str] = set()
        self.runs = self.processes = self.refused = 0

    def reach(self) -> Reach:
        """Return what has been reached."""
        return Reach(self.runs, self.processes, self.refused, len(self._corpus), frozenset(self._seen))

    def run(
        self, is_over: Callable[[int], bool], progress: Callable[[Reach], None] = lambda _: None
    ) -> Found | None:
        """Search until `is_over` of the number of runs, and return the first input that breaks an invariant.

        The input is shrunk. `progress` is called after each batch.
        """
        with _workers(self._jobs) as examine:
            for number in count():
                inputs = self._batch(number)
                for table, result in zip(inputs, examine(inputs), strict=True):
                    self.runs += 1
                    self.refused += result.refused is not None
                    if result.breaches:
                        return _shrunk(table, result.breaches[0], self.runs, examine)
                    self._keep(table, result)
                if (found := self._as_processes(inputs)) is not None:
                    return found
                progress(self.reach())
                if is_over(self.runs):
                    return None
        return None

    def _batch(self, number: int) -> list[Table]:
        """Return the inputs of batch `number`: the seeds first, then mutations."""
        left = self.seeds[number * BATCH : (number + 1) * BATCH]
        draw = random.Random(f"{self._seed}/hunt/{number}")
        return [*left, *[self._input(draw) for _ in range(BATCH - len(left))]]

    def _input(self, draw: random.Random) -> Table:
        if not self._guided or not self._corpus:
            one = draw.choice(self.seeds)
            known = Known(tuple([robot.id for robot in scenario_of(one)[0].robots]), 100)
            return mutated(one, known, draw.choice(self.seeds), draw)
        latest = self._corpus[-NEWEST:] if draw.random() < 0.5 else self._corpus
        entry = draw.choice(latest)
        return mutated(entry.table, entry.known, draw.choice(self._corpus).table, draw)

    def _keep(self, table: Table, result: Examined) -> None:
        new = result.reached - self._seen
        self._seen |= new
        if new:
            self._corpus.append(Entry(table, result.known))

    def _as_processes(self, inputs: Sequence[Table]) -> Found | None:
        """Run the last of `inputs` that has kills as processes, if it is time for that."""
        if self.runs // PROCESSES_EACH == (self.runs - len(inputs)) // PROCESSES_EACH:
            return None
        for table in reversed(inputs):
            if table.get("kill") and examined(table).refused is None:
                self.processes += 1
                scenario, kills = scenario_of(table)
                try:
                    differing = as_processes(scenario, audit=False, kills=kills).differing
                except ChildFailed as error:
                    return Found(table, Breach("a process dies", str(error)), self.runs, 0)
                if differing:
                    what = f"as processes: {', '.join(differing)}"
                    return Found(table, Breach("the recording differs", what), self.runs, 0)
                return None
        return None


Examine = Callable[[Sequence[Table]], Iterator[Examined]]


def _shrunk(table: Table, breach: Breach, runs: int, examine: Examine) -> Found:
    """Return the smallest input that breaks the same invariant, from which nothing more can be left out."""
    tried, left = 0, [table]
    while left:
        for smaller, result in zip(left, examine(left), strict=True):
            tried += 1
            same = next((one for one in result.breaches if one.kind == breach.kind), None)
            if same is not None:
                table, breach = smaller, same
                left = list(simpler(table))
                break
        else:
            left = []
    return Found(table, breach, runs, tried)


@contextmanager
def _workers(jobs: int) -> Iterator[Examine]:
    """Yield a function that examines inputs in `jobs` processes, forked from this one, in their order."""
    context = multiprocessing.get_context("fork")
    pool = context.Pool(jobs, _begin)

    def examine(tables: Sequence[Mapping[str, Any]]) -> Iterator[Examined]:
        nonlocal pool
        results = [pool.apply_async(examined, (dict(table),)) for table in tables]
        for one in results:
            began = time.monotonic()
            try:
                yield one.get(HANG_S)
            except multiprocessing.TimeoutError:
                waited = f"no result within {time.monotonic() - began:.0f} s"
                yield Examined((Breach("it never ends, or its process dies", waited),))

    try:
        yield examine
    finally:
        pool.terminate()
        pool.join()


def _begin() -> None:
    """Prepare a worker: the command that started it handles signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
    coverage.note_conditions()
