"""A wake-up forest whose last end is within a factor of a lower bound, as tests/test_wake_up_tree.py proves.

Robots are localised from the inside out, and the two at one place share a sector, as in the strategy
Split-Cone (Bonichon et al., Freeze-tag in L1 has wake-up time five, DISC 2024). Here, a cut balances the
angles of both parts, which cost travel, with the numbers of their robots, which cost meetings.
"""

from __future__ import annotations

from math import atan2, log2, pi, sin

from compose.scenario.wake_up_tree import MeetingTimes, WakeUpForest


def sector_forest(times: MeetingTimes, anchors: list[tuple[float, float]], meeting: float) -> WakeUpForest:
    """Return the forest of quick seed pairs, each of which localises the robots about it by sectors.

    A hop takes the time of the way between two `anchors`, given in m, and of a meeting, `meeting` in s.
    """
    latest, waiting = times.earliest_end(), set(times.robots)
    cells: dict[tuple[int, int], list[int]] = {}
    pairs = [(end, a, b) for a, row in enumerate(times.seed) for b, end in enumerate(row) if a != b]
    for end, a, b in sorted(pairs):
        if end <= latest and {a, b} <= waiting:
            waiting -= {a, b}
            cells[a, b] = []
    for robot in sorted(waiting):
        _, a, b = min((times.seed[a][b] + MOST_TRAVEL * times.hop[b][robot], a, b) for a, b in cells)
        cells[a, b].append(robot)
    hops: list[tuple[int, int]] = []
    for (_, root), cell in cells.items():
        (x, y), ways = anchors[root], times.hop[root]
        angles = {robot: atan2(anchors[robot][1] - y, anchors[robot][0] - x) for robot in cell}
        radius = max([ways[robot] - meeting for robot in cell], default=0.0)
        shared = [(root, sorted(cell, key=angles.__getitem__))]
        while shared:
            place, rest = shared.pop()
            for part in filter(None, _cut(rest, angles, radius, meeting)):
                first = min(part, key=ways.__getitem__)
                hops.append((place, first))
                shared.append((first, [robot for robot in part if robot != first]))
    return WakeUpForest(tuple(cells), tuple(hops))


def _cut(robots: list[int], angles: dict[int, float], radius: float, meeting: float) -> tuple[list[int], ...]:
    """Return the two parts of `robots`, sorted by their `angles`, for which the larger bound is least.

    The bound is that of the time from the first meeting in a part on, without the way outwards; `radius` is
    the time of the way to the farthest robot.
    """

    def bound(part: list[int]) -> float:
        return (
            radius * lateral(angles[part[-1]] - angles[part[0]]) + meeting * log2(len(part)) if part else 0.0
        )

    cuts = [(robots[:count], robots[count:]) for count in range(len(robots) + 1)]
    return min(cuts, key=lambda parts: max(map(bound, parts)))


def lateral(angle: float) -> float:
    """Return the bound of the ways across a sector of `angle` in rad, each part half of the one before.

    It is in units of the radius, concave, and at least the chord of `angle` and lateral(angle / 2).
    """
    return sum([2.0 * sin(min(angle / share, pi) / 2.0) for share in (1.0, 2.0, 4.0)]) + angle / 4.0


MOST_TRAVEL = 1.0 + lateral(pi)
"""The bound of the way until two robots have localised all about them, in units of the longest: 5.97."""
