"""Runs that can be watched: records, whether they grow yet or not, and what is said on a network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path

from compose.record import journals_in
from compose.scene.facts import Gathering
from compose.scene.recorded import Journals
from compose.scene.stage import Stage

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
        """The latest tick to show: while more may come, one in which every robot has answered."""
        last = self.known.last
        if not self.live or self.stage is None:
            return last
        robots = len(self.stage.robots)
        for tick in range(last, max(last - UNANSWERED, -1), -1):
            facts = self.known.ticks.get(tick)
            if facts is not None and len(facts.drives) + len(facts.late) >= robots:
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

    def poll(self) -> None:
        """Fold in what has come. Raises OSError."""
        written = self._expected or any(is_written(path) for path in journals_in(self.folder))
        if self._over and not written:
            return
        self._journals.read()
        self.stage = self._journals.stage
        self.live = written and self.known.end is None
        self._over = not written  # until whoever went on with it writes again
        if self._over:
            self._journals.fill()
        self.revised()

    def concluded(self) -> None:
        """Nobody writes it any more."""
        self._expected = False


def is_written(path: Path) -> bool:
    """Whether a process has the journal locked. To try to lock it could keep its writer from it."""
    try:
        inode = path.stat().st_ino
        locks = LOCKS.read_text(encoding="ascii")
    except OSError:  # no file, or a system that does not tell
        return False
    return any(line.split()[1] == "FLOCK" and f":{inode} " in line for line in locks.splitlines())


LOCKS = Path("/proc/locks")
