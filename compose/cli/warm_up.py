"""The work that a fork server does once for all worlds and agents that are forked from it."""

from __future__ import annotations

from compose.cli.main import COMMANDS, command_parser
from compose.launch import in_process
from compose.scenario.scenario_file import load
from protocol import wire
from protocol.journal import environment
from protocol.messages import (
    Command,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from world.scenario import Scenario

WARM_UP_MISSION = "paper-1"
FORKED = ("world", "agent")
"""The commands that forked processes run."""
RECEIVED = (
    RobotConfig,
    Scenario,
    Observation | MissionEnd,
    Report,
    Command,
    Command | FinalReport,
)
"""The types that worlds and agents decode."""


def missions() -> None:
    """Prepare worlds and agents: import modules, build their parsers and decoders, and run a mission."""
    for command in COMMANDS:
        if command.name in FORKED:
            command_parser(command)
    in_process.run_mission(load(WARM_UP_MISSION))
    for kind in RECEIVED:
        wire.prepare(kind)
    environment.of_world()
    environment.of_robot()
