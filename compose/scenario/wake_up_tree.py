"""The wake-up forest of a group: who localises whom, with the earliest end of the last meeting.

The freeze-tag problem (Arkin et al., The freeze-tag problem, SODA 2002) with a cost for each meeting and with
several places of departure. A seed pair meets at the anchor of the robot that it visits. After a meeting, two
localised robots are at one place, and each fetches one more, so a place has at most two others below it.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

Rows = tuple[tuple[float, ...], ...]
"""A square table of times in s, indexed [from][to] by robot."""


class MeetingTimes(msgspec.Struct, frozen=True):
    """The bounds in s of how long each meeting of a group takes."""

    seed: Rows
    """`seed[a][b]`: a searches for b, which waits, until both are localised at the anchor of b."""
    hop: Rows
    """`hop[a][b]`: a localised robot drives from the anchor of a to that of b, until b is localised."""

    @property
    def robots(self) -> range:
        """The numbers of the robots."""
        return range(len(self.seed))

    def earliest_end(self) -> float:
        """Return a lower bound in s of the last end of any forest: that of the robot that is reached last.

        A robot is reached no earlier than by a seed pair of its own, or by one hop from the place of another:
        more hops take no less time.
        """
        seed, hop, robots = self.seed, self.hop, self.robots
        as_visitor = [min(seed[a][b] for b in robots if a != b) for a in robots]
        as_visited = [min(seed[a][b] for a in robots if a != b) for b in robots]
        return max(
            min(
                as_visitor[robot],
                as_visited[robot],
                *(as_visited[place] + hop[place][robot] for place in robots if place != robot),
            )
            for robot in robots
        )


class WakeUpForest(msgspec.Struct, frozen=True):
    """The trees of a group: each starts with a seed pair, each hop localises one robot more."""

    seeds: tuple[tuple[int, int], ...]
    """The seed pairs, as (visitor, visited)."""
    hops: tuple[tuple[int, int], ...]
    """The robot at whose anchor each hop starts, and the robot that it visits, in a possible order."""

    def ends(self, times: MeetingTimes) -> dict[int, float]:
        """Return the time in s at which each visited robot is localised."""
        ends = {b: times.seed[a][b] for a, b in self.seeds}
        for place, robot in self.hops:
            ends[robot] = ends[place] + times.hop[place][robot]
        return ends

    def last_end(self, times: MeetingTimes) -> float:
        """Return the time in s at which the last robot is localised."""
        return max(self.ends(times).values())


def optimal_forest(times: MeetingTimes) -> WakeUpForest:
    """Return a forest whose last meeting ends as early as possible.

    Trees do not interact, and after a meeting neither do its two robots, so the optimum of a set of robots
    follows from the optima of its subsets, in O(n 3^n) steps for all. Ties go to the lower numbers.
    """
    return _Optimum(times).forest()


class _Optimum:
    """The least times of all sets of robots, a set being the sum of 2**robot."""

    def __init__(self, times: MeetingTimes) -> None:
        self.times = times
        sets = 1 << len(times.robots)
        self.everyone = sets - 1
        self.one = [[0.0] * sets for _ in times.robots]
        """`one[p][s]`: the least time in which one robot at p, and those that it localises, localise s."""
        self.two = [[0.0] * sets for _ in times.robots]
        """`two[p][s]`: the same with two robots at p."""
        self.tree = [float("inf")] * sets
        """`tree[s]`: the least time in which s, all unlocalised, become one tree."""
        self.trees = [0.0] + [float("inf")] * self.everyone
        """`trees[s]`: the same with any number of trees."""
        for group in range(1, sets):
            self._extend(group)

    def _extend(self, group: int) -> None:
        """Fill in the times of `group` from those of its subsets."""
        for place in self.times.robots:
            if not group >> place & 1:
                one, two = self.one[place], self.two[place]
                one[group] = min(self._first_hops(place, group))[0]
                two[group] = min(max(one[part], one[group ^ part]) for part in _halves(group))
        if group & (group - 1):
            self.tree[group] = min(self._seed_pairs(group))[0]
            self.trees[group] = min(max(self.tree[part], self.trees[group ^ part]) for part in _halves(group))

    def _first_hops(self, place: int, group: int) -> Iterator[tuple[float, int]]:
        hop = self.times.hop[place]
        for robot in _members(group):
            yield hop[robot] + self.two[robot][group ^ 1 << robot], robot

    def _seed_pairs(self, group: int) -> Iterator[tuple[float, int, int]]:
        for a in _members(group):
            seed, others = self.times.seed[a], group ^ 1 << a
            for b in _members(others):
                yield seed[b] + self.two[b][others ^ 1 << b], a, b

    def forest(self) -> WakeUpForest:
        """Return the forest of the least time for everyone."""
        seeds: list[tuple[int, int]] = []
        hops: list[tuple[int, int]] = []
        waiting = self.everyone
        while waiting:
            part = min(_halves(waiting), key=lambda part: max(self.tree[part], self.trees[waiting ^ part]))
            _, a, b = min(self._seed_pairs(part))
            seeds.append((a, b))
            self._add_hops(b, part ^ 1 << a ^ 1 << b, hops)
            waiting ^= part
        return WakeUpForest(tuple(seeds), tuple(hops))

    def _add_hops(self, place: int, group: int, hops: list[tuple[int, int]]) -> None:
        """Append the hops by which two robots at `place` localise `group`."""
        if not group:
            return
        one = self.one[place]
        first = min(_halves(group), key=lambda part: max(one[part], one[group ^ part]))
        for part in filter(None, (first, group ^ first)):
            _, robot = min(self._first_hops(place, part))
            hops.append((place, robot))
            self._add_hops(robot, part ^ 1 << robot, hops)


def _members(group: int) -> Iterator[int]:
    while group:
        last = group & -group
        yield last.bit_length() - 1
        group ^= last


def _halves(group: int) -> Iterator[int]:
    """Yield the subsets of `group` that contain its highest number: one of each split into two."""
    part = group
    rest = group ^ 1 << group.bit_length() - 1
    while part > rest:
        yield part
        part = (part - 1) & group
