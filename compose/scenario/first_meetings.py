"""The first meeting of each robot of a scenario file: with its peer, or as the group's plan has it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import permutations

from compose.errors import BadScenario, Unworkable
from compose.launch import planner_loader
from compose.scenario.group_confirmation import check_tolerated, with_confirmation
from compose.scenario.group_coverage import check_unanchored, with_coverage
from compose.scenario.group_meetings import FirstMeeting, GroupMeetings, group_meetings
from compose.scenario.scenario_tables import RobotTable, ScenarioFile
from compose.scenario.team_plan import is_team
from protocol.mission import infeasibility
from protocol.rounding import TOLERANCE
from protocol.spelling import did_you_mean
from world.faults import Fault

NEAREST_ANCHORS = TOLERANCE
"""The minimum distance in m of two anchors: nearer ones coincide at the accuracy of exact claims."""


def in_group(file: ScenarioFile) -> bool:
    """Return whether the robots form a group, and not pairs."""
    return len(file.robot) != 2 and all(robot.peer is None for robot in file.robot)


def linked(file: ScenarioFile) -> list[tuple[str, str]]:
    """Return the pairs of robots that can exchange reports, each in both orders. Raises BadScenario."""
    for name, count in Counter(robot.id for robot in file.robot).items():
        if count > 1:
            raise BadScenario(f"robot.id: {count} robots have the id '{name}'")
    if in_group(file) or is_team(file):
        return list(permutations([robot.id for robot in file.robot], 2))
    for i, robot in enumerate(file.robot):
        if robot.anchor is None:
            raise BadScenario(f"robot[{i}]: missing field 'anchor'")
    return list(_peers(file.robot).items())


def meetings_of(
    file: ScenarioFile, faults: Sequence[Fault], links: Sequence[tuple[str, str]]
) -> GroupMeetings:
    """Return the meetings of the group that the robots form; if they form pairs, only the first ones.

    `links` holds each pair of robots in both orders. Raises BadScenario and Unworkable.
    """
    robots, mission = file.robot, file.mission
    if is_team(file):
        return GroupMeetings((), {}, 0.0, (), 0.0, 0.0)
    if mission.survey or mission.diameter:
        name, what = ("survey", "[[anchor]]") if mission.survey else ("diameter", "mission.frame")
        raise BadScenario(f"mission.{name}: there is no {what} in the file")
    for i, robot in enumerate(robots):
        if robot.anchors is not None:
            raise BadScenario(f"robot[{i}].anchors: there is no [[anchor]] in the file")
    if len(robots) < 2:
        raise BadScenario("robot: one robot alone needs at least two [[anchor]]")
    if not in_group(file):
        if mission.tolerates:
            raise Unworkable("mission.tolerates: it is for groups, and the robots form pairs")
        return GroupMeetings((), _pair_meetings(file, links), 0.0, (), 0.0, 0.0)
    check_unanchored(file)
    anchored = [robot for robot in robots if robot.anchor is not None]
    if len(anchored) == len(robots):
        check_tolerated(file)
    places = [i for i, robot in enumerate(robots) if robot.anchor is not None]
    distances = [_checked_distance(file, i, j) for j in places for i in places if i < j]
    # least accurate are robots that are very near to each other, and those that have a long way
    _check_accuracy(file, (min(distances), max(distances)))
    meetings = group_meetings(anchored, mission, file.planner, faults, tolerates=mission.tolerates)
    if mission.tolerates and len(anchored) == len(robots):
        return with_confirmation(robots, mission, meetings, faults, mission.tolerates)
    return with_coverage(robots, mission.area, mission, meetings, tolerates=mission.tolerates)


def _pair_meetings(file: ScenarioFile, links: Sequence[tuple[str, str]]) -> dict[str, FirstMeeting]:
    """Return the meeting of each robot with its peer. Raises BadScenario and Unworkable."""
    found: dict[str, FirstMeeting] = {}
    place = {robot.id: i for i, robot in enumerate(file.robot)}
    for robot, peer in links:
        if place[robot] < place[peer]:
            distance = _checked_distance(file, place[robot], place[peer], "its peer ")
            _check_accuracy(file, (distance,))
            planner = file.planner
            orbits = planner_loader.orbits(planner.name, planner.options, file.mission, distance)
            found[robot] = FirstMeeting(peer, "a", orbits)
            found[peer] = FirstMeeting(robot, "b", orbits)
    return found


def _checked_distance(file: ScenarioFile, first: int, second: int, whose: str = "") -> float:
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
            f"robot[{second}].anchor: less than {NEAREST_ANCHORS:g} m from the anchor of {whose}'{one.id}'"
        )
    why = infeasibility(file.mission, distance)
    if why is not None:
        raise Unworkable(f"mission: {why}")
    return distance


def _check_accuracy(file: ScenarioFile, distances: Sequence[float]) -> None:
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
            raise Unworkable(f"mission.{why}")


def _peers(robots: list[RobotTable]) -> dict[str, str]:
    """Return the peer of each robot. With two robots, each is the peer of the other by default."""
    ids = [robot.id for robot in robots]
    if len(robots) == 2 and all(robot.peer is None for robot in robots):
        return {ids[0]: ids[1], ids[1]: ids[0]}
    peers = {}
    for i, robot in enumerate(robots):
        if robot.peer is None:
            raise BadScenario(
                f"robot[{i}].peer: '{robot.id}' needs a peer, because other robots have one; "
                "robots form a group if none of them has"
            )
        if robot.peer not in ids:
            near = did_you_mean(robot.peer, ids)
            raise BadScenario(f"robot[{i}].peer: there is no robot '{robot.peer}'{near}")
        peers[robot.id] = robot.peer
    for i, robot in enumerate(robots):
        if peers[robot.id] == robot.id or peers[peers[robot.id]] != robot.id:
            raise BadScenario(
                f"robot[{i}].peer: '{robot.id}' names '{robot.peer}', whose peer is "
                f"'{peers[peers[robot.id]]}'; robots must form pairs"
            )
    return peers
