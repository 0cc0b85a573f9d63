"""Where every robot is. Any number of them, in the order of the scenario."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.messages import Drive
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
    legs: tuple[Leg | None, ...] = ()
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
        legs = tuple(map(_onward, self.legs or (None,) * len(self.local), self.local, controls))
        local = [step(leg.begin, leg.controls.v, leg.controls.omega, leg.ticks * period) for leg in legs]
        return Truth(self.tick + 1, tuple(local), self.origins, legs)


def _onward(leg: Leg | None, pose: Pose, controls: Controls) -> Leg:
    """Return the leg of a robot that is at `pose` after `leg`, and drives `controls` for a tick."""
    if leg is not None and leg.controls == controls:
        return Leg(leg.begin, leg.ticks + 1, controls)
    return Leg(pose, 1, controls)


def asked(drive: Drive | None, mission: Mission) -> Controls:
    """The command that a Drive gives: it saturates at v_max and omega_max; without a Drive it is to rest."""
    if drive is None:
        return REST
    return Controls(
        min(max(drive.v, -mission.max_speed), mission.max_speed),
        min(max(drive.omega, -mission.max_turn_rate), mission.max_turn_rate),
    )
