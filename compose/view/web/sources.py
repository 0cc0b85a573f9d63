"""Sources of runs for the page: recordings, complete or growing, and missions on a network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from compose.recording.kills_file import kills_in
from compose.recording.reasons import reason_for
from compose.recording.recording_files import WORLD_JOURNAL, agent_journal, journals_in, robot_of
from compose.recording.run_setup import RunSetup, of_configs, of_scenario
from compose.recording.summary_json import SUMMARY_JSON
from compose.view.played_estimate import PlayedEstimate
from compose.view.run_data import RunData
from protocol import documents
from protocol.journal.journal_file import CorruptJournal, OtherVersion, Tail
from protocol.messages import MissionEnd, OfRobot
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode
from world.scenario import Scenario
from world.world_journal import WorldJournalReading

REVISIONS_KEPT = 1000
"""The number of stored revisions. A page that has missed more reloads all scenes."""
PORTION_BYTES = 96 << 10
"""The number of bytes of a recording that one poll reads: some hundred ticks of a pair, some ms of work."""
LEAST_OF_A_JOURNAL_BYTES = 4 << 10
"""The number of these bytes that are read of each journal, however many there are."""
UNANSWERED = 5
"""The maximum number of ticks by which the head goes back to a tick with all commands."""


def end_of(end: MissionEnd | None) -> dict[str, Any] | None:
    """Return the end of a mission for the page, as its value in JSON; None before."""
    return None if end is None else {"tick": end.tick, "outcome": end.outcome, "reason": reason_for(end)}


class WatchedRun(ABC):
    """A run that pages can watch."""

    live: bool
    """True if new data may arrive."""
    more = False
    """True if the last poll has left data to be read by the next one."""
    setup: RunSetup | None
    """The static data of the run; None until it is known."""

    def __init__(self, name: str, known: RunData) -> None:
        self.name = name
        """The name of the run, unique within one server and part of URLs."""
        self.known = known
        self.notes: list[str] = []
        self.version = 0
        """The number of polls that changed the run."""
        self._revisions: deque[int] = deque(maxlen=REVISIONS_KEPT)
        """The first tick that changed in each of the latest versions."""

    @abstractmethod
    def poll(self) -> None:
        """Read new data, of a size that is bounded."""

    def revised(self) -> None:
        """Record a revision if the data has changed. Subclasses call this at the end of `poll`."""
        if self.known.touched is not None:
            self.version += 1
            self._revisions.append(self.known.touched)
            self.known.touched = None

    def since(self, version: int) -> int | None:
        """Return the first tick that changed after `version`; None if none did."""
        missed = self.version - version
        if missed > len(self._revisions):
            return 0
        return min(list(self._revisions)[-missed:]) if missed > 0 else None

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
            "notes": self.notes,
        }

    @property
    def mission(self) -> dict[str, Any]:
        """The static data and the state of the run for the page, likewise."""
        return {"stage": self.setup, **self.state, "version": self.version}


class Recorded(WatchedRun):
    """The recording in a folder, whose journals are read incrementally while they grow."""

    def __init__(self, name: str, folder: Path, *, expected: bool = False) -> None:
        """Open the recording in `folder`. `expected` is true if its journals may not exist yet."""
        super().__init__(name, RunData())
        self.folder = folder
        self.setup = None
        self.live = True
        self._expected = expected
        self._over = False
        self._tails: dict[str, Tail] = {}
        self._through: dict[str, int] = {}
        """The tick of the latest message that has been read in each journal, by the journal's name."""
        self._commands: dict[bytes, Any] = {}
        """The Commands in the world's journal by frame, until those of the agents' have been read."""
        self._reading = WorldJournalReading(self._commands)
        self._writers: dict[str, int] = {}
        """The id of the process that last held the lock of each journal, by the journal's name."""

    @property
    def scenario(self) -> Scenario | None:
        """The scenario in the world's journal; None until it has been read, or if there is none."""
        return self._reading.world.scenario if self._reading.world is not None else None

    def poll(self) -> None:
        """Read new frames of the journals, of at most about PORTION_BYTES. Raises OSError."""
        self._poll(PORTION_BYTES)

    def _poll(self, most: int | None) -> None:
        """Read new frames, of `most` bytes, or as many as `Tail` reads at once. Raises OSError."""
        # Locks before journals: then all frames of a process that has ended are read.
        writers = writers_of(journals_in(self.folder))
        written = self._expected or bool(writers)
        if self._over and not written:
            return
        setup = self.setup
        try:
            self.read(most)
        except OSError:  # a recording that cannot be read as a whole is not shown in parts
            self.setup, self.more = setup, False
            raise
        if written and not self.more:
            self._attend(writers)
        self.live = self.more or (written and self.known.end is None)
        self._over = not written and not self.more  # until a resumed mission writes again
        if self._over:
            self._fill()
        self.revised()

    @property
    def head(self) -> int:
        """The latest tick to show: one of which all that each journal has of it has been read."""
        behind = [self._through.get(name, 0) - 1 for name, tail in self._tails.items() if tail.more]
        return min([super().head, *behind])

    def read(self, most: int | None = None) -> None:
        """Read frames appended since the last call, of `most` bytes, or as many as `Tail` reads at once.

        Raises OSError.
        """
        journals = journals_in(self.folder)
        if most is not None and journals:
            most = max(most // len(journals), LEAST_OF_A_JOURNAL_BYTES)
        for path in journals:
            tail = self._tails.setdefault(path.name, Tail(path))
            try:
                frames = tail.news(most)
                if path.name == WORLD_JOURNAL:
                    self._add_world(frames, path)
                else:
                    self._add_of_robot(frames, robot_of(path.name), path)
            except OtherVersion as error:
                self._note(f"{self.folder}: {error.versions}; {error.remedy}")  # the same in all journals
            except CorruptJournal as error:
                self._note(str(error))
            except MalformedFrame as error:
                self._note(f"{path}: {error}")
        self.more = any(self._tails[path.name].more for path in journals)
        configs, scenario = self.known.configs, self.scenario
        if scenario is not None:
            for robot in [robot for robot, one in configs.items() if not scenario.is_of(one)]:
                path = self.folder / agent_journal(robot)
                self._note(f"{path}: belongs to another run: its configuration does not match the world's")
        elif len(configs) > (len(self.setup.robots) if self.setup is not None else 0):
            self.setup = of_configs(self.folder.name, configs)

    def _add_of_robot(self, frames: list[bytes], robot: str, path: Path) -> None:
        """Add frames of the journal of `robot`. Raises MalformedFrame."""
        for frame in frames:
            message = self._commands.pop(frame, None) or decode(frame, OfRobot, MAX_FRAME_BYTES)
            self.known.add(message, robot)
            self._through[path.name] = getattr(message, "tick", self._through.get(path.name, -1))

    def _add_world(self, frames: list[bytes], path: Path) -> None:
        reading = self._reading
        first_new = len(reading.ticks)
        for frame in frames:
            if reading.unexpected is not None:
                break
            if not reading.take(frame):
                assert reading.unexpected is not None
                self._note(f"{path}: {reading.unexpected.what}; all later frames are ignored")
        if reading.world is None:
            return
        if self.setup is None or self.setup.seed is None:
            self.setup = of_scenario(reading.world.scenario, self._mode())
        for tick in reading.ticks[first_new:]:
            self.known.add_tick(tick)
        self._through[path.name] = reading.world.truth.tick
        if reading.recomputed_end is None:
            self.known.add_world(reading.world)
        if reading.end is not None:
            self.known.conclude(reading.end)
        self.known.final_reports.update(reading.final_reports)

    def _mode(self) -> str | None:
        try:
            summary = documents.json_file(self.folder / SUMMARY_JSON)
            return str(summary["mode"])
        except (OSError, msgspec.MsgspecError, TypeError, KeyError):
            return None

    def _fill(self) -> None:
        """Add what follows from complete journals: missing observations, and the killed processes."""
        content = self._reading.content()
        if content is not None:
            self.known.add_observations(content.worlds)
        kills, note = kills_in(self.folder)
        self.known.add_kills(kills)
        if note is not None:
            self._note(note)

    def _note(self, text: str) -> None:
        """Add a line about a damaged journal, whose frames after the damage are ignored."""
        if text not in self.notes:
            self.notes.append(text)

    def load(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Read all that is in the journals, unless `stopped` returns true meanwhile. Raises OSError."""
        self._poll(None)
        while self.more and not stopped():
            self._poll(None)

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


class WatchedEstimate(WatchedRun):
    """The estimate in a folder, as a run that has ended."""

    live = False

    def __init__(self, found: PlayedEstimate) -> None:
        super().__init__("estimate", found.run_data())
        self.setup = found.setup

    def poll(self) -> None:
        """Do nothing: the files do not change."""


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
