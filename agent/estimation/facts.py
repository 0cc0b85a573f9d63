"""A set of facts about any number of robots, from which every joint estimate follows.

A fact is something that was measured or told once: the motion of a robot in a tick, a range, the position of
an anchor. Each has a key. Knowledge is merged by the union of sets, which is idempotent, commutative and
associative. Estimates are functions of the set, in the order of the keys. So neither the order in which facts
arrive, nor how often and by which way, changes an estimate by a bit, and none counts twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import Literal, NamedTuple

import msgspec

Kind = Literal["anchor", "anchor range", "manoeuvre", "mutual range", "start"]


class FactKey(NamedTuple):
    """The key of a fact. There is at most one fact with each key."""

    robot: str
    """The robot, or the anchor of the kind `anchor`. Of a mutual range, the smaller of the two names."""
    tick: int
    """The tick; 0 for a start, and for the position of an anchor, which does not change."""
    kind: Kind
    other: str = ""
    """The other robot of a mutual range, or the anchor of an anchor range."""

    def __str__(self) -> str:
        """Return the key in words."""
        match self.kind:
            case "anchor":
                return f"the position of anchor {self.robot}"
            case "anchor range":
                return f"the range of {self.robot} to anchor {self.other} at tick {self.tick}"
            case "manoeuvre":
                return f"the manoeuvre of {self.robot} in tick {self.tick}"
            case "mutual range":
                return f"the range between {self.robot} and {self.other} at tick {self.tick}"
            case "start":
                return f"the pose of {self.robot} at tick 0"


class Manoeuvre(NamedTuple):
    """The measured motion of a robot from a tick to the next."""

    v: float
    """The forward velocity in m/s."""
    omega: float
    """The angular velocity in rad/s."""
    slip: float = 0.0
    """The angle in rad from the chord of eq. (1a) to the displacement."""
    v_variance: float = 0.0
    """The variance of v in (m/s)^2 beyond that of the noise model."""
    omega_variance: float = 0.0
    """The variance of omega in (rad/s)^2 beyond that of the noise model."""


class MeasuredRange(NamedTuple):
    """A measured range."""

    range: float
    """The range in m."""
    sigma: float
    """The standard deviation of the range in m."""


class AnchorPlace(NamedTuple):
    """The position of an anchor in <W>."""

    x: float
    """The x coordinate in m."""
    y: float
    """The y coordinate in m."""
    sigma: float = 0.0
    """The standard deviation of each coordinate in m. 0: surveyed; infinite: unknown."""


class StartPose(NamedTuple):
    """The pose of a robot at tick 0, which is exact: without anchors, it defines the frame."""

    x: float
    """The x coordinate in m."""
    y: float
    """The y coordinate in m."""
    heading: float
    """The heading in rad."""


Value = Manoeuvre | MeasuredRange | AnchorPlace | StartPose


class Fact(NamedTuple):
    """A key with its value."""

    key: FactKey
    value: Value


class ContradictoryFacts(ValueError):
    """Two facts with the same key have different values."""

    def __init__(self, key: FactKey, values: Iterable[Value]) -> None:
        """Name the `key`, and the `values` in their order."""
        self.key = key
        super().__init__(f"contradiction: {key} has the values " + " and ".join(map(_text, sorted(values))))


def _text(value: Value) -> str:
    """Return the numbers of a value with their names, without those that are mostly 0 if all of them are."""
    numbers = [f"{name} = {one!r}" for name, one in value._asdict().items()]
    if isinstance(value, Manoeuvre | AnchorPlace) and not any(value[2:]):
        numbers = numbers[:2]
    return f"({', '.join(numbers)})"


class Facts(msgspec.Struct, frozen=True, dict=True):
    """A set of facts without contradictions. Raises ContradictoryFacts."""

    known: frozenset[Fact] = frozenset()

    def __post_init__(self) -> None:
        """Check that no two facts have the same key."""
        if len({one.key for one in self.known}) < len(self.known):
            raise _contradiction(self.known)

    def __or__(self, other: Facts) -> Facts:
        """Return the union of both sets. Raises ContradictoryFacts, which names the key."""
        if other.known <= self.known:
            return self
        if self.known <= other.known:
            return other
        return Facts(self.known | other.known)

    def __len__(self) -> int:
        """Return the number of facts."""
        return len(self.known)

    @cached_property
    def ordered(self) -> tuple[Fact, ...]:
        """All facts in the order of their keys."""
        return tuple(sorted(self.known, key=lambda one: one.key))

    @cached_property
    def robots(self) -> tuple[str, ...]:
        """The names of all robots with a manoeuvre, a range or a start, in their order."""
        names: set[str] = set()
        for key, _ in self.known:
            if key.kind != "anchor":
                names.add(key.robot)
            if key.kind == "mutual range":
                names.add(key.other)
        return tuple(sorted(names))

    def of_kind(self, kind: Kind) -> list[Fact]:
        """Return the facts of a kind, in the order of their keys."""
        return [one for one in self.ordered if one.key.kind == kind]


def _contradiction(facts: Iterable[Fact]) -> ContradictoryFacts:
    """Return the error of the first key that has several values."""
    values: dict[FactKey, list[Value]] = {}
    for key, value in facts:
        values.setdefault(key, []).append(value)
    first = min(key for key, some in values.items() if len(some) > 1)
    return ContradictoryFacts(first, values[first])


# --- facts ------------------------------------------------------------------------------------------------


def anchor(name: str, x: float, y: float, sigma: float = 0.0) -> Fact:
    """Return the fact that an anchor is at x, y (m), each with a standard deviation of `sigma` (m).

    An infinite sigma is that of an unknown position. Raises ValueError if another number is not finite.
    """
    key = FactKey(name, 0, "anchor")
    if sigma == math.inf:
        return Fact(key, AnchorPlace(0.0, 0.0, sigma))
    return _fact(key, AnchorPlace(x + 0.0, y + 0.0, sigma + 0.0))


def anchor_range(robot: str, name: str, tick: int, rho: float, sigma: float) -> Fact:
    """Return the fact that `robot` has measured the range `rho` (m) to an anchor at a tick."""
    return _fact(FactKey(robot, tick, "anchor range", name), MeasuredRange(rho + 0.0, sigma + 0.0))


def mutual_range(robot: str, other: str, tick: int, rho: float, sigma: float) -> Fact:
    """Return the fact that two robots, in either order, have measured the range `rho` (m) between them."""
    first, second = sorted((robot, other))
    return _fact(FactKey(first, tick, "mutual range", second), MeasuredRange(rho + 0.0, sigma + 0.0))


def manoeuvre(robot: str, tick: int, measured: Manoeuvre) -> Fact:
    """Return the fact that `robot` has `measured` this motion from `tick` to the next."""
    return _fact(FactKey(robot, tick, "manoeuvre"), Manoeuvre(*[one + 0.0 for one in measured]))


def start_pose(robot: str, x: float, y: float, heading: float) -> Fact:
    """Return the fact that `robot` is at x, y (m) with this heading (rad) at tick 0."""
    return _fact(FactKey(robot, 0, "start"), StartPose(x + 0.0, y + 0.0, heading + 0.0))


def _fact(key: FactKey, value: Value) -> Fact:
    """Return a fact whose numbers are finite. There is no -0.0: it is equal to 0.0, and not the same."""
    if key.tick < 0 or key.robot == key.other:
        raise ValueError(f"{key}: the tick is at least 0, and no robot ranges itself")
    if not all(map(math.isfinite, value)):
        raise ValueError(f"{key}: {_text(value)} is not finite")
    return Fact(key, value)
