"""Where every robot is. Any number of them, in the order of the scenario."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.messages import Drive
from protocol.mission import Anchor, Mission
from protocol.motion import REST, Controls, Pose, step


class Truth(msgspec.Struct, frozen=True):
    """The true state at one tick.

    It is kept relative to the anchor of each pair's a, so that where in the plane the anchors stand
    costs no digits.
    """

    tick: int
    local: tuple[Pose, ...]
    """relative to `origins`; the axes are the world's"""
    origins: tuple[Anchor, ...]

    @property
    def poses(self) -> tuple[Pose, ...]:
        """In the world frame."""
        return tuple(
            Pose(origin.x + pose.x, origin.y + pose.y, pose.heading)
            for origin, pose in zip(self.origins, self.local, strict=True)
        )

    def moved(self, controls: Sequence[Controls], period: float) -> Truth:
        """Where everyone is one tick later, having driven `controls`."""
        return Truth(
            self.tick + 1,
            tuple([step(pose, c.v, c.omega, period) for pose, c in zip(self.local, controls, strict=True)]),
            self.origins,
        )


def asked(drive: Drive | None, mission: Mission) -> Controls:
    """The command that a Drive gives: it saturates at v_max and omega_max; without a Drive it is to rest."""
    if drive is None:
        return REST
    return Controls(
        min(max(drive.v, -mission.max_speed), mission.max_speed),
        min(max(drive.omega, -mission.max_turn_rate), mission.max_turn_rate),
    )
