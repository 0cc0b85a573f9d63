"""The first meeting of each robot of a scenario file: with its peer, or as the group's plan has it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import permutations

from compose.errors import BadScenario, Unworkable
from compose.launch import planner_loader
from compose.scenario.group_confirmation import check_tolerated, with_confirmation
from compose.scenario.group_meetings import FirstMeeting, GroupMeetings, group_meetings
from compose.scenario.group_sweep import check_unanchored, with_sweep
from compose.scenario.scenario_tables import Area, PlannerTable, RobotTable, ScenarioFile
from protocol.mission import Mission, infeasibility
from protocol.orbits import Rendezvous
from protocol.rounding import TOLERANCE
from protocol.spelling import did_you_mean
from world.faults import Fault

NEAREST_ANCHORS = TOLERANCE
"""The minimum distance in m of two anchors: nearer ones coincide at the accuracy of exact claims."""


def in_group(file: ScenarioFile) -> bool:
    """Return whether the robots form a group, and not pairs."""
    return len(file.robot) != 2 and all(robot.peer is None for robot in file.robot)


def meetings_of(file: ScenarioFile, faults: Sequence[Fault], source: str) -> GroupMeetings | None:
    """Return the meetings of the group that the robots form; None if they form pairs.

    Raises BadScenario and Unworkable.
    """
    robots = file.robot
    if not in_group(file):
        for i, robot in enumerate(robots):
            if robot.anchor is None:
                raise BadScenario(f"{source}: robot[{i}]: missing field 'anchor'")
        if file.mission.tolerates:
            raise Unworkable(f"{source}: mission.tolerates: it is for groups, and the robots form pairs")
        return None
    _check_ids(robots, source)
    check_unanchored(file, source)
    anchored = [i for i, robot in enumerate(robots) if robot.anchor is not None]
    if len(anchored) == len(robots):
        check_tolerated(file, source)
    distances = [_checked_distance(file, i, j, source) for j in anchored for i in anchored if i < j]
    # least accurate are robots that are very near to each other, and those that have a long way
    _check_accuracy(file, (min(distances), max(distances)), source)
    try:
        mission = file.mission
        return plan_of(robots, mission, file.planner, faults, area=mission.area, tolerates=mission.tolerates)
    except Unworkable as error:
        raise Unworkable(f"{source}: {error}") from None


def plan_of(
    robots: Sequence[RobotTable],
    mission: Mission,
    planner: PlannerTable,
    faults: Sequence[Fault],
    *,
    area: Area | None,
    tolerates: int,
) -> GroupMeetings:
    """Return all meetings of a group, and the sweep of `area` or the confirming visits. Raises Unworkable."""
    anchored = [robot for robot in robots if robot.anchor is not None]
    meetings = group_meetings(anchored, mission, planner, faults, tolerates=tolerates)
    if tolerates and len(anchored) == len(robots):
        return with_confirmation(robots, mission, meetings, faults, tolerates)
    return with_sweep(robots, area, mission, meetings, tolerates=tolerates)


def pair_meetings(file: ScenarioFile, source: str) -> dict[str, FirstMeeting]:
    """Return the meeting of each robot with its peer. Raises BadScenario and Unworkable."""
    peers = _peers(file.robot, source)
    place = {robot.id: i for i, robot in enumerate(file.robot)}
    found: dict[str, FirstMeeting] = {}
    for i, robot in enumerate(file.robot):
        peer = peers[robot.id]
        if i < place[peer]:
            orbits = _plan(file, i, place[peer], source)
            found[robot.id], found[peer] = (
                FirstMeeting(peer, "a", orbits),
                FirstMeeting(robot.id, "b", orbits),
            )
    return found


def linked(
    robots: Sequence[RobotTable], first: Mapping[str, FirstMeeting], *, in_group: bool
) -> list[tuple[str, str]]:
    """Return the pairs of robots that can exchange reports, each in both orders."""
    if in_group:
        return list(permutations([robot.id for robot in robots], 2))
    return [(robot.id, first[robot.id].peer) for robot in robots]


def _plan(file: ScenarioFile, first: int, second: int, source: str) -> Rendezvous:
    """Return the rendezvous orbits of the pair of robots at the places `first` and `second` in the file."""
    distance = _checked_distance(file, first, second, source, "its peer ")
    _check_accuracy(file, (distance,), source)
    return planner_loader.orbits(file.planner.name, file.planner.options, file.mission, distance)


def _checked_distance(file: ScenarioFile, first: int, second: int, source: str, whose: str = "") -> float:
    """Return the distance in m of the anchors of two robots that may meet, given by their places in the file.

    `whose` says what the first robot is to the second. Raises BadScenario if the distance is too small, and
    Unworkable if they could not localise themselves.
    """
    one, other = file.robot[first], file.robot[second]
    assert one.anchor is not None
    assert other.anchor is not None
    distance = math.dist(one.anchor, other.anchor)
    if distance < NEAREST_ANCHORS:
        raise BadScenario(
            f"{source}: robot[{second}].anchor: less than {NEAREST_ANCHORS:g} m from the anchor of "
            f"{whose}'{one.id}'"
        )
    why = infeasibility(file.mission, distance)
    if why is not None:
        raise Unworkable(f"{source}: mission: {why}")
    return distance


def _check_accuracy(file: ScenarioFile, distances: Sequence[float], source: str) -> None:
    """Raise Unworkable if the noise forbids the accuracy of robots whose anchors are so far apart, in m.

    White noise averages out over many ranges: a pair may take them until `max_ticks`. In a group, robots
    wait for others that do so.
    """
    if file.mission.noise.exact:
        return
    # imports numpy, which scenarios with exact sensors do not need
    from agent.estimation.gaussian import reachable_accuracy as reachable  # noqa: PLC0415

    reasons = [reachable.forbidding_prior(file.mission, distance) for distance in distances]
    if in_group(file) and max(distances) >= file.mission.orienting_distance:
        searches = any(robot.anchor is None for robot in file.robot)
        active = reachable.ACTIVE_SEARCH if searches else reachable.ACTIVE
        reasons.append(reachable.unreachable(file.mission, max(distances), active))
    for why in reasons:
        if why is not None:
            raise Unworkable(f"{source}: mission.{why}")


def _check_ids(robots: Sequence[RobotTable], source: str) -> None:
    """Raise BadScenario if two robots have the same id."""
    for name, count in Counter(robot.id for robot in robots).items():
        if count > 1:
            raise BadScenario(f"{source}: robot.id: {count} robots have the id '{name}'")


def _peers(robots: list[RobotTable], source: str) -> dict[str, str]:
    """Return the peer of each robot. With two robots, each is the peer of the other by default."""
    _check_ids(robots, source)
    ids = [robot.id for robot in robots]
    if len(robots) == 2 and all(robot.peer is None for robot in robots):
        return {ids[0]: ids[1], ids[1]: ids[0]}
    peers = {}
    for i, robot in enumerate(robots):
        if robot.peer is None:
            raise BadScenario(
                f"{source}: robot[{i}].peer: '{robot.id}' needs a peer, because other robots have one; "
                "robots form a group if none of them has"
            )
        if robot.peer not in ids:
            near = did_you_mean(robot.peer, ids)
            raise BadScenario(f"{source}: robot[{i}].peer: there is no robot '{robot.peer}'{near}")
        peers[robot.id] = robot.peer
    for i, robot in enumerate(robots):
        if peers[robot.id] == robot.id or peers[peers[robot.id]] != robot.id:
            raise BadScenario(
                f"{source}: robot[{i}].peer: '{robot.id}' names '{robot.peer}', whose peer is "
                f"'{peers[peers[robot.id]]}'; robots must form pairs"
            )
    return peers
