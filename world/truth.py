"""The true poses of all robots, in the order of the scenario."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from protocol.messages import Command
from protocol.mission import Anchor, Mission
from protocol.motion import REST, Controls, Pose, step


class Leg(msgspec.Struct, frozen=True, gc=False):
    """The sequence of equal manoeuvres that a robot is driving."""

    begin: Pose
    """The pose at its beginning, relative to the same origin as in Truth: m, m and rad."""
    ticks: int
    """The number of ticks so far."""
    controls: Controls
    """The executed velocities, in m/s and rad/s."""


class Truth(msgspec.Struct, frozen=True):
    """The true poses at one tick.

    Poses are stored relative to the anchor of robot a of the pair, so that rounding errors do not depend on
    the position of the anchors in <W>.
    """

    tick: int
    """The tick k."""
    local: tuple[Pose, ...]
    """The pose of each robot relative to its element of `origins`, with the axes of <W>: m, m and rad."""
    origins: tuple[Anchor, ...]
    """The position of the anchor of the pair's robot a, for each robot, in <W>."""
    legs: tuple[Leg, ...] = ()
    """The current leg of each robot; empty at tick 0.

    Equal manoeuvres are computed as one arc, so that rounding errors do not grow with their number.
    """

    @property
    def poses(self) -> tuple[Pose, ...]:
        """The pose of each robot in <W>: m, m and rad."""
        return tuple(
            Pose(origin.x + pose.x, origin.y + pose.y, pose.heading)
            for origin, pose in zip(self.origins, self.local, strict=True)
        )

    def before(self, delay: float) -> tuple[Pose, ...]:
        """Return the poses `delay` s ago, at most one tick, in the same frames as `local`.

        Before tick 0, the robots were at rest.
        """
        if not delay or not self.legs:
            return self.local
        return tuple(
            [
                step(pose, -leg.controls.v, -leg.controls.omega, delay)
                for pose, leg in zip(self.local, self.legs, strict=True)
            ]
        )

    def moved(self, controls: Sequence[Controls], period: float) -> Truth:
        """Return the truth one tick later, after all robots have driven `controls` for `period` s."""
        legs: list[Leg] = []
        local: list[Pose] = []
        before = self.legs or (None,) * len(self.local)
        for leg, pose, driven in zip(before, self.local, controls, strict=True):
            begin, ticks = pose, 1
            if leg is not None and leg.controls == driven:
                begin, ticks = leg.begin, leg.ticks + 1
            legs.append(Leg(begin, ticks, driven))
            local.append(step(begin, driven.v, driven.omega, ticks * period))
        return Truth(self.tick + 1, tuple(local), self.origins, tuple(legs))


def limited_controls(command: Command | None, mission: Mission) -> Controls:
    """Return the controls of `command`, limited to v_max and omega_max; REST for None."""
    if command is None:
        return REST
    v, omega = command.v, command.omega
    if abs(v) <= mission.max_speed and abs(omega) <= mission.max_turn_rate:  # four times as fast
        return Controls(v, omega)
    return Controls(
        min(max(v, -mission.max_speed), mission.max_speed),
        min(max(omega, -mission.max_turn_rate), mission.max_turn_rate),
    )
