"""`tandem check-driver`: a driver, tried against the contract; the robot moves."""

from __future__ import annotations

import argparse
from contextlib import closing

from compose.errors import CLEAN, VIOLATED
from compose.hardware.conformance import judged
from compose.hardware.exercise import Broken, ExerciseRun
from compose.launch.driver_loader import briefed, driver_class, made, mission, options_of
from compose.scenario.scenario_file import check_rate
from compose.terminal import text_width
from protocol.output import one_line, say

MARKED = len("wrong  ")


def main(options: argparse.Namespace) -> int:
    """Go through the exercise, and say of each check whether it holds."""
    scenario = mission(options.mission, options.robot)
    rate = options.rate or 1.0
    check_rate(scenario, rate)
    manoeuvre_s = scenario.mission.period / rate
    config = briefed(scenario, options.robot, manoeuvre_s)
    maker, given = driver_class(options.driver), options_of(options.option)
    with closing(made(maker, options.driver, config, manoeuvre_s, given)) as driver:
        trial = ExerciseRun(driver, config, manoeuvre_s)
        try:
            trial.go_through()
        except Broken as broken:
            where = trial.tries[-1].what if trial.tries else "the start"
            say(f"wrong  the exercise can be gone through: after '{where}': {broken}")
            return VIOLATED
    found = judged(trial)
    for one in found:
        line = f"wrong  {one.check}: {one.wrong}" if one.wrong else f"ok     {one.check}"
        say(*text_width.wrapped(one_line(line), MARKED))
    return VIOLATED if any(one.wrong for one in found) else CLEAN
