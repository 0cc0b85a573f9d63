"""Bounds on the ticks that the coverage takes: of its ways, of its stops, and of whole parts of the area."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from protocol.coverage_strips import ALONG, ASIDE, SIDE, STEP, Place, SweptArea, surveyed_path
from protocol.mission import Mission

LOOPS = 3
"""The number of squares within which a robot that has been found is localised.

In the first, the robot that has found it drives alone; in the second, the other one drives, too. The third is
left for reports, turns and ticks that are only partly used.
"""

NOISY_LOOPS = 2
"""The pairs of rectangles within which a robot that has been found is localised under noise.

A robot with sigmas of 0.05 m and R = 3 m takes 12 to 30 of their 65 ticks. With less, some are left for a
later part of the coverage; with more, a robot that cannot be localised holds the other one up for longer.
"""

ENOUGH_SIGMA, MOST_TIMES = 1.0 / 6.0, 10.0
"""The sigma of a range from which contacts take longer, in units of the accuracy, and the largest factor."""


def coverage_speed(mission: Mission) -> float:
    """Return the speed in m/s of the coverage, with which no robot is passed between two ticks."""
    return min(mission.max_speed, STEP * mission.sensing_range / mission.period)


def straight_ticks(length: float, mission: Mission) -> int:
    """Return the ticks in which a robot drives straight on for `length` m, with the speed of the coverage."""
    return math.ceil(length / (coverage_speed(mission) * mission.period))


def turn_ticks(mission: Mission) -> int:
    """Return a bound on the ticks that a place costs: a turn of at most pi, and a part of a tick."""
    return math.ceil(math.pi / (mission.max_turn_rate * mission.period)) + 1


def way_ticks(places: Sequence[Place], mission: Mission) -> int:
    """Return a bound on the ticks in which a robot drives from the first of `places` to the last."""
    turn = turn_ticks(mission)
    return sum([straight_ticks(math.dist(*ends), mission) + turn for ends in pairwise(places)], turn)


def helping_ticks(mission: Mission) -> int:
    """Return a bound on the ticks for which a covering robot stops to localise another one.

    It includes the way of that one, at most R long, to the way of the first, half of whose strips it covers.
    """
    side, reach = SIDE * mission.sensing_range, mission.sensing_range
    square = way_ticks([(0.0, 0.0), (side, 0.0), (side, side), (0.0, side), (0.0, 0.0)], mission)
    return LOOPS * square + straight_ticks(reach, mission) + turn_ticks(mission)


def contact_ticks(mission: Mission) -> int:
    """Return the most ticks for which a covering robot stops for another one with noisy sensors.

    The number of ranges that it takes grows with the square of their sigma over the accuracy.
    """
    along, aside = ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    once = way_ticks([(0.0, 0.0), (0.0, aside), (along, aside), (along, 0.0), (0.0, 0.0)], mission)
    sigma = mission.noise.mutual_sigma / (ENOUGH_SIGMA * mission.accuracy)
    return math.ceil(2 * NOISY_LOOPS * once * min(max(1.0, sigma * sigma), MOST_TIMES))


def part_ticks(path: Sequence[Place], mission: Mission, unanchored: int) -> int:
    """Return a bound on the ticks in which a robot drives along `path`, and stops for `unanchored` robots.

    The path is `SweptArea.path` with exact sensors, and `surveyed_path` with noisy ones.
    """
    stop = helping_ticks(mission) if mission.noise.exact else contact_ticks(mission)
    return way_ticks(path, mission) + unanchored * stop


def ticks_of_parts(area: SweptArea, mission: Mission, widest: float, unanchored: int) -> list[int]:
    """Return a bound on the ticks in which any robot drives to each part of `area`, and covers it.

    It stops once for each of the `unanchored` robots. No two anchors or corners of the area are more than
    `widest` m apart. With noisy sensors, a robot also passes its anchor and its beacon, as far away as that.
    """
    exact, reach = mission.noise.exact, mission.sensing_range
    x, y = area.corners[0]
    paths = [
        area.path(area.strips_of(part, reach), reach)
        if exact
        else surveyed_path(area, part, reach, (x, y), (x + widest, y))
        for part in range(area.parts)
    ]
    return [straight_ticks(widest, mission) + part_ticks(path, mission, unanchored) for path in paths]


def robots_of_part(tolerates: int) -> int:
    """Return the number of robots that cover each part, so that `tolerates` + 1 of them are honest.

    As many robots may report false data as `tolerates` says.
    """
    return 2 * tolerates + 1
