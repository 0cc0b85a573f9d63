"""The static data of a run: its robots, anchors and orbits, and the mission parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from protocol.attack import Attack
from protocol.coverage_strips import SweptArea
from protocol.messages import Command, RobotConfig, TeamAnchor
from protocol.mission import Anchor, Mission, PlannerName, Role
from protocol.motion import Pose
from protocol.orbits import RENDEZVOUS, Orbit
from protocol.units import RobotId, Tick
from world.faults import Fault
from world.scenario import RobotSpec, Scenario


class RobotSetup(msgspec.Struct, frozen=True):
    """One robot: its role, peer, anchor and orbit. In a group, they are those of its first meeting.

    A robot of a team has none of them.
    """

    id: RobotId
    peer: RobotId | None = None
    role: Role | None = None
    given_anchor: Anchor | None = msgspec.field(name="anchor", default=None)
    """The anchor of the robot; None if it has none, as some robots of a group."""
    given_orbit: Orbit | None = msgspec.field(name="orbit", default=None)
    attack: Attack | None = None
    """The false data injection that the scenario configures for this robot."""
    frame: Pose | None = None
    """The pose of the robot's anchor frame in the world frame, in m and rad.

    The x-axis points from the anchor to the robot's start. None if the start is not known. A robot does
    not know this heading before it is localised, so a picture of its belief may use any heading.
    """
    own_planner: bool = False
    """True if the phases and states of its Commands are those of a planner of the user.

    They have names and sentences only if the planner is a shipped one, or decides in the meetings of a group.
    """

    @property
    def anchor(self) -> Anchor:
        """The position of its anchor in <W>, in m. Raises LookupError if it has none."""
        if self.given_anchor is None:
            raise LookupError(f"{self.id} has no anchor")
        return self.given_anchor

    @property
    def orbit(self) -> Orbit:
        """The orbit of the robot. Raises LookupError if it has none."""
        if self.given_orbit is None:
            raise LookupError(f"{self.id} has no orbit")
        return self.given_orbit


class AnchorSetup(msgspec.Struct, frozen=True):
    """One anchor of a team."""

    id: RobotId
    position: Anchor | None
    """The position that the robots are told, in m; None if they know none."""
    sigma: float
    """The standard deviation of each coordinate of `position` in m; 0 if it is surveyed."""
    place: Anchor | None = None
    """The true position in m; None without the world's journal."""


class Visit(msgspec.Struct, frozen=True):
    """A planned meeting of a group: the robot of role a, and that of role b."""

    visitor: RobotId
    visited: RobotId
    ends_s: float
    """The planned bound in s of the time at which both are localised."""


class PresentMeeting(NamedTuple):
    """The meeting that a robot of a group is in, or on its way to."""

    peer: RobotId
    role: Role
    """The role of the robot in it."""


ESTIMATED = "estimate"
"""The mode of an estimate from recorded ranges, which is no run."""
Meetings = Mapping[RobotId, PresentMeeting]
"""The latest meeting of each robot of which one is known."""


def meetings_after(meetings: Meetings, commands: Mapping[RobotId, Command]) -> Meetings:
    """Return the latest meetings in the tick of `commands`; `meetings` are those of the tick before."""
    new = {
        robot: PresentMeeting(command.peer, command.role)
        for robot, command in commands.items()
        if command.peer is not None and command.role is not None
    }
    return meetings if all(meetings.get(robot) == one for robot, one in new.items()) else {**meetings, **new}


