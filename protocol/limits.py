"""The limits of a process (ulimit), asked before what would fail halfway, or hang, for want of more.

Zenoh's threads panic where they get no descriptor or no memory, and its session then waits for them.
"""

from __future__ import annotations

import errno
import os
import resource
from pathlib import Path

SESSION_FILES = 20
"""descriptors that a Zenoh session takes beside one for each link: 14 to 16 measured on two cores"""
SESSION_BYTES = 900 << 20
"""address space that its threads take, little of which they use: 830 MB measured on two cores"""
START_BYTES = 240 << 20
"""the same for the interpreter and the libraries: 150 MB measured, more where there are more cores"""


def need_files(more: int, what: str) -> None:
    """See to it that this process can open so many files `more`, by its hard limit. Raises OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _open() + more
    if soft == resource.RLIM_INFINITY or wanted <= soft:
        return
    if hard != resource.RLIM_INFINITY and wanted > hard:
        raise OSError(errno.EMFILE, f"{what} takes {wanted} open files, and the limit is {hard} (ulimit -n)")
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def need_memory(more: int, what: str) -> None:
    """Raises OSError unless this process may have so many bytes `more` of address space."""
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
    """What this process has run out of, if that is what `error` says."""
    if isinstance(error, MemoryError):
        return "there is no more memory"
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
        return "no more threads can be started (ulimit -u, ulimit -v)"
    if (
        type(error).__name__ == "PanicException"
    ):  # of a library in Rust; no Exception, and of no type of its own
        return f"Zenoh has given up: {error}"
    return None


def _open() -> int:
    """How many descriptors are open."""
    try:
        return len(os.listdir("/dev/fd")) - 1
    except OSError:  # there may be none left to look with
        return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def _size() -> int:
    """Bytes of address space that this process has."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:  # no Linux
        return 0
