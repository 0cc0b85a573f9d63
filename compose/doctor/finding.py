"""The result of a check."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple


class Finding(NamedTuple):
    """One line: a check that passed, a problem with its solution, or a check that could not be made."""

    mark: str
    text: str

    def __str__(self) -> str:
        return f"{self.mark:<4}{self.text}"


FIX = "fix"
ok, fix, untried = partial(Finding, "ok"), partial(Finding, FIX), partial(Finding, "--")
"""Return a finding that a check passed, of a problem with its solution, and of a check that was not made."""
