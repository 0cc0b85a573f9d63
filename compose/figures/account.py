"""The planner states of a robot, recomputed from the inputs in its journal."""

from __future__ import annotations

import msgspec

from agent.planning.state import RobotState
from agent.process.agent_journal import AgentHistory
from agent.process.planner_replay import PlannerReplay
from compose.recording.run import Run
from protocol.messages import Estimate


class Account(msgspec.Struct, frozen=True):
    """The journal of one robot, with the recomputed planner states."""

    agent: AgentHistory | None
    """The journal's content; None if the robot was killed before it received its configuration."""
    states: tuple[RobotState, ...] = ()
    """The state after each tick in which the robot decided, starting at tick 0."""
    broken: str | None = None
    """The reason why `states` ends before the recording does; None if it does not."""

    @property
    def held(self) -> tuple[Estimate, ...]:
        """The journaled estimates."""
        return self.agent.estimates if self.agent is not None else ()


def account(run: Run, robot: str) -> Account:
    """Take the journal of `robot` in `run`, and run its planner again on the journaled inputs.

    Raises OSError if there is no journal, CorruptJournal if it is damaged before its end or belongs to
    another robot or run.
    """
    agent = run.agent(robot)
    return _recomputed(agent) if agent is not None else Account(None)


def _recomputed(agent: AgentHistory) -> Account:
    """Repeat every decision. Stops at the first that differs from the recording."""
    replay = PlannerReplay(agent)
    states: list[RobotState] = []
    try:
        for step in replay:
            if step.command is None:
                break
            if replay.robot.command_frame != step.command_frame:
                why = (
                    f"the recorded decision at tick {replay.tick} differs: another version wrote the journal"
                )
                return Account(agent, tuple(states), why)
            states.append(replay.robot.state)
    except Exception as error:  # noqa: BLE001  # recorded inputs may raise any error in the planner
        why = f"the planner fails on its inputs of tick {replay.tick}: {type(error).__name__}: {error}"
        return Account(agent, tuple(states), why)
    return Account(agent, tuple(states))
