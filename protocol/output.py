"""Output to the terminal. All output goes through here: it may contain untrusted text from the network."""

from __future__ import annotations

import sys


def say(*lines: str, error: bool = False) -> None:
    """Print each of `lines` as one line on standard output or error; escape what its encoding lacks."""
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    text = "\n".join(map(one_line, lines))
    print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def one_line(text: str) -> str:
    """Return `text` with unprintable characters escaped, line breaks and terminal commands included."""
    return "".join([char if char.isprintable() else repr(char)[1:-1] for char in text])
