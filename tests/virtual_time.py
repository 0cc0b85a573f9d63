"""A clock that only sleeping moves, for an exercise and the drivers that it is tried on.

`tandem check-driver tests.virtual_time:Rover` is an exercise in it: what it finds does not depend on the machine.
"""

from __future__ import annotations

from types import ModuleType

from compose.hardware import exercise
from docs import rover
from docs.rover import Rover as RealRover
from protocol.messages import RobotConfig
from tests import broken_drivers


class Clock:
    """In the place of the module `time`."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


MODULES: tuple[ModuleType, ...] = (exercise, rover, broken_drivers)
"""that tell the time in an exercise"""


class Rover(RealRover):
    """The example, in a process where time is virtual from now on."""

    def __init__(self, config: RobotConfig, manoeuvre_s: float) -> None:
        clock = Clock()
        for module in MODULES:
            module.time = clock  # type: ignore[attr-defined]
        super().__init__(config, manoeuvre_s)
