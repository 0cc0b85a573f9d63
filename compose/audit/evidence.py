"""The evidence of an audit: the content of a run's journals, and the Observations recomputed from it."""

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
    """The content of an agent's journal, up to the first frame that is out of order."""

    past: Past | None
    """Content of the journal; None if it does not even contain a RobotConfig."""
    disorder: str | None = None
    """Description of the first frame that is out of order; frames after it are not read."""
    disorder_tick: int | None = None
    """Tick of that frame, if it has one."""
    missing: bool = False
    """Absence of the journal."""


class Testified(Protocol):
    """The evidence in the agents' journals, with or without a world's journal."""

    @property
    def pasts(self) -> dict[str, Past]:
        """The content of each agent's journal, by robot; robots without a RobotConfig are omitted."""


class Evidence(msgspec.Struct, frozen=True):
    """The evidence of a run with a world's journal."""

    history: History
    observations: tuple[dict[str, Observation], ...]
    """Observations of each tick, by robot, recomputed from the journaled Commands."""
    testimonies: dict[str, AgentLog]
    """Journal of each robot of the scenario."""

    @property
    def pasts(self) -> dict[str, Past]:
        """The content of each agent's journal, by robot; robots without a RobotConfig are omitted."""
        return {robot: one.past for robot, one in self.testimonies.items() if one.past is not None}

    @property
    def forced(self) -> bool:
        """True if the world may have continued without an answer: in real time, or after a timeout."""
        failed = self.history.end is not None and self.history.end.outcome == "failed"
        return failed or any(past.config.tick_s is not None for past in self.pasts.values())

    def contact(self, robot: str, tick: int) -> Contact | None:
        """Return the recomputed contact of `robot` at `tick`; None if there is none, or no ground truth."""
        if not 0 <= tick < len(self.observations):
            return None
        return next(iter(self.observations[tick][robot].contacts), None)

    def command(self, robot: str, tick: int) -> Command | None:
        """Return the Command of `robot` at `tick` in the world's journal; None if there is none."""
        return self.history.ticks[tick].commands.get(robot)


def evidence_of(journals: Mapping[str, Iterable[bytes]], folder: object) -> Evidence:
    """Return the evidence in the frames of `journals`, by file name; `folder` appears in error messages.

    Raises CorruptJournal, whose text names the journal.
    """
    run = history(journals[WORLD_JOURNAL], f"{folder}/{WORLD_JOURNAL}")
    testimonies = {}
    for robot in run.scenario.robots:
        name = agent_journal(robot.id)
        frames = list(journals.get(name, ()))
        agent_log = testimony_of(frames, f"{folder}/{name}") if name in journals else _MISSING
        if agent_log.past is not None and agent_log.past.config.robot != robot.id:
            raise CorruptJournal(f"{folder}/{name} is the journal of {agent_log.past.config.robot}")
        testimonies[robot.id] = agent_log
    sensed = tuple(
        [{observation.robot: observation for observation in observations(world)} for world in run.worlds]
    )
    return Evidence(run, sensed, testimonies)


_MISSING = AgentLog(None, missing=True)


def testimony_of(frames: list[bytes], source: object) -> AgentLog:
    """Return the content of an agent's journal, up to the first frame that is out of order.

    Raises CorruptJournal, whose text begins with `source`.
    """
    if is_blank(frames):
        return AgentLog(None)
    try:
        return AgentLog(past(frames, source))
    except OutOfOrder as error:
        return AgentLog(past(frames[: error.place], source), error.what, error.tick)


def other_versions(pasts: Mapping[str, Past]) -> str | None:
    """Return how the versions of the first robot that has others differ from those of this process.

    The result is None if no robot has other versions.
    """
    differences = [otherwise(past.environment, of_robot()) for past in pasts.values()]
    return next((one for one in differences if one is not None), None)
