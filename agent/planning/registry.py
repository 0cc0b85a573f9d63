"""The planners that are shipped with Tandem, by name. They are classes like those of users."""

from __future__ import annotations

from typing import Any

from agent.planning.assured import Assured
from agent.planning.paper import Paper
from agent.planning.planner import Planner

PLANNER_CLASSES: dict[str, type[Planner[Any, Any]]] = {"assured": Assured, "paper": Paper}
"""The classes of the shipped planners."""
