"""`--kill` and `[[kill]]`: processes that kill themselves where they are told to, to be started again."""

from __future__ import annotations

import os
import random
import re
import signal
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, cast, get_args

import msgspec
from msgspec import Meta

from compose.errors import BadKill
from protocol.spelling import did_you_mean

Point = Literal["observation", "report", "journal", "command"]
"""How far a tick has come. An agent's: its Observation is there, and nothing on record; its Report is sent; its
Command is on record, and not sent; it is sent. The world's: no Observation is sent; all are; all Commands are on
record, and nobody has moved; all Commands are there, and not on record."""

POINTS: tuple[Point, ...] = get_args(Point)
WORLD = "world"
DRAWN = "?"
"""whoever, or wherever in the tick, the seed says"""
_Tick = Annotated[int, Meta(ge=0, le=999_999_999)]
_FORM = re.compile(
    r"(?P<who>[A-Za-z0-9_-]{1,32})@(?P<tick>[0-9]{1,9})(?::(?P<point>sense|report|journal|drive))?"
    r"(?:\+(?:(?P<never>never)|(?P<after>[0-9]{1,6}(?:\.[0-9]{1,6})?)s))?"
)


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


class KillTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[kill]]: what `--kill` says, or that it is to be drawn from the seed."""

    who: str | list[str] = DRAWN
    """a robot, or WORLD; or several, all of them in the one tick"""
    tick: _Tick | Annotated[list[_Tick], Meta(min_length=2, max_length=2)] = 0
    """or drawn between two, both included"""
    point: Literal["observation", "report", "journal", "command", "?"] = "observation"
    """of each that is killed, where it is drawn"""
    after: Annotated[float, Meta(ge=0.0, le=999_999.0)] | Literal["never"] = 0.0
    """s until each is started again"""

    def kills(self, draw: random.Random, anyone: Sequence[str]) -> list[Kill]:
        """Those that `draw` makes of it, among `anyone`. Raises BadKill, whose text begins with the field."""
        named = self.who if isinstance(self.who, list) else [self.who]
        least, most = self.tick if isinstance(self.tick, list) else (self.tick, self.tick)
        if least > most:
            raise BadKill(f"tick: from {least} to {most} is backwards")
        tick = draw.randint(least, most)
        after = f"+{self.after:.6f}s" if self.after != "never" else "+never"
        found = []
        for name in named:
            who = draw.choice(anyone) if name == DRAWN else name
            if who not in anyone:
                near = did_you_mean(who, anyone)
                raise BadKill(f"who: there is no '{who}'; there are {', '.join(anyone)}{near}")
            point = draw.choice(POINTS) if self.point == DRAWN else self.point
            found.append(parse(f"{who}@{tick}:{point}{after if self.after else ''}"))
        return found


def drawn(tables: Sequence[KillTable], seed: int, robots: Sequence[str]) -> tuple[Kill, ...]:
    """What the tables of a scenario come to. Raises BadKill, whose text begins with the field."""
    kills: list[Kill] = []
    for i, table in enumerate(tables):
        try:
            kills += table.kills(random.Random(f"{seed}/kill/{i}"), [*robots, WORLD])
        except BadKill as error:
            raise BadKill(f"kill[{i}].{error}") from None
    return tuple(kills)


def parse(text: str) -> Kill:
    """`a@17`, `b@20:report`, `world@30:journal+5s`, `a@17+never`. Raises BadKill."""
    match = _FORM.fullmatch(text)
    if match is None:
        raise BadKill(
            f"'{text}' is no kill; one is a@17, b@20:report, world@30:journal+5s or a@17:command+never, "
            "and the points of a tick are observation, report, journal, command"
        )
    after = None if match["never"] else float(match["after"] or 0.0)
    point = cast(Point, match["point"] or "observation")
    return Kill(match["who"], int(match["tick"]), point, after, text)


def taker(kills: Sequence[Kill]) -> Callable[[str, int], None] | None:
    """What the process that is to take `kills` calls wherever it comes to a point; none if there are none."""
    if not kills:
        return None
    fatal: dict[tuple[str, int], Kill] = {(kill.point, kill.tick): kill for kill in kills}

    def on_kill_point(point: str, tick: int) -> None:
        kill = fatal.get((point, tick))
        if kill is not None:
            os.write(2, f"{kill.last_words}\n".encode())
            os.kill(os.getpid(), signal.SIGKILL)

    return on_kill_point


def taken(kills: Sequence[Kill], said: str) -> Kill | None:
    """Which of `kills` a process took that has been killed, and has said so at the end."""
    for kill in kills:
        if said.endswith(kill.last_words):
            return kill
    return None
