"""Access to files that a user names: only regular files are read, and writing is atomic.

Reading a FIFO or a device could block for ever. A written file replaces what is at its path. If that is a
symbolic link, the link is replaced, and its target stays as it is.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

DRAFT = ".unfinished"
"""The suffix of a file that is being written."""


def error_text(error: OSError) -> str:
    """Return the message for a user: what went wrong, and with which file."""
    why = error.strerror or str(error)
    return f"{error.filename}: {why}" if error.filename else why


class NotRegular(OSError):
    """The path of a file leads to a directory, FIFO, device or socket, or is a link where none may be."""

    def __init__(self, path: Path, mode: int) -> None:
        kinds = {stat.S_IFDIR: "a directory", stat.S_IFLNK: "a link"}
        kind = kinds.get(stat.S_IFMT(mode), "not a regular file")
        super().__init__(errno.EINVAL, f"it is {kind}", str(path))


def open_file(path: Path) -> BinaryIO:
    """Open the regular file at `path` for reading. Raises OSError; NotRegular if it is not a regular file."""
    return os.fdopen(open_regular(path, os.O_RDONLY), "rb")


def open_regular(path: Path, flags: int) -> int:
    """Return a descriptor of the regular file at `path`. Raises like `open_file`."""
    return _opened(path, flags | os.O_NONBLOCK, path)


def _opened(name: str | Path, flags: int, path: Path, folder: int | None = None) -> int:
    """Return a descriptor of the regular file, or with O_DIRECTORY of the directory, `name`.

    In a `folder`, it must not be a link. NotRegular names `path`.
    """
    wanted = stat.S_ISDIR if flags & os.O_DIRECTORY else stat.S_ISREG
    before = os.stat(name, dir_fd=folder, follow_symlinks=folder is None)
    if not wanted(mode := before.st_mode):  # opening some devices has an effect
        raise NotRegular(path, mode)
    file = os.open(name, flags | os.O_CLOEXEC, dir_fd=folder)
    if not wanted(mode := os.fstat(file).st_mode):  # it has been replaced since `stat`
        os.close(file)
        raise NotRegular(path, mode)
    return file


class TooLarge(OSError):
    """A file has more bytes than are read."""

    def __init__(self, path: Path, most: int) -> None:
        super().__init__(errno.EFBIG, f"it is larger than {most} bytes", str(path))


def read_bytes(path: Path, most: int = -1) -> bytes:
    """Return the content of the regular file at `path`.

    Raises like `open_file`, and TooLarge if it has more than `most` bytes, unless that is negative.
    """
    with open_file(path) as file:
        return _content(file, path, most)


def read_inside(folder: Path, *names: str, most: int) -> bytes:
    """Return the content of the regular file with the path `names` in `folder`, none of which is a link.

    Somebody else may have written the folder, and a link in it may lead to any file of the user. Raises like
    `read_bytes`, and NotRegular for a link.
    """
    path, descriptor = folder.joinpath(*names), os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for name in names[:-1]:
            descriptor, outer = _within(descriptor, name, os.O_DIRECTORY, path), descriptor
            os.close(outer)
        with os.fdopen(_within(descriptor, names[-1], os.O_NONBLOCK, path), "rb") as file:
            return _content(file, path, most)
    finally:
        os.close(descriptor)


def regular_in(folder: Path, pattern: str) -> list[str]:
    """Return the names of the regular files in `folder` that match `pattern`, without links."""
    found = [path for path in folder.glob(pattern) if not path.is_symlink() and path.is_file()]
    return [path.name for path in found]


def _within(folder: int, name: str, flags: int, path: Path) -> int:
    """Return a descriptor of the directory (O_DIRECTORY) or file `name` in `folder`; errors name `path`."""
    try:
        return _opened(name, os.O_RDONLY | os.O_NOFOLLOW | flags, path, folder)
    except OSError as error:
        error.filename = str(path)
        raise


def _content(file: BinaryIO, path: Path, most: int) -> bytes:
    content = file.read(most + 1 if most >= 0 else -1)
    if 0 <= most < len(content):
        raise TooLarge(path, most)
    return content


def read_text(path: Path, most: int = -1) -> str:
    """Return the same as text, without a byte-order mark.

    Raises like `read_bytes`, and UnicodeDecodeError if the content is not UTF-8.
    """
    return read_bytes(path, most).decode("utf-8-sig")


def write(path: Path, content: bytes | str, mode: int = 0o666) -> None:
    """Write the whole file at `path`, or raise OSError and leave the previous file unchanged."""
    with draft(path, mode) as place:
        place.write_bytes(content if isinstance(content, bytes) else content.encode())


@contextmanager
def draft(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Yield the path of an empty file beside `path`, and move it to `path` if the block raises no error.

    The file is locked while the block runs. Files of earlier processes that were killed have no lock, and
    are removed. The umask applies to `mode`. Raises OSError, which names `path`.
    """
    try:
        place, file = _new(path, 0, mode)
    except FileExistsError:  # a process was killed, or writes the same file now
        for left in path.parent.glob(f".{glob.escape(path.name)}.*{DRAFT}"):
            _remove_abandoned(left)
        place, file = _new(path, os.getpid(), mode)
    try:
        lock(file)
        yield place
        place.replace(path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        os.close(file)
        place.unlink(missing_ok=True)


def _new(path: Path, owner: int, mode: int) -> tuple[Path, int]:
    """Return a new draft of `path` and its descriptor; `owner` tells drafts apart. Raises FileExistsError."""
    place = path.with_name(f".{path.name}.{owner}{DRAFT}")
    return place, os.open(place, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)


def _remove_abandoned(path: Path) -> None:
    """Remove the draft at `path` unless a process is writing it."""
    with suppress(OSError):
        file = open_regular(path, os.O_RDONLY)
        try:
            lock(file)
            path.unlink()
        finally:
            os.close(file)


def lock(file: int) -> None:
    """Lock `file` exclusively. Raises BlockingIOError if another process has the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        pass
