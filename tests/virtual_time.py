"""A virtual clock for check-driver exercises, which only advances when the code sleeps.

The results of `tandem check-driver tests.virtual_time:Rover` therefore do not depend on the speed of the
machine.
"""

from __future__ import annotations

from types import ModuleType

from compose.hardware import exercise
from docs import rover
from docs.rover import Rover as RealRover
from protocol.messages import RobotConfig
from tests import broken_drivers


class Clock:
    """A replacement for the module `time`."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


MODULES: tuple[ModuleType, ...] = (exercise, rover, broken_drivers)
"""The modules that read the time in an exercise."""


class Rover(RealRover):
    """The example driver. Time is virtual in its process from its construction on."""

    def __init__(self, config: RobotConfig, manoeuvre_s: float) -> None:
        clock = Clock()
        for module in MODULES:
            module.time = clock  # type: ignore[attr-defined]
        super().__init__(config, manoeuvre_s)


class RangesInFeet(broken_drivers.RangesInFeet, Rover):
    """A broken driver whose whole exercise takes no time."""
