"""The planners by name."""

from __future__ import annotations

from agent.planning import assured, paper
from agent.planning.planner import Planner
from protocol.mission import PlannerName

PLANNERS: dict[PlannerName, Planner] = {"assured": assured, "paper": paper}


def planner(name: PlannerName) -> Planner:
    """Return the planner `name`."""
    return PLANNERS[name]
