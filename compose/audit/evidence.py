"""What is judged: a run, as its journals tell it, beside what the world's sensors must have said in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

import msgspec

from agent.process.agent_journal import OutOfOrder, Past, past
from compose.recording.run import WORLD_JOURNAL, agent_journal
from protocol.journal.environment import is_blank, of_robot, otherwise
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import Command, Contact, Observation
from world.tick import observations
from world.world_journal import History, history


class AgentLog(msgspec.Struct, frozen=True):
    """A robot's journal, as far as it can be followed."""

    past: Past | None
    """none where not even a briefing is on record"""
    disorder: str | None = None
    """what stands where it cannot; what comes after it is not read"""
    disorder_tick: int | None = None
    missing: bool = False
    """there is no such journal"""


class Testified(Protocol):
    """What robots' journals tell, whoever else tells something."""

    @property
    def pasts(self) -> dict[str, Past]:
        """Of the robots that tell one."""


class Evidence(msgspec.Struct, frozen=True):
    """A run, before the judge."""

    history: History
    observations: tuple[dict[str, Observation], ...]
    """what every robot senses, tick by tick, where the Commands on record have led it"""
    testimonies: dict[str, AgentLog]
    """of every robot of the scenario"""

    @property
    def pasts(self) -> dict[str, Past]:
        """Of the robots that tell one."""
        return {robot: one.past for robot, one in self.testimonies.items() if one.past is not None}

    @property
    def forced(self) -> bool:
        """Whether the world did not wait for every answer: in real time, or with its patience lost."""
        failed = self.history.end is not None and self.history.end.outcome == "failed"
        return failed or any(past.config.tick_s is not None for past in self.pasts.values())

    def contact(self, robot: str, tick: int) -> Contact | None:
        """The contact that `robot` truly had at that tick; none, too, where that is not on record."""
        if not 0 <= tick < len(self.observations):
            return None
        return next(iter(self.observations[tick][robot].contacts), None)

    def command(self, robot: str, tick: int) -> Command | None:
        """What the world had of `robot` at that tick."""
        return self.history.ticks[tick].commands.get(robot)


def case_of(journals: Mapping[str, Iterable[bytes]], folder: object) -> Evidence:
    """The frames of the journals in `folder`, by name, as a case.

    Raises CorruptJournal, whose text names the journal.
    """
    told = history(journals[WORLD_JOURNAL], f"{folder}/{WORLD_JOURNAL}")
    testimonies = {}
    for robot in told.scenario.robots:
        name = agent_journal(robot.id)
        frames = list(journals.get(name, ()))
        testimony = testimony_of(frames, f"{folder}/{name}") if name in journals else _NONE
        if testimony.past is not None and testimony.past.config.robot != robot.id:
            raise CorruptJournal(f"{folder}/{name} is the journal of {testimony.past.config.robot}")
        testimonies[robot.id] = testimony
    sensed = tuple(
        [{observation.robot: observation for observation in observations(world)} for world in told.worlds]
    )
    return Evidence(told, sensed, testimonies)


_NONE = AgentLog(None, missing=True)


def testimony_of(frames: list[bytes], source: object) -> AgentLog:
    """What `frames` tell, as far as that can be followed. Raises CorruptJournal."""
    if is_blank(frames):
        return AgentLog(None)
    try:
        return AgentLog(past(frames, source))
    except OutOfOrder as error:
        return AgentLog(past(frames[: error.place], source), error.what, error.tick)


def other_versions(pasts: Mapping[str, Past]) -> str | None:
    """In what the first robot's versions differ from those here, of the robots whose do."""
    told = [otherwise(past.environment, of_robot()) for past in pasts.values()]
    return next((one for one in told if one is not None), None)
