"""What robots' own journals tell of a run that had no world, or whose world has left no journal.

Nobody knows the truth of it. What each measured and decided is on record; where it was, only as it claims.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from compose.record import WORLD_JOURNAL, agent_journal, journals_in, past_of, robot_of
from compose.summary import ended
from compose.ticks import Row
from protocol import journal
from protocol.messages import Briefing, Contact
from protocol.motion import Pose, compose
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode

if TYPE_CHECKING:
    from agent.past import Past


def is_worldless(folder: Path) -> bool:
    """Whether there are robots' journals in `folder`, and no world's."""
    names = [path.name for path in journals_in(folder)]
    return bool(names) and WORLD_JOURNAL not in names


def pasts(folder: Path) -> dict[str, Past]:
    """What each robot has left in `folder`; nothing of one that was never briefed.

    Raises OSError if a journal cannot be read, journal.CorruptJournal if one is damaged before its end.
    """
    told = {robot: past_of(folder, robot) for robot in map(robot_of, journals_in(folder))}
    return {robot: past for robot, past in told.items() if past is not None}


def casts(folder: Path) -> list[tuple[str, ...]]:
    """The robots that have left a journal in `folder`, each with its peer if that has, too; a first.

    Raises OSError if one cannot be read.
    """
    robots = [robot_of(path) for path in journals_in(folder)]
    told = {robot: _briefing(folder / agent_journal(robot)) for robot in robots}
    found: list[tuple[str, ...]] = []
    for robot in robots:
        briefing = told[robot]
        peer = briefing.peer if briefing is not None else None
        if briefing is None or peer not in told:
            found.append((robot,))
        elif briefing.role == "a":
            found.append((robot, peer))
        elif (theirs := told[peer]) is None or theirs.peer != robot:
            found.append((robot,))
    return found


def _briefing(path: Path) -> Briefing | None:
    """None where it does not begin with one."""
    frames = journal.Tail(path).news()
    try:
        return decode(frames[0], Briefing, MAX_FRAME_BYTES) if frames else None
    except MalformedFrame:
        return None


def contact(past: Past, tick: int) -> Contact | None:
    """With its peer, as it sensed it at `tick`."""
    contacts = past.steps[tick].sense.contacts if tick < len(past.steps) else ()
    return contacts[0] if contacts else None


def path(past: Past) -> tuple[Pose, ...]:
    """Where it was in the plane, tick by tick, as it claims: its odometry, laid through its claim.

    Empty, if it never claimed.
    """
    claim, odometry = past.claim, past.odometry
    if claim is None:
        return ()
    tick, said = claim
    there, local = said.pose, odometry[tick]
    turned = compose(Pose(0.0, 0.0, there.heading - local.heading), local)
    frame = Pose(there.x - turned.x, there.y - turned.y, there.heading - local.heading)
    return tuple([compose(frame, pose) for pose in odometry])


def outcome(told: Mapping[str, Past]) -> str:
    """How it ended, by what each says; once, where they agree."""
    ends = {
        robot: f"the record breaks off after {max(0, len(past.steps) - 1)} ticks"
        if past.end is None
        else ended(past.end.outcome, past.end.tick, past.end.reason)
        for robot, past in told.items()
    }
    if len(set(ends.values())) == 1:
        return next(iter(ends.values()))
    return "; ".join([f"{robot} {end}" for robot, end in ends.items()])


def rows(told: Mapping[str, Past]) -> Iterator[Row]:
    """One per tick and robot, tick by tick; speeds as measured, and of its true pose nothing."""
    for tick in range(max([len(past.steps) for past in told.values()], default=0)):
        for robot, past in told.items():
            if tick >= len(past.steps):
                continue
            sense, drive = past.steps[tick].sense, past.steps[tick].drive
            after = past.steps[tick + 1].sense.executed if tick + 1 < len(past.steps) else None
            met = contact(past, tick)
            yield Row(
                tick,
                robot,
                x=None,
                y=None,
                heading=None,
                v=after.v if after is not None else None,
                omega=after.omega if after is not None else None,
                anchor_range=sense.anchor_range,
                mutual_range=met.range if met is not None else None,
                phase=drive.phase if drive is not None else None,
                state=drive.state if drive is not None else None,
            )
