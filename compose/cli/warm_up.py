"""The work that a fork server does once for all worlds and agents that are forked from it."""

from __future__ import annotations

from importlib import import_module

from compose.cli.commands import COMMANDS
from compose.cli.main import command_parser
from compose.launch import in_process
from compose.scenario.scenario_file import load
from protocol import wire
from protocol.journal import environment
from protocol.messages import Command, FinalReport, MissionEnd, Observation, Report, RobotConfig
from world.scenario import Scenario

WARM_UP_MISSION = "paper-1"
FORKED = ("world", "agent")
"""The commands that forked processes run."""
RECEIVED = (RobotConfig, Scenario, Observation | MissionEnd, Report, Command, Command | FinalReport)
"""The types that worlds and agents decode."""


def missions() -> None:
    """Prepare worlds and agents: import modules, build their parsers and decoders, and run a mission."""
    for command in COMMANDS:
        if command.name in FORKED:
            command_parser(command)
            import_module(command.module)
    in_process.run_mission(load(WARM_UP_MISSION))
    for kind in RECEIVED:
        wire.prepare(kind)
    environment.of_world()
    environment.of_robot()
