"""The robot whose ticks another one counts, in hardware mode.

All robots must count the same ticks. Each sets its clock from the first robot, in the order of the mission,
that it hears: in a pair, b from a. If a robot falls silent, the next one takes its place without an
agreement, and no robot waits.
"""

from __future__ import annotations

import math

from protocol.messages import RobotConfig

UNHEARD = 4.0
"""The number of ticks within which a running robot sends a TickStart."""


class TickSource:
    """The robots before this one in the mission, and when each was heard."""

    def __init__(self, config: RobotConfig, tick_s: float) -> None:
        """`tick_s` is the duration of a tick in s of wall time."""
        self.joins = bool(config.members)
        """True if a robot that has not begun does so in the tick of any other one that has: in a group."""
        self._before = config.group[: config.group.index(config.robot)]
        self._unheard_s = UNHEARD * tick_s
        self._heard: dict[str, float] = {}
        """The time at which each of them was heard last, by the robot's clock."""

    @property
    def is_first(self) -> bool:
        """True if this robot is the first of the mission."""
        return not self._before

    def leads(self, robot: str, now: float) -> bool:
        """Return whether this one sets its clock from `robot`, unless it is only to catch up."""
        for one in self._before:
            if one == robot:
                return True
            if now - self._heard.get(one, -math.inf) < self._unheard_s:
                return False
        return False

    def hear(self, robot: str, now: float) -> None:
        """Note that a TickStart of `robot` fits this robot's ticks."""
        self._heard[robot] = now
