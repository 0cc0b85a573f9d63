"""The work that a fork server does once for all worlds and agents that are forked from it."""

from __future__ import annotations

import compose.commands.agent
import compose.commands.world  # noqa: F401  # for its import only
from compose import inline
from compose.cli import parser
from compose.scenario import load
from protocol import environment, wire
from protocol.messages import Briefing, Drive, End, Farewell, Report, Sense
from world.scenario import Scenario

MISSION = "paper-1"
RECEIVED = (Briefing, Scenario, Sense | End, Report, Drive, Drive | Farewell)
"""The types that worlds and agents decode."""


def missions() -> None:
    """Prepare worlds and agents: import modules, build the command line and decoders, and run a mission."""
    parser()
    inline.play(load(MISSION))
    for kind in RECEIVED:
        wire.prepare(kind)
    environment.of_world()
    environment.of_robot()
