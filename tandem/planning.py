"""The names with which planners are written: the contract, its messages, and the shipped planners.

>>> from tandem.planning import Paper
>>> import tandem
>>> tandem.run("paper-1", planner=Paper).outcome
'localised'
"""

from __future__ import annotations

from typing import Any

from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.planning.assured import Assured
from agent.planning.exchange import LogPlanner
from agent.planning.paper import Paper
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.planner import Planner, Summary
from agent.planning.state import RobotState
from agent.planning.team import TeamPlanner
from protocol.messages import (
    MAX_BODY_BYTES,
    Command,
    Contact,
    Estimate,
    Inconsistent,
    Localised,
    Observation,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.mission import Anchor, Mission
from protocol.motion import REST, Controls, Covariance, Pose, compose, inverse, step, wrap
from protocol.orbits import Orbit, Rendezvous

__all__ = [
    "MAX_BODY_BYTES",
    "REST",
    "Anchor",
    "Assured",
    "Command",
    "Contact",
    "Controls",
    "Covariance",
    "Estimate",
    "Inconsistent",
    "Localised",
    "LogPlanner",
    "Mission",
    "Observation",
    "Orbit",
    "Paper",
    "Plan",
    "Planner",
    "PlanningHypothesis",
    "Pose",
    "Question",
    "Rendezvous",
    "Report",
    "RobotConfig",
    "RobotState",
    "Summary",
    "TeamPlanner",
    "Undecided",
    "compose",
    "inverse",
    "step",
    "wrap",
]


def __getattr__(name: str) -> Any:
    """Raise ImportError for a name that was removed, and AttributeError for others."""
    if name in ("AssuredExact", "AccuracySeeking"):
        raise ImportError(f"tandem.planning.{name} was removed in version 0.3: subclass Assured")
    raise AttributeError(f"module 'tandem.planning' has no attribute '{name}'")
