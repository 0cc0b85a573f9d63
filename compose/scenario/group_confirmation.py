"""The meetings after which the robots of a group claim their poses, if some of them may report false data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from compose.errors import Unworkable
from compose.scenario.group_coverage import LEAVING_TICKS
from compose.scenario.group_meetings import ALLOWED_SIDES, GroupMeetings
from compose.scenario.scenario_tables import RobotTable, ScenarioFile
from protocol.messages import Appointment
from protocol.mission import Mission
from protocol.orbits import meeting_ticks, search_ticks, visiting
from world.faults import Fault, exchange_ticks
from world.scenario import PlannedConfirmation

CONFIRMING = 30
"""The ticks beside its anchor in which a robot that has come back measures its pose."""

PASSES = 4
"""The number of times that robots visit each other: the last two passes begin after all retries."""


def others_to_meet(tolerates: int) -> int:
    """Return the number of others that a robot must meet, so that `tolerates` + 1 of them are honest."""
    return 2 * tolerates + 1


def check_tolerated(file: ScenarioFile) -> None:
    """Raise Unworkable if the robots, which all have an anchor, cannot tolerate as many attackers."""
    tolerates, where = file.mission.tolerates, "mission.tolerates"
    if not tolerates:
        return
    if file.mission.noise.exact:
        raise Unworkable(
            f"{where}: sensors are exact and all robots have an anchor, so they check all reports themselves"
        )
    if len(file.robot) <= others_to_meet(tolerates):
        raise Unworkable(
            f"{where}: with {tolerates} false, a robot needs {others_to_meet(tolerates)} others, of which "
            f"{tolerates + 1} are honest; there are {len(file.robot) - 1}"
        )
    attacks = [i for i, robot in enumerate(file.robot) if robot.attack is not None]
    if len(attacks) > tolerates:
        raise Unworkable(
            f"robot[{attacks[tolerates]}].attack: {len(attacks)} robots have one, and "
            f"mission.tolerates is {tolerates}"
        )
    if file.mission.safety_distance:
        raise Unworkable(f"{where}: it is not for groups with a mission.safety_distance")


def with_confirmation(
    robots: Sequence[RobotTable],
    mission: Mission,
    meetings: GroupMeetings,
    faults: Sequence[Fault],
    tolerates: int,
) -> GroupMeetings:
    """Return `meetings` of `robots`, which all have an anchor, with those that confirm their poses.

    In each round, robots meet in pairs, beside the anchor of one of the two, and the other one returns. The
    first pass adds to the planned meetings, and begins when all should know their poses. The later ones
    include the planned meetings, which an attacker may have prevented. From one pass to the next, robots
    change their roles, because only a robot that knows its pose can visit another one, and because an
    attacker may have led a visitor astray.
    """
    anchors = {one.id: one.anchor for one in robots if one.anchor is not None}
    planned = {frozenset((one.visitor, one.visited)) for one in meetings.meetings}
    begins, ends, visits = meetings.bound, meetings.bound, list[Appointment]()
    each, once = exchange_ticks(faults)
    for number in range(PASSES):
        if number == PASSES - 2:
            begins = max(begins, meetings.latest)
        met = planned if number == 0 else set[frozenset[str]]()
        for pairs in _rounds(anchors, met, others_to_meet(tolerates), mission.orienting_distance):
            way = max([math.dist(anchors[a], anchors[b]) for a, b in pairs])
            ticks = 2 * math.ceil(way / (mission.max_speed * mission.period)) + CONFIRMING
            ticks += LEAVING_TICKS + search_ticks(mission, ALLOWED_SIDES) + meeting_ticks(mission)
            ticks += each + once
            lasts = ticks * mission.period
            for pair in pairs:
                a, b = pair if number % 2 == 0 else pair[::-1]
                orbits = visiting(mission, math.dist(anchors[a], anchors[b]))
                visits.append(Appointment(a, b, orbits, begins, lasts))
            begins += lasts
        if number == 0:
            ends = begins
    return meetings._replace(bound=ends, latest=begins, confirmation=PlannedConfirmation(tuple(visits), ends))


def _rounds(
    anchors: dict[str, tuple[float, float]], met: set[frozenset[str]], others: int, nearest: float
) -> list[list[tuple[str, str]]]:
    """Return the meetings of each round, until each robot has met as many `others`, those of `met` included.

    Robots that have met the fewest others come first, then those that are near to each other, but not those
    whose anchors are less than `nearest` m apart. The robot with more meetings visits the other one, if both
    have met as many, it is the first one.
    """
    found: list[list[tuple[str, str]]] = []
    count = {robot: sum([robot in pair for pair in met]) for robot in anchors}
    while True:
        left = [
            (min(count[a], count[b]), count[a] + count[b], math.dist(anchors[a], anchors[b]), a, b)
            for a, b in combinations(anchors, 2)
            if frozenset((a, b)) not in met
            and min(count[a], count[b]) < others
            and math.dist(anchors[a], anchors[b]) >= nearest
        ]
        if not left:
            return found
        pairs: list[tuple[str, str]] = []
        busy: set[str] = set()
        for *_, a, b in sorted(left):
            if a not in busy and b not in busy:
                pairs.append((b, a) if count[b] > count[a] else (a, b))
                busy |= {a, b}
        for a, b in pairs:
            met = met | {frozenset((a, b))}
            count[a] += 1
            count[b] += 1
        found.append(pairs)
