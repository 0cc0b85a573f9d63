"""The result of a check."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """One line: a check that passed, a problem with its solution, or a check that could not be made."""

    mark: str
    """OK, FIX or UNTRIED."""
    text: str

    def __str__(self) -> str:
        return f"{self.mark:<4}{self.text}"


OK = "ok"
FIX = "fix"
UNTRIED = "--"


def ok(text: str) -> Finding:
    """Return a finding that a check passed."""
    return Finding(OK, text)


def fix(text: str) -> Finding:
    """Return a finding of a problem; `text` says what is wrong and what to do."""
    return Finding(FIX, text)


def untried(text: str) -> Finding:
    """Return a finding that a check was not made; `text` says why."""
    return Finding(UNTRIED, text)
