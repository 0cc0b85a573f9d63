"""The plans of groups beside their lower bound: `uv run python -m tests.plans [GROUPS]` prints two tables.

Each row of the first table is over GROUPS groups (100 by default), each of the second over a twentieth of
them. In the first one, meetings are those of a mission. In the second one, only one pair can meet first, and
meetings take no time, as long as the way to the farthest robot, or ten times as long; `search` and `sectors`
are the two plans of which the better one is taken.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable, Sequence
from statistics import median

from compose.scenario.group_meetings import group_meetings
from compose.scenario.scenario_tables import PlannerTable, RobotTable
from compose.scenario.wake_up_search import short_forest
from compose.scenario.wake_up_sectors import sector_forest
from compose.scenario.wake_up_tree import MeetingTimes
from protocol.mission import Mission

MISSION = Mission(sensing_range=3.0, period=1.0, max_speed=1.0, max_turn_rate=math.pi)
SIZES = (8, 50, 200)
Anchors = list[tuple[float, float]]
Shape = Callable[[int, random.Random], Anchors]


def square(robots: int, draw: random.Random) -> Anchors:
    """Return anchors in the square of `random-group`, of side 10 R sqrt(n)."""
    side = 10.0 * MISSION.sensing_range * math.sqrt(robots)
    return [(draw.uniform(0.0, side), draw.uniform(0.0, side)) for _ in range(robots)]


def clusters(robots: int, draw: random.Random) -> Anchors:
    """Return anchors about a tenth as many places of the square, R apart from these."""
    places = square(robots, draw)[: 1 + robots // 10]
    spread = MISSION.sensing_range
    return [(draw.gauss(x, spread), draw.gauss(y, spread)) for x, y in draw.choices(places, k=robots)]


def line(robots: int, draw: random.Random) -> Anchors:
    """Return anchors on a straight line, 10 R apart in the mean."""
    return [(draw.uniform(0.0, 10.0 * MISSION.sensing_range * robots), 0.0) for _ in range(robots)]


def _polar(distance: float, angle: float) -> tuple[float, float]:
    return distance * math.cos(angle), distance * math.sin(angle)


def circle(robots: int, draw: random.Random) -> Anchors:
    """Return two anchors at the centre of a circle, and the others on it: all are equally far."""
    return [(0.0, 0.0)] * 2 + [_polar(100.0, draw.uniform(0.0, 7.0)) for _ in range(robots - 2)]


def disc(robots: int, draw: random.Random) -> Anchors:
    """Return two anchors at the centre of a disc, and the others in it."""
    radii = [100.0 * math.sqrt(draw.random()) for _ in range(robots - 2)]
    return [(0.0, 0.0)] * 2 + [_polar(radius, draw.uniform(0.0, 7.0)) for radius in radii]


def far_cluster(robots: int, draw: random.Random) -> Anchors:
    """Return two anchors, and the others within 1 m of a place 100 m away."""
    return [(0.0, 0.0)] * 2 + [(100.0 + x / 100, y / 100) for x, y in disc(robots, draw)[2:]]


def fan(robots: int, draw: random.Random) -> Anchors:
    """Return two anchors, and the others 100 m away, of which half of the angle contains nearly all."""
    angles = [math.pi * 2.0 ** (-i / 8) for i in range(robots - 2)]
    return [(0.0, 0.0)] * 2 + [_polar(draw.uniform(100.0, 100.001), angle) for angle in angles]


def spiral(robots: int, draw: random.Random) -> Anchors:
    """Return two anchors at the centre of a spiral, which each way to the next one crosses."""
    shift = draw.uniform(0.0, 7.0)
    return [(0.0, 0.0)] * 2 + [_polar(100.0 * 1.03**-i, shift + 2.4 * i) for i in range(robots - 2)]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def of_missions(shape: Shape, robots: int, groups: int) -> list[str]:
    """Return the row of the first table for groups of so many robots."""
    bounds, ratios, seconds = [], [], []
    for seed in range(groups):
        anchors = shape(robots, random.Random(1000 * seed + robots))
        tables = [RobotTable(f"r{i}", anchor) for i, anchor in enumerate(anchors)]
        begun = time.process_time()
        plan = group_meetings(tables, MISSION, PlannerTable())
        seconds.append(time.process_time() - begun)
        bounds.append(plan.bound)
        ratios.append(plan.bound / plan.least_bound)
    return [
        *(shape.__name__, str(robots), f"{median(bounds):.0f} / {max(bounds):.0f}"),
        *(f"{median(ratios):.2f} / {max(ratios):.2f}", f"{median(seconds):.2f} / {max(seconds):.2f}"),
    ]


def of_one_pair(shape: Shape, robots: int, meeting: float, groups: int) -> list[str]:
    """Return the row of the second table for groups in which only the first two robots can meet first."""
    found = []
    for seed in range(groups):
        anchors = shape(robots, random.Random(seed))
        pair = [[math.inf] * robots for _ in anchors]
        pair[0][1] = 1.5 * meeting + 1.0
        ways = tuple(tuple(math.dist(one, other) + meeting for other in anchors) for one in anchors)
        times = MeetingTimes(tuple(map(tuple, pair)), ways)
        least = times.earliest_end()
        search, sectors = short_forest(times), sector_forest(times, anchors, meeting)
        found.append((search.last_end(times) / least, sectors.last_end(times) / least))
    better = sum([sectors < search for search, sectors in found])
    both = [f"{median(ratios):.2f} / {max(ratios):.2f}" for ratios in zip(*found, strict=True)]
    worst = max(min(ratios) for ratios in found)
    return [shape.__name__, str(robots), f"{meeting:.0f}", *both, f"{worst:.2f}", f"{better} of {groups}"]


def main(groups: int) -> None:
    """Print both tables."""
    head = ["anchors", "robots", "bound in s, median / largest", "bound over lower bound", "CPU-s"]
    rows = [of_missions(shape, robots, groups) for shape in (square, clusters) for robots in SIZES]
    print(table(head, rows), end="\n\n", flush=True)
    head = [
        "anchors",
        "robots",
        "meeting in s",
        "search",
        "sectors",
        "the better one, largest",
        "sectors better",
    ]
    shapes = (circle, disc, far_cluster, fan, spiral)
    few = max(groups // 20, 1)
    cases = [
        (shape, robots, meeting)
        for shape in shapes
        for robots in SIZES[1:]
        for meeting in (0.0, 100.0, 1000.0)
    ]
    print(table(head, [of_one_pair(shape, robots, meeting, few) for shape, robots, meeting in cases]))


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 100)
