"""Runs that can be watched: records, whether they grow yet or not, and what is said on a network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from compose.recording.run import WORLD_JOURNAL, agent_journal, journals_in
from compose.view.cast import Stage
from compose.view.facts import Gathering
from compose.view.recorded import Journals

REVISIONS_KEPT = 1000
"""polls that changed something; who has not looked for longer begins anew"""
UNANSWERED = 5
"""ticks at the most that the head looks back for one that everyone has answered"""


class Show(ABC):
    """A run to be watched."""

    live: bool
    """whether more may come"""
    stage: Stage | None
    """none until somebody has told"""

    def __init__(self, name: str, known: Gathering) -> None:
        self.name = name
        """within one server; part of an address"""
        self.known = known
        self.notes: list[str] = []
        self.version = 0
        """how often something has become known"""
        self._revisions: deque[tuple[int, int]] = deque(maxlen=REVISIONS_KEPT)

    @abstractmethod
    def poll(self) -> None:
        """Fold in what has come."""

    def revised(self) -> None:
        """To be called where something may have come: whoever watches is told from which tick on."""
        if self.known.touched is not None:
            self.version += 1
            self._revisions.append((self.version, self.known.touched))
            self.known.touched = None

    def since(self, version: int) -> int | None:
        """The first tick of which more is known than at `version`; none if there is no such tick."""
        if version >= self.version:
            return None
        if not self._revisions or self._revisions[0][0] > version + 1:
            return 0
        return min(tick for revision, tick in self._revisions if revision > version)

    @property
    def head(self) -> int:
        """The latest tick to show: while more may come, one in which every robot has answered.

        While a process is gone, nothing more comes, but that it is.
        """
        last = self.known.last
        if not self.live or self.stage is None or self.known.gone:
            return last
        robots = len(self.stage.robots)
        for tick in range(last, max(last - UNANSWERED, -1), -1):
            facts = self.known.ticks.get(tick)
            if facts is not None and len(facts.commands) + len(facts.late) >= robots:
                return tick
        return last


class Recorded(Show):
    """The record in a folder."""

    def __init__(self, name: str, folder: Path, *, expected: bool = False) -> None:
        """`expected` is whether it will be written, though there may be nothing yet."""
        self._journals = Journals(folder)
        super().__init__(name, self._journals.known)
        self.notes = self._journals.notes
        self.folder = folder
        self.stage = None
        self.live = True
        self._expected = expected
        self._over = False
        self._writers: dict[str, int] = {}
        """the process that was seen last to have a journal locked, by the journal's name"""

    def poll(self) -> None:
        """Fold in what has come. Raises OSError."""
        writers = writers_of(journals_in(self.folder))  # first: all that a process wrote that is gone is read
        written = self._expected or bool(writers)
        if self._over and not written:
            return
        self._journals.read()
        self.stage = self._journals.stage
        if written:
            self._attend(writers)
        self.live = written and self.known.end is None
        self._over = not written  # until whoever went on with it writes again
        if self._over:
            self._journals.fill()
        self.revised()

    def _attend(self, writers: dict[str, int]) -> None:
        """Fold in whose process has ended, and whose is another since."""
        robots = self.stage.ids if self.stage is not None else ()
        for who, name in ((None, WORLD_JOURNAL), *((robot, agent_journal(robot)) for robot in robots)):
            process = writers.get(name)
            if process != self._writers.get(name):
                self.known.present(who, False)
            if process is not None:
                self.known.present(who, True)
                self._writers[name] = process

    def concluded(self) -> None:
        """Nobody writes it any more."""
        self._expected = False


def writers_of(journals: Iterable[Path]) -> dict[str, int]:
    """Return the processes that have `journals` locked, by the journal's name.

    To try to lock one could keep its writer from it.
    """
    try:
        locks = [line.split() for line in LOCKS.read_text(encoding="ascii").splitlines()]
    except OSError:  # a system that does not tell
        return {}
    by_inode = {lock[5].rpartition(":")[2]: int(lock[4]) for lock in locks if lock[1] == "FLOCK"}
    found = {}
    for path in journals:
        with suppress(OSError, KeyError):
            found[path.name] = by_inode[str(path.stat().st_ino)]
    return found


LOCKS = Path("/proc/locks")
