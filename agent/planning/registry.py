"""The planners that are shipped with Tandem, by name. They are classes like those of users."""

from __future__ import annotations

from typing import Any

from agent.planning.accuracy_seeking import AccuracySeeking
from agent.planning.assured import AssuredExact
from agent.planning.log_exchange import LogPlanner
from agent.planning.paper import Paper
from agent.planning.planner import Planner
from protocol.mission import Mission


class Assured(AssuredExact):
    """The planner `assured`, of which there are two: for exact and for noisy sensors."""

    def suited(self, mission: Mission) -> LogPlanner:
        """Return the planner for the noise of `mission`."""
        return AssuredExact() if mission.noise.exact else AccuracySeeking()


PLANNER_CLASSES: dict[str, type[Planner[Any, Any]]] = {"assured": Assured, "paper": Paper}
"""The classes of the shipped planners."""


def planner(name: str, mission: Mission) -> Planner[Any, Any]:
    """Return the shipped planner `name` for the noise of `mission`. Raises KeyError if there is none."""
    return PLANNER_CLASSES[name]().suited(mission)
