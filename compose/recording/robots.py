"""The robots of a recording of hardware mode: their journals, their pairs and the outcome that they recorded.

Such a recording has no ground truth. It contains what each robot measured and decided.
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
    """Return whether `folder` contains agents' journals and no world's journal."""
    names = [path.name for path in journals_in(folder)]
    return bool(names) and WORLD_JOURNAL not in names


def pasts(folder: Path) -> dict[str, Past]:
    """Return the content of each agent's journal in `folder`, by robot.

    Journals without a RobotConfig are omitted. Raises OSError if a journal cannot be read, CorruptJournal if
    one is damaged before its end or belongs to another run than its peer's.
    """
    contents = {robot: past_of(folder, robot) for robot in map(robot_of, journals_in(folder))}
    found = {robot: past for robot, past in contents.items() if past is not None}
    agree({robot: past.config for robot, past in found.items()}, folder)
    return found


def casts(folder: Path) -> list[tuple[str, ...]]:
    """Return the pairs of which at least one robot has a journal in `folder`, role a first.

    A robot whose journal has no RobotConfig is in a tuple of its own. Raises OSError if a journal cannot be
    read, CorruptJournal if one belongs to another run than its peer's.
    """
    robots = [robot_of(path) for path in journals_in(folder)]
    configs = {
        robot: config
        for robot in robots
        if (config := _config(folder / agent_journal(robot))) is not None and config.robot == robot
    }
    agree(configs, folder)
    pairs = [(one.robot, one.peer) if one.role == "a" else (one.peer, one.robot) for one in configs.values()]
    paired = {robot for pair in pairs for robot in pair}
    return [*dict.fromkeys(pairs), *[(robot,) for robot in robots if robot not in paired]]


def agree(configs: Mapping[str, RobotConfig], folder: object) -> None:
    """Raise CorruptJournal if the configurations of two peers are not of the same pair and mission."""
    for robot, one in configs.items():
        other = configs.get(one.peer)
        if other is not None and _shared(one, robot) != _shared(other, robot):
            path = f"{folder}/{agent_journal(one.peer)}"
            raise CorruptJournal(
                f"{path}: belongs to another run: its configuration does not match {robot}'s"
            )


def _shared(config: RobotConfig, robot: str) -> tuple[object, ...]:
    """Return the part of a configuration that both robots of a pair share, in the view of `robot`."""
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


def _config(path: Path) -> RobotConfig | None:
    """Return the RobotConfig at the beginning of an agent's journal; None if there is none."""
    try:
        frames = journal_file.Tail(path).news()
        head = frames[named_in(frames) is not None :]
        return decode(head[0], RobotConfig, MAX_FRAME_BYTES) if head else None
    except (CorruptJournal, MalformedFrame):
        return None


def outcome(pasts: Mapping[str, Past]) -> str:
    """Return the outcome that each robot recorded, in one line; if all agree, once."""
    ends = {
        robot: ended(past.end.outcome, past.end.tick, past.end.reason)
        if past.end is not None
        else broken_off(len(past.steps) - 1)
        for robot, past in pasts.items()
    }
    if len(set(ends.values())) == 1:
        return next(iter(ends.values()))
    return "; ".join([f"{robot}: {end}" for robot, end in ends.items()])
