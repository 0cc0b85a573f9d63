"""Drivers that violate the driver contract, each in one way."""

from __future__ import annotations

import math
import os
import time
from signal import SIGKILL

from msgspec.structs import replace

from docs.rover import Rover
from protocol.messages import RobotConfig
from protocol.motion import REST, Controls
from world.hardware.driver import Reading


class TellsWhatWasAsked(Rover):
    _asked = REST

    def drive(self, v: float, omega: float) -> None:
        self._asked = Controls(v, omega)
        super().drive(v, omega)

    def sense(self, tick: int) -> Reading:
        asked, self._asked = self._asked, REST
        return replace(super().sense(tick), executed=asked)


class TurnsInDegrees(Rover):
    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        executed = Controls(reading.executed.v, math.degrees(reading.executed.omega))
        return replace(reading, executed=executed)


class RangesInFeet(Rover):
    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        rho = reading.anchor_range
        return replace(reading, anchor_range=rho / 0.3048 if rho is not None else None)


class RangesBeyondReach(Rover):
    def sense(self, tick: int) -> Reading:
        anchor = self._config.anchor
        reading = super().sense(tick)
        rho = math.hypot(self.pose.x - anchor.x, self.pose.y - anchor.y)
        return replace(reading, anchor_range=rho)


class RangesToOthersBeyondReach(Rover):
    """A driver of a robot in a group."""

    def sense(self, tick: int) -> Reading:
        return replace(super().sense(tick), mutual_ranges={"c": 3.5} if tick == 4 else {})


class RangesToStrangers(Rover):
    def sense(self, tick: int) -> Reading:
        return replace(super().sense(tick), mutual_ranges={"x": 1.5})


class RepeatsStaleRanges(Rover):
    _stale: float | None = None

    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        if tick % 2 == 0 or reading.anchor_range is None:
            self._stale = reading.anchor_range
        return replace(reading, anchor_range=self._stale)


class MissesRanges(Rover):
    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        return replace(reading, anchor_range=None) if tick == 4 else reading


class TellsTheTickBefore(Rover):
    _before = REST

    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        late, self._before = self._before, reading.executed
        return replace(reading, executed=late)


class SkipsEverySecondTick(Rover):
    _first: Reading | None = None

    def sense(self, tick: int) -> Reading:
        if tick % 2 == 1 and self._first is not None:
            return self._first
        self._first = super().sense(tick)
        return self._first


class DrivesWithoutEnd(Rover):
    """A driver that continues the last command until it receives another."""

    def _settle(self) -> None:
        super()._settle()
        if self._done >= 1.0 and self._controls != REST:
            self._began, self._done = self._began + self._manoeuvre_s, 0.0
            if time.monotonic() > self._began:
                self._settle()


class DrivesOnAfterStop(Rover):
    def stop(self) -> None:
        pass


class DrivesForTwiceAsLong(Rover):
    def __init__(self, config: RobotConfig, manoeuvre_s: float) -> None:
        super().__init__(config, manoeuvre_s)
        self._manoeuvre_s = 2.0 * manoeuvre_s


class DrivesInHalfTheTime(Rover):
    """A driver that executes a whole manoeuvre in half the time."""

    def __init__(self, config: RobotConfig, manoeuvre_s: float) -> None:
        super().__init__(config, manoeuvre_s)
        self._manoeuvre_s = 0.5 * manoeuvre_s


class WaitsForItsWheels(Rover):
    def drive(self, v: float, omega: float) -> None:
        super().drive(v, omega)
        time.sleep(0.5 * self._manoeuvre_s)


class SensesNonsense(Rover):
    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        return replace(reading, anchor_range=math.nan) if tick == 5 else reading


class LosesItsSensors(Rover):
    def sense(self, tick: int) -> Reading:
        if tick == 3:
            raise OSError("no such device")
        return super().sense(tick)


class NoDriver:
    def sense(self, tick: int) -> None: ...


class CannotResume(Rover):
    """A driver that does not store what its wheels did."""

    resume = None  # type: ignore[assignment]


class LosesAReading(Rover):
    """A driver whose process is killed once, after it has taken the reading of a tick."""

    TICK = 8

    def sense(self, tick: int) -> Reading:
        reading = super().sense(tick)
        assert self._state is not None
        killed = self._state.with_suffix(".killed")
        if tick == self.TICK and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), SIGKILL)
        return reading
