"""What the world is told before it starts: the mission, and who is where. Its journal begins with it."""

from __future__ import annotations

import msgspec

from protocol.attack import Attack
from protocol.messages import RobotConfig
from protocol.mission import Anchor, Mission, PlannerName, Role
from protocol.motion import Pose
from protocol.orbits import Rendezvous
from protocol.units import RobotId, Tick
from world.faults import Fault


class RobotSpec(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One robot: whom it is to find, which anchor ranges it, and where it is released."""

    id: RobotId
    peer: RobotId
    role: Role
    anchor: Anchor
    start: Pose
    rendezvous: Rendezvous
    attack: Attack | None = None


class Scenario(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="scenario"):
    """A validated mission, complete: nothing in it is left to be drawn or worked out."""

    name: str
    seed: int
    max_ticks: Tick
    mission: Mission
    planner_name: PlannerName
    robots: tuple[RobotSpec, ...]
    faults: tuple[Fault, ...] = ()
    """of the radio"""

    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Which robots are each other's peer, by their place; a first."""
        place = {robot.id: i for i, robot in enumerate(self.robots)}
        return tuple((place[one.id], place[one.peer]) for one in self.robots if one.role == "a")

    def robot(self, robot: str) -> RobotSpec:
        """Raises KeyError if nobody is called that."""
        for placed in self.robots:
            if placed.id == robot:
                return placed
        raise KeyError(robot)

    def is_of(self, config: RobotConfig) -> bool:
        """Whether that is what one of its robots is told, be it in real time or in lockstep."""
        known = any(placed.id == config.robot for placed in self.robots)
        return known and self.config(config.robot, config.tick_s) == config

    def config(self, robot: str, tick_s: float | None = None) -> RobotConfig:
        """What `robot` is told; nothing of where it is. `tick_s` is set in real time only."""
        own = self.robot(robot)
        return RobotConfig(
            robot=own.id,
            peer=own.peer,
            role=own.role,
            anchor=own.anchor,
            peer_anchor=self.robot(own.peer).anchor,
            mission=self.mission,
            planner_name=self.planner_name,
            rendezvous=own.rendezvous,
            attack=own.attack,
            tick_s=tick_s,
        )
