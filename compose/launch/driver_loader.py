"""A driver by its name, MODULE:CLASS, as the user says it on the command line."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module

from compose.errors import UserError
from compose.scenario.scenario_file import setting
from protocol.messages import RobotConfig
from protocol.spelling import did_you_mean
from world.hardware.driver import THINKING, Driver
from world.hardware.driver_journal import DriverPast
from world.scenario import Scenario

METHODS = ("sense", "drive", "stop", "close")

Maker = Callable[..., Driver]


def driver_class(name: str) -> Maker:
    """The class that `name` says; modules are looked for in the directory at hand, too. Raises UserError."""
    module, _, cls = name.partition(":")
    if not module or not cls.isidentifier():
        raise UserError(f"'{name}' is no driver; one looks like MODULE:CLASS")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last: there may be a folder called world
    try:
        found = getattr(import_module(module), cls)
    except ModuleNotFoundError as error:
        raise UserError(f"{name}: there is no module '{error.name}'") from None
    except AttributeError:
        raise UserError(f"{name}: there is no '{cls}' in {module}") from None
    except Exception as error:  # noqa: BLE001  # it is the user's own, and may raise anything
        raise UserError(f"{name}: {module} cannot be imported: {type(error).__name__}: {error}") from None
    missing = [method for method in METHODS if not callable(getattr(found, method, None))]
    if not callable(found) or missing:
        raise UserError(f"{name}: is no driver: it has no {', '.join(missing) or 'constructor'}")
    maker: Maker = found
    return maker


def made(
    maker: Maker, name: str, config: RobotConfig, manoeuvre_s: float, given: Mapping[str, str]
) -> Driver:
    """The driver itself. Raises UserError, by whatever it raised."""
    try:
        return maker(config, manoeuvre_s, **given)
    except Exception as error:  # noqa: BLE001  # as above
        raise UserError(f"{name}: cannot be made: {type(error).__name__}: {error}") from None


def again(driver: Driver, name: str, past: DriverPast) -> None:
    """Stop the robot, and have its driver go on where `past` ends. Raises UserError."""
    resume = getattr(driver, "resume", None)
    if not callable(resume):
        raise UserError(f"--out: holds a record, and {name} has no resume() for it; choose another folder")
    try:
        driver.stop()
        resume(past.tick, past.mark)
    except Exception as error:  # noqa: BLE001  # as above
        raise UserError(f"{name}: cannot go on: {type(error).__name__}: {error}") from None


def options_of(words: list[str]) -> dict[str, str]:
    """What NAME=VALUE, as often as it was said, gives a driver. Raises UserError."""
    given = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name.isidentifier():
            raise UserError(f"--option: '{word}' is no option; one looks like NAME=VALUE")
        given[name] = value
    return given


def mission(source: str, robot: str) -> Scenario:
    """The mission in that file, in which `robot` takes part. Raises UserError."""
    scenario = setting(source).scenario
    if scenario.faults:
        raise UserError(f"{source}: fault: without a world, the radio is as it is")
    if robot not in (ids := [placed.id for placed in scenario.robots]):
        near = did_you_mean(robot, ids)
        raise UserError(f"{source}: there is no robot '{robot}'; there are {', '.join(ids)}{near}")
    return scenario


def briefed(scenario: Scenario, robot: str, manoeuvre_s: float) -> RobotConfig:
    """What `robot` is told; a tick lasts a manoeuvre and what thinking takes."""
    return scenario.config(robot, (1.0 + THINKING) * manoeuvre_s)
