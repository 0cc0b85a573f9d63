"""The file of a journal: the frames that a process receives and sends, in order. Journals are the recording.

A journal is a stream of msgpack byte strings, one for each frame, so any msgpack library can read it. It
contains no wall-clock time. Each write is one system call, so a killed process loses no frame that it has
journaled. At worst, the last frame is torn, and reading ignores it. The writer locks the file, so two
processes never write the same journal.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

import msgpack
import msgspec

from protocol import files
from protocol.messages import Command, Environment, Report
from protocol.wire import MAX_FRAME_BYTES, MalformedFrame, decode, is_sound, other_version, versions

_packer = msgpack.Packer()
_HEADS = {0xC4: 1, 0xC5: 2, 0xC6: 4}
"""The first byte of a msgpack byte string -> the number of bytes of its length field."""


JOURNAL_PIECE_BYTES = 16 << 20
"""The maximum number of bytes of a journal that are read at once: more than the longest frame has."""

MOST_CHECKED = 1 << 30
"""The number of bytes in which a complete frame is searched within a torn one, before it counts as damaged.

Of torn frames that Tandem has written, at most a tenth of that is searched.
"""


class CannotRecord(OSError):
    """A journal cannot be opened or written. The text of the error names the file and the reason."""


class RecordExists(CannotRecord):
    """The file of a new journal exists already."""


class CorruptJournal(ValueError):
    """A journal is damaged before its end, or its content is not valid."""


def message_in(frame: bytes, kind: Any, source: object) -> Any:
    """Return the message in a frame of the journal `source`. Raises CorruptJournal if it is not a `kind`."""
    try:
        return decode(frame, kind, MAX_FRAME_BYTES)
    except MalformedFrame as error:
        raise CorruptJournal(f"{source}: {error}") from None


class UnexpectedFrame(msgspec.Struct, frozen=True):
    """The first frame that must not be at its place. The frames after it are not read."""

    tick: int | None
    """The tick of the frame; None if it has none."""
    what: str
    """The description of the problem, for a user."""


class OtherVersion(CorruptJournal):
    """A journal has another version of the protocol. The text of the error names both, and the remedy."""

    def __init__(self, path: Path, version: int) -> None:
        self.path = path
        self.versions = versions(version)
        """Text that names both versions."""
        self.remedy = "run its scenario again, or read it with the release that wrote it"
        """Text for the user who wants to read the recording."""
        super().__init__(f"{path}: {self.versions}; {self.remedy}")


class Sink(Protocol):
    """The contract of a journal that is written."""

    def write(self, *frames: bytes) -> None:
        """Append all of `frames` in one operation."""


class JournalReading:
    """A reader of a journal, frame by frame. The journal may still be growing."""

    KINDS: Any
    """The kinds of messages in the journal."""

    def __init__(self, shared: dict[bytes, Any] | None = None) -> None:
        """`shared` are the Reports and Commands that readers of the same recording have decoded, by frame."""
        self._shared = {} if shared is None else shared
        self.environment: Environment | None = None
        """The environment in which the journal was written; None until it has been read."""
        self.messages: list[Any] = []
        """The messages that have been read, in order."""
        self.unexpected: UnexpectedFrame | None = None
        """The first frame out of order."""

    def take(self, frame: bytes) -> bool:
        """Add the next frame, and return whether it is in order. Add no frame after one that is not.

        Raises MalformedFrame, also if the journal does not begin as it must.
        """
        message = self._shared.get(frame)
        if message is None:
            message = decode(frame, self.KINDS, MAX_FRAME_BYTES)
            if isinstance(message, Report | Command):
                self._shared[frame] = message
        if not self._fits(message, frame):
            self.unexpected = _out_of_order(message)
            return False
        self.messages.append(message)
        return True

    def _fits(self, message: Any, frame: bytes) -> bool:
        """Add `message`, and return True if it may be next. Raises MalformedFrame."""
        raise NotImplementedError


def _out_of_order(message: Any) -> UnexpectedFrame:
    kind, robot, tick = (
        type(message).__name__,
        getattr(message, "robot", None),
        getattr(message, "tick", None),
    )
    whose, at = f" of {robot}" if robot is not None else "", f" of tick {tick}" if tick is not None else ""
    article = "an" if kind[0] in "AEIO" else "a"
    return UnexpectedFrame(tick, f"{article} {kind}{whose}{at} is out of order")


def take_all(reading: JournalReading, frames: Iterable[bytes], source: object) -> CorruptJournal | None:
    """Give `frames` to `reading`, up to the first out of order; return the error of one that is damaged.

    The text of the error begins with `source`.
    """
    try:
        for frame in frames:
            if not reading.take(frame):
                break
    except MalformedFrame as error:
        return CorruptJournal(f"{source}: {error}")
    return None


class MemoryJournal:
    """A journal in memory, for runs in one process."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    def write(self, *frames: bytes) -> None:
        """Append `frames`."""
        self.frames += frames


