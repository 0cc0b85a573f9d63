"""The planners by name and, for `assured`, by the noise of the mission."""

from __future__ import annotations

from agent.planning import accuracy_seeking, assured, paper
from agent.planning.planner import Planner
from protocol.mission import Mission, PlannerName


def planner(name: PlannerName, mission: Mission) -> Planner:
    """Return the planner `name` for the noise of `mission`."""
    match name:
        case "paper":
            return paper
        case "assured":
            return assured if mission.noise.exact else accuracy_seeking
