"""The findings of an audit: the number of checks of each rule, and the violations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import msgspec

from compose.recording.run import Run

ROUNDING = 1e-6
"""The difference that rounding alone can cause, relative to the value or to 1, whichever is larger."""
RECOMPUTED = ("observation", "decision", "config")
"""The rules that compare the recording with values computed by this process."""
MAX_VALUE = 60
"""The maximum length in characters of a quoted value."""


class Difference(msgspec.Struct, frozen=True):
    """A recorded value that differs from the one computed from the rest of the recording."""

    kind: str
    """Class name of the message."""
    field: str
    """Path of the value in the message, such as `contacts[0].range`."""
    found: str
    expected: str
    by_rounding: bool
    """True if all values of the two messages agree within ROUNDING."""


class Violation(msgspec.Struct, frozen=True):
    """A contradiction in the recording, which a correct run cannot produce."""

    rule: str
    tick: int | None
    """Tick of the violation; None if it has none, such as one in a RobotConfig."""
    robot: str | None
    """Id of the robot; None if only the world's journal is concerned."""
    what: str
    """Text that says what was found and what was expected."""
    difference: Difference | None = None
    """First difference, if the violation is one between two messages."""
    breaks_off: bool = False
    """True if the violation is only that a journal ends early; its content may be correct."""

    @property
    def line(self) -> str:
        """The violation as one line of text."""
        where = f"tick {self.tick}" if self.tick is not None else "no tick"
        return f"{where}, {self.robot or 'the world'}, {self.rule}: {self.what}"


Checks = Iterator[Violation | None]
"""The iterator that a rule returns: for each check a violation, or None if it passed."""


class Count(msgspec.Struct, frozen=True):
    """The number of checks of one rule, and how many of them failed."""

    rule: str
    checks: int
    violations: int


class LinkStatistics(msgspec.Struct, frozen=True):
    """The statistics of the Reports on one link, from the receiver's Observations; each copy counts."""

    link: str
    """Link, as sender->receiver."""
    sent: int
    """Number of ticks in contact, in each of which one Report is sent."""
    heard: int
    """Number of received Reports."""
    late: int
    """Number of Reports received in a later tick than the one in which they were sent."""
    twice: int
    """Number of Reports that had been received before."""
    damaged: int
    """Number of Reports that arrived damaged."""
    lost: int
    """Number of Reports of which no copy arrived, not even a damaged one."""


class Findings(msgspec.Struct, frozen=True):
    """The findings of the audit of one recording."""

    scenario: str
    """Name of the scenario; in hardware mode, the names of the robots."""
    ticks: int
    """Number of elapsed ticks, which is the last recorded tick: ticks are counted from 0."""
    counts: tuple[Count, ...]
    """Counts of each rule."""
    violations: tuple[Violation, ...]
    """Violations, by tick."""
    links: tuple[LinkStatistics, ...] = ()
    """Statistics of each link; empty without a fault plan."""
    rounding: tuple[Violation, ...] = ()
    """Differences by rounding alone in a recording made with other versions; they are not violations."""
    versions: str | None = None
    """Description of how those versions differ from the ones of this process; None if they do not."""

    @property
    def checks(self) -> int:
        """The number of checks of all rules."""
        return sum([count.checks for count in self.counts])

    @property
    def differences(self) -> tuple[Violation, ...]:
        """The violations that are not only an early end of a journal, by tick."""
        return tuple([one for one in self.violations if not one.breaks_off])

    @property
    def tears(self) -> tuple[Violation, ...]:
        """The violations that are only an early end of a journal."""
        return tuple([one for one in self.violations if one.breaks_off])


def findings_of(
    rules: Sequence[Callable[[Run], Checks]],
    run: Run,
    versions: str | None,
    *,
    scenario: str,
    ticks: int,
    links: tuple[LinkStatistics, ...] = (),
) -> Findings:
    """Return the findings of `rules` in `run`; `versions` describes other versions, if it has any."""
    checks = {rule.__name__: list(rule(run)) for rule in rules}
    found = [one for some in checks.values() for one in some if one is not None]
    found.sort(key=lambda one: -1 if one.tick is None else one.tick)
    rounding: list[Violation] = []
    violations: list[Violation] = []
    for one in found:
        by_rounding = one.difference is not None and one.difference.by_rounding
        known = versions is not None and one.rule in RECOMPUTED and by_rounding
        (rounding if known else violations).append(one)
    counts = [
        Count(rule, len(some), sum([one.rule == rule for one in violations])) for rule, some in checks.items()
    ]
    return Findings(scenario, ticks, tuple(counts), tuple(violations), links, tuple(rounding), versions)


def unlike(
    rule: str,
    tick: int | None,
    robot: str | None,
    found: msgspec.Struct,
    expected: msgspec.Struct,
    where: str = "",
) -> Violation:
    """Return the violation that a message is not the expected one; its text begins with `where`."""
    first = between(found, expected)
    what = f"{where}{first.field} is {first.found}, expected {first.expected}"
    if not first.field:
        what = f"{where}the frame differs, its content is the same"
    return Violation(rule, tick, robot, what, first)


def between(found: msgspec.Struct, expected: msgspec.Struct) -> Difference:
    """Return the first value, at any depth, in which the two messages differ."""
    field, one, other = _first("", found, expected)
    return Difference(type(found).__name__, field, quoted(one), quoted(other), _close(found, expected))


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


def quoted(value: Any) -> str:
    """Return `value` as JSON, cut to MAX_VALUE characters."""
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."


def _bits(value: Any) -> bytes:
    return msgspec.msgpack.encode(value)
