"""The journal of a robot's driver: the measurements and commands that a resume needs.

An Observation is written before it is sent to the agent, and a Command before it is executed. After a kill,
the journal therefore contains everything that was sent or executed, and at most the reading of one tick has
to be repeated. After a power cut this holds only if each write was synced (`--fsync`). If not, the robot
refuses to resume: its Reports could contradict earlier ones, and its peer would find them inconsistent.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from protocol.journal.journal_file import CorruptJournal, message_in
from protocol.messages import Command, Message, MissionEnd, Observation, RobotConfig, TickStart
from protocol.units import Finite, RobotId, Tick

MAX_MARK = 64
"""The maximum number of values of a mark."""


def driver_journal(robot: str) -> str:
    """Return the name of the journal's file."""
    return f"driver-{robot}.journal"


class Mark(Message, frozen=True):
    """The mark of a reading (see `driver.Reading`), written before the Observation made from that reading."""

    tick: Tick
    robot: RobotId
    mark: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=MAX_MARK)]


class ProcessStart(Message, frozen=True):
    """The start of the process that writes the frames after it."""

    boot: Annotated[str, msgspec.Meta(max_length=64)]
    """The identifier of the computer's boot; empty if the system does not provide one."""
    synced: bool
    """True if each write is synced to the disk before the process continues."""


def boot() -> str:
    """Return the identifier of this computer's current boot; "" if the system does not provide one."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return ""


BOOT = Path("/proc/sys/kernel/random/boot_id")


class DrivenTick(msgspec.Struct, frozen=True):
    """One tick of a driver's journal."""

    observation: Observation
    frame: bytes
    """The frame of the Observation."""
    command: Command | None = None
    """The Command of the agent; None if it missed the deadline."""
    received: tuple[TickStart, ...] = ()
    """The messages of other robots that affect when the mission ends."""


class DriverHistory(msgspec.Struct, frozen=True):
    """The content of a driver's journal, complete or up to where it breaks off."""

    ticks: tuple[DrivenTick, ...] = ()
    mark: tuple[float, ...] = ()
    """The mark of the latest reading; empty if it has none."""
    end: MissionEnd | None = None
    start: ProcessStart | None = None
    """The latest start of the driver's process."""

    @property
    def tick(self) -> int:
        """The latest tick; -1 if there is none."""
        return len(self.ticks) - 1

    @property
    def may_lack(self) -> bool:
        """True if frames may be missing: writes were not synced, and the computer has been rebooted since."""
        start = self.start
        return self.end is None and start is not None and not start.synced and start.boot != boot()


OfDriver = RobotConfig | ProcessStart | Mark | Observation | Command | TickStart | MissionEnd
"""The kinds of messages in the journal of a driver."""


def driver_history(frames: Sequence[bytes], config: RobotConfig, path: Path) -> DriverHistory:
    """Return the content of the journal at `path` from its `frames`.

    Raises CorruptJournal if a frame is malformed or out of order, or if it is not the mission of `config`.
    """
    ticks: list[DrivenTick] = []
    mark: tuple[float, ...] = ()
    marked: Mark | None = None
    end: MissionEnd | None = None
    start: ProcessStart | None = None
    for index, frame in enumerate(frames):
        message = message_in(frame, OfDriver, path)
        match message:
            case RobotConfig() if index == 0:
                if message != config:
                    raise CorruptJournal(f"{path}: it belongs to another mission: its RobotConfig differs")
            case ProcessStart() if index > 0 and end is None:
                start = message
            case Mark(tick) if tick == len(ticks):
                marked = message
            case Observation(tick) if tick == len(ticks) and index > 0:
                ticks.append(DrivenTick(message, frame))
                mark = marked.mark if marked is not None and marked.tick == tick else ()
            case Command() if (
                ticks and message.tick == ticks[-1].observation.tick and ticks[-1].command is None
            ):
                ticks[-1] = msgspec.structs.replace(ticks[-1], command=message)
            case TickStart() if ticks:
                ticks[-1] = msgspec.structs.replace(ticks[-1], received=(*ticks[-1].received, message))
            case MissionEnd() if end is None:
                end = message
            case _:
                raise CorruptJournal(f"{path}: frame {index + 1}, {type(message).__name__}, is out of order")
    return DriverHistory(tuple(ticks), mark, end, start)
