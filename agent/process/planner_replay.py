"""The replay of a robot's journal: the planner runs again on the recorded inputs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from agent.planning.planner import Planner
from agent.process.agent_journal import AgentHistory, Step
from agent.process.robot import Robot
from protocol.journal.journal_file import Sink


class PlannerReplay:
    """The planner of one robot, run again tick by tick on the inputs in its journal.

    Iterate over it once. After each step, `robot` has the recomputed state and frames of that tick. An error
    of the planner is raised as it is, and `tick` is then the tick in which it occurred.
    """

    def __init__(
        self, history: AgentHistory, planner: Planner[Any, Any], journal: Sink | None = None
    ) -> None:
        """Prepare the replay of `history` with `planner`, which its configuration names.

        Everything that the robot recomputes is written to `journal`.
        """
        self.robot = Robot(history.config, planner)
        self.robot.append_to(journal)
        self.tick: int | None = None
        """The tick of the current step; None before the first."""
        self._steps = history.steps

    def __iter__(self) -> Iterator[Step]:
        """Yield each step after the robot has observed it and, if its Command is recorded, has decided."""
        for step in self._steps:
            self.tick = step.observation.tick
            self.robot.observation(step.observation, step.frame)
            if step.command is not None:
                self.robot.decide(step.received, step.missed)
            yield step
