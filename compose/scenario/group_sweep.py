"""The search of a group for its robots without an anchor: who sweeps which part, and until when."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import msgspec

from compose.errors import BadScenario, Unworkable
from compose.scenario.group_meetings import MOST_TURNED, FirstMeeting, GroupMeetings, rounded_down
from compose.scenario.scenario_tables import Area, RobotTable, ScenarioFile
from protocol.mission import Mission, infeasibility
from protocol.noise import VelocityNoise
from protocol.orbits import Orbit, Rendezvous
from protocol.sweep_strips import (
    STRIPS_OF_ROUND,
    Place,
    SweptArea,
    contact_ticks,
    helping_ticks,
    rounds,
    surveyed_path,
    sweep_speed,
    sweep_ticks,
)
from world.scenario import PlannedMeeting, PlannedSweep

LEAVING = 10
"""The bound on the ticks after a meeting until a robot goes on (see `group_transitions.PARTED_AFTER`)."""

ASIDE = 2.0
"""The largest distance from the anchor of its last meeting at which a robot goes on, in units of R."""

NOT_TOLERATED = (
    "mission.tolerates: it is for groups in which a robot has no anchor; others check all reports themselves"
)
"""The reason for which `mission.tolerates` is refused elsewhere."""

PARTS = 3.0
"""The time allowed for sweeps in `max_ticks`, in units of the planned bound."""


def check_unanchored(file: ScenarioFile, source: str) -> None:
    """Raise BadScenario or Unworkable if the robots without an anchor in a group cannot be localised."""
    missing = [i for i, robot in enumerate(file.robot) if robot.anchor is None]
    if not missing:
        if file.mission.tolerates:
            raise Unworkable(f"{source}: {NOT_TOLERATED}")
        return
    where = f"{source}: robot[{missing[0]}]: missing field 'anchor'"
    if file.group is not None:
        where = f"{source}: group.without_anchor"
    if len(file.robot) - len(missing) < 2:
        raise BadScenario(f"{where}: at least two robots of a group need one")
    if file.mission.safety_distance:
        raise Unworkable(
            f"{source}: mission.safety_distance: there is a robot without an anchor, and until it is "
            "found nobody knows on which side to pass it"
        )
    _check_attacks(file, len(file.robot) - len(missing), source)
    _check_area(file, missing, source)


def _check_attacks(file: ScenarioFile, anchored: int, source: str) -> None:
    """Raise Unworkable if robots without an anchor cannot tolerate the attackers among the others.

    With f of them, f + 1 honest finders must agree, and `anchored` robots have an anchor.
    """
    tolerates = file.mission.tolerates
    attacks = [i for i, robot in enumerate(file.robot) if robot.attack is not None]
    if tolerates and not file.mission.noise.exact:
        raise Unworkable(f"{source}: mission.tolerates: sensors have noise, and it is for exact ones only")
    if tolerates and anchored < rounds(tolerates):
        raise Unworkable(
            f"{source}: mission.tolerates: {tolerates} false finders need {rounds(tolerates)} robots with an "
            f"anchor, of which {tolerates + 1} are honest; there are {anchored}"
        )
    if len(attacks) > tolerates:
        remedy = f"set mission.tolerates = {len(attacks)}"
        if not file.mission.noise.exact:
            remedy = "with noisy sensors, nothing confirms them"
        raise Unworkable(
            f"{source}: robot[{attacks[0]}].attack: there is a robot without an anchor, which believes the "
            f"poses that others report: {remedy}"
        )


def _check_area(file: ScenarioFile, missing: Sequence[int], source: str) -> None:
    """Raise BadScenario if the area is missing or malformed, or if one of `missing` is not in it."""
    if file.mission.area is None:
        raise BadScenario(f"{source}: mission: missing field 'area': robots without an anchor are in it")
    x_min, y_min, x_max, y_max = file.mission.area
    if x_min > x_max or y_min > y_max:
        raise BadScenario(f"{source}: mission.area: it must be [x_min, y_min, x_max, y_max]")
    for i in missing:
        start = file.robot[i].start
        if start is not None and not (x_min <= start[0] <= x_max and y_min <= start[1] <= y_max):
            raise BadScenario(f"{source}: robot[{i}].start: '{file.robot[i].id}' is outside mission.area")


def with_sweep(
    robots: Sequence[RobotTable],
    area: Area | None,
    mission: Mission,
    meetings: GroupMeetings,
    *,
    tolerates: int = 0,
) -> GroupMeetings:
    """Return `meetings` with the search for those of `robots` that have no anchor, which are in `area`.

    `tolerates` of the robots may report false data, so each part is swept by several of them.
    The latest time allows for robots that sweep the parts of others, which have failed. Raises Unworkable if
    the area is too large for rounding errors.
    """
    unanchored = [robot.id for robot in robots if robot.anchor is None]
    if not unanchored or area is None:
        return meetings
    places = [robot.anchor for robot in robots if robot.anchor is not None]
    places += SweptArea(*area, 1).corners
    why = infeasibility(mission, max([math.dist(*two) for two in combinations(places, 2)]))
    if why is not None:
        raise Unworkable(f"mission.area: {why}")
    plan = _planned_sweep if mission.noise.exact else _noisy_sweep
    planned = plan(robots, len(unanchored), area, mission, meetings)
    if tolerates:
        again = _next_rounds(planned.sweep, places, len(unanchored), tolerates, mission)
        planned = msgspec.structs.replace(planned, ends=planned.ends + again, tolerates=tolerates)
    still = Orbit(0.0, 0.0, 0.0)
    waiting = FirstMeeting(planned.sweepers[0], "b", Rendezvous(still, still, planned.ends))
    return meetings._replace(
        first={**meetings.first, **dict.fromkeys(unanchored, waiting)},
        bound=planned.ends,
        latest=meetings.latest + PARTS * planned.ends,
        sweep=planned,
    )


def _planned_sweep(
    robots: Sequence[RobotTable], unanchored: int, area: Area, mission: Mission, meetings: GroupMeetings
) -> PlannedSweep:
    """Return the search for `unanchored` robots in `area`, in m, after `meetings`.

    Each robot with an anchor sweeps a part after its last meeting. Parts and robots are in the same order
    across the strips, so that their ways do not cross.
    """
    anchors = {one.id: one.anchor for one in robots if one.anchor is not None}
    places, free = _last_meetings(anchors, meetings)
    sweep = SweptArea(*area, len(anchors))
    sweepers = sorted(places, key=lambda robot: places[robot][sweep.across])
    aside = math.ceil(ASIDE * mission.sensing_range / (sweep_speed(mission) * mission.period))
    latest = 0.0
    for part, robot in enumerate(sweepers):
        path = sweep.path(part, mission.sensing_range)
        if path:
            ticks = LEAVING + aside + sweep_ticks([places[robot], *path], mission)
            ticks += unanchored * helping_ticks(mission)
            latest = max(latest, free[robot] + ticks * mission.period)
    return PlannedSweep(sweep, tuple(sweepers), latest)


def _next_rounds(
    sweep: SweptArea, places: Sequence[tuple[float, float]], unanchored: int, tolerates: int, mission: Mission
) -> float:
    """Return the bound in s of the rounds of a sweep after the first.

    In each, a robot goes to all anchors, which are among `places`, and then sweeps the part of another one.
    """
    way = max([math.dist(*two) for two in combinations(places, 2)])
    turn = math.ceil(math.pi / (mission.max_turn_rate * mission.period)) + 1
    visits = (sweep.parts - 1) * (math.ceil(way / (mission.max_speed * mission.period)) + turn)
    paths = [sweep.path(part, mission.sensing_range) for part in range(sweep.parts)]
    ticks = math.ceil(way / (sweep_speed(mission) * mission.period)) + turn
    ticks += max([sweep_ticks(path, mission) for path in paths]) + unanchored * helping_ticks(mission)
    return (rounds(tolerates) - 1) * (visits + ticks) * mission.period


def _last_meetings(
    anchors: Mapping[str, tuple[float, float]], meetings: GroupMeetings
) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """Return the place (m) of the last meeting of each robot, and the time (s) at which it ends."""
    places, free = dict(anchors), dict.fromkeys(anchors, 0.0)
    for meeting in meetings.planned:
        for robot in (meeting.visitor, meeting.visited):
            places[robot], free[robot] = anchors[meeting.visited], meeting.ends
    return places, free


def _noisy_sweep(
    robots: Sequence[RobotTable], unanchored: int, area: Area, mission: Mission, meetings: GroupMeetings
) -> PlannedSweep:
    """Return the search for `unanchored` robots in `area`, in m, after `meetings`, with noisy sensors.

    The visitors of last meetings sweep a part each. The robots that they have visited stay, as their beacons.
    They come last among the sweepers. Raises Unworkable if gyros or odometry are not good enough for a round.
    """
    anchors = {one.id: one.anchor for one in robots if one.anchor is not None}
    places, free = _last_meetings(anchors, meetings)
    last: dict[str, PlannedMeeting] = {}
    for meeting in meetings.planned:
        last[meeting.visitor] = last[meeting.visited] = meeting
    finders = [robot for robot, one in last.items() if one.visitor == robot and last[one.visited] is one]
    sweep = SweptArea(*area, len(finders))
    finders.sort(key=lambda robot: places[robot][sweep.across])
    aside = math.ceil(ASIDE * mission.sensing_range / (sweep_speed(mission) * mission.period))
    latest = 0.0
    for part, robot in enumerate(finders):
        path = surveyed_path(sweep, part, mission.sensing_range, anchors[robot], places[robot])
        if path:
            times = math.ceil(len(path) / ENDS_OF_ROUND)
            ticks = LEAVING + aside + sweep_ticks([places[robot], *path], mission)
            ticks += 2 * times * aside + unanchored * contact_ticks(mission)
            _check_gyros(mission, math.ceil(ticks / times))
            _check_odometry(mission, path)
            latest = max(latest, free[robot] + ticks * mission.period)
    return PlannedSweep(sweep, (*finders, *[one for one in anchors if one not in finders]), latest)


PLACES_PASSED = 6
"""The number of places of a round at the anchor and the beacon."""
ENDS_OF_ROUND = PLACES_PASSED + 2 * STRIPS_OF_ROUND
"""The number of places in a round of `surveyed_path`."""


def _check_gyros(mission: Mission, ticks: int) -> None:
    """Raise Unworkable if a bias of the gyros turns a robot too far within the `ticks` of a round."""
    turned = mission.noise.priors.gyro_bias * ticks * mission.period
    if turned > MOST_TURNED:
        enough = rounded_down(MOST_TURNED / (ticks * mission.period))
        raise Unworkable(
            f"mission.noise.gyro_bias: within the {ticks * mission.period:.0f} s between two passages of its "
            f"anchor, a bias of {mission.noise.priors.gyro_bias:g} rad/s turns a robot that sweeps by "
            f"{turned:.2g} rad, more than {MOST_TURNED:g}: calibrate the gyros to {enough:g} rad/s"
        )


MOST_WANDERED = 1.25
"""The largest sigma of a robot on its strips by the white noise of its odometry, in units of the accuracy.

