"""The planners by name. A planner is imported when it is asked for."""

from __future__ import annotations

from functools import cache

from agent.planning.planner import Planner
from protocol.mission import PlannerName


@cache
def planner(name: PlannerName) -> Planner:
    """Return the planner `name`."""
    match name:
        case "paper":
            from agent.planning import paper  # noqa: PLC0415  # a robot has one planner

            return paper
        case "assured":
            from agent.planning import assured  # noqa: PLC0415

            return assured
