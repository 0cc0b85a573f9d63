"""Files that a user names: only regular ones are read, and one that is written is there whole or not at all.

A FIFO or a device in place of a file would be waited for without end. What is written replaces what is there,
a symbolic link included, and never what such a link leads to.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

DRAFT = ".unfinished"
"""ends the name of a file that is being written"""


def said(error: OSError) -> str:
    """What went wrong, and with which file, as a user is told."""
    why = error.strerror or str(error)
    return f"{error.filename}: {why}" if error.filename else why


class NotRegular(OSError):
    """A directory, FIFO, device or socket where a file should be."""

    def __init__(self, path: Path, mode: int) -> None:
        kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
        super().__init__(errno.EINVAL, f"it is {kind}", str(path))


def open_file(path: Path) -> BinaryIO:
    """The regular file at `path`, open to be read. Raises OSError: NotRegular if it is another thing."""
    return os.fdopen(open_regular(path, os.O_RDONLY), "rb")


def open_regular(path: Path, flags: int) -> int:
    """The descriptor of the regular file at `path`. Raises like `open_file`."""
    if not stat.S_ISREG(mode := path.stat().st_mode):  # opening some devices has an effect
        raise NotRegular(path, mode)
    file = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(mode := os.fstat(file).st_mode):  # it was replaced meanwhile
        os.close(file)
        raise NotRegular(path, mode)
    return file


def read_bytes(path: Path) -> bytes:
    """The content of the regular file at `path`. Raises like `open_file`."""
    with open_file(path) as file:
        return file.read()


def read_text(path: Path) -> str:
    """The same as text, without a byte-order mark. Raises UnicodeDecodeError, too, if it is not UTF-8."""
    return read_bytes(path).decode("utf-8-sig")


def write(path: Path, content: bytes | str, mode: int = 0o666) -> None:
    """Write the file at `path`, all of it, or raise OSError and leave what was there before."""
    with draft(path, mode) as place:
        place.write_bytes(content if isinstance(content, bytes) else content.encode())


@contextmanager
def draft(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Yield the path of an empty file beside `path`; it replaces `path` if the block ends without an error.

    It is locked meanwhile, so that drafts of processes that were killed are told from it, and removed. The
    umask applies to `mode`. Raises OSError, which names `path`.
    """
    for left in path.parent.glob(f".{_literal(path.name)}.*{DRAFT}"):
        _remove_abandoned(left)
    place = path.with_name(f".{path.name}.{os.getpid()}{DRAFT}")
    file = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        _lock(file)
        yield place
        place.replace(path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        os.close(file)
        place.unlink(missing_ok=True)


def _literal(name: str) -> str:
    """`name` as a pattern that matches only itself."""
    return "".join([f"[{one}]" if one in "*?[" else one for one in name])


def _remove_abandoned(path: Path) -> None:
    """Remove the draft at `path` if no process is writing it."""
    with suppress(OSError):
        file = open_regular(path, os.O_RDONLY)
        try:
            _lock(file)
            path.unlink()
        finally:
            os.close(file)


def _lock(file: int) -> None:
    """Raises BlockingIOError if another process has the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        pass
