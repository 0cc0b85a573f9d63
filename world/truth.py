"""Where every robot is. Any number of them, in the order of the scenario."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.mission import Mission
from protocol.motion import Controls, Pose, step


class Truth(msgspec.Struct, frozen=True):
    """The true state at one tick."""

    tick: int
    poses: tuple[Pose, ...]

    def moved(self, controls: Sequence[Controls], period: float) -> Truth:
        """Where everyone is one tick later, having driven `controls`."""
        return Truth(
            self.tick + 1,
            tuple([step(pose, c.v, c.omega, period) for pose, c in zip(self.poses, controls, strict=True)]),
        )


def within_limits(v: float, omega: float, mission: Mission) -> Controls:
    """What the actuators make of a command: they saturate at v_max and omega_max."""
    return Controls(
        min(max(v, -mission.max_speed), mission.max_speed),
        min(max(omega, -mission.max_turn_rate), mission.max_turn_rate),
    )
