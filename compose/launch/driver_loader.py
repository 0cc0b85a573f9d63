"""The robot of hardware mode: its scenario, and its driver, a class of the user (see `class_loader`)."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

from compose.errors import UserError, no_such, user_code
from compose.launch.class_loader import named, trust
from compose.scenario.run_settings import check_rate
from compose.scenario.scenario_file import setting
from protocol.messages import RobotConfig
from protocol.network.clock import ClockError
from world.hardware.driver import THINKING, Driver
from world.hardware.driver_journal import DriverHistory
from world.scenario import Scenario

DRIVER_METHODS = ("sense", "drive", "stop", "close")
"""The methods that a driver must have."""


class HardwareRobot(NamedTuple):
    """One robot of a mission in hardware mode."""

    scenario: Scenario
    config: RobotConfig
    rate: float
    """The speed relative to real time."""
    manoeuvre_s: float
    """The wall time of a manoeuvre in s."""
    clock: ClockError | None
    """The error of the clock of the robot's processes."""
    driver: Callable[[], Driver]
    """Return the driver. Raises UserError for whatever its constructor raises."""


def hardware_robot(options: argparse.Namespace, robot: str) -> HardwareRobot:
    """Return the robot that the flags --mission, --rate, --driver and --option describe. Raises UserError."""
    scenario = mission(options.mission, robot)
    rate = options.rate or 1.0
    check_rate(scenario, rate)
    manoeuvre_s = scenario.mission.period / rate
    config = config_of(scenario, robot, manoeuvre_s)
    maker = driver_class(options.driver)

    def driver() -> Driver:
        with user_code(f"{options.driver}: cannot be created:"):
            return maker(config, manoeuvre_s, **dict(options.option))

    return HardwareRobot(
        scenario, config, rate, manoeuvre_s, setting(options.mission).clocks.get(robot), driver
    )


def driver_class(name: str) -> Callable[..., Driver]:
    """Return the class that the user has named, also of the working directory. Raises UserError."""
    trust(name)
    found: Callable[..., Driver] = named(name, "driver")
    missing = [method for method in DRIVER_METHODS if not callable(getattr(found, method, None))]
    if not callable(found) or missing:
        raise UserError(f"{name}: is not a driver: it has no {', '.join(missing) or 'constructor'}")
    return found


def resume_driver(driver: Driver, name: str, history: DriverHistory) -> None:
    """Stop the robot, and resume its driver at the end of `history`. Raises UserError."""
    resume = getattr(driver, "resume", None)
    if not callable(resume):
        raise UserError(
            f"--out: contains a recording, and {name} has no resume() method; choose another folder"
        )
    with user_code(f"{name}: cannot resume:"):
        driver.stop()
        resume(history.tick, history.mark)


def mission(source: str, robot: str) -> Scenario:
    """Return the scenario named `source`, or in that file, after checking that `robot` is in it.

    Raises UserError.
    """
    scenario = setting(source).scenario
    if scenario.faults:
        raise UserError(f"{source}: fault: not available in hardware mode, which uses the real radio")
    if scenario.deaths:
        raise UserError(f"{source}: dies: not available in hardware mode, in which no robot is simulated")
    if robot not in (ids := [placed.id for placed in scenario.robots]):
        raise UserError(f"{source}: {no_such(robot, ids, what='robot ')}")
    return scenario


def config_of(scenario: Scenario, robot: str, manoeuvre_s: float) -> RobotConfig:
    """Return the configuration of `robot`; a tick lasts a manoeuvre and the part THINKING of one at rest."""
    return scenario.config(robot, (1.0 + THINKING) * manoeuvre_s)
