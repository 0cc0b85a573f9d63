"""The result of a check, and its line on the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

from compose.errors import ENDED, VIOLATED
from compose.terminal.text_width import wrapped
from protocol.output import one_line, say


class Finding(NamedTuple):
    """One line: a check that passed, a problem with its solution, or a check that could not be made."""

    mark: str
    text: str


FIX, WRONG = "fix", "wrong"
"""The marks of problems: of a machine, and of code of the user."""
ok, fix, untried = partial(Finding, "ok"), partial(Finding, FIX), partial(Finding, "--")
"""Return a finding that a check passed, of a problem with its solution, and of a check that was not made."""


def checked(rule: str, wrong: str | None) -> Finding:
    """Return the finding on a rule for code of the user; `wrong` says how it is broken, if it is."""
    return Finding(WRONG, f"{rule}: {wrong}") if wrong else ok(rule)


def tell_all(findings: Iterable[Finding], width: int = len("wrong  ")) -> int:
    """Print `findings`, with their marks in a column of this width; return VIOLATED if one is a problem."""
    status = ENDED
    for mark, text in findings:
        say(*wrapped(one_line(f"{mark:<{width}}{text}"), width))
        status = VIOLATED if mark in (FIX, WRONG) else status
    return status
