"""Scheduled kills, from `--kill` and `[[kill]]`: a process kills itself, and the launcher restarts it."""

from __future__ import annotations

import os
import random
import re
import signal
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, cast, get_args

import msgspec
from msgspec import Meta

from compose.errors import BadKill, no_such

Point = Literal["observation", "report", "journal", "command"]
"""A point of a tick at which a process can be killed.

| point | in an agent | in the world |
|---|---|---|
| observation | the Observation has arrived and is not journaled | no Observation has been sent |
| report | the Report has been sent | all Observations have been sent |
| journal | the Command is journaled and not sent | all Commands are journaled, no robot has moved |
| command | the Command has been sent | all Commands have arrived and are not journaled |
"""

KILL_POINTS: tuple[Point, ...] = get_args(Point)
WORLD = "world"
DRAWN_VALUE = "?"
"""The value of `who` or `point` that is drawn from the seed."""
_Tick = Annotated[int, Meta(ge=0, le=999_999_999)]
_FORM = re.compile(
    r"(?P<who>[A-Za-z0-9_-]{1,32})@(?P<tick>[0-9]{1,9})(?::(?P<point>observation|report|journal|command))?"
    r"(?:\+(?:(?P<never>never)|(?P<after>[0-9]{1,6}(?:\.[0-9]{1,6})?)s))?"
)


class Kill(msgspec.Struct, frozen=True):
    """One kill of one process."""

    who: str
    """The id of a robot, or WORLD."""
    tick: int
    point: Point
    after: float | None
    """Time in s until the process is restarted; None if it is not restarted."""
    text: str
    """The kill as the user wrote it."""

    @property
    def process(self) -> str:
        """The launcher's name for the process."""
        return WORLD if self.who == WORLD else f"agent {self.who}"

    @property
    def last_words(self) -> str:
        """The line that the process writes to standard error just before it kills itself."""
        return f"--kill {self.text}: taken"


class KillTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A `[[kill]]` table: the fields of `--kill`, each of which can be drawn from the seed."""

    who: str | list[str] = DRAWN_VALUE
    """The id of a robot, `world`, or `?` for one that is drawn; or a list, killed in the same tick."""
    tick: _Tick | Annotated[list[_Tick], Meta(min_length=2, max_length=2)] = 0
    """The tick, or the bounds between which it is drawn, both included."""
    point: Literal["observation", "report", "journal", "command", "?"] = "observation"
    """The point of the tick; `?`: it is drawn separately for each process."""
    after: Annotated[float, Meta(ge=0.0, le=999_999.0)] | Literal["never"] = 0.0
    """Time in s until each process is restarted."""

    def kills(self, draw: random.Random, anyone: Sequence[str]) -> list[Kill]:
        """Return the kills of this table, with open fields drawn from `draw` and processes from `anyone`.

        Raises BadKill, whose text begins with the field.
        """
        named = self.who if isinstance(self.who, list) else [self.who]
        least, most = self.tick if isinstance(self.tick, list) else (self.tick, self.tick)
        if least > most:
            raise BadKill(f"tick: the lower bound {least} is above the upper bound {most}")
        tick = draw.randint(least, most)
        after = f"+{self.after:.6f}s" if self.after != "never" else "+never"
        found = []
        for name in named:
            who = draw.choice(anyone) if name == DRAWN_VALUE else name
            if who not in anyone:
                raise BadKill(f"who: {no_such(who, anyone)}")
            point = draw.choice(KILL_POINTS) if self.point == DRAWN_VALUE else self.point
            found.append(parse(f"{who}@{tick}:{point}{after if self.after else ''}"))
        return found


def drawn(tables: Sequence[KillTable], seed: int, robots: Sequence[str]) -> tuple[Kill, ...]:
    """Return the kills of all `[[kill]]` tables of a scenario.

    Each table has its own random stream, keyed by `seed` and the place of the table. Raises BadKill, whose
    text begins with the field.
    """
    kills: list[Kill] = []
    for i, table in enumerate(tables):
        try:
            kills += table.kills(random.Random(f"{seed}/kill/{i}"), [*robots, WORLD])
        except BadKill as error:
            raise BadKill(f"kill[{i}].{error}") from None
    return tuple(kills)


def parse(text: str) -> Kill:
    """Return the kill that `text` describes.

    Examples are `a@17`, `b@20:report`, `world@30:journal+5s` and `a@17+never`. Raises BadKill.
    """
    match = _FORM.fullmatch(text)
    if match is None:
        raise BadKill(
            f"'{text}' is not a kill; expected a@17, b@20:report, world@30:journal+5s or a@17:command+never; "
            "the points of a tick are observation, report, journal and command"
        )
    after = None if match["never"] else float(match["after"] or 0.0)
    point = cast(Point, match["point"] or "observation")
    return Kill(match["who"], int(match["tick"]), point, after, text)


def taker(kills: Sequence[Kill]) -> Callable[[str, int], None]:
    """Return a callback that kills this process at its scheduled points.

    The process calls it with the point and the tick at every point of every tick.
    """
    fatal: dict[tuple[str, int], Kill] = {(kill.point, kill.tick): kill for kill in kills}

    def on_kill_point(point: str, tick: int) -> None:
        kill = fatal.get((point, tick))
        if kill is not None:
            os.write(2, f"{kill.last_words}\n".encode())
            os.kill(os.getpid(), signal.SIGKILL)

    return on_kill_point


def taken(kills: Sequence[Kill], errors: str) -> Kill | None:
    """Return the kill that ended a process, from the end of its standard error `errors`; None if none did."""
    for kill in kills:
        if errors.endswith(kill.last_words):
            return kill
    return None
