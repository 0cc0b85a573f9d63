"""The journal of a robot's hardware: what its driver measured and drove, as far as a restart needs it.

A Sense stands here before the agent gets it, and a Drive before the wheels do. So after a kill nothing has
been told or driven that is not on record, and at most the reading of one tick has to be taken again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from protocol.journal import CorruptJournal
from protocol.messages import Briefing, Drive, End, Message, Report, Sense
from protocol.units import RobotId, Tick
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode


def driver_journal(robot: str) -> str:
    """The name of the file."""
    return f"driver-{robot}.journal"


class Mark(Message, frozen=True):
    """The mark of a reading (see `driver.Reading`); it stands before the Sense that the reading makes."""

    tick: Tick
    robot: RobotId
    mark: tuple[float, ...]


class DrivenTick(msgspec.Struct, frozen=True):
    """One tick on record."""

    sense: Sense
    frame: bytes
    drive: Drive | None = None
    """none if none came in time"""
    reports: tuple[Report, ...] = ()
    """of the peer, as far as they bear on when the mission is over"""


class DriverPast(msgspec.Struct, frozen=True):
    """A driver's journal, whole or up to where it breaks off."""

    ticks: tuple[DrivenTick, ...] = ()
    mark: tuple[float, ...] = ()
    """of the latest reading"""
    end: End | None = None

    @property
    def tick(self) -> int:
        """The latest."""
        return len(self.ticks) - 1


def driver_past(frames: Sequence[bytes], briefing: Briefing, path: Path) -> DriverPast:
    """What `frames` tell of the mission of `briefing`. Raises CorruptJournal."""
    ticks: list[DrivenTick] = []
    mark: tuple[float, ...] = ()
    marked: Mark | None = None
    end: End | None = None
    for place, frame in enumerate(frames):
        try:
            message = decode(frame, Briefing | Mark | Sense | Drive | Report | End, MAX_FRAME_BYTES)
        except MalformedFrame as error:
            raise CorruptJournal(f"{path}: {error}") from None
        match message:
            case Briefing() if place == 0:
                if message != briefing:
                    raise CorruptJournal(f"{path}: another run's: its briefing is not this mission's")
            case Mark(tick) if tick == len(ticks):
                marked = message
            case Sense(tick) if tick == len(ticks) and place > 0:
                ticks.append(DrivenTick(message, frame))
                mark = marked.mark if marked is not None and marked.tick == tick else ()
            case Drive() if ticks and message.tick == ticks[-1].sense.tick and ticks[-1].drive is None:
                ticks[-1] = msgspec.structs.replace(ticks[-1], drive=message)
            case Report() if ticks:
                ticks[-1] = msgspec.structs.replace(ticks[-1], reports=(*ticks[-1].reports, message))
            case End() if end is None:
                end = message
            case _:
                raise CorruptJournal(f"{path}: a {type(message).__name__} is out of order")
    return DriverPast(tuple(ticks), mark, end)
