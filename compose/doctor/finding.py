"""What a check has found."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """A line of what is so, of what to do, or of what could not be told."""

    mark: str
    text: str

    def __str__(self) -> str:
        return f"{self.mark:<4}{self.text}"


OK = "ok"
FIX = "fix"
UNTRIED = "--"


def ok(text: str) -> Finding:
    """All is well with it."""
    return Finding(OK, text)


def fix(text: str) -> Finding:
    """It is not; says what, and what to do."""
    return Finding(FIX, text)


def untried(text: str) -> Finding:
    """It was not tried; says why."""
    return Finding(UNTRIED, text)
