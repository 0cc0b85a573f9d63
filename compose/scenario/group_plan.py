"""The plan of meetings of a group: its seed pairs, the hops of its wake-up trees, and the bounds of both."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import permutations
from math import inf, sqrt

import msgspec

from compose.scenario.wake_up_search import short_forest
from compose.scenario.wake_up_sectors import sector_forest
from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest, optimal_forest

MOST_OPTIMAL = 8
"""The most robots whose plan is optimal. The time that the optimum takes triples with each further robot."""


class PlannedVisit(msgspec.Struct, frozen=True, array_like=True):
    """A meeting of a plan, at the anchor of the robot that is visited."""

    visitor: int
    visited: int
    ends: float
    """The bound in s of the time at which both are localised."""
    first: bool = False
    """The visitor is not localised before: a seed pair."""


class GroupPlan(msgspec.Struct, frozen=True):
    """The meetings that localise a group, each robot's in order."""

    meetings: tuple[PlannedVisit, ...]
    """The meetings in the order of their ends."""
    bound: float
    """The bound in s of the time at which all are localised."""
    least_bound: float
    """A lower bound in s of the `bound` of any plan; their proved factor: tests/test_wake_up_tree.py."""
    travel: MeetingTimes
    """The bounds of seed pairs, and of travel alone."""


def least_makespan(times: MeetingTimes) -> float:
    """Return a lower bound in s of the time until all are localised by meetings that take `times`.

    It is the optimum up to MOST_OPTIMAL robots; beyond, the earliest end for the robot reached last.
    """
    if len(times.robots) <= MOST_OPTIMAL:
        return optimal_forest(times).last_end(times)
    return times.earliest_end()


def group_plan(
    anchors: Sequence[tuple[float, float]],
    seed_time: Callable[[int, int], float],
    speed: float,
    meeting: float,
    nearest: float = 0.0,
) -> GroupPlan:
    """Return the plan of the group whose robots wait beside `anchors`, given in m.

    `seed_time(a, b)` bounds in s how long it takes until a, which searches, and b, which waits, are both
    localised beside the anchor of b; it is infinite if they cannot meet. Later a localised robot drives at
    `speed` in m/s to the anchor of one that waits, where their meeting lasts at most `meeting` in s. Robots
    whose anchors are less than `nearest` m apart visit each other only if no other robot can.

    The plan is optimal up to MOST_OPTIMAL robots; beyond, it is the better one of `short_forest` and
    `sector_forest`. Numbering and translation change the bound by rounding only, unless two anchors are at
    one place. Raises ValueError for fewer than two robots, or if no two can meet first.
    """
    if len(anchors) < 2:
        raise ValueError(f"a group has at least two robots, not {len(anchors)}")
    order = sorted(range(len(anchors)), key=anchors.__getitem__)
    near = {(a, b) for a, b in permutations(order, 2) if _distance(anchors[a], anchors[b]) < nearest}
    seed = tuple(tuple(inf if a == b else seed_time(a, b) for b in order) for a in order)
    if min(map(min, seed)) == inf:
        raise ValueError("no two robots of the group can meet first")
    travel = tuple(tuple(_distance(anchors[a], anchors[b]) / speed for b in order) for a in order)
    times = MeetingTimes(seed, tuple(tuple(time + meeting for time in row) for row in travel))
    if len(order) <= MOST_OPTIMAL:
        forest = optimal_forest(times)
    else:
        forests = short_forest(times), sector_forest(times, [anchors[robot] for robot in order], meeting)
        forest = min(forests, key=lambda forest: forest.last_end(times))
    meetings = tuple(
        msgspec.structs.replace(each, visitor=order[each.visitor], visited=order[each.visited])
        for each in planned_meetings(forest, times, {(order.index(a), order.index(b)) for a, b in near})
    )
    bound = meetings[-1].ends
    least_bound = bound if len(order) <= MOST_OPTIMAL else times.earliest_end()
    return GroupPlan(meetings, bound, least_bound, MeetingTimes(seed, travel))


def planned_meetings(
    forest: WakeUpForest, times: MeetingTimes, near: Collection[tuple[int, int]] = ()
) -> list[PlannedVisit]:
    """Return the meetings of `forest`, in the order of their ends.

    The robot that was visited makes the hop whose branch ends last, and its visitor the other; the other way
    round if fewer of these visits are `near`, which holds (visitor, visited).
    """
    ends = forest.ends(times)
    last = dict(ends)
    for place, robot in reversed(forest.hops):
        last[place] = max(last[place], last[robot])
    visitors = {b: a for a, b in forest.seeds}
    meetings = [PlannedVisit(a, b, ends[b], first=True) for a, b in forest.seeds]
    for place, robot in forest.hops:
        branches = [other for start, other in forest.hops if start == place]
        branches.sort(key=last.__getitem__, reverse=True)
        ways = [dict(zip(branches, both, strict=False)) for both in permutations((place, visitors[place]))]
        way = min(ways, key=lambda way: sum([(by, other) in near for other, by in way.items()]))
        visitors[robot] = way[robot]
        meetings.append(PlannedVisit(visitors[robot], robot, ends[robot]))
    return sorted(meetings, key=lambda meeting: meeting.ends)


def _distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    return sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)
