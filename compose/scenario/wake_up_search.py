"""A search for a short wake-up forest of a group that is too large for the optimum.

It changes a forest: it releases robots, and inserts them where that delays least.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator
from math import inf
from operator import itemgetter

from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest

SEARCH_STEPS = 1000
"""The changes that are tried."""
MOST_RELEASED = 10
"""The most robots that a change takes out of the forest, without their partners."""
STEP_SLACK = 0.05
"""The share by which a step may exceed the shortest forest at the start of the search; it falls to zero."""
SEARCH_SEED = 21
SEED_VISITED = -1
SEED_VISITOR = -2
RELEASED = -3
"""Values in place of the robot above."""
BLINKS = 0.1
"""The share of possible meetings that a step does not consider, so that steps differ."""


def short_forest(times: MeetingTimes, steps: int = SEARCH_STEPS) -> WakeUpForest:
    """Return the shortest forest that the search finds.

    A step releases robots near one of those on which the last end depends, and inserts them again in another
    order: ruin and recreate (Schrimpf et al., J. Comput. Phys. 159, 2000) with blinks (Christiaens and
    Vanden Berghe, Transp. Sci. 54, 2020). The search ends early at a lower bound. Its seed is a constant. No
    ratio to the optimum is proved, as one is for `sector_forest`.
    """
    draw = random.Random(SEARCH_SEED).random
    near = [sorted(times.robots, key=row.__getitem__) for row in times.hop]
    forest = OpenForest(times)
    forest.insert(_shuffled(list(times.robots), draw), draw)
    best = forest
    lower_bound = times.earliest_end()
    for step in range(steps):
        if best.length() <= lower_bound:
            break
        changed = forest.copy()
        latest = changed.latest()
        centre = latest[int(draw() * len(latest))]
        count = 2 + int(draw() * (MOST_RELEASED - 1))
        parts = changed.release([centre, *(robot for robot in near[centre][: 2 * count] if draw() < 0.5)])
        changed.insert(_shuffled(parts, draw), draw)
        slack = 1.0 + STEP_SLACK * (1.0 - step / steps)
        if changed.length() <= max(forest.length(), best.length() * slack):
            forest = changed
        if changed.length() < best.length():
            best = changed
    return best.frozen()


def _shuffled(parts: list[int], draw: Callable[[], float]) -> list[int]:
    """Return `parts` in an order that is the same with every version of Python."""
    return [part for _, part in sorted((draw(), part) for part in parts)]


class OpenForest:
    """A forest of which parts can be released. A released part is a robot with all that are below it."""

    def __init__(self, times: MeetingTimes) -> None:
        robots = len(times.robots)
        self._times = times
        self._ways = tuple(zip(*times.hop, strict=True))
        """The times of the hops, indexed [to][from]."""
        self._above = [RELEASED] * robots
        """The robot at whose anchor the hop to this one starts, or one of the constants above."""
        self._below: list[tuple[int, ...]] = [()] * robots
        """The robots to which hops start at the anchor of this one, at most two."""
        self._partner = [-1] * robots
        """The other robot of the seed pair, or -1."""
        self._end = [0.0] * robots
        """The time in s at which this robot is localised; without meaning in a released part."""
        self._tail = [0.0] * robots
        """The time in s from then until the last robot below this one is localised."""

    def copy(self) -> OpenForest:
        """Return a copy that changes on its own."""
        copy = object.__new__(OpenForest)
        copy._times, copy._ways = self._times, self._ways
        copy._above, copy._below, copy._partner = self._above[:], self._below[:], self._partner[:]
        copy._end, copy._tail = self._end[:], self._tail[:]
        return copy

    def frozen(self) -> WakeUpForest:
        """Return the forest as a value."""
        roots = self._roots()
        hops = [(self._above[robot], robot) for root in roots for robot in self._part(root) if robot != root]
        return WakeUpForest(tuple((self._partner[root], root) for root in roots), tuple(hops))

    def length(self) -> float:
        """Return the time in s at which the last robot is localised."""
        return max(self._end[root] + self._tail[root] for root in self._roots())

    def latest(self) -> list[int]:
        """Return the robots whose meetings lead to the last end, a seed pair first."""
        robot = max(self._roots(), key=lambda root: self._end[root] + self._tail[root])
        found = [self._partner[robot], robot]
        while self._below[robot]:
            robot = max(self._below[robot], key=lambda below: self._end[below] + self._tail[below])
            found.append(robot)
        return found

    def release(self, robots: Iterable[int]) -> list[int]:
        """Take out `robots` and their partners in seed pairs. Return these and the branches below them."""
        out = {each for robot in robots for each in (robot, self._partner[robot]) if each >= 0}
        parts = set(out)
        for robot in out:
            above = self._above[robot]
            if above >= 0:
                self._below[above] = tuple(each for each in self._below[above] if each != robot)
                self._settle_above(above)
            for each in self._below[robot]:
                self._above[each] = RELEASED
                parts.add(each)
            self._above[robot], self._below[robot] = RELEASED, ()
            self._partner[robot], self._tail[robot] = -1, 0.0
        return sorted(parts)

    def insert(self, parts: list[int], draw: Callable[[], float]) -> None:
        """Insert `parts`, the last one first, each where the meetings that it changes end earliest.

        A place or a seed pair for which `draw` returns less than BLINKS is not considered.
        """
        places = [robot for root in self._roots() for robot in self._part(root)]
        waiting = parts[:]
        while waiting:
            part = waiting.pop()
            end, place, under = self._best_hop(part, [place for place in places if draw() >= BLINKS])
            seed_pairs = [pair for pair in self._seed_pairs_of(part, waiting) if draw() >= BLINKS]
            end_of_pair, visitor, root = min(seed_pairs, key=itemgetter(0), default=(inf, -1, -1))
            if end == end_of_pair == inf:
                waiting.insert(0, part)
            elif end_of_pair < end:
                waiting = [each for each in waiting if each not in {visitor, root}]
                places.extend(self._part(root))
                self._add_seed(visitor, root)
            else:
                places.extend(self._part(part))
                self._add_hop(place, part, under)

    def _best_hop(self, part: int, places: Iterable[int]) -> tuple[float, int, int]:
        """Return the last end, the place of departure, and the robot above which `part` is put, or -1."""
        hop, tail, after = self._times.hop, self._tail, self._tail[part]
        best, way, ends = (inf, -1, -1), self._ways[part], self._end
        for place in places:
            end = ends[place] + way[place]
            if end + after < best[0]:
                if len(self._below[place]) < 2:
                    best = (end + after, place, -1)
                if len(self._below[part]) < 2:
                    for under in self._below[place]:
                        last = end + max(after, hop[part][under] + tail[under])
                        if last < best[0]:
                            best = (last, place, under)
        return best

    def _seed_pairs_of(self, part: int, waiting: list[int]) -> Iterator[tuple[float, int, int]]:
        """Yield the last end, the visitor and the visited of each seed pair of `part` with another part."""
        seed, tail = self._times.seed, self._tail
        for other in waiting:
            if not self._below[other]:
                yield seed[other][part] + tail[part], other, part
            if not self._below[part]:
                yield seed[part][other] + tail[other], part, other

    def _add_seed(self, visitor: int, root: int) -> None:
        self._above[visitor], self._partner[visitor] = SEED_VISITOR, root
        self._above[root], self._partner[root] = SEED_VISITED, visitor
        self._end[root] = self._times.seed[visitor][root]
        self._settle_below(root)

    def _add_hop(self, place: int, part: int, under: int) -> None:
        """Put `part` below `place`, and `under`, unless it is -1, below `part` instead."""
        if under >= 0:
            self._below[place] = tuple(each for each in self._below[place] if each != under)
            self._below[part] += (under,)
            self._above[under] = part
        self._below[place] += (part,)
        self._above[part] = place
        self._settle_below(place)
        self._settle_above(part)

    def _settle_below(self, place: int) -> None:
        """Compute the ends of all below `place`."""
        for robot in self._part(place):
            hop = self._times.hop[robot]
            for each in self._below[robot]:
                self._end[each] = self._end[robot] + hop[each]

    def _settle_above(self, robot: int) -> None:
        """Compute the tails of `robot` and of all above it."""
        while robot >= 0:
            hop = self._times.hop[robot]
            self._tail[robot] = max(
                [hop[each] + self._tail[each] for each in self._below[robot]], default=0.0
            )
            robot = self._above[robot]

    def _roots(self) -> list[int]:
        return [robot for robot, above in enumerate(self._above) if above == SEED_VISITED]

    def _part(self, root: int) -> list[int]:
        """Return `root` and all below it, each after the one above it."""
        found = [root]
        for robot in found:
            found.extend(self._below[robot])
        return found