class Journal:
    """A journal that is open for writing. Its file is new: only a `Retrace` appends to an existing one."""

    def __init__(self, path: Path, *, fsync: bool = False, file: int | None = None) -> None:
        """Create the file at `path`, or take `file`, the descriptor of a file that is open and locked.

        Raises RecordExists if `path` exists and no `file` is given, CannotRecord if it cannot be written.
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
                raise RecordExists(f"{self.path} already exists; choose another folder") from None
            raise self._cannot(error) from None
        lock(file, self.path)
        return file

    def write(self, *frames: bytes) -> None:
        """Append all of `frames` in one system call, with `fsync` down to the disk.

        Raises CannotRecord if they cannot be written, for example because the disk is full.
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
        refusal = CannotRecord(f"{self.path} cannot be written: {error.strerror or error}")
        refusal.errno = error.errno
        return refusal

    def close(self) -> None:
        """Close and unlock the file. Nothing is lost without it."""
        os.close(self._file)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _sync_folder(folder: Path) -> None:
    """Write the directory entries of `folder` to the disk."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def lock(file: int, path: Path) -> None:
    """Lock `file` until it is closed.

    If another process has the lock, close `file` and raise CannotRecord.
    """
    try:
        files.lock(file)
    except BlockingIOError:
        os.close(file)
        raise CannotRecord(f"{path} is in use by another process; choose another folder") from None


def packed(frames: Iterable[bytes]) -> bytes:
    """Return the bytes of `frames` in a journal."""
    return b"".join([_packer.pack(frame) for frame in frames])


def read(path: Path) -> Iterator[bytes]:
    """Return the frames of the journal at `path`, without a torn last frame.

    Raises OSError if it cannot be read, CorruptJournal if it contains anything but frames.
    """
    return iter(torn(path)[0])


def torn(path: Path) -> tuple[list[bytes], int]:
    """Return the frames of the journal at `path`, and the number of bytes of a torn last frame.

    Raises like `read`.
    """
    tail = Tail(path)
    frames = tail.news()
    while tail.more:
        frames += tail.news()
    if _holds_a_frame(tail.torn) or len(packed(frames)) != tail.whole:
        raise CorruptJournal(f"{path}: damaged at byte {tail.whole}: a frame of a wrong length")
    return frames, len(tail.torn)


def _holds_a_frame(rest: bytes) -> bool:
    """Return whether `rest`, which looks like a torn frame, contains a complete one: then it is damaged."""
    checked = 0
    for offset in range(1, len(rest)):
        width = _HEADS.get(rest[offset])
        if width is not None:
            begin = offset + 1 + width
            size = int.from_bytes(rest[offset + 1 : begin])
            if begin + size <= len(rest):
                checked += size
                if is_sound(rest[begin : begin + size]) or checked > MOST_CHECKED:
                    return True
    return False


def _frame(data: bytes, begin: int) -> slice | None:
    """Return the part of `data` that is the frame whose head begins there; None if it is incomplete.

    Only heads of byte strings are read: decoding any msgpack would take memory for whatever it may contain.
    Raises ValueError if no frame begins there.
    """
    if begin == len(data):
        return None
    width = _HEADS.get(data[begin])
    if width is None:
        raise ValueError("not a frame")
    body = begin + 1 + width
    size = int.from_bytes(data[begin + 1 : body])
    if body <= len(data) and size > MAX_FRAME_BYTES:
        raise ValueError("a frame of impossible length")
    return slice(body, body + size) if body + size <= len(data) else None


class Tail:
    """A reader of a journal that may still be growing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = 0
        """The number of bytes of the frames that have been read."""
        self.torn = b""
        """The bytes after them at the last read: an incomplete frame."""
        self.more = False
        """True if the last read has left bytes to be read by the next one."""

    def news(self, most: int | None = None) -> list[bytes]:
        """Return the frames that have been added since the last call, of at most JOURNAL_PIECE_BYTES.

        If `most` is given, they are those in the next `most` bytes, and at least one. An incomplete frame is
        read later.

        Raises OSError if it cannot be read, CorruptJournal if it contains anything but frames, OtherVersion
        if its first frame has another version.
        """
        piece = JOURNAL_PIECE_BYTES if most is None else most
        with files.open_file(self.path) as file:
            file.seek(self.whole)
            data = file.read(piece)
        self.more = False
        frames: list[bytes] = []
        whole = 0
        try:
            while (frame := _frame(data, whole)) is not None:
                frames.append(data[frame])
                whole = frame.stop
        except ValueError as error:
            raise CorruptJournal(f"{self.path}: damaged at byte {self.whole + whole}: {error}") from None
        self.torn = data[whole:]
        if self.whole == 0 and frames and (version := other_version(frames[0])) is not None:
            raise OtherVersion(self.path, version)
        self.whole += whole
        self.more = len(data) == piece
        if not frames and self.more and most is not None:  # the next frame is longer than that
            return self.news(min(4 * most, JOURNAL_PIECE_BYTES) if most < JOURNAL_PIECE_BYTES else None)
        return frames
