"""`--kill`: processes of a run that kill themselves where they are told to, to be started again."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Sequence
from typing import Literal, cast, get_args

import msgspec

Point = Literal["sense", "report", "journal", "drive"]
"""How far a tick has come. An agent's: its Sense is there, and nothing on record; its Report is sent; its
Drive is on record, and not sent; it is sent. The world's: no Sense is sent; all are; all Drives are on
record, and nobody has moved; all Drives are there, and not on record."""

POINTS: tuple[Point, ...] = get_args(Point)
WORLD = "world"
_FORM = re.compile(
    r"(?P<who>[A-Za-z0-9_-]{1,32})@(?P<tick>[0-9]{1,9})(?::(?P<point>sense|report|journal|drive))?"
    r"(?:\+(?:(?P<never>never)|(?P<after>[0-9]{1,6}(?:\.[0-9]{1,6})?)s))?"
)


class BadKill(ValueError):
    """A text that says no kill; says what one looks like."""


class Kill(msgspec.Struct, frozen=True):
    """One process, killed once."""

    who: str
    """a robot, or WORLD"""
    tick: int
    point: Point
    after: float | None
    """s until it is started again; none is never"""
    text: str
    """as it was written"""

    @property
    def process(self) -> str:
        """What the launcher calls it."""
        return WORLD if self.who == WORLD else f"agent {self.who}"

    @property
    def last_words(self) -> str:
        """What the process says when it takes it."""
        return f"--kill {self.text}: taken"


def parse(text: str) -> Kill:
    """`a@17`, `b@20:report`, `world@30:journal+5s`, `a@17+never`. Raises BadKill."""
    match = _FORM.fullmatch(text)
    if match is None:
        raise BadKill(
            f"'{text}' is no kill; one is a@17, b@20:report, world@30:journal+5s or a@17:drive+never, "
            "and the points of a tick are sense, report, journal, drive"
        )
    after = None if match["never"] else float(match["after"] or 0.0)
    point = cast(Point, match["point"] or "sense")
    return Kill(match["who"], int(match["tick"]), point, after, text)


def taker(kills: Sequence[Kill]) -> Callable[[str, int], None] | None:
    """What the process that is to take `kills` calls wherever it comes to a point; none if there are none."""
    if not kills:
        return None
    fatal: dict[tuple[str, int], Kill] = {(kill.point, kill.tick): kill for kill in kills}

    def reached(point: str, tick: int) -> None:
        kill = fatal.get((point, tick))
        if kill is not None:
            os.write(2, f"{kill.last_words}\n".encode())
            os.kill(os.getpid(), signal.SIGKILL)

    return reached


def taken(kills: Sequence[Kill], said: str) -> Kill | None:
    """Which of `kills` a process took that has been killed, and has said so at the end."""
    for kill in kills:
        if said.endswith(kill.last_words):
            return kill
    return None
