"""Checks of the process's limits (ulimit), before an operation that would fail halfway or hang at a limit.

Zenoh's threads panic if they get no descriptor or no memory, and its session then waits for them for ever.
"""

from __future__ import annotations

import errno
import os
import resource
from pathlib import Path

SESSION_FILES = 20
"""The descriptors of a Zenoh session besides one per link: 14 to 16 were measured on two cores."""
SESSION_BYTES = 900 << 20
"""The address space in bytes that its threads reserve and hardly use: 830 MB were measured on two cores."""
START_BYTES = 240 << 20
"""The address space in bytes of the interpreter and the libraries.

150 MB were measured on two cores. It grows with the number of cores.
"""


def need_files(more: int, what: str) -> None:
    """Raise the soft limit so that this process can open `more` further files for `what`.

    Raises OSError, which names `what`, if the hard limit does not allow it.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _open() + more
    if soft == resource.RLIM_INFINITY or wanted <= soft:
        return
    if hard != resource.RLIM_INFINITY and wanted > hard:
        raise OSError(errno.EMFILE, f"{what} takes {wanted} open files, and the limit is {hard} (ulimit -n)")
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def need_memory(more: int, what: str) -> None:
    """Raise OSError, which names `what`, unless this process may map `more` further bytes of memory."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return
    wanted = _size() + more
    if wanted > limit:
        raise OSError(
            errno.ENOMEM,
            f"{what} takes {wanted >> 20} MB of memory, and the limit is {limit >> 20} (ulimit -v)",
        )


def shortage(error: BaseException) -> str | None:
    """Return the message if `error` says that this process has reached a limit, or None otherwise."""
    if isinstance(error, MemoryError):
        return "there is no more memory"
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
        return "no more threads can be started (ulimit -u, ulimit -v)"
    if (
        type(error).__name__ == "PanicException"
    ):  # raised by a Rust library: a BaseException that cannot be imported
        return f"Zenoh has given up: {error}"
    return None


def _open() -> int:
    """Return the number of open descriptors; the soft limit if there are too many to count them."""
    try:
        return len(os.listdir("/dev/fd")) - 1
    except OSError:  # listing needs a descriptor, and none may be left
        return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def _size() -> int:
    """Return the bytes of address space of this process; 0 where there is no /proc."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:  # not Linux
        return 0