class RunSetup(msgspec.Struct, frozen=True, dict=True):
    """The static data of a run, known before its first tick."""

    name: str
    """The name of the scenario, or, in hardware mode, of the run."""
    robots: tuple[RobotSetup, ...]
    mission: Mission
    planner_name: PlannerName
    t_max_s: float
    """The time bound T_max in s, the largest of all pairs."""
    max_ticks: Tick | None = None
    """The tick limit of the mission. None, like all fields below, without the world's journal."""
    seed: int | None = None
    mode: str | None = None
    """The launch mode, "processes" or "in-process", or ESTIMATED; None if unknown."""
    tick_s: float | None = None
    """The wall-clock duration of a tick in s; None in lockstep."""
    faults: tuple[Fault, ...] = ()
    visits: tuple[Visit, ...] = ()
    """The meetings of a group, in the order in which they are planned to end; empty for pairs."""
    sweep: SweptArea | None = None
    """The area in which robots without an anchor are; None if all robots have one."""
    team: bool = False
    """True if the robots share all measurements: they form neither pairs nor a group."""
    anchors: tuple[AnchorSetup, ...] = ()
    """The anchors of a team."""
    origin: RobotId | None = None
    """The robot of a team whose pose at tick 0 is the origin of <W>; None if anchors determine <W>."""

    @property
    def in_pairs(self) -> bool:
        """True if the robots form pairs, and neither a group nor a team."""
        return not self.visits and not self.team

    @property
    def anchored(self) -> tuple[RobotSetup, ...]:
        """The robots that have an anchor."""
        return tuple([robot for robot in self.robots if robot.given_anchor is not None])

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the robots, in scenario order."""
        return tuple([robot.id for robot in self.robots])

    def position_of(self, anchor: str) -> Anchor | None:
        """Return the position of an anchor of a team as robots know it; None if it is not known."""
        return next((one.position for one in self.anchors if one.id == anchor), None)

    def robot_setup(self, robot: str) -> RobotSetup:
        """Return the setup of `robot`. Raises KeyError if there is no such robot."""
        for one in self.robots:
            if one.id == robot:
                return one
        raise KeyError(robot)

    def pairs(self) -> tuple[tuple[RobotSetup, RobotSetup], ...]:
        """Return the pairs whose robots are both known, as (robot of role a, robot of role b).

        In a group, these are the robots that are each other's peers: with `in_meetings`, at present.
        """
        known = {one.id: one for one in self.robots}
        return tuple(
            [
                (one, known[one.peer])
                for one in self.robots
                if one.role == "a"
                and one.peer in known
                and (not self.visits or known[one.peer].peer == one.id)
            ]
        )

    def links(self) -> tuple[tuple[RobotSetup, RobotSetup], ...]:
        """Return all pairs that meet during the run: in a group those of each meeting, in a team any two."""
        if self.team:
            return tuple(combinations(self.robots, 2))
        known = {one.id: one for one in self.robots}
        met = [
            (known[one.visitor], known[one.visited])
            for one in self.visits
            if {one.visitor, one.visited} <= known.keys()
        ]
        return tuple(met) if self.visits else self.pairs()

    @cached_property
    def bounds_s(self) -> dict[RobotId, float]:
        """The planned bound in s of the time at which each robot of a group is localised; empty for pairs."""
        found: dict[RobotId, float] = {}
        if self.sweep is not None:
            found = {robot.id: self.t_max_s for robot in self.robots if robot.given_anchor is None}
        for visit in self.visits:
            for robot in (visit.visitor, visit.visited):
                found.setdefault(robot, visit.ends_s)
        return found

    def in_meetings(self, meetings: Meetings) -> RunSetup:
        """Return this setup with the peer and the role that each robot has in its meeting.

        A robot that is not in the mission, or that meets one which is not, changes nothing.
        """
        ids = {*self.ids}
        robots = [
            replace(one, peer=meeting.peer, role=meeting.role)
            if (meeting := meetings.get(one.id)) and meeting.peer in ids and meeting.peer != one.id
            else one
            for one in self.robots
        ]
        return replace(self, robots=tuple(robots)) if meetings else self


def of_scenario(scenario: Scenario, mode: str | None = None) -> RunSetup:
    """Return the static data that the world's journal holds; the launch `mode` is not part of it."""
    team, planned = scenario.team, scenario.planned_sweep
    own_planner = scenario.planner_name not in RENDEZVOUS and not scenario.meetings
    return RunSetup(
        name=scenario.name,
        robots=tuple([_robot(one.id, one, one.start, own_planner=own_planner) for one in scenario.robots]),
        mission=scenario.mission,
        planner_name=scenario.planner_name,
        t_max_s=_bound(scenario),
        max_ticks=scenario.max_ticks,
        seed=scenario.seed,
        mode=mode,
        faults=scenario.faults,
        visits=tuple([Visit(one.visitor, one.visited, one.ends) for one in scenario.meetings]),
        sweep=planned.sweep if planned is not None else None,
        team=team is not None,
        anchors=tuple([_anchor(one.told, one.place) for one in team.anchors]) if team is not None else (),
        origin=team.origin if team is not None else None,
    )


