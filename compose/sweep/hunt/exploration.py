"""The search: which inputs run next, what is kept of them, and when it ends."""

from __future__ import annotations

import multiprocessing
import random
import signal
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import contextmanager, redirect_stderr
from io import StringIO
from itertools import count
from typing import NamedTuple

from compose.errors import UserError
from compose.launch.supervisor import ChildFailed
from compose.sweep.hunt import reached_states
from compose.sweep.hunt.examination import Examined, examined, scenario_of
from compose.sweep.hunt.invariants import Breach
from compose.sweep.hunt.mutation import (
    LISTS,
    WITHIN_BOUNDS,
    Clues,
    Table,
    is_noisy,
    mutated,
    robots_of,
    seeds,
    simpler,
)
from compose.sweep.trial_mission import as_processes

BATCH = 16
"""The number of inputs that are drawn from one state of the corpus, so that the workers do not matter."""
CLIMBING = 5
"""One of so many inputs is a change of one that came near to a computed bound."""
NEARER = 24
"""The power of the share of its bound by which such an input is chosen.

With the mutant `bound`, the hunt then ends with run 448; without such inputs, not in 2 988 runs.
"""
HANG_S = 600.0
"""The time in s after which an input counts as one that never ends."""
MOST_TRIES = 100
"""The number of runs in which an input is shrunk at most."""
PROCESSES_EACH = 100
"""The number of runs after which an input with kills also runs as processes."""
FIXED_TICKS = 25
"""The time of a run that does not depend on its ticks, in ticks of exact sensors: 4 ms, mostly the audit.

Without it, missions of a few ticks are changed most often, in which kills and faults meet nothing.
"""
NOISY_SLOWER = 8.0
"""The time of a run with noisy sensors, relative to one with exact sensors that lasts as many ticks.

It was 8 in pairs (65 ms), of which few run a second time.
"""


class CorpusEntry(NamedTuple):
    """An input of the corpus."""

    table: Table
    known: Clues
    bound_share: float = 0.0
    """The largest share of a computed bound that its run took."""

    @property
    def share(self) -> float:
        """The frequency of its changes: it is larger if its run takes less time."""
        slower = NOISY_SLOWER if is_noisy(self.table) else 1.0
        return 1.0 / (FIXED_TICKS + self.known.ticks) / len(self.known.robots) ** 2 / slower


class FoundBreach(NamedTuple):
    """An input that breaks an invariant."""

    table: Table
    breach: Breach
    runs: int
    """The number of the run that found it."""


