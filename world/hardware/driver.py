"""The contract of a robot's own driver: wheels and sensors of one robot, in the world's place.

What the world is to a robot, its hardware is without one: from both come Observations, to both go Commands, and an
agent cannot tell which it has. So the contract stands in this room, and `world/hardware/bridge.py` plays by
it. docs/driver.md tells a driver's author the same at length, and `tandem check-driver` tries a driver.
"""

from __future__ import annotations

from typing import Protocol

import msgspec

from protocol.motion import Controls

THINKING = 0.25
"""of T_s: by how much a tick lasts longer than its manoeuvre, for sensing, hearing and deciding at rest"""
SENSING = 0.1
"""of T_s: how long `observation` may take, so that there is time left to decide"""


class Reading(msgspec.Struct, frozen=True):
    """What one robot's sensors say, standing, between two manoeuvres."""

    executed: Controls
    """m/s and rad/s: what it drove since the reading before, as it was measured, as if held for T_s: `step`
    of it (protocol/motion.py) leads from where it stood to where it stands. At tick 0 nobody looks at it"""
    anchor_range: float | None = None
    """m, to its own anchor, now; none beyond R, or of a drop-out, if the mission has any"""
    mutual_range: float | None = None
    """m, to its peer, measured while both stood in this same tick; else none, as above"""
    contact: bool = False
    """whether the peer is near though no range was had; a range is a contact anyway"""
    mark: tuple[float, ...] = ()
    """numbers that are handed to `resume`, such as the odometer's at this reading"""


class Driver(Protocol):
    """Made of the robot's RobotConfig, the seconds that a manoeuvre lasts, and the user's options, as strings.

    The laws: a robot moves only by `command`, for one manoeuvre at the most, and then stands until told
    otherwise, whatever becomes of whoever told it; over a manoeuvre that was not interrupted,
    `step(before, v, omega, T_s) = after`, within the mission's noise. One thread calls.
    """

    def sense(self, tick: int) -> Reading:
        """What the sensors say in `tick`, which counts 0, 1, 2, ...; within SENSING of a manoeuvre.

        What could not be measured is none only where the mission has drop-outs: otherwise silence is a fact.
        Raises any exception if it cannot tell; then the mission is over for this robot.
        """

    def drive(self, v: float, omega: float) -> None:
        """Begin a manoeuvre: hold `v` m/s and `omega` rad/s from now, then stand. Returns at once."""

    def stop(self) -> None:
        """Stand still now. It comes at the end, too, whatever that was; and it may come twice."""

    def close(self) -> None:
        """Let go of the hardware; nothing comes after that."""


class Resumable(Driver, Protocol):
    """A driver that goes on from a record after its process was killed; without `resume` none can."""

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:
        """Comes once after a restart, after `stop` and before the first `observation`.

        The latest reading on record is that of `tick`, and carried `mark`. One that was taken after it is
        lost, and is taken again: the next `executed` is what was driven since the reading on record.
        """
