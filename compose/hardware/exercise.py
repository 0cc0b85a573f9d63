"""An exercise that a driver is led through, so that what it did can be judged, by `conformance`.

The robot needs room: it drives straight away from about its anchor until it is out of its range for sure.
"""

from __future__ import annotations

import math
import time
from typing import NamedTuple

from protocol.messages import Observation, RobotConfig
from protocol.motion import REST, Controls
from protocol.wire import MalformedFrame, decode, encode
from world.hardware.driver import Driver, Reading

SETTLED = 0.1
"""of a manoeuvre: how long after it the robot is looked at"""


class Try(NamedTuple):
    """A tick of the exercise."""

    what: str
    asked: Controls
    share: float
    """of the manoeuvre that was over when the robot was looked at, or stopped; 1 at the most"""
    reading: Reading
    driving_s: float
    sensing_s: float


class Broken(Exception):
    """The exercise could not go on; its text says why."""


class ExerciseRun:
    """An exercise, as it is gone through."""

    def __init__(self, driver: Driver, config: RobotConfig, manoeuvre_s: float) -> None:
        self.config = config
        self.tries: list[Try] = []
        self._driver = driver
        self._manoeuvre_s = manoeuvre_s
        self._began = 0.0
        """the latest manoeuvre"""

    def go_through(self) -> None:
        """All of it. Raises Broken. The robot stands afterwards."""
        mission = self.config.mission
        v = 0.5 * mission.first_straight / mission.period
        omega = min(mission.max_turn_rate, 1.0 / mission.period)
        try:
            self._observation("stands at first", REST, 1.0)
            for what, asked in (
                ("stands, as nobody says anything", REST),
                ("straight", Controls(v, 0.0)),
                ("turn", Controls(0.0, omega)),
                ("arc", Controls(0.6 * v, 0.8 * omega)),
                ("backwards", Controls(-v, 0.0)),
                ("stands, as no drive comes", REST),
                ("turn back", Controls(0.0, -0.7 * omega)),
                ("straight", Controls(0.9 * v, 0.0)),
            ):
                self._try(what, asked)
            self._command(asked := Controls(v, 0.0))
            self._wait(0.5)
            self._observation("half of a straight", asked, self._share())
            before = self.tries[-1].share
            self._wait(1.0)
            self._observation("the rest of it", asked, 1.0 - before)
            self._command(asked := Controls(-v, 0.0))
            self._wait(0.5)
            share = self._share()
            self._driver.stop()
            self._wait(1.0)
            self._observation("stopped half-way", asked, share)
            self._try("stands after the stop", REST)
            for _ in range(math.ceil(2.0 * mission.sensing_range / (v * mission.period)) + 2):
                self._try("away", Controls(v, 0.0))
        except Broken:
            raise
        except Exception as error:  # it is the user's own, and may raise anything
            raise Broken(f"{type(error).__name__}: {error}") from error
        finally:
            self._driver.stop()

    def _try(self, what: str, asked: Controls) -> None:
        """A whole manoeuvre; none at all if it is to rest."""
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
        until = self._began + (share + (SETTLED if share == 1.0 else 0.0)) * self._manoeuvre_s
        time.sleep(max(0.0, until - time.monotonic()))

    def _observation(self, what: str, asked: Controls, share: float, driving_s: float = 0.0) -> None:
        tick, began = len(self.tries), time.monotonic()
        reading = self._driver.sense(tick)
        took = time.monotonic() - began
        if not isinstance(reading, Reading):
            raise Broken(f"sense({tick}) gives {type(reading).__name__}, expected a Reading")
        try:
            decode(
                encode(Observation(tick, self.config.robot, reading.executed, reading.anchor_range)),
                Observation,
            )
            if reading.mutual_range is not None:
                decode(encode(Observation(tick, self.config.robot, None, reading.mutual_range)), Observation)
        except (MalformedFrame, TypeError) as error:
            raise Broken(f"sense({tick}): {error}") from None
        share_s = self._manoeuvre_s
        self.tries.append(Try(what, asked, share, reading, driving_s / share_s, took / share_s))
