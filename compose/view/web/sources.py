"""Sources of runs for the page: recordings, complete or growing, and missions on a network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal, journals_in
from compose.recording.run_setup import RunSetup
from compose.view.recorded import Journals
from compose.view.run_data import RunData
from protocol.messages import MissionEnd
from world.scenario import Scenario

REVISIONS_KEPT = 1000
"""The number of stored revisions. A page that has missed more reloads all scenes."""
UNANSWERED = 5
"""The maximum number of ticks by which the head goes back to a tick with all commands."""


def end_of(end: MissionEnd | None) -> dict[str, Any] | None:
    """Return the end of a mission for the page, as its value in JSON; None before."""
    return None if end is None else {"tick": end.tick, "outcome": end.outcome, "reason": reason_for(end)}


class WatchedRun(ABC):
    """A run that pages can watch."""

    live: bool
    """True if new data may arrive."""
    setup: RunSetup | None
    """The static data of the run; None until it is known."""

    def __init__(self, name: str, known: RunData) -> None:
        self.name = name
        """The name of the run, unique within one server and part of URLs."""
        self.known = known
        self.notes: list[str] = []
        self.version = 0
        """The number of polls that changed the run."""
        self._revisions: deque[tuple[int, int]] = deque(maxlen=REVISIONS_KEPT)

    @abstractmethod
    def poll(self) -> None:
        """Read new data."""

    def revised(self) -> None:
        """Record a revision if the data has changed. Subclasses call this at the end of `poll`."""
        if self.known.touched is not None:
            self.version += 1
            self._revisions.append((self.version, self.known.touched))
            self.known.touched = None

    def since(self, version: int) -> int | None:
        """Return the first tick that changed after `version`; None if none did."""
        if version >= self.version:
            return None
        if not self._revisions or self._revisions[0][0] > version + 1:
            return 0
        return min(tick for revision, tick in self._revisions if revision > version)

    @property
    def head(self) -> int:
        """The latest tick to show.

        It is the last tick, or, in a live run, the latest of the last UNANSWERED ticks in which every robot
        has answered. While a process is gone it is the last tick as well, because no answer is expected.
        """
        last = self.known.last
        if not self.live or self.setup is None or self.known.gone:
            return last
        robots = {*self.setup.ids}
        for tick in range(last, max(last - UNANSWERED, -1), -1):
            data = self.known.ticks.get(tick)
            if data is not None and data.commands.keys() | data.late >= robots:
                return tick
        return last

    @property
    def state(self) -> dict[str, Any]:
        """The state of the run for the page, as its value in JSON."""
        return {
            "last": self.head,
            "first": next(iter(self.known.ticks), 0),
            "live": self.live,
            "has_truth": self.known.has_truth,
            "end": end_of(self.known.end),
            "farewells": self.known.final_reports,
            "notes": self.notes,
        }

    @property
    def mission(self) -> dict[str, Any]:
        """The static data and the state of the run for the page, likewise."""
        return {"stage": self.setup, **self.state, "version": self.version}


class Recorded(WatchedRun):
    """The recording in a folder."""

    def __init__(self, name: str, folder: Path, *, expected: bool = False) -> None:
        """Open the recording in `folder`. `expected` is true if its journals may not exist yet."""
        self._journals = Journals(folder)
        super().__init__(name, self._journals.known)
        self.notes = self._journals.notes
        self.folder = folder
        self.setup = None
        self.live = True
        self._expected = expected
        self._over = False
        self._writers: dict[str, int] = {}
        """The id of the process that last held the lock of each journal, by the journal's name."""

    @property
    def scenario(self) -> Scenario | None:
        """The scenario in the world's journal; None if there is none."""
        return self._journals.scenario

    def poll(self) -> None:
        """Read new frames of the journals. Raises OSError."""
        # Locks before journals: then all frames of a process that has ended are read.
        writers = writers_of(journals_in(self.folder))
        written = self._expected or bool(writers)
        if self._over and not written:
            return
        self._journals.read()
        self.setup = self._journals.setup
        if written:
            self._attend(writers)
        self.live = (written or self._journals.more) and self.known.end is None
        self._over = not written and not self._journals.more  # until a resumed mission writes again
        if self._over:
            self._journals.fill()
        self.revised()

    def load(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Read all that is in the journals, unless `stopped` returns true meanwhile. Raises OSError."""
        self.poll()
        while self._journals.more and not stopped():
            self.poll()

    def _attend(self, writers: dict[str, int]) -> None:
        """Record which processes have ended or have been replaced."""
        robots = self.setup.ids if self.setup is not None else ()
        for robot, name in ((None, WORLD_JOURNAL), *((one, agent_journal(one)) for one in robots)):
            process = writers.get(name)
            if process != self._writers.get(name):
                self.known.present(robot, False)
            if process is not None:
                self.known.present(robot, True)
                self._writers[name] = process

    def concluded(self) -> None:
        """Mark the recording as complete, because its writers have ended."""
        self._expected = False


def writers_of(journals: Iterable[Path]) -> dict[str, int]:
    """Return the ids of the processes that have locked `journals`, by the journal's name.

    The locks are read from /proc/locks, because an attempt to lock a journal could block its writer.
    """
    try:
        locks = [line.split() for line in LOCKS.read_text(encoding="ascii").splitlines()]
    except OSError:  # the system has no /proc/locks
        return {}
    by_inode = {lock[5].rpartition(":")[2]: int(lock[4]) for lock in locks if lock[1] == "FLOCK"}
    found = {}
    for path in journals:
        with suppress(OSError, KeyError):
            found[path.name] = by_inode[str(path.stat().st_ino)]
    return found


LOCKS = Path("/proc/locks")
