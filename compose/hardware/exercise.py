"""The exercise of a driver, whose measurements `conformance` checks.

The robot needs space: it starts near its anchor and drives straight away from it until it is out of range.
"""

from __future__ import annotations

import math
import time
from typing import NamedTuple

from protocol.messages import RobotConfig
from protocol.motion import REST, Controls
from world.hardware.driver import Driver, Reading
from world.hardware.measurements import InvalidReading, mark_frames, observation_frame

SETTLING_SHARE = 0.1
"""The part of a manoeuvre to wait after its end before sensing."""
FIRST_HALF, SECOND_HALF = "first half of a straight", "second half of a straight"
STOPPED_HALF_WAY = "stopped half-way"


class Try(NamedTuple):
    """A tick of the exercise."""

    what: str
    """Name of the tick in messages."""
    asked: Controls
    """Commanded speeds in m/s and rad/s."""
    share: float
    """Part of the manoeuvre that was over at the sensing or the stop, at most 1."""
    reading: Reading
    driving_s: float
    """Time that `drive` took, in parts of a manoeuvre."""
    sensing_s: float
    """Time that `sense` took, in parts of a manoeuvre."""


class Broken(Exception):
    """The exercise failed; the text says why."""


class ExerciseRun:
    """One run of the exercise."""

    def __init__(self, driver: Driver, config: RobotConfig, manoeuvre_s: float) -> None:
        self.config = config
        self.tries: list[Try] = []
        self._driver = driver
        self._manoeuvre_s = manoeuvre_s
        self._began = 0.0
        """Monotonic time in s of the start of the latest manoeuvre."""

    def go_through(self) -> None:
        """Run the whole exercise, after which the robot is at rest. Raises Broken."""
        mission = self.config.mission
        v = 0.5 * mission.first_straight / mission.period
        omega = min(mission.max_turn_rate, 1.0 / mission.period)
        try:
            self._observation("at rest at the start", REST, 1.0)
            for what, asked in (
                ("at rest, without a command", REST),
                ("straight", Controls(v, 0.0)),
                ("turn", Controls(0.0, omega)),
                ("arc", Controls(0.6 * v, 0.8 * omega)),
                ("backwards", Controls(-v, 0.0)),
                ("at rest, without another command", REST),
                ("turn back", Controls(0.0, -0.7 * omega)),
                ("straight", Controls(0.9 * v, 0.0)),
            ):
                self._try(what, asked)
            self._command(asked := Controls(v, 0.0))
            self._wait(0.5)
            self._observation(FIRST_HALF, asked, self._share())
            before = self.tries[-1].share
            self._wait(1.0)
            self._observation(SECOND_HALF, asked, 1.0 - before)
            self._command(asked := Controls(-v, 0.0))
            self._wait(0.5)
            share = self._share()
            self._driver.stop()
            self._wait(1.0)
            self._observation(STOPPED_HALF_WAY, asked, share)
            self._try("at rest after the stop", REST)
            for _ in range(math.ceil(2.0 * mission.sensing_range / (v * mission.period)) + 2):
                self._try("away from the anchor", Controls(v, 0.0))
        except Broken:
            raise
        except (Exception, SystemExit) as error:  # the user's code may raise anything
            raise Broken(f"{type(error).__name__}: {error}") from error
        finally:
            self._driver.stop()

    def _try(self, what: str, asked: Controls) -> None:
        """Drive a whole manoeuvre, or wait as long without a command if `asked` is rest, and sense."""
        if asked == REST:
            self._began, took = time.monotonic(), 0.0
        else:
            took = self._command(asked)
        self._wait(1.0)
        self._observation(what, asked, 1.0, took)

    def _command(self, asked: Controls) -> float:
        self._began = time.monotonic()
        self._driver.drive(asked.v, asked.omega)
        return time.monotonic() - self._began

    def _share(self) -> float:
        return min(1.0, (time.monotonic() - self._began) / self._manoeuvre_s)

    def _wait(self, share: float) -> None:
        until = self._began + (share + (SETTLING_SHARE if share == 1.0 else 0.0)) * self._manoeuvre_s
        time.sleep(max(0.0, until - time.monotonic()))

    def _observation(self, what: str, asked: Controls, share: float, driving_s: float = 0.0) -> None:
        tick, began = len(self.tries), time.monotonic()
        reading = self._driver.sense(tick)
        took = time.monotonic() - began
        try:
            observation_frame(reading, tick, self.config)
            mark_frames(reading, tick, self.config.robot)
        except InvalidReading as error:
            raise Broken(f"sense({tick}): {error}") from None
        manoeuvre_s = self._manoeuvre_s
        self.tries.append(Try(what, asked, share, reading, driving_s / manoeuvre_s, took / manoeuvre_s))
