"""The search: which inputs run next, what is kept of them, and when it ends."""

from __future__ import annotations

import math
import multiprocessing
import random
import signal
from collections import Counter
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
    joined,
    mutated,
    robots_of,
    seeds,
    simpler,
)
from compose.sweep.trial_mission import as_processes

BATCH = 16
"""The number of inputs that are drawn from one state of the corpus, so that the workers do not matter."""
HANG_S = 600.0
"""The time in s after which an input counts as one that never ends."""
MOST_TRIES = 100
"""The number of runs in which an input is shrunk at most."""
PROCESSES_EACH = 100
"""The number of runs after which an input with kills also runs as processes."""
JOINED_SHARE = 0.15
"""The share of inputs that get a part of another input before they are changed."""
SLOWEST_SHARE = 0.2
"""The share of the time for changes of the inputs that came nearest to a computed bound."""
NEARER = 8
"""The power of the share of its bound by which such an input is chosen: the slowest runs take longest."""
NOISY_SLOWER = 8.0
"""The time of a run with noisy sensors, relative to one with exact sensors that lasts as many ticks.

It was 8 in pairs (65 ms), of which few run a second time.
"""
FIXED_TICKS = 25
"""The time of a run that does not depend on its ticks, in ticks of exact sensors: 4 ms, mostly the audit.

Without it, missions of a few ticks are changed most often, in which kills and faults meet nothing.
"""
SEEDS_SHARE = 0.2
"""The share of inputs that are changes of the first ones, of which more and more are taken.

One that takes 100 times as long is changed a tenth as often.
"""
LONG_TICKS = 300
"""The ticks from which on most of the time grows with the square of the ticks.

A meeting that does not end tests all its ranges again in each tick.
"""


class CorpusEntry(NamedTuple):
    """An input of the corpus."""

    table: Table
    known: Clues
    reached: frozenset[str] = frozenset()

    @property
    def share(self) -> float:
        """The frequency of its changes, relative to others: it is larger if its run takes less time."""
        ticks = FIXED_TICKS + self.known.ticks
        slower = (1.0 + ticks / LONG_TICKS) * (NOISY_SLOWER if is_noisy(self.table) else 1.0)
        return 1.0 / ticks / len(self.known.robots) ** 2 / slower


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
        self._first = [CorpusEntry(one, Clues(tuple(robots_of(one)), 100)) for one in self.seeds]
        """These inputs, with what their runs have shown."""
        self._seed, self._workers, self._guided = seed, workers, guided
        self.corpus: list[CorpusEntry] = []
        """The inputs that reached something new."""
        self._energies: list[float] = []
        """The frequencies of changes of these inputs."""
        self._spent = self._climbed = 0.0
        """The time of all runs, and of changes of `slowest`, in units of one whose `share` is 1."""
        self.slowest: dict[tuple[int, int, int], tuple[float, CorpusEntry]] = {}
        """The inputs whose runs used most of a bound, with the share, by number of bounds, place and length.

        The length is the number of binary digits of the ticks: a long run replaces no short one, of which ten
        are changed in its time.
        """
        self.seen = Counter[str]()
        """The states that the runs have reached, with the number of runs that reached each."""
        self.runs = self.processes = self.refused = 0
        """The numbers of inputs, of those that also ran as processes, and of those that have no result."""

    def run(self, is_over: Callable[[Hunt], bool]) -> FoundBreach | None:
        """Search until `is_over`, and return the first input that breaks an invariant, shrunk.

        `is_over` is asked after each batch.
        """
        with _pool(self._workers) as examine:
            for number in count():
                inputs = self._batch(number)
                for table, result in zip(inputs, examine(inputs, self.seen.keys()), strict=True):
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
        left = self.seeds[number : number + 1]
        draw = random.Random(f"{self._seed}/hunt/{number}")
        self._energies = [
            one.share / math.sqrt(min([self.seen[state] for state in one.reached])) for one in self.corpus
        ]
        return [*left, *[self._input(draw) for _ in range(BATCH - len(left))]]

    def _input(self, draw: random.Random) -> Table:
        """Return a mutation of an input of the corpus, or of one of the first inputs: by chance, always."""
        if not self._guided or not self.corpus or draw.random() < SEEDS_SHARE:
            firsts = self._first[: 1 + len(self.corpus)] if self._guided else self._first
            [first] = draw.choices(firsts, [math.sqrt(one.share) if self._guided else 1.0 for one in firsts])
            return mutated(first.table, first.known, draw)
        if self.slowest and self._climbed < SLOWEST_SHARE * self._spent:
            near = [*self.slowest.values()]
            [(_, entry)] = draw.choices(near, [share**NEARER * one.share for share, one in near])
            self._climbed += 1.0 / entry.share
            return mutated(entry.table, entry.known, draw, WITHIN_BOUNDS)
        entry, other = draw.choices(self.corpus, self._energies, k=2)
        table = joined(entry.table, other.table, draw) if draw.random() < JOINED_SHARE else entry.table
        return mutated(table, entry.known, draw)

    def _keep(self, table: Table, result: Examined) -> None:
        entry = CorpusEntry(table, result.known, result.reached)
        for i in [i for i, one in enumerate(self.seeds) if one is table and result.known.robots]:
            self._first[i] = entry
        if not result.reached <= self.seen.keys():
            self.corpus.append(entry)
        self.seen.update(result.reached)
        self._spent += 1.0 / entry.share if entry.known.robots else 0.0
        for place, share in enumerate(result.bound_shares):
            which = len(result.bound_shares), place, result.known.ticks.bit_length()
            if share > self.slowest.get(which, (0.0, None))[0]:
                self.slowest[which] = share, entry

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
