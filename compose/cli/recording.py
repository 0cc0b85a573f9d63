"""A recording that a command reads, and the notes about it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from compose.recording.run import Run, read
from protocol.output import say


def read_noted(folder: Path, command: str, *, audited: bool = False) -> Run:
    """Return the run recorded in `folder`, and print its notes for `command`. Raises like `read`."""
    run = read(folder, audited=audited)
    note(command, run.notes)
    return run


def note(command: str, lines: Iterable[str]) -> None:
    """Print `lines` on standard error, each with the name of `command`."""
    for line in lines:
        say(f"tandem {command}: {line}", error=True)
