"""`tandem check-driver`: check a driver against its contract, docs/driver.md; the robot moves."""

from __future__ import annotations

import argparse
from contextlib import closing

from compose.errors import CLEAN, VIOLATED, UserError
from compose.hardware.conformance import check_results
from compose.hardware.exercise import Broken, ExerciseRun
from compose.launch.driver_loader import config_of, driver_class, made, mission, options_of
from compose.scenario.run_settings import check_rate
from compose.terminal import text_width
from compose.terminal.text_width import tell
from protocol.output import one_line, say


def main(options: argparse.Namespace) -> int:
    """Run the exercise, print the result of each check, and return VIOLATED if one failed."""
    scenario = mission(options.mission, options.robot)
    if options.robot in scenario.unanchored:
        raise UserError(f"--robot: {options.robot} has no anchor, and the checks need ranges to one")
    rate = options.rate or 1.0
    check_rate(scenario, rate)
    manoeuvre_s = scenario.mission.period / rate
    config = config_of(scenario, options.robot, manoeuvre_s)
    maker, given = driver_class(options.driver), options_of(options.option)
    with closing(made(maker, options.driver, config, manoeuvre_s, given)) as driver:
        trial = ExerciseRun(driver, config, manoeuvre_s)
        try:
            trial.go_through()
        except Broken as broken:
            where = trial.tries[-1].what if trial.tries else "the start"
            tell(f"wrong  the exercise can be completed: after '{where}': {broken}")
            return VIOLATED
    found = check_results(trial)
    for one in found:
        line = f"wrong  {one.check}: {one.wrong}" if one.wrong else f"ok     {one.check}"
        say(*text_width.wrapped(one_line(line), text_width.MARKED))
    return VIOLATED if any(one.wrong for one in found) else CLEAN
