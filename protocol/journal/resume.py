"""A journal taken up where it breaks off, by a process that is started again.

Whoever folds what is on record writes it once more, to a `Retrace`, which compares; so nothing is added
to a record that is not what this process would have written. Until `go_on`, nothing changes on disk.
"""

from __future__ import annotations

import os
from pathlib import Path

from protocol.files import open_regular
from protocol.journal.journal_file import CannotRecord, Journal, lock, packed, torn


class ReplayMismatch(ValueError):
    """Something else is on record than what is written to its Retrace."""


class Retrace:
    """An old journal, locked; its frames are met again, one by one, before any is added."""

    def __init__(self, path: Path, *, fsync: bool = False) -> None:
        """Raises CannotRecord if `path` cannot be opened, or another process has it; CorruptJournal."""
        self.path = path
        self._fsync = fsync
        self._met = 0
        self._more: list[bytes] = []
        try:
            self._file = open_regular(path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW)
        except OSError as error:
            raise CannotRecord(f"{path} cannot be opened: {error.strerror or error}") from None
        lock(self._file, path)
        try:
            self.frames, _ = torn(path)
            """what is on record"""
        except OSError as error:
            self.close()
            raise CannotRecord(f"{path} cannot be read: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise

    def write(self, *frames: bytes) -> None:
        """Meet `frames` again; what is beyond the record is kept for `go_on`. Raises Otherwise."""
        for frame in frames:
            if self._met == len(self.frames):
                self._more.append(frame)
            elif frame == self.frames[self._met]:
                self._met += 1
            else:
                raise ReplayMismatch

    def go_on(self) -> tuple[Journal, int]:
        """The journal, to be written on, and how many bytes were cut off: what there was of a torn write.

        Raises CannotRecord.
        """
        kept = len(packed(self.frames[: self._met]))
        cut = os.fstat(self._file).st_size - kept
        journal = Journal(self.path, fsync=self._fsync, file=self._file)
        if cut:
            os.ftruncate(self._file, kept)
        if self._more:
            journal.write(*self._more)
        return journal, cut

    def close(self) -> None:
        """Leave it as it is."""
        os.close(self._file)
