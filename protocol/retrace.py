"""A journal taken up where it breaks off, by a process that is started again.

Whoever folds what is on record writes it once more, to a `Retrace`, which compares; so nothing is added
to a record that is not what this process would have written. Until `go_on`, nothing changes on disk.
"""

from __future__ import annotations

import os
from pathlib import Path

from protocol.journal import CannotRecord, CorruptJournal, Journal, Tail, lock, packed
from protocol.wire import is_sound

_HEADS = {0xC4: 1, 0xC5: 2, 0xC6: 4}
"""how a byte string begins in msgpack, and how many bytes its length then takes"""


class Otherwise(ValueError):
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
            self._file = os.open(path, os.O_RDWR | os.O_APPEND)
        except OSError as error:
            raise CannotRecord(f"{path} cannot be opened: {error.strerror or error}") from None
        lock(self._file, path)
        try:
            self.frames = self._found()
            """what is on record"""
        except BaseException:
            self.close()
            raise

    def _found(self) -> list[bytes]:
        try:
            tail = Tail(self.path)
            frames = tail.news()
            torn = self.path.read_bytes()[tail.whole :]
        except OSError as error:
            raise CannotRecord(f"{self.path} cannot be read: {error.strerror or error}") from None
        if _holds_a_frame(torn) or len(packed(frames)) != tail.whole:
            raise CorruptJournal(f"{self.path}: damaged at byte {tail.whole}: a frame of a wrong length")
        return frames

    def write(self, *frames: bytes) -> None:
        """Meet `frames` again; what is beyond the record is kept for `go_on`. Raises Otherwise."""
        for frame in frames:
            if self._met == len(self.frames):
                self._more.append(frame)
            elif frame == self.frames[self._met]:
                self._met += 1
            else:
                raise Otherwise

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


def _holds_a_frame(torn: bytes) -> bool:
    """Whether a whole frame stands in what looks like a torn one: then it is not its end that is missing."""
    for place in range(1, len(torn)):
        width = _HEADS.get(torn[place])
        if width is not None:
            begin = place + 1 + width
            size = int.from_bytes(torn[place + 1 : begin])
            if begin + size <= len(torn) and is_sound(torn[begin : begin + size]):
                return True
    return False
