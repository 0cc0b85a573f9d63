"""Work that a fork server does once, so that none of the processes forked from it has to."""

from __future__ import annotations

import compose.commands.agent
import compose.commands.world  # noqa: F401  # imported to be there
from compose import inline
from compose.cli import parser
from compose.scenario import load
from protocol import environment

MISSION = "paper-1"


def missions() -> None:
    """Get ready for worlds and agents: what is imported, the command line, and code that has run."""
    parser()
    inline.play(load(MISSION))
    environment.of_world()
    environment.of_robot()
