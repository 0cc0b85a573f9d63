"""When a mission without a world is over for one robot, by what it says itself and by what it was told.

Nobody there knows the truth, so nobody can call a claim wrong. A robot stays until it knows that its peer
knows: reports go on a little after that, for the peer to learn the same.
"""

from __future__ import annotations

import time

from protocol.messages import (
    Command,
    Inconsistent,
    Localised,
    MissionEnd,
    Report,
    RobotConfig,
    Undecided,
    Verdict,
)
from world.referee import inaccuracy

LAST_WORDS = 4
"""ticks in which a robot goes on telling, once it knows all that it must"""


class Ending:
    """What is known of both verdicts."""

    def __init__(self, config: RobotConfig, max_ticks: int, timeout: float) -> None:
        self._peer = config.peer
        self._me = config.robot
        self._mission = config.mission
        self._max_ticks = max_ticks
        self._timeout = timeout
        self.verdict: Verdict | None = None
        """the robot's own"""
        self._at = 0
        """the tick of that"""
        self._since = 0.0
        """when it was, by the clock"""
        self._peers: Verdict | None = None
        self._acknowledged = -1
        """the peer knows this robot's manoeuvres through this tick, and what it said then"""
        self._known: int | None = None
        """in which tick all was known"""

    def told(self, report: Report) -> bool:
        """The peer has said `report`; whether anything follows from it."""
        before = self._peers, self._heard
        self._acknowledged = max(self._acknowledged, report.heard)
        self._peers = self._peers or report.verdict
        return (self._peers, self._heard) != before

    @property
    def _heard(self) -> bool:
        """Whether the peer knows this robot's verdict."""
        return self.verdict is not None and self._acknowledged >= self._at

    def after(self, tick: int, command: Command | None, *, peer_there: bool) -> MissionEnd | None:
        """The MissionEnd, if `tick` was the last, in which the robot gave `command`; else none."""
        if self.verdict is None and command is not None and command.verdict is not None:
            self.verdict, self._at, self._since = command.verdict, tick, time.monotonic()
        if self.verdict is None:
            if tick >= self._max_ticks:
                return MissionEnd(tick, "undecided", f"max_ticks: {self._me} not localised by then")
            return None
        gone = not peer_there and self._peers is not None
        if self._known is None and self._peers is not None and (self._heard or gone):
            self._known = tick
        if self._known is not None and tick >= self._known + LAST_WORDS:
            return self._end(tick)
        if tick >= self._max_ticks or time.monotonic() - self._since > self._timeout:
            return self._end(tick)
        return None

    def _end(self, tick: int) -> MissionEnd:
        for who, other, verdict in (
            (self._me, self._peer, self.verdict),
            (self._peer, self._me, self._peers),
        ):
            match verdict:
                case Inconsistent(claim):
                    return MissionEnd(tick, "inconsistent", f"{who}: {other} reports {claim}")
                case Undecided(reason):
                    return MissionEnd(tick, "undecided", f"{who}: {reason}")
        for who, verdict in ((self._me, self.verdict), (self._peer, self._peers)):
            if isinstance(verdict, Localised) and (vague := inaccuracy(verdict, self._mission)) is not None:
                return MissionEnd(tick, "undecided", f"{who} {vague}")
        if isinstance(self._peers, Localised):
            return MissionEnd(tick, "localised", None)
        return MissionEnd(tick, "undecided", f"{self._me} is localised; {self._peer} was not heard to be")
