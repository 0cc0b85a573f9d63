"""What a robot's own journal tells of its mind: its planner, run again on what came in."""

from __future__ import annotations

from pathlib import Path

import msgspec

from agent.planning.state import RobotState
from agent.process.agent_journal import Past
from agent.process.robot import Robot
from compose.recording.run import past_of
from protocol.messages import Estimate
from protocol.wire import encode


class Account(msgspec.Struct, frozen=True):
    """One robot's own record."""

    past: Past | None
    """none if it was killed before it was briefed"""
    states: tuple[RobotState, ...] = ()
    """after each tick, from 0 on, as far as it decided in it"""
    broken: str | None = None
    """why minds end before the record does, if they do"""

    @property
    def held(self) -> tuple[Estimate, ...]:
        """What it held possible, as it journaled."""
        return self.past.estimates if self.past is not None else ()


def account(folder: Path, robot: str) -> Account:
    """What `robot` journaled, and its planner run again on it.

    Raises OSError if there is no journal, CorruptJournal if it is damaged before its end, or another's.
    """
    told = past_of(folder, robot)
    return _again(told) if told is not None else Account(None)


def _again(told: Past) -> Account:
    """Every decision once more, which must be the one on record."""
    robot = Robot(told.config)
    states: list[RobotState] = []
    for step in told.steps:
        tick = step.observation.tick
        try:
            robot.observation(step.observation, step.frame)
            if step.command is None:
                break
            robot.decide(step.heard, step.missed)
        except Exception as error:  # noqa: BLE001  # whatever the inputs on record do to it
            why = f"the planner cannot go on from its inputs of tick {tick}: {type(error).__name__}: {error}"
            return Account(told, tuple(states), why)
        if robot.drive_frame != encode(step.command):
            why = f"on record it decided otherwise at tick {tick}: the journal is another version's"
            return Account(told, tuple(states), why)
        states.append(robot.mind)
    return Account(told, tuple(states))
