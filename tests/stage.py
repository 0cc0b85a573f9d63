"""A simulated environment for the bridge of hardware mode.

Time passes only while the bridge waits, and the test answers the frames that it sends.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh
from msgspec.structs import replace

from protocol.journal.journal_file import Sink
from protocol.messages import Command, FinalReport, MissionEnd, Observation, RobotConfig, TickStart, Verdict
from protocol.motion import REST
from protocol.network import keys
from protocol.network.clock import Clock
from protocol.network.inbox import NO_ARRIVAL, Arrival, Inbox, Topic
from protocol.wire import decode, encode
from world.hardware import bridge
from world.hardware.bridge import Field
from world.hardware.driver import THINKING, Reading

TRANSPORT_S = 1e-4
"""The simulated transport time of a frame, in s."""
MANOEUVRE_S = 0.1
TICK_S = (1.0 + THINKING) * MANOEUVRE_S
LINK = cast(zenoh.Session, None)
"""A placeholder; a stage needs no session."""


class Stage(Inbox):
    """The clock, network and inbox of a bridge, in one thread and independent of the speed of the machine."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        super().__init__("field", Clock(true=self.monotonic))
        self.put_frames: list[tuple[str, bytes]] = []
        """keys and frames that the bridge has sent"""
        self.answer: Callable[[str, bytes], None] = lambda _key, _frame: None
        self._coming: list[tuple[float, int, Arrival]] = []
        monkeypatch.setattr(
            bridge,
            "session",
            SimpleNamespace(
                publisher=lambda _link, key: SimpleNamespace(put=lambda frame: self._on_put(key, frame)),
                subscribe=lambda *_: None,
                watch_liveliness=lambda *_: None,
                answer=lambda *_: None,
                show_alive=lambda *_: None,
            ),
        )

    def monotonic(self) -> float:
        """Return the simulated time in s."""
        return self.now

    def alive(self, *robots: str) -> None:
        """Report the agents of these robots as alive."""
        for robot in robots:
            self.comes("alive", keys.robot_alive("r", robot))

    def comes(self, topic: Topic, key: str, frame: bytes = b"", after: float = TRANSPORT_S) -> None:
        """Schedule an arrival `after` seconds from now."""
        heapq.heappush(
            self._coming,
            (
                self.now + after,
                len(self._coming),
                Arrival(topic, key, frame, keys.parse(key) or keys.UNKNOWN_KEY),
            ),
        )

    def next(self, timeout: float | None) -> Arrival:
        """Return the next arrival at its time; NO_ARRIVAL if there is none within `timeout` seconds."""
        assert timeout is not None
        until = self.now + max(timeout, 0.0)
        if self._coming and self._coming[0][0] <= until:
            when, _, arrival = heapq.heappop(self._coming)
            self.now = max(self.now, when)
            return arrival
        self.now = until
        return NO_ARRIVAL

    def _on_put(self, key: str, frame: bytes) -> None:
        self.put_frames.append((key, frame))
        self.answer(key, frame)


class Recorded:
    """A driver that only records its commands and their times."""

    def __init__(self, fails_at: int | None = None, reading: Reading | None = None) -> None:
        self.commands: list[tuple[float, float]] = []
        self.ticks: list[tuple[int, float]] = []
        self.stopped = 0
        self.clock = time.monotonic
        self._fails_at = fails_at
        self._reading = reading or Reading(REST, 2.0)

    def sense(self, tick: int) -> Reading:
        self.ticks.append((tick, self.clock()))
        if tick == self._fails_at:
            raise OSError("no such device")
        return self._reading

    def drive(self, v: float, omega: float) -> None:
        self.commands.append((v, omega))

    def stop(self) -> None:
        self.stopped += 1

    def close(self) -> None:
        pass


FINAL_REPORT = FinalReport(
    "a", 0, 0, None, None, None, None, None, None, None, None, None, 0, 0, 0, 0, 0, 0, 0
)


def command(tick: int, robot: str = "a", v: float = 0.5, verdict: Verdict | None = None) -> Command:
    return Command(tick, robot, v, 0.25, 1, "straight", verdict)


class Member:
    """A robot in hardware mode on a stage, whose agent answers each Observation at once."""

    def __init__(
        self,
        stage: Stage,
        config: RobotConfig,
        max_ticks: int,
        verdict: Verdict | None = None,
        journal: Sink | None = None,
        driver: Recorded | None = None,
    ) -> None:
        self.driver = driver or Recorded()
        self.driver.clock = stage.monotonic
        self._stage, self._robot, self._verdict = stage, config.robot, verdict
        self.field = Field(
            self.driver, config, "r", stage, max_ticks=max_ticks, manoeuvre_s=MANOEUVRE_S, journal=journal
        )
        stage.answer = self._answer

    def _answer(self, key: str, frame: bytes) -> None:
        if key == keys.observation("r", self._robot):
            message = decode(frame, Observation | TickStart | MissionEnd | FinalReport)
            said = (
                command(message.tick, self._robot, verdict=self._verdict)
                if isinstance(message, Observation)
                else replace(FINAL_REPORT, robot=self._robot)
            )
            self._stage.comes("command", keys.command("r", self._robot), encode(said), 0.001)

    def play(self, wait: float = 10.0) -> MissionEnd:
        self.field.attach(LINK)
        return self.field.run_mission(wait, lambda: None)

    @property
    def times(self) -> dict[int, float]:
        """The time of each tick."""
        return dict(self.driver.ticks)

    def started(self) -> list[int]:
        """Return the ticks of the TickStarts that it has sent."""
        key = keys.tick_start("r", self._robot)
        return [decode(frame, TickStart).tick for to, frame in self._stage.put_frames if to == key]


def begins(stage: Stage, robot: str, ticks: Mapping[int, float]) -> None:
    """Let the driver of `robot` send the TickStart of each of `ticks` at its time."""
    for tick, at in ticks.items():
        stage.comes("tick-start", keys.tick_start("r", robot), encode(TickStart(tick, robot)), at)
