"""The journal of a robot's hardware: what its driver measured and drove, as far as a restart needs it.

A Sense stands here before the agent gets it, and a Drive before the wheels do. So after a kill nothing has
been told or driven that is not on record, and at most the reading of one tick has to be taken again. After a
power cut that holds if each write was synced (`--fsync`); if not, the robot does not go on: what it would
tell could contradict what it has told, and its peer would raise an alarm.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from protocol.journal import CorruptJournal
from protocol.messages import Briefing, Drive, End, Message, Report, Sense
from protocol.units import Finite, RobotId, Tick
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode

MAX_MARK = 64
"""numbers of a mark"""


def driver_journal(robot: str) -> str:
    """The name of the file."""
    return f"driver-{robot}.journal"


class Mark(Message, frozen=True):
    """The mark of a reading (see `driver.Reading`); it stands before the Sense that the reading makes."""

    tick: Tick
    robot: RobotId
    mark: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=MAX_MARK)]


class Start(Message, frozen=True):
    """The start of the process that writes from here on."""

    boot: Annotated[str, msgspec.Meta(max_length=64)]
    """of the computer, since it was switched on; empty where that is not to be had"""
    synced: bool
    """whether each write is on the disk before anything follows from it"""


def boot() -> str:
    """Return what names the time since this computer was switched on; "" where the system does not tell."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return ""


BOOT = Path("/proc/sys/kernel/random/boot_id")


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
    start: Start | None = None
    """the latest"""

    @property
    def tick(self) -> int:
        """The latest."""
        return len(self.ticks) - 1

    @property
    def may_lack(self) -> bool:
        """Whether the computer has been started again since, which may have taken what had been told."""
        start = self.start
        return self.end is None and start is not None and not start.synced and start.boot != boot()


def driver_past(frames: Sequence[bytes], briefing: Briefing, path: Path) -> DriverPast:
    """What `frames` tell of the mission of `briefing`. Raises CorruptJournal."""
    ticks: list[DrivenTick] = []
    mark: tuple[float, ...] = ()
    marked: Mark | None = None
    end: End | None = None
    start: Start | None = None
    for place, frame in enumerate(frames):
        message = _message(frame, path)
        match message:
            case Briefing() if place == 0:
                if message != briefing:
                    raise CorruptJournal(f"{path}: another run's: its briefing is not this mission's")
            case Start() if place > 0 and end is None:
                start = message
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
    return DriverPast(tuple(ticks), mark, end, start)


def _message(frame: bytes, path: Path) -> Briefing | Start | Mark | Sense | Drive | Report | End:
    try:
        return decode(frame, Briefing | Start | Mark | Sense | Drive | Report | End, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{path}: {error}") from None