def _anchor(told: TeamAnchor, place: Anchor | None = None) -> AnchorSetup:
    return AnchorSetup(told.id, told.position, told.sigma, place)


def _bound(scenario: Scenario) -> float:
    """Return the bound T_max in s: that of the group or the team, or the largest of all pairs."""
    if scenario.team is not None:
        return scenario.team.bound
    if (planned := scenario.confirmation or scenario.planned_sweep) is not None:
        return planned.ends
    return max(
        [one.ends for one in scenario.meetings] or [robot.rendezvous.bound for robot in scenario.robots]
    )


def of_configs(name: str, configs_by_robot: Mapping[str, RobotConfig]) -> RunSetup:
    """Return the static data that the robots' configurations hold.

    `configs_by_robot` maps robot ids to configurations and must not be empty.
    """
    configs = list(configs_by_robot.values())
    first, team = configs[0], configs[0].team
    visits = _visits(configs) if team is None else []
    waiting = [one for one in configs if one.given_anchor is None and team is None]
    bounds = [one.ends_s for one in visits] or [one.rendezvous.bound for one in configs if team is None]
    if waiting:
        bounds = [one.rendezvous.bound for one in waiting]
    own_planner = first.planner_name not in RENDEZVOUS and not visits
    return RunSetup(
        name=name,
        robots=tuple([_robot(one.robot, one, None, own_planner=own_planner) for one in configs]),
        mission=first.mission,
        planner_name=first.planner_name,
        t_max_s=team.bound if team is not None else max(bounds),
        tick_s=first.tick_s,
        visits=tuple(visits),
        sweep=waiting[0].sweep if waiting else None,
        team=team is not None,
        anchors=tuple(map(_anchor, team.anchors)) if team is not None else (),
        origin=team.origin if team is not None else None,
    )


def _robot(name: str, one: RobotSpec | RobotConfig, start: Pose | None, *, own_planner: bool) -> RobotSetup:
    """Return a robot; the frame of its anchor follows from its `start`, if that is known."""
    if (meeting := one.encounter) is None:
        return RobotSetup(name)
    at, orbit = one.given_anchor, meeting.rendezvous.of(meeting.role)
    own_frame = frame(at, start) if at is not None and start is not None else None
    return RobotSetup(name, meeting.peer, meeting.role, at, orbit, one.attack, own_frame, own_planner)


def _visits(configs: Sequence[RobotConfig]) -> list[Visit]:
    """Return the planned meetings in the configurations of a group."""
    found = [(one, one.peer) for one in configs if one.role == "a"]  # none without an anchor
    found += [(one, visited) for one in configs for visited in one.visits]
    visits = [
        Visit(one.robot, visited, one.member(visited).ends * one.mission.period)
        for one, visited in found
        if visited in {member.robot for member in one.members}
    ]
    return sorted(visits, key=lambda visit: visit.ends_s)


def frame(anchor: Anchor, start: Pose) -> Pose:
    """Return the anchor frame, as a pose in the world frame, of a robot that starts at `start`."""
    return Pose(anchor.x, anchor.y, math.atan2(start.y - anchor.y, start.x - anchor.x))
