"""The search of a group for its robots without an anchor: who covers which part, and until when."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from compose.errors import BadScenario, Unworkable
from compose.launch import planner_loader
from compose.scenario.group_meetings import FirstMeeting, GroupMeetings, check_gyros, rounded_down
from compose.scenario.scenario_tables import Area, RobotTable, ScenarioFile
from protocol.coverage_strips import Place, SweptArea, surveyed_path, ways_between_passages, widest_distance
from protocol.coverage_ticks import part_ticks, robots_of_part, straight_ticks, ticks_of_parts, turn_ticks
from protocol.mission import Mission, infeasibility
from protocol.noise import VelocityNoise
from protocol.orbits import Orbit, Rendezvous
from world.scenario import PlannedCoverage, PlannedMeeting

LEAVING_TICKS = 10
"""The bound on the ticks after a meeting until a robot goes on (see `meetings.PARTED_AFTER`)."""

LEAVES_WITHIN = 2.0
"""The largest distance from the anchor of its last meeting at which a robot goes on, in units of R."""

COVERED_SLOWER = 3.0
"""The time for coverage in `max_ticks`, in units of the planned bound: others cover the parts of the dead."""

MOST_WANDERED = 1.25
"""The largest sigma of a robot on its strips by the white noise of its odometry, in units of the accuracy.

