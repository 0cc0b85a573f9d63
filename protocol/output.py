"""Output to the terminal. All output goes through here: it may contain untrusted text from the network."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import NoReturn, TextIO


def say(*lines: str, error: bool = False) -> None:
    """Print each of `lines` as one line on standard output or error; escape what its encoding lacks.

    Raises OSError if standard output cannot be written. A line that standard error does not take is lost: it
    must not end a mission.
    """
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    text = "\n".join(map(one_line, lines))
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)
    except OSError:
        if not error:
            raise
        discard(stream)


def discard(stream: TextIO) -> None:
    """Redirect `stream` to /dev/null, so that the interpreter does not fail to flush it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def leave(status: int) -> NoReturn:
    """End the process with this exit status, without the shutdown of the interpreter.

    The shutdown would hang if a Zenoh session did not close. It would abort the process if one of Zenoh's
    threads is in a callback, which is possible for a moment after a session has closed. After a signal, it
    would wait for the threads and servers of a library.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the reader may be gone
            stream.flush()
    os._exit(status)


def one_line(text: str) -> str:
    """Return `text` with unprintable characters escaped, line breaks and terminal commands included."""
    return "".join([char if char.isprintable() else repr(char)[1:-1] for char in text])
