"""Frames in and out of a process, on disk, in order: the record of a run.

A journal is a plain stream of msgpack byte strings, one a frame, so that any msgpack library reads it.
It holds no wall-clock time. Each write is one system call: a process that is killed loses nothing it
had journaled, and at worst leaves a last frame torn, which reading ignores. Who writes a journal has it
locked, so no two processes write one.
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Protocol

import msgpack

from protocol.files import open_file
from protocol.wire import MAX_FRAME_BYTES, is_sound

_packer = msgpack.Packer()
_LONGEST = b"\xc6" + MAX_FRAME_BYTES.to_bytes(4, "big")
"""how the longest frame begins"""
_HEADS = {0xC4: 1, 0xC5: 2, 0xC6: 4}
"""how a byte string begins in msgpack, and how many bytes its length then takes"""


class CannotRecord(OSError):
    """A journal cannot be opened or written; the text says which, and why."""


class RecordExists(CannotRecord):
    """A journal would have been overwritten."""


class CorruptJournal(ValueError):
    """A journal that is damaged before its end."""


class Sink(Protocol):
    """What takes frames, in order."""

    def write(self, *frames: bytes) -> None:
        """All of `frames`, at once."""


class MemoryJournal:
    """A journal that is kept in memory, for whoever judges the run as soon as it is over."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    def write(self, *frames: bytes) -> None:
        """All of `frames`."""
        self.frames += frames


class Journal:
    """An open journal. A new file, never an old one: what is on record stays, and goes on by a `Retrace`."""

    def __init__(self, path: Path, *, fsync: bool = False, file: int | None = None) -> None:
        """`file` is one that is open and locked already.

        Raises RecordExists if `path` is there otherwise, CannotRecord if it cannot be written.
        """
        self.path = path
        self._fsync = fsync
        self._file = self._new() if file is None else file

    def _new(self) -> int:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
            if self._fsync:
                _sync_folder(self.path.parent)
        except OSError as error:
            if self.path.exists():
                raise RecordExists(f"{self.path} is there already; choose another folder") from None
            raise self._cannot(error) from None
        lock(file, self.path)
        return file

    def write(self, *frames: bytes) -> None:
        """All of `frames`, in one write, on the disk's side of the process when it returns.

        Raises CannotRecord when the disk takes no more.
        """
        data = packed(frames)
        try:
            if os.write(self._file, data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self._fsync:
                os.fsync(self._file)
        except OSError as error:
            raise self._cannot(error) from None

    def _cannot(self, error: OSError) -> CannotRecord:
        return CannotRecord(f"{self.path} cannot be written: {error.strerror or error}")

    def close(self) -> None:
        """Nothing is lost without it; it frees the file."""
        os.close(self._file)

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _sync_folder(folder: Path) -> None:
    """Have the disk know the files that are in `folder` by now."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def lock(file: int, path: Path) -> None:
    """Have `file` alone while it is open. Raises CannotRecord, and closes it, if another process has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise CannotRecord(f"{path} is in use by another process; choose another folder") from None
    except OSError:  # a file system without locks
        pass


def packed(frames: Iterable[bytes]) -> bytes:
    """`frames` as they stand in a journal."""
    return b"".join([_packer.pack(frame) for frame in frames])


def read(path: Path) -> Iterator[bytes]:
    """The frames of the journal at `path`, up to its end or its torn tail.

    Raises OSError if it cannot be read, CorruptJournal where something stands that is no frame.
    """
    return iter(torn(path)[0])


def torn(path: Path) -> tuple[list[bytes], int]:
    """The frames of the journal at `path`, and how many bytes stand behind them: of a torn write.

    Raises like `read`.
    """
    tail = Tail(path)
    frames = tail.news()
    if _holds_a_frame(tail.torn) or len(packed(frames)) != tail.whole:
        raise CorruptJournal(f"{path}: damaged at byte {tail.whole}: a frame of a wrong length")
    return frames, len(tail.torn)


def _holds_a_frame(rest: bytes) -> bool:
    """Whether a whole frame stands in what looks like a torn one: then it is not its end that is missing."""
    for place in range(1, len(rest)):
        width = _HEADS.get(rest[place])
        if width is not None:
            begin = place + 1 + width
            size = int.from_bytes(rest[place + 1 : begin])
            if begin + size <= len(rest) and is_sound(rest[begin : begin + size]):
                return True
    return False


class Tail:
    """A journal that may still be written, read as it grows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = 0
        """bytes of what has been read"""
        self.torn = b""
        """what stood behind them the last time"""

    def news(self) -> list[bytes]:
        """The frames that have come since the last time; what is torn waits for the rest.

        Raises OSError if it cannot be read, CorruptJournal where something stands that is no frame.
        """
        with open_file(self.path) as file:
            file.seek(self.whole)
            data = file.read()
        unpacker = msgpack.Unpacker(max_buffer_size=0)
        unpacker.feed(data)
        frames: list[bytes] = []
        whole = 0
        try:
            for frame in unpacker:
                if not isinstance(frame, bytes) or len(frame) > MAX_FRAME_BYTES:
                    raise ValueError("no frame")  # it is the file that is wrong
                frames.append(frame)
                whole = unpacker.tell()
            self.torn = data[whole:]
            head = self.torn[: len(_LONGEST)]
            if head.startswith(_LONGEST[:1]) and head > _LONGEST:
                raise ValueError("a frame of impossible length")
        except (ValueError, msgpack.UnpackException) as error:
            raise CorruptJournal(f"{self.path}: damaged at byte {self.whole + whole}: {error}") from None
        self.whole += whole
        return frames