Of missions of four robots, two of them without an anchor, all robots were localised in 16 of 17 below 0.7,
in 5 of 7 from 0.9 to 1.25, and in 2 of 17 above it. The others took up to 2 000 ticks.
"""


def _check_odometry(mission: Mission, path: Sequence[Place]) -> None:
    """Raise Unworkable if a robot on the strips of `path` hardly ever knows its pose well enough."""
    noise = mission.noise.odometry
    if noise == VelocityNoise():
        return
    # imports numpy, which scenarios without this noise do not need
    from agent.estimation.gaussian.reachable_accuracy import rounded_up, swept_sigma  # noqa: PLC0415

    ways = [path[i + PLACES_PASSED - 1 : i + ENDS_OF_ROUND] for i in range(0, len(path), ENDS_OF_ROUND)]
    sigma = max([swept_sigma(mission, way) for way in ways])
    if sigma > MOST_WANDERED * mission.accuracy:
        share = rounded_down(MOST_WANDERED * mission.accuracy / sigma)
        raise Unworkable(
            f"mission.noise.odometry: between two passages of its anchor, a robot that sweeps knows its "
            f"position to {sigma:.2g} m on half of its way, more than {MOST_WANDERED:g} of the accuracy of "
            f"{mission.accuracy:g} m: reduce this noise to {share:g} of it, or set an accuracy of "
            f"{rounded_up(sigma / MOST_WANDERED):g} m"
        )
