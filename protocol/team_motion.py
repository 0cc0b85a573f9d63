"""The motion of a team's robots that know too little to plan: a loop, a way to an anchor, and a search.

Both are functions of the mission, so that the bound of its duration is computed with the scenario.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

from protocol.coverage_strips import Place
from protocol.coverage_ticks import way_ticks
from protocol.messages import TeamAnchor
from protocol.mission import Mission
from protocol.motion import TAU, Controls
from protocol.orbits import Orbit

LOOP_RADII = (0.2, 0.14, 0.17)
"""The radii of the loops of consecutive robots in units of R. Their turns alternate, too.

Ranges between two robots that drive the same circle, one behind the other, leave several poses possible.
"""

FEWEST_LOOP_TICKS = 8
"""The fewest ticks of a loop, so that it has ranges from different places."""

BESIDE = 0.4
"""The distance from an anchor, in units of R, at which the way past it leads."""

NEAREST_WAY = 0.3
"""The least radius of that way, in units of R."""


def loop(mission: Mission, place: int, tick: int) -> Controls:
    """Return the controls of the loop of the robot with this place in the team.

    The next loop is on the other side. So at least half of one of both is in range of whatever is in range at
    its beginning.
    """
    radius = LOOP_RADII[place % len(LOOP_RADII)] * mission.sensing_range
    fastest = TAU / (FEWEST_LOOP_TICKS * mission.period)
    omega = min(mission.max_turn_rate, fastest, mission.max_speed / radius)
    turns = place + tick // math.ceil(TAU / (omega * mission.period))
    return Controls(omega * radius, omega if turns % 2 == 0 else -omega)


def loop_ticks(mission: Mission, place: int) -> int:
    """Return the ticks of that loop."""
    return math.ceil(TAU / (abs(loop(mission, place, 0).omega) * mission.period))


def nearest_other(anchor: TeamAnchor, anchors: Iterable[TeamAnchor]) -> float | None:
    """Return the distance (m) from `anchor` to the nearest other one with a position; None if there is none.

    Two anchors at one place determine no heading: they count as one.
    """
    here = anchor.position
    places = [one.position for one in anchors if one.position is not None and one.id != anchor.id]
    if here is None:
        return None
    distances = [math.hypot(here.x - one.x, here.y - one.y) for one in places]
    return min([away for away in distances if away > 0.0], default=None)


def way_past(mission: Mission, distance: float) -> Orbit:
    """Return the circle about an anchor that passes one at this `distance` (m) from it."""
    radius = max(NEAREST_WAY * mission.sensing_range, distance - BESIDE * mission.sensing_range)
    omega = min(mission.max_turn_rate, mission.max_speed / radius)
    return Orbit(radius, omega * radius, omega)


def team_ticks(mission: Mission, robots: int, farthest: float) -> int:
    """Return the bound on the ticks until a team is localised with exact sensors.

    `farthest` (m) is the largest distance from an anchor to the one that is nearest to it. Each robot drives
    a loop, the way past that anchor, and, there, loops while it measures.
    """
    loops = max([loop_ticks(mission, place) for place in range(min(robots, len(LOOP_RADII)))])
    orbit = way_past(mission, farthest)
    radial = math.ceil((orbit.radius + mission.sensing_range) / (orbit.v * mission.period))
    return (MEASURING_LOOPS + 1) * loops + radial + math.ceil(TAU / (orbit.omega * mission.period))


def next_on_spiral(place: tuple[float, float], side: int, mission: Mission) -> tuple[float, float]:
    """Return the end of the side after `side` of a square spiral, in m, if the latter ends at `place`.

    Each second side is longer, by R.
    """
    length = (side // 2 + 1) * mission.sensing_range
    along, sign = side % 2, 1.0 if side % 4 < 2 else -1.0
    x, y = place
    return (x, y + sign * length) if along else (x + sign * length, y)


@lru_cache(maxsize=8)
def spiral(mission: Mission, diameter: float) -> tuple[Place, ...]:
    """Return the corners (m) of a square spiral from 0 that passes all places within `diameter` (m) of 0.

    Each place is within 0.6 R of a side, so the robot is in range of it for a part of the side.
    """
    places = [(0.0, 0.0)]
    for side in range(4 * math.ceil(diameter / mission.sensing_range - 0.5) + 1):
        places.append(next_on_spiral(places[-1], side, mission))
    return tuple(places)


def search_ticks(mission: Mission, robots: int, diameter: float) -> int:
    """Return the bound on the ticks of a search on that spiral, with a return to it after each robot."""
    aside = way_ticks(((0.0, 0.0), (2.0 * mission.sensing_range, 0.0)), mission)
    return way_ticks(spiral(mission, diameter), mission) + (robots - 1) * aside


MEASURING_LOOPS = 3
"""The number of loops in which a robot measures enough ranges for a claim."""
