"""The meetings of a group of robots: who visits whom, and the bound of the time until all are localised."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from compose.errors import Unworkable
from compose.launch import planner_loader
from compose.scenario.group_plan import group_plan
from compose.scenario.scenario_tables import PlannerTable, RobotTable
from protocol.mission import Mission, Role
from protocol.orbits import Rendezvous, meeting_ticks, pair_ticks, visiting
from world.scenario import PlannedMeeting

PLANNERS = ("assured",)
"""The planners with which robots can form a group."""

NEIGHBOURS = 3
"""The number of nearest anchors among which a robot's first peer is chosen, in a large group."""

LARGE = 12
"""The number of robots from which on a group is large."""


class FirstMeeting(NamedTuple):
    """The first meeting of a robot."""

    peer: str
    role: Role
    rendezvous: Rendezvous


class GroupMeetings(NamedTuple):
    """The meetings of a group."""

    planned: tuple[PlannedMeeting, ...]
    """All meetings, in the order in which they end."""
    first: dict[str, FirstMeeting]
    """The first meeting of each robot."""
    bound: float
    """The bound in s of the time at which all robots are localised."""


def group_meetings(robots: Sequence[RobotTable], mission: Mission, planner: PlannerTable) -> GroupMeetings:
    """Return the meetings of `robots`, planned for the shortest bound.

    Raises Unworkable if the planner is not made for groups.
    """
    if planner.name not in PLANNERS:
        raise Unworkable(
            f"planner.name: robots with the planner {planner.name} meet in pairs: set robot.peer"
        )
    anchors, ids = [robot.anchor for robot in robots], [robot.id for robot in robots]
    near = _neighbours(anchors)

    def rendezvous(i: int, j: int) -> Rendezvous:
        return planner_loader.orbits(
            planner.name, planner.options, mission, math.dist(anchors[i], anchors[j])
        )

    def pair_time(i: int, j: int) -> float:
        if len(robots) >= LARGE and j not in near[i]:
            return math.inf
        return pair_ticks(mission, rendezvous(i, j)) * mission.period

    plan = group_plan(anchors, pair_time, mission.max_speed, meeting_ticks(mission) * mission.period)
    planned = tuple([PlannedMeeting(ids[one.visitor], ids[one.visited], one.ends) for one in plan.meetings])
    first: dict[str, FirstMeeting] = {}
    for one in plan.meetings:
        a, b = ids[one.visitor], ids[one.visited]
        if a in first:
            orbits = visiting(mission, math.dist(anchors[one.visitor], anchors[one.visited]))
        else:
            orbits = rendezvous(one.visitor, one.visited)
            first[a] = FirstMeeting(b, "a", orbits)
        first[b] = FirstMeeting(a, "b", orbits)
    return GroupMeetings(planned, first, plan.bound)


def _neighbours(anchors: Sequence[tuple[float, float]]) -> list[set[int]]:
    """Return the NEIGHBOURS nearest anchors of each anchor."""
    return [
        set(sorted(range(len(anchors)), key=lambda j: math.dist(one, anchors[j]))[1 : NEIGHBOURS + 1])
        for one in anchors
    ]
