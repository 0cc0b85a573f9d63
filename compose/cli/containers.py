"""`tandem containers`: write the compose file of a scenario."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path

from compose.errors import ENDED, UserError, writing
from compose.hardware.compose_file import compose_file
from compose.launch.planner_loader import is_shipped
from compose.scenario.scenario_file import setting
from compose.terminal.text_width import tell
from protocol import files
from protocol.output import say
from world.scenario import Scenario


def main(options: argparse.Namespace) -> int:
    """Write the compose file, and print the command that uses it."""
    found = setting(options.scenario)
    for name, tables in (("kill", found.file.kill), ("clock", found.file.clock)):
        if tables:
            raise UserError(f"{options.scenario}: {name}: a scenario has no effect on containers")
    scenario = found.scenario
    _check_code(options.scenario, scenario)
    place: Path = options.file
    if os.path.lexists(place):  # a link that leads nowhere is a file, too
        raise UserError(f"{place} already exists; choose another file")
    with writing(place):
        files.write(place, compose_file(options.scenario, scenario, place))
    robots = ", ".join([robot.id for robot in scenario.robots])
    tell(f"{place}: a world, the agents of {robots}, and a page", "to go on:")
    say(f"  docker compose -f {shlex.quote(str(place))} up --build")
    return ENDED


def _check_code(name: str, scenario: Scenario) -> None:
    """Raise UserError if the mission needs a planner or a model that the image does not contain."""
    planner = scenario.config(scenario.robots[0].id).planner_name
    if not is_shipped(planner):
        raise UserError(f"{name}: planner: {planner} is not in the image, which has shipped planners only")
    for model in (scenario.range_model, scenario.radio_model):
        if model is not None and ":" in model.model:
            raise UserError(
                f"{name}: world: {model.model} is not in the image, which has shipped models only"
            )
