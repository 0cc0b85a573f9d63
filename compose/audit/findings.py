"""What an audit finds: of each rule how many checks were made, and what was found otherwise than expected."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import msgspec

ROUNDING = 1e-6
"""of a value, or of 1 where it is less: how far apart two computations may come by rounding alone"""
RECOMPUTED = ("observation", "decision", "config")
"""rules that hold the recording against what is computed here"""
MAX_VALUE = 60
"""characters of a value that is quoted"""


class Difference(msgspec.Struct, frozen=True):
    """A value on record that is not what follows from the rest of the record, to the bit."""

    kind: str
    """of message"""
    field: str
    """where in the message it stands, such as `contacts[0].range`"""
    found: str
    expected: str
    by_rounding: bool
    """no value in the two messages differs by more than ROUNDING"""


class Violation(msgspec.Struct, frozen=True):
    """Something that a sound run cannot have on record."""

    rule: str
    tick: int | None
    """none of what is of no tick, such as a briefing"""
    robot: str | None
    """none of what only the world has on record"""
    what: str
    """was found, and what was expected"""
    difference: Difference | None = None
    """where two messages were held against each other: the first in which they differ"""
    breaks_off: bool = False
    """there is no more of the journal, and what there is may be sound"""

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


class LinkStatistics(msgspec.Struct, frozen=True):
    """A link, and what became of the reports on it, as Observations have it; a copy counts for itself."""

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
    links: tuple[LinkStatistics, ...] = ()
    """of each link, under a fault plan"""
    rounding: tuple[Violation, ...] = ()
    """what differs by rounding alone, in a recording that was made with other versions: no violations"""
    versions: str | None = None
    """in what they are others than here"""


T = TypeVar("T")


def findings_of(
    rules: Sequence[Callable[[T], Checks]],
    case: T,
    versions: str | None,
    *,
    scenario: str,
    ticks: int,
    links: tuple[LinkStatistics, ...] = (),
) -> Findings:
    """Return what each of `rules`, counted by its name, finds in `case`; `versions` says which differ."""
    checks = {rule.__name__: list(rule(case)) for rule in rules}
    found = [one for some in checks.values() for one in some if one is not None]
    found.sort(key=lambda one: -1 if one.tick is None else one.tick)
    rounding: list[Violation] = []
    violations: list[Violation] = []
    for one in found:
        (rounding if versions is not None and _by_rounding(one) else violations).append(one)
    counts = [
        Count(rule, len(some), sum([one.rule == rule for one in violations])) for rule, some in checks.items()
    ]
    return Findings(scenario, ticks, tuple(counts), tuple(violations), links, tuple(rounding), versions)


def _by_rounding(one: Violation) -> bool:
    return one.rule in RECOMPUTED and one.difference is not None and one.difference.by_rounding


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


def between(found: msgspec.Struct, expected: msgspec.Struct) -> Difference:
    """The first value in which they differ, however deep it stands."""
    field, one, other = _first("", found, expected)
    return Difference(type(found).__name__, field, said(one), said(other), _close(found, expected))


def _close(one: Any, other: Any) -> bool:
    """Return whether the two values are the same except for rounding."""
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= ROUNDING * max(1.0, abs(one), abs(other))
    if type(one) is not type(other):
        return False
    if isinstance(one, msgspec.Struct):
        return all(_close(getattr(one, name), getattr(other, name)) for name in one.__struct_fields__)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_close, one, other))
    return bool(one == other)


def _first(path: str, found: Any, expected: Any) -> tuple[str, Any, Any]:
    parts: Iterable[tuple[str, Any, Any]] = ()
    match found:
        case msgspec.Struct() if type(found) is type(expected):
            names = found.__struct_fields__
            parts = [(f"{path}.{name}", getattr(found, name), getattr(expected, name)) for name in names]
        case tuple() if isinstance(expected, tuple) and len(found) == len(expected):
            parts = [
                (f"{path}[{i}]", one, other)
                for i, (one, other) in enumerate(zip(found, expected, strict=True))
            ]
    for deeper, one, other in parts:
        if _bits(one) != _bits(other):
            return _first(deeper, one, other)
    return path.removeprefix("."), found, expected


def said(value: Any) -> str:
    """A value, as short as it can be quoted."""
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."


def _bits(value: Any) -> bytes:
    return msgspec.msgpack.encode(value)
