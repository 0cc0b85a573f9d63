"""Loading of drivers by their name on the command line, MODULE:CLASS."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from compose.errors import UserError, user_code
from compose.launch.class_loader import named, trust
from compose.scenario.scenario_file import setting
from protocol.messages import RobotConfig
from protocol.spelling import did_you_mean
from world.hardware.driver import THINKING, Driver
from world.hardware.driver_journal import DriverHistory
from world.scenario import Scenario

DRIVER_METHODS = ("sense", "drive", "stop", "close")
"""The methods that a driver must have."""

Maker = Callable[..., Driver]
"""The constructor of a driver."""


def driver_class(name: str) -> Maker:
    """Return the class that the user has named, also of the working directory. Raises UserError."""
    trust(name)
    found = named(name, "driver")
    missing = [method for method in DRIVER_METHODS if not callable(getattr(found, method, None))]
    if not callable(found) or missing:
        raise UserError(f"{name}: is not a driver: it has no {', '.join(missing) or 'constructor'}")
    maker: Maker = found
    return maker


def made(
    maker: Maker, name: str, config: RobotConfig, manoeuvre_s: float, options: Mapping[str, str]
) -> Driver:
    """Return the driver that `maker` creates. Raises UserError for whatever it raises.

    `manoeuvre_s` is the wall time of a manoeuvre in s.
    """
    with user_code(f"{name}: cannot be created:"):
        return maker(config, manoeuvre_s, **options)


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


def options_of(words: list[str]) -> dict[str, str]:
    """Return the driver's options from a list of NAME=VALUE. Raises UserError."""
    options = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name.isidentifier():
            raise UserError(f"--option: '{word}' is not an option; expected NAME=VALUE")
        options[name] = value
    return options


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
        near = did_you_mean(robot, ids)
        raise UserError(f"{source}: there is no robot '{robot}'; there are {', '.join(ids)}{near}")
    return scenario


def config_of(scenario: Scenario, robot: str, manoeuvre_s: float) -> RobotConfig:
    """Return the configuration of `robot`; a tick lasts a manoeuvre and the part THINKING of one at rest."""
    return scenario.config(robot, (1.0 + THINKING) * manoeuvre_s)
