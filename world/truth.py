"""Where every robot is. Any number of them, in the order of the scenario."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.messages import Command
from protocol.mission import Anchor, Mission
from protocol.motion import REST, Controls, Pose, step


class Leg(msgspec.Struct, frozen=True, gc=False):
    """Equal manoeuvres of one robot, so far."""

    begin: Pose
    ticks: int
    controls: Controls


class Truth(msgspec.Struct, frozen=True):
    """The true state at one tick.

    It is kept relative to the anchor of each pair's a, so that where in the plane the anchors stand
    costs no digits.
    """

    tick: int
    local: tuple[Pose, ...]
    """relative to `origins`; the axes are the world's"""
    origins: tuple[Anchor, ...]
    legs: tuple[Leg, ...] = ()
    """what led each robot there: equal manoeuvres are one arc, so rounding does not grow with their number"""

    @property
    def poses(self) -> tuple[Pose, ...]:
        """In the world frame."""
        return tuple(
            Pose(origin.x + pose.x, origin.y + pose.y, pose.heading)
            for origin, pose in zip(self.origins, self.local, strict=True)
        )

    def moved(self, controls: Sequence[Controls], period: float) -> Truth:
        """Where everyone is one tick later, having driven `controls`."""
        legs: list[Leg] = []
        local: list[Pose] = []
        before = self.legs or [Leg(pose, 0, c) for pose, c in zip(self.local, controls, strict=True)]
        for leg, pose, c in zip(before, self.local, controls, strict=True):
            begin, ticks = (leg.begin, leg.ticks + 1) if leg.controls == c else (pose, 1)
            legs.append(Leg(begin, ticks, c))
            local.append(step(begin, c.v, c.omega, ticks * period))
        return Truth(self.tick + 1, tuple(local), self.origins, tuple(legs))


def asked(command: Command | None, mission: Mission) -> Controls:
    """The command that a Command gives: it saturates at v_max and omega_max; without a Command it is to rest."""
    if command is None:
        return REST
    return Controls(
        min(max(command.v, -mission.max_speed), mission.max_speed),
        min(max(command.omega, -mission.max_turn_rate), mission.max_turn_rate),
    )
