"""`tandem check-driver`: check a driver against its contract, docs/driver.md; the robot moves."""

from __future__ import annotations

import argparse
from contextlib import closing

from compose.errors import UserError
from compose.hardware.conformance import check_results
from compose.hardware.exercise import Broken, ExerciseRun
from compose.launch.driver_loader import hardware_robot
from compose.terminal.finding import checked, tell_all


def main(options: argparse.Namespace) -> int:
    """Run the exercise, print the result of each check, and return VIOLATED if one failed."""
    robot = hardware_robot(options, options.robot)
    if robot.config.given_anchor is None:
        raise UserError(
            f"--robot: {options.robot} has no anchor of its own, and the checks need ranges to one"
        )
    with closing(robot.driver()) as driver:
        trial = ExerciseRun(driver, robot.config, robot.manoeuvre_s)
        try:
            trial.go_through()
        except Broken as broken:
            where = trial.tries[-1].what if trial.tries else "the start"
            return tell_all([checked("the exercise can be completed", f"after '{where}': {broken}")])
    return tell_all(check_results(trial))
