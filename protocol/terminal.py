"""The one way to a terminal. What is printed may hold text that came over the network, from anybody."""

from __future__ import annotations

import sys


def say(*lines: str, error: bool = False) -> None:
    """Print each of `lines` as one line, on standard output or error, in characters that it takes."""
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    text = "\n".join(map(one_line, lines))
    print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def one_line(text: str) -> str:
    """`text` with whatever would break or garble a line, or command a terminal, escaped."""
    return "".join([char if char.isprintable() else repr(char)[1:-1] for char in text])
