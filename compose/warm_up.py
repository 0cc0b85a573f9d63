"""Work that a fork server does once, so that none of the processes forked from it has to."""

from __future__ import annotations

import compose.commands.agent
import compose.commands.world  # noqa: F401  # imported to be there
from compose import inline
from compose.cli import parser
from compose.scenario import load
from protocol import environment, wire
from protocol.messages import Briefing, Drive, End, Farewell, Report, Sense
from world.scenario import Scenario

MISSION = "paper-1"
RECEIVED = (Briefing, Scenario, Sense | End, Report, Drive, Drive | Farewell)
"""what worlds and agents decode"""


def missions() -> None:
    """Get ready for worlds and agents: imports, the command line, decoders, and code that has run."""
    parser()
    inline.play(load(MISSION))
    for kind in RECEIVED:
        wire.prepare(kind)
    environment.of_world()
    environment.of_robot()
