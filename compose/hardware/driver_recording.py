"""The recording of one robot in hardware mode: the journals of its agent and its driver, for a resume."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from compose.launch.driver_loader import resume_driver
from compose.recording.recording_files import agent_journal
from compose.terminal.outcome import reopened
from protocol.journal.journal_file import CannotRecord, CorruptJournal, Journal, message_in
from protocol.journal.resume import Retrace
from protocol.messages import Observation, OfRobot, RobotConfig
from protocol.network.inbox import Inbox
from protocol.wire import encode
from world.hardware.bridge import Field
from world.hardware.driver import Driver
from world.hardware.driver_journal import DriverHistory, ProcessStart, boot, driver_history, driver_journal

RELEASE_S = 10.0
"""Time in s that the agent of a killed launcher has to end, which unlocks its journal."""
RECORDING_POLL_S = 0.02
"""The polling interval in s."""


class DriverRecord(msgspec.Struct, frozen=True):
    """The content of both journals; the driver's journal is open for writing."""

    journal: Journal
    """Journal of the driver."""
    history: DriverHistory
    """Content of the driver's journal when it was opened."""
    known: int
    """Latest tick in the agent's journal; -1 if there is none."""
    again: bool
    """True if the journals existed before."""
    start: ProcessStart
    """Start of this process."""

    def take_up(self, driver: Driver, name: str, field: Field) -> None:
        """Resume the mission with `driver`, called `name` in errors. Raises UserError if it cannot."""
        if self.history.ticks:
            resume_driver(driver, name, self.history)
        if self.again:
            field.resume(self.history, self.known)
        if self.history.end is None and self.history.start != self.start:
            self.journal.write(encode(self.start))


@contextmanager
def recorded(folder: Path, config: RobotConfig, inbox: Inbox, *, fsync: bool) -> Iterator[DriverRecord]:
    """Yield the recording in `folder` of the robot with `config`; a new one if there is none.

    Raises CannotRecord, and CorruptJournal if the journals are not of the same robot and run, or if Reports
    that the robot has sent may be missing in them.
    """
    start = ProcessStart(boot(), fsync)
    path = folder / driver_journal(config.robot)
    agents = folder / agent_journal(config.robot)
    if not path.exists():
        if _frames(agents, inbox):
            raise CannotRecord(f"{agents} exists, and {path.name} does not; choose another folder")
        with Journal(path, fsync=fsync) as journal:
            journal.write(encode(config))
            yield DriverRecord(journal, DriverHistory(), -1, again=False, start=start)
        return
    old = Retrace(path, fsync=fsync)
    try:
        history = driver_history(old.frames, config, path)
        if history.may_lack:
            raise CorruptJournal(
                f"{path} was written without --fsync, and this computer has restarted since: "
                "Reports that the robot sent to its peer may be missing in it"
            )
        known = _known(_frames(agents, inbox), history, agents)
        old.write(*(old.frames or [encode(config)]))
    except BaseException:
        old.close()
        raise
    with reopened(old, inbox) as journal:
        yield DriverRecord(journal, history, known, again=True, start=start)


def _frames(path: Path, inbox: Inbox) -> list[bytes]:
    """Return the frames of the agent's journal once it is unlocked. Raises CannotRecord or CorruptJournal."""
    give_up = time.monotonic() + RELEASE_S
    while path.exists():
        try:
            old = Retrace(path)
        except CannotRecord:
            if time.monotonic() >= give_up:
                raise
            inbox.next(RECORDING_POLL_S)
        else:
            old.close()
            return old.frames
    return []


def _known(frames: list[bytes], history: DriverHistory, path: Path) -> int:
    """Return the latest tick in the agent's `frames`, -1 if there is none.

    Raises CorruptJournal unless each Observation in them is that of the same tick in the driver's journal.
    """
    known = -1
    for frame in frames:
        if isinstance(message_in(frame, OfRobot, path), Observation):
            known += 1
            if known > history.tick:
                raise CorruptJournal(
                    f"{path} continues after tick {history.tick}, where the driver's journal ends; "
                    "only with --fsync do both survive a power cut"
                )
            if frame != history.ticks[known].frame:
                raise CorruptJournal(
                    f"{path}: the Observation of tick {known} differs from the one in the driver's journal"
                )
    return known
