"""The resumption of a journal by a restarted process.

The process recomputes its state from the frames in the journal, and writes every frame again to a `Retrace`,
which compares it with the recorded one. It therefore only adds to a journal that it would have written
itself. Until `open_for_append`, nothing changes on disk.
"""

from __future__ import annotations

import os
from pathlib import Path

from protocol.files import open_regular
from protocol.journal.environment import otherwise
from protocol.journal.journal_file import CannotRecord, CorruptJournal, Journal, lock, packed, torn
from protocol.messages import Environment


class ReplayMismatch(ValueError):
    """A frame that was written to a Retrace differs from the recorded one."""


class Retrace:
    """An existing journal, locked. All its frames have to be written again before new ones are appended."""

    def __init__(self, path: Path, *, fsync: bool = False) -> None:
        """Open, lock and read the journal at `path`.

        Raises CannotRecord if it cannot be opened or is in use, CorruptJournal if it is damaged.
        """
        self.path = path
        self._fsync = fsync
        self._matched = 0
        self._new: list[bytes] = []
        try:
            self._file = open_regular(path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW)
        except OSError as error:
            raise CannotRecord(f"{path} cannot be opened: {error.strerror or error}") from None
        lock(self._file, path)
        try:
            self.frames, _ = torn(path)
            """The recorded frames."""
        except OSError as error:
            self.close()
            raise CannotRecord(f"{path} cannot be read: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise

    def differing(self, what: str, recorded: Environment, here: Environment) -> CorruptJournal:
        """Return the error of a replay: the recorded `what`, such as "world differs at tick 3", and why."""
        why = otherwise(recorded, here) or "the journal was written by another version"
        return CorruptJournal(f"{self.path}: the recorded {what}: {why}")

    def write(self, *frames: bytes) -> None:
        """Compare `frames` with the next recorded ones.

        Frames beyond the last recorded one are stored until `open_for_append`, which writes them.
        Raises ReplayMismatch if a frame differs.
        """
        for frame in frames:
            if self._matched == len(self.frames):
                self._new.append(frame)
            elif frame == self.frames[self._matched]:
                self._matched += 1
            else:
                raise ReplayMismatch

    def open_for_append(self) -> tuple[Journal, int]:
        """Return the journal, open for appending, and the number of bytes that were cut off its end.

        A torn frame and the recorded frames that were not written again are cut off. The stored new frames
        are appended. Raises CannotRecord.
        """
        size = len(packed(self.frames[: self._matched]))
        cut = os.fstat(self._file).st_size - size
        journal = Journal(self.path, fsync=self._fsync, file=self._file)
        if cut:
            os.ftruncate(self._file, size)
        if self._new:
            journal.write(*self._new)
        return journal, cut

    def close(self) -> None:
        """Close the journal without changing it."""
        os.close(self._file)
