"""The planner states of a robot, recomputed from the inputs in its journal."""

from __future__ import annotations

from typing import Any

import msgspec

from agent.planning.group import GroupPlanner
from agent.planning.planner import Planner
from agent.planning.state import RobotState
from agent.process.agent_journal import AgentHistory
from agent.process.robot import PlannerReplay
from compose.errors import UserError
from compose.launch.planner_loader import planner_of
from compose.recording.run import Run
from protocol.messages import Estimate


class AgentReplay(msgspec.Struct, frozen=True):
    """The journal of one robot, with the recomputed planner states."""

    history: AgentHistory | None
    """The journal's content; None if the robot was killed before it received its configuration."""
    states: tuple[RobotState, ...] = ()
    """The state after each tick in which the robot decided, from tick 0."""
    broken: str | None = None
    """The reason why `states` ends before the recording does; None if it does not."""
    planner: Planner[Any, Any] | None = None
    """The planner, in a group that of a meeting; None if it cannot be drawn or its code is not loaded."""

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """The journaled estimates."""
        return self.history.estimates if self.history is not None else ()


def agent_replay(run: Run, robot: str) -> AgentReplay:
    """Return the journal of `robot` in `run`, with its planner run again on the journaled inputs.

    Raises OSError if there is no journal, CorruptJournal if it is damaged before its end or belongs to
    another robot or run.
    """
    history = run.agent(robot)
    if history is None:
        return AgentReplay(None)
    try:
        planner = planner_of(history.config)
    except UserError:
        return AgentReplay(history)
    drawn = planner.pair_planner if isinstance(planner, GroupPlanner) else planner
    if drawn.MANOEUVRES is None:
        return AgentReplay(history)
    again, states, why = PlannerReplay(history, planner), [], None
    try:
        for step in again:
            if step.command is None:
                break
            if again.robot.command_frame != step.command_frame:
                why = f"the recorded decision at tick {again.tick} differs: another version wrote the journal"
                break
            states.append(again.robot.state)
    except Exception as error:  # noqa: BLE001  # recorded inputs may raise any error in the planner
        why = f"the planner fails on its inputs of tick {again.tick}: {type(error).__name__}: {error}"
    return AgentReplay(history, tuple(states), why, drawn)
