"""The end of a pair's mission in hardware mode, for one robot, from its own result and the peer's Reports.

The true poses are unknown, so the outcome is never `wrong`. A robot stays until the peer has acknowledged its
result. It then continues to send Reports for LAST_WORDS ticks, which contain its own acknowledgement. A peer
that has disappeared may have been killed, and needs the result when it resumes. So the robot waits for it
until the timeout after its own result.
"""

from __future__ import annotations

import time
from typing import Protocol

from protocol.messages import (
    Cause,
    Command,
    MissionEnd,
    Report,
    RobotConfig,
    TickStart,
    Verdict,
)
from world.referee import mission_end, shortfall

LAST_WORDS = 4
"""The number of ticks in which a robot still sends Reports after both results are known and acknowledged."""


class Termination(Protocol):
    """The contract of the end of a mission: the results of the robots, as far as they are known to one."""

    verdict: Verdict | None
    """The robot's own result; None until it has one."""
    reporters: tuple[str, ...]
    """The robots whose Reports contribute to what is known."""

    def receive(self, message: Report | TickStart) -> bool:
        """Add the message of another robot, and return whether it changes what is known."""

    def tick_start(self, tick: int) -> TickStart:
        """Return the TickStart of `tick`, with what the others have to know."""

    def after(self, tick: int, command: Command | None) -> MissionEnd | None:
        """Return the MissionEnd if `tick`, in which the agent sent `command`, was the last; else None."""


class Ending(Termination):
    """The results of both robots, as far as they are known to this one."""

    def __init__(self, config: RobotConfig, max_ticks: int, timeout: float) -> None:
        self._peer = config.peer
        self.reporters = (config.peer,)
        self._me = config.robot
        self._mission = config.mission
        self._max_ticks = max_ticks
        self._timeout = timeout
        self.verdict: Verdict | None = None
        self._at = 0
        """The tick of the result."""
        self._since = 0.0
        """The time of the result, on the monotonic clock."""
        self._peers: Verdict | None = None
        """The peer's result; None until it is received."""
        self._acknowledged = -1
        """The tick up to which the peer has acknowledged this robot's manoeuvres, and so its Report."""
        self._known: int | None = None
        """The tick in which both results were known and acknowledged."""

    def receive(self, message: Report | TickStart) -> bool:
        """Add the peer's Report, and return whether it changes what is known."""
        before = self._peers, self._is_acknowledged
        match message:
            case TickStart():
                return False
            case Report(heard=heard, body=body):  # of those with a body, the one after the result contains it
                self._acknowledged = max(self._acknowledged, heard if body is None else heard - 1)
        self._peers = self._peers or message.verdict
        return (self._peers, self._is_acknowledged) != before

    @property
    def _is_acknowledged(self) -> bool:
        """True if the peer has received this robot's result."""
        return self.verdict is not None and self._acknowledged >= self._at

    def tick_start(self, tick: int) -> TickStart:
        """Return the TickStart of `tick`. The results are in the Reports."""
        return TickStart(tick, self._me)

    def after(self, tick: int, command: Command | None) -> MissionEnd | None:
        """Return the MissionEnd if `tick` was the last; None otherwise. See `Termination.after`."""
        if self.verdict is None and command is not None and command.verdict is not None:
            self.verdict, self._at, self._since = command.verdict, tick, time.monotonic()
        if self.verdict is None:
            if tick >= self._max_ticks:
                return mission_end(tick, [Cause("max-ticks", (self._me,))])
            return None
        if self._known is None and self._peers is not None and self._is_acknowledged:
            self._known = tick
        if self._known is not None and tick >= self._known + LAST_WORDS:
            return self._end(tick)
        if tick >= self._max_ticks or time.monotonic() - self._since > self._timeout:
            return self._end(tick)
        return None

    def _end(self, tick: int) -> MissionEnd:
        results = ((self._me, self.verdict, self._peer), (self._peer, self._peers, self._me))
        found = [shortfall(robot, verdict, self._mission, other) for robot, verdict, other in results]
        left = sorted(
            [one for one in found if one is not None], key=lambda one: one.code in ("position", "heading")
        )
        if left or self._peers is not None:
            return mission_end(tick, left[:1])
        return mission_end(tick, [Cause("waiting", (self._me,)), Cause("no-result", (self._peer,))])
