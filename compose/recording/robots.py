"""The robots of a record without a world: who has left a journal, and how it ended by what they say.

Nobody knows the truth of it. What each measured and decided is on record; where it was, only as it claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from compose.recording.run import WORLD_JOURNAL, agent_journal, journals_in, past_of, robot_of
from compose.recording.summary_json import broken_off, ended
from protocol.journal import journal_file
from protocol.journal.environment import named_in
from protocol.journal.journal_file import CorruptJournal
from protocol.messages import RobotConfig
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode

if TYPE_CHECKING:
    from agent.process.agent_journal import Past


def alone(folder: Path) -> bool:
    """Whether there are robots' journals in `folder`, and no world's."""
    names = [path.name for path in journals_in(folder)]
    return bool(names) and WORLD_JOURNAL not in names


def pasts(folder: Path) -> dict[str, Past]:
    """What each robot has left in `folder`; nothing of one that was never briefed.

    Raises OSError if a journal cannot be read, CorruptJournal if one is damaged before its end, or of another
    run than its peer's.
    """
    told = {robot: past_of(folder, robot) for robot in map(robot_of, journals_in(folder))}
    found = {robot: past for robot, past in told.items() if past is not None}
    agree({robot: past.config for robot, past in found.items()}, folder)
    return found


def casts(folder: Path) -> list[tuple[str, ...]]:
    """The pairs of which one has left a journal in `folder`, a first; and who was never briefed, alone.

    Raises OSError if one cannot be read, CorruptJournal if one is of another run than its peer's.
    """
    robots = [robot_of(path) for path in journals_in(folder)]
    told = {
        robot: config
        for robot in robots
        if (config := _briefing(folder / agent_journal(robot))) is not None and config.robot == robot
    }
    agree(told, folder)
    pairs = [(one.robot, one.peer) if one.role == "a" else (one.peer, one.robot) for one in told.values()]
    paired = {robot for pair in pairs for robot in pair}
    return [*dict.fromkeys(pairs), *[(robot,) for robot in robots if robot not in paired]]


def agree(told: Mapping[str, RobotConfig], folder: object) -> None:
    """Peers were briefed for one mission. Raises CorruptJournal if any two were not, or they are no pair."""
    for robot, one in told.items():
        other = told.get(one.peer)
        if other is not None and _shared(one, robot) != _shared(other, robot):
            raise CorruptJournal(
                f"{folder}/{agent_journal(one.peer)}: another run's: its briefing is not of {robot}'s peer"
            )


def _shared(config: RobotConfig, robot: str) -> tuple[object, ...]:
    """What both of a pair are told, seen from `robot`."""
    own = config.robot == robot
    return (
        config.robot if own else config.peer,
        (config.role == "a") == own,
        config.anchor if own else config.peer_anchor,
        config.peer_anchor if own else config.anchor,
        config.mission,
        config.planner_name,
        config.rendezvous,
        config.tick_s,
    )


def _briefing(path: Path) -> RobotConfig | None:
    """None where it does not begin with one."""
    try:
        frames = journal_file.Tail(path).news()
        head = frames[named_in(frames) is not None :]
        return decode(head[0], RobotConfig, MAX_FRAME_BYTES) if head else None
    except (CorruptJournal, MalformedFrame):
        return None


def outcome(told: Mapping[str, Past]) -> str:
    """How it ended, by what each says; once, where they agree."""
    ends = {
        robot: ended(past.end.outcome, past.end.tick, past.end.reason)
        if past.end is not None
        else broken_off(len(past.steps) - 1)
        for robot, past in told.items()
    }
    if len(set(ends.values())) == 1:
        return next(iter(ends.values()))
    return "; ".join([f"{robot}: {end}" for robot, end in ends.items()])
