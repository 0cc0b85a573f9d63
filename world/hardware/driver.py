"""The contract of a driver: the interface to the wheels and sensors of one robot, in hardware mode.

In hardware mode, `world/hardware/bridge.py` takes the place of the simulator. It makes Observations from what
the driver measures, and executes Commands with it, so an agent works in the same way in both modes. See
docs/driver.md for a guide. `tandem check-driver` tests a driver against this contract.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import msgspec

from protocol.messages import Estimate
from protocol.motion import Controls

THINKING = 0.25
"""The duration of the rest in each tick, for measurements, Reports and the decision, as a fraction of T_s."""
SENSING = 0.1
"""The maximum duration of `sense`, as a fraction of T_s. The rest of THINKING is for the decision."""


class Reading(msgspec.Struct, frozen=True):
    """The measurements of one robot at rest, between two manoeuvres."""

    executed: Controls
    """The measured motion since the previous reading, in m/s and rad/s; ignored at tick 0.

    These are the constant velocities that lead from the previous to the current pose in T_s, by `step`
    (protocol/motion.py).
    """
    anchor_range: float | None = None
    """The current range to the robot's own anchor, in m; None beyond R, and for a drop-out."""
    mutual_range: float | None = None
    """The range to the peer, in m, measured in this tick with both robots at rest; None as for the anchor."""
    contact: bool = False
    """True if the peer is within range without a measured range. A measured range always is a contact."""
    mark: tuple[float, ...] = ()
    """The numbers that `resume` gets after a restart, such as the odometer's values at this reading."""
    mutual_ranges: Mapping[str, float | None] = {}
    """The range to each robot within range, in m, by its id; None for a contact without a measured range.

    A driver for groups returns these; one for pairs may, in place of `mutual_range` and `contact`, which are
    about the peer in the RobotConfig.
    """
    anchors: Mapping[str, float | None] = {}
    """The range to each anchor of a team, in m, by its name; absent or None where none was measured."""


class Driver(Protocol):
    """The driver of one robot.

    Its constructor takes the RobotConfig, the duration of a manoeuvre in s, and the user's options as keyword
    arguments (strings). All calls come from one thread. A driver has to obey two laws:

    - The robot only moves after `drive`, for at most one manoeuvre. It then rests until the next call, even
      if the calling process has ended.
    - A manoeuvre that is not interrupted satisfies `step(before, v, omega, T_s) = after` within the mission's
      noise.
    """

    def sense(self, tick: int) -> Reading:
        """Return the measurements at `tick` (0, 1, 2, ...), within SENSING of a manoeuvre's duration.

        A range within R may only be missing if the mission has drop-outs: otherwise it means out of range.
        Raise any exception if a measurement fails. This ends the mission of this robot.
        """

    def drive(self, v: float, omega: float) -> None:
        """Start a manoeuvre with `v` m/s and `omega` rad/s, and return at once. The robot stops by itself."""

    def stop(self) -> None:
        """Stop the robot now. This is always called at the end, and may be called several times."""

    def close(self) -> None:
        """Release the hardware. This is the last call."""


class Resumable(Driver, Protocol):
    """A driver that can resume a mission after its process was killed."""

    def resume(self, tick: int, mark: tuple[float, ...]) -> None:
        """Continue after the recorded reading of `tick`, whose mark is `mark`.

        This is called once after a restart, after `stop` and before the first `sense`. A later reading is not
        in the recording and has to be repeated: the next `executed` is the motion since the recorded one.
        """


class Reporting(Driver, Protocol):
    """A driver that publishes what its robot knows, such as to the robot's navigation."""

    def estimated(self, estimate: Estimate) -> None:
        """Take the Estimate of the agent for a tick, mostly between `sense` and `drive` of that tick.

        It may be late or missing, as a Command may. An exception ends the mission of this robot.
        """
