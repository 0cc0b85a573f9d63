"""What an audit finds: of each rule how many checks were made, and what was found otherwise than expected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

MAX_VALUE = 60
"""characters of a value that is quoted"""


class Violation(msgspec.Struct, frozen=True):
    """Something that a sound run cannot have on record."""

    rule: str
    tick: int | None
    """none of what is of no tick, such as a briefing"""
    robot: str | None
    """none of what only the world has on record"""
    what: str
    """was found, and what was expected"""

    @property
    def line(self) -> str:
        """All of it."""
        where = f"tick {self.tick}" if self.tick is not None else "no tick"
        return f"{where}, {self.robot or 'the world'}, {self.rule}: {self.what}"


Checks = Iterator[Violation | None]
"""what a rule yields: of every check that it makes the violation, or None"""


class Count(msgspec.Struct, frozen=True):
    """How often a rule was held against the record, and how often it did not hold."""

    rule: str
    checks: int
    violations: int


class Befallen(msgspec.Struct, frozen=True):
    """A link, and what became of the reports on it, as Senses have it; a copy counts for itself."""

    link: str
    sent: int
    """in contact"""
    heard: int
    late: int
    """of these: not in the tick in which they were sent"""
    twice: int
    """of these: heard before"""
    damaged: int
    lost: int
    """that nobody heard, not even damaged"""


class Findings(msgspec.Struct, frozen=True):
    """Of a whole record."""

    scenario: str
    ticks: int
    """that are on record"""
    counts: tuple[Count, ...]
    """a rule each"""
    violations: tuple[Violation, ...]
    """the earliest first"""
    radio: tuple[Befallen, ...] = ()
    """of each link, under a fault plan"""


def difference(found: msgspec.Struct, expected: msgspec.Struct) -> str:
    """In which fields two messages of a kind differ, to the bit; the first of them in full."""
    fields = [
        name
        for name in found.__struct_fields__
        if _bits(getattr(found, name)) != _bits(getattr(expected, name))
    ]
    if not fields:
        return "the frame is another, of the same content"
    first = fields[0]
    more = f" (and {', '.join(fields[1:])})" if fields[1:] else ""
    return f"{first} is {said(getattr(found, first))}, expected {said(getattr(expected, first))}{more}"


def said(value: Any) -> str:
    """A value, as short as it can be quoted."""
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."


def _bits(value: Any) -> bytes:
    return msgspec.msgpack.encode(value)