class Hunt:
    """The state of a hunt. It is the same for the same source, seed and number of runs."""

    def __init__(self, source: str, seed: int, workers: int, *, guided: bool = True) -> None:
        """`guided` is whether inputs that reach something new are kept; otherwise, chance alone decides."""
        self.seeds = seeds(source)
        """The inputs with which the hunt begins, the source first."""
        self.corpus = [CorpusEntry(one, Clues(tuple(robots_of(one)), 100)) for one in self.seeds]
        """These inputs, and after them those that reached something new."""
        self._seed, self._workers, self._guided = seed, workers, guided
        self.seen: set[str] = set()
        """The states that the runs have reached."""
        self.runs = self.processes = self.refused = 0
        """The numbers of inputs, of those that also ran as processes, and of those that have no result."""

    def run(self, is_over: Callable[[Hunt], bool]) -> FoundBreach | None:
        """Search until `is_over`, and return the first input that breaks an invariant, shrunk.

        `is_over` is asked after each batch.
        """
        with _pool(self._workers) as examine:
            for number in count():
                inputs = self._batch(number)
                for table, result in zip(inputs, examine(inputs, self.seen), strict=True):
                    self.runs += 1
                    self.refused += result.refused is not None
                    if result.breaches:
                        return self._shrunk(table, result.breaches[0], examine)
                    self._keep(table, result)
                if (found := self._as_processes(inputs)) is not None or is_over(self):
                    return found
        return None

    def _batch(self, number: int) -> list[Table]:
        """Return the inputs of batch `number`: one of the seeds, many of which are slow, and mutations."""
        begin, draw = self.seeds[number : number + 1], random.Random(f"{self._seed}/hunt/{number}")
        shares = [one.share if self._guided else 1.0 for one in self.corpus]
        near = [one.share * one.bound_share**NEARER for one in self.corpus]
        climbing = BATCH // CLIMBING if self._guided and any(near) else 0
        drawn = draw.choices(self.corpus, shares, k=BATCH - len(begin) - climbing)
        climbed = draw.choices(self.corpus, near, k=climbing) if climbing else []
        return [
            *begin,
            *[mutated(one.table, one.known, draw) for one in drawn],
            *[mutated(one.table, one.known, draw, WITHIN_BOUNDS) for one in climbed],
        ]

    def _keep(self, table: Table, result: Examined) -> None:
        """Note what the run of an input has shown, and keep the input if that is new."""
        if not result.known.robots:
            return
        entry = CorpusEntry(table, result.known, result.bound_share)
        for i in [i for i, one in enumerate(self.seeds) if one is table]:
            self.corpus[i] = entry
        if self._guided and not result.reached <= self.seen:
            self.corpus.append(entry)
        self.seen |= result.reached

    def _shrunk(self, table: Table, breach: Breach, examine: Examine) -> FoundBreach:
        """Return the input nearest to the source with the same breach, as far as MOST_TRIES runs show."""
        rows = {name: table[name] for name in LISTS if name in table}
        left, tries = [{**self.seeds[0], **rows}, *simpler(table, self.seeds[0])], 0
        while left and tries < MOST_TRIES:
            size = min(self._workers, MOST_TRIES - tries)
            tried, left = left[:size], left[size:]
            for smaller, result in zip(tried, examine(tried, None), strict=True):
                tries += result.refused is None
                same = next((one for one in result.breaches if one.kind == breach.kind), None)
                if same is not None:
                    table, breach, left = smaller, same, list(simpler(smaller, self.seeds[0]))
                    break
        return FoundBreach(table, breach, self.runs)

    def _as_processes(self, inputs: Sequence[Table]) -> FoundBreach | None:
        """Run the first of `inputs` that has kills as processes, if it is time for that."""
        due = self.runs // PROCESSES_EACH > (self.runs - len(inputs)) // PROCESSES_EACH
        for table in [one for one in inputs if one.get("kill")] if due else ():
            try:
                scenario, kills, _ = scenario_of(table)
                self.processes += 1
                with redirect_stderr(StringIO()):  # what it says about each kill
                    differing = as_processes(scenario, audit=False, kills=kills).differing
            except UserError:
                continue
            except ChildFailed as error:
                return FoundBreach(table, Breach("a process dies", str(error)), self.runs)
            if differing:
                what = f"as processes: {', '.join(differing)}"
                return FoundBreach(table, Breach("the recording differs", what), self.runs)
            break
        return None


Examine = Callable[[Sequence[Table], Set[str] | None], Iterator[Examined]]


@contextmanager
def _pool(workers: int) -> Iterator[Examine]:
    """Yield a function that examines inputs in `workers` processes, forked from this one, in their order."""
    pool = multiprocessing.get_context("fork").Pool(workers, _begin)

    def examine(tables: Sequence[Table], seen: Set[str] | None) -> Iterator[Examined]:
        known = frozenset(seen) if seen is not None else None
        for one in [pool.apply_async(examined, (table, known)) for table in tables]:
            try:
                yield one.get(HANG_S)
            except multiprocessing.TimeoutError:
                yield Examined((Breach("it never ends", f"no result within {HANG_S:g} s"),))

    try:
        yield examine
    finally:
        pool.terminate()
        pool.join()


def _begin() -> None:
    """Prepare a worker: the command that started it handles signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
    reached_states.note_conditions()