Of missions of four robots, two of them without an anchor, all robots were localised in 16 of 17 below 0.7,
in 5 of 7 from 0.9 to 1.25, and in 2 of 17 above it. The others took up to 2 000 ticks.
"""


def check_unanchored(file: ScenarioFile) -> None:
    """Raise BadScenario or Unworkable if the robots without an anchor in a group cannot be localised."""
    missing = [i for i, robot in enumerate(file.robot) if robot.anchor is None]
    _check_area(file, missing)
    if not missing:
        return
    where = f"robot[{missing[0]}]: missing field 'anchor'"
    if file.group is not None:
        where = "group.without_anchor"
    if len(file.robot) - len(missing) < 2:
        raise BadScenario(f"{where}: at least two robots of a group need one")
    if not planner_loader.is_for_groups(file.planner.name, helps=True):
        raise Unworkable(f"{where}: robots with the planner {file.planner.name} do not search for others")
    if file.mission.safety_distance:
        raise Unworkable(
            "mission.safety_distance: there is a robot without an anchor, and until it is "
            "found nobody knows on which side to pass it"
        )
    _check_attacks(file, len(file.robot) - len(missing))


def _check_attacks(file: ScenarioFile, anchored: int) -> None:
    """Raise Unworkable if robots without an anchor cannot tolerate the attackers among the others.

    With f of them, f + 1 honest finders must agree, and `anchored` robots have an anchor.
    """
    tolerates = file.mission.tolerates
    attacks = [i for i, robot in enumerate(file.robot) if robot.attack is not None]
    if tolerates and not file.mission.noise.exact:
        raise Unworkable("mission.tolerates: with noisy sensors, all robots need an anchor")
    needed = robots_of_part(tolerates)
    if tolerates and anchored < needed:
        raise Unworkable(
            f"mission.tolerates: to tolerate {tolerates}, {needed} robots need an anchor, of which "
            f"{tolerates + 1} are then honest; there are {anchored}"
        )
    if len(attacks) > tolerates:
        remedy = f"set mission.tolerates = {len(attacks)}"
        if not file.mission.noise.exact:
            remedy = "with noisy sensors, nothing confirms them"
        raise Unworkable(
            f"robot[{attacks[0]}].attack: there is a robot without an anchor, which believes the "
            f"poses that others report: {remedy}"
        )


def _check_area(file: ScenarioFile, missing: Sequence[int]) -> None:
    """Raise BadScenario if the area is invalid, or is not around the starts of all `missing` robots."""
    if file.mission.area is None:
        if missing:
            raise BadScenario("mission: missing field 'area': robots without an anchor are in it")
        return
    x_min, y_min, x_max, y_max = file.mission.area
    if x_min > x_max or y_min > y_max:
        raise BadScenario("mission.area: it must be [x_min, y_min, x_max, y_max]")
    for i in missing:
        start = file.robot[i].start
        if start is not None and not (x_min <= start[0] <= x_max and y_min <= start[1] <= y_max):
            raise BadScenario(f"robot[{i}].start: '{file.robot[i].id}' is outside mission.area")


def with_coverage(
    robots: Sequence[RobotTable],
    area: Area | None,
    mission: Mission,
    meetings: GroupMeetings,
    *,
    tolerates: int = 0,
) -> GroupMeetings:
    """Return `meetings` with the search for those of `robots` that have no anchor, which are in `area`.

    `tolerates` of the robots may report false data, so several of them cover each part. The latest time
    allows for robots that cover the parts of others, which have failed. Raises Unworkable if the area is too
    large for rounding errors, or if gyros or odometry are too inaccurate for it.
    """
    unanchored = [robot.id for robot in robots if robot.anchor is None]
    if not unanchored or area is None:
        return meetings
    anchors = {robot.id: robot.anchor for robot in robots if robot.anchor is not None}
    widest = widest_distance((*anchors.values(), *SweptArea(*area, 1).corners))
    why = infeasibility(mission, widest)
    if why is not None:
        raise Unworkable(f"mission.area: {why}")
    planned = _planned_coverage(anchors, len(unanchored), area, mission, meetings)
    each = _next_coverage_ticks(planned.sweep, mission, widest, len(unanchored))
    ends = planned.ends + (robots_of_part(tolerates) - 1) * each * mission.period
    planned = msgspec.structs.replace(planned, ends=ends)
    still = Orbit(0.0, 0.0, 0.0)
    waiting = FirstMeeting(planned.sweepers[0], "b", Rendezvous(still, still, planned.ends))
    return meetings._replace(
        first={**meetings.first, **dict.fromkeys(unanchored, waiting)},
        bound=planned.ends,
        latest=meetings.latest + COVERED_SLOWER * planned.ends,
        planned_sweep=planned,
    )


def _planned_coverage(
    anchors: Mapping[str, Place], unanchored: int, area: Area, mission: Mission, meetings: GroupMeetings
) -> PlannedCoverage:
    """Return the search for `unanchored` robots in `area`, in m, after `meetings`.

    Each robot with an anchor covers a part after its last meeting. With noisy sensors, only the visitors of
    last meetings do; the robots that they have visited stay, as their beacons, and come last among the
    sweepers. Parts and robots are in the same order across the strips, so that their ways do not cross.
    Raises Unworkable if gyros or odometry are not good enough for a round.
    """
    places, free = _last_meetings(anchors, meetings)
    exact, reach = mission.noise.exact, mission.sensing_range
    finders = list(anchors) if exact else _last_visitors(meetings)
    sweep = SweptArea(*area, len(finders))
    finders.sort(key=lambda robot: places[robot][sweep.across])
    off_anchor = straight_ticks(LEAVES_WITHIN * reach, mission)
    latest = 0.0
    for part, robot in enumerate(finders):
        path = sweep.path(sweep.strips_of(part, reach), reach)
        if not exact:
            path = surveyed_path(sweep, part, reach, anchors[robot], places[robot])
        if not path:
            continue
        ticks = LEAVING_TICKS + off_anchor + part_ticks([places[robot], *path], mission, unanchored)
        if not exact:
            rounds = ways_between_passages(path)
            ticks += 2 * len(rounds) * off_anchor
            check_gyros(
                mission, math.ceil(ticks / len(rounds)) * mission.period, "between two passages of its anchor"
            )
            _check_odometry(mission, rounds)
        latest = max(latest, free[robot] + ticks * mission.period)
    return PlannedCoverage(sweep, (*finders, *[one for one in anchors if one not in finders]), latest)


def _last_meetings(
    anchors: Mapping[str, Place], meetings: GroupMeetings
) -> tuple[dict[str, Place], dict[str, float]]:
    """Return the place (m) of the last meeting of each robot, and the time (s) at which it ends."""
    places, free = dict(anchors), dict.fromkeys(anchors, 0.0)
    for meeting in meetings.meetings:
        for robot in (meeting.visitor, meeting.visited):
            places[robot], free[robot] = anchors[meeting.visited], meeting.ends
    return places, free


def _last_visitors(meetings: GroupMeetings) -> list[str]:
    """Return the visitors of those meetings that are the last of both robots."""
    last: dict[str, PlannedMeeting] = {}
    for meeting in meetings.meetings:
        last[meeting.visitor] = last[meeting.visited] = meeting
    return [robot for robot, one in last.items() if one.visitor == robot and last[one.visited] is one]


def _next_coverage_ticks(sweep: SweptArea, mission: Mission, widest: float, unanchored: int) -> int:
    """Return the bound on the ticks in which each part is covered by one robot more than before.

    That robot goes to all anchors first. No two of these or corners of the area are more than `widest` m
    apart.
    """
    turn = turn_ticks(mission)
    visit = math.ceil(widest / (mission.max_speed * mission.period)) + turn
    return (sweep.parts - 1) * visit + turn + max(ticks_of_parts(sweep, mission, widest, unanchored))


def _check_odometry(mission: Mission, ways: Sequence[Sequence[Place]]) -> None:
    """Raise Unworkable if a robot on these ways between passages hardly ever knows its pose well enough."""
    noise = mission.noise.odometry
    if noise == VelocityNoise():
        return
    # imports numpy, which scenarios without this noise do not need
    from agent.estimation.gaussian.reachable_accuracy import covering_sigma, rounded_up  # noqa: PLC0415

    sigma = max([covering_sigma(mission, way) for way in ways])
    if sigma > MOST_WANDERED * mission.accuracy:
        share = rounded_down(MOST_WANDERED * mission.accuracy / sigma)
        raise Unworkable(
            f"mission.noise.odometry: between two passages of its anchor, a robot that covers the area knows "
            f"its position to {sigma:.2g} m on half of its way, more than {MOST_WANDERED:g} of the accuracy "
            f"of {mission.accuracy:g} m: reduce this noise to {share:g} of it, or set an accuracy of "
            f"{rounded_up(sigma / MOST_WANDERED):g} m"
        )
