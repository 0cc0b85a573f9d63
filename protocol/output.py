"""Output to the terminal. All output goes through here: it may contain untrusted text from the network."""

from __future__ import annotations

import os
import re
import sys
import textwrap
from contextlib import suppress
from typing import NoReturn, TextIO

UNLIMITED = 1000
"""The width in columns of an output that is not a terminal."""
JOINED = "\0"
"""A character that no printed line contains, in place of a space at which a line must not be broken."""


def say(*lines: str, error: bool = False) -> None:
    """Print each of `lines` as one line on standard output or error; escape what its encoding lacks.

    Messages, which go to standard error, are wrapped there if it is a terminal.

    Raises OSError if standard output cannot be written. A line that standard error does not take is lost: it
    must not end a mission.
    """
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    printed = [one_line(line) for line in lines]
    try:
        if error and stream.isatty():
            width = os.get_terminal_size(stream.fileno()).columns or UNLIMITED
            printed = [part for line in printed for part in wrapped(line, width)]
        text = "\n".join(printed)
        print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)
    except OSError:
        if not error:
            raise
        discard(stream)


def wrapped(text: str, width: int, indent: int = 0) -> list[str]:
    """Return the lines of `text`, wrapped between words; all but the first are indented.

    No word is broken, and no command in backticks.
    """
    joined = re.sub("`[^`]*`", lambda found: found[0].replace(" ", JOINED), text)
    lines = textwrap.wrap(
        joined, width, subsequent_indent=indent * " ", break_long_words=False, break_on_hyphens=False
    )
    return [line.replace(JOINED, " ") for line in lines] or [""]


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
