"""The static part of what there is to see: who plays, where the anchors stand, what can be sensed."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from protocol.attack import Attack
from protocol.messages import RobotConfig
from protocol.mission import Anchor, Mission, PlannerName, Role
from protocol.motion import Pose
from protocol.orbits import Orbit
from protocol.units import RobotId, Tick
from world.faults import Fault
from world.scenario import Scenario


class Seat(msgspec.Struct, frozen=True):
    """One robot: its part, and its places."""

    id: RobotId
    peer: RobotId
    role: Role
    anchor: Anchor
    orbit: Orbit
    attack: Attack | None = None
    """what it is told to tell its peer instead of the truth"""
    frame: Pose | None = None
    """that of its own anchor, in the world's: the x-axis leads from the anchor to where the robot was
    released. None where that is not known. Its heading is nothing that the robot knows before it is
    localised, so a picture of what the robot knows may turn the frame about the anchor as it likes"""


class Stage(msgspec.Struct, frozen=True):
    """A run, before it begins."""

    name: str
    """of the scenario; where only robots tell of it, of the run"""
    robots: tuple[Seat, ...]
    mission: Mission
    planner_name: PlannerName
    t_max_s: float
    """T_max, the longest of all pairs"""
    max_ticks: Tick | None = None
    """like what follows, only where the world's journal is there"""
    seed: int | None = None
    mode: str | None = None
    """how it was played: "processes", "in-process"; none where that is not known"""
    tick_s: float | None = None
    """s of wall time that a tick lasts; none in lockstep"""
    faults: tuple[Fault, ...] = ()

    @property
    def ids(self) -> tuple[str, ...]:
        """Of the robots, in their order."""
        return tuple([seat.id for seat in self.robots])

    def seat(self, robot: str) -> Seat:
        """Raises KeyError if nobody is called that."""
        for seat in self.robots:
            if seat.id == robot:
                return seat
        raise KeyError(robot)

    def pairs(self) -> tuple[tuple[Seat, Seat], ...]:
        """Those of which both are known; a first."""
        known = {seat.id: seat for seat in self.robots}
        return tuple([(one, known[one.peer]) for one in self.robots if one.role == "a" and one.peer in known])


def of_scenario(scenario: Scenario, mode: str | None = None, tick_s: float | None = None) -> Stage:
    """As the world's journal tells it."""
    return Stage(
        name=scenario.name,
        robots=tuple(
            [
                Seat(
                    robot.id,
                    robot.peer,
                    robot.role,
                    robot.anchor,
                    robot.rendezvous.of(robot.role),
                    robot.attack,
                    frame(robot.anchor, robot.start),
                )
                for robot in scenario.robots
            ]
        ),
        mission=scenario.mission,
        planner_name=scenario.planner_name,
        t_max_s=max(robot.rendezvous.bound for robot in scenario.robots),
        max_ticks=scenario.max_ticks,
        seed=scenario.seed,
        mode=mode,
        tick_s=tick_s,
        faults=scenario.faults,
    )


def of_briefings(name: str, briefings: Mapping[str, RobotConfig]) -> Stage:
    """As the robots were told it; there must be one at least."""
    told = list(briefings.values())
    return Stage(
        name=name,
        robots=tuple(
            [
                Seat(one.robot, one.peer, one.role, one.anchor, one.rendezvous.of(one.role), one.attack)
                for one in told
            ]
        ),
        mission=told[0].mission,
        planner_name=told[0].planner_name,
        t_max_s=max(one.rendezvous.bound for one in told),
        tick_s=told[0].tick_s,
    )


def frame(anchor: Anchor, start: Pose) -> Pose:
    """The frame of `anchor` for a robot that is released at `start`, in the world's."""
    return Pose(anchor.x, anchor.y, math.atan2(start.y - anchor.y, start.x - anchor.x))
