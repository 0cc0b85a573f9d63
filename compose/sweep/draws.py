"""Values drawn at random for every trial of a sweep: fields of the scenario, and the robots' starts.

Every draw has its own random stream. It depends only on the trial's seed and the name of the field.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from compose.sweep.field_paths import Steps, value_at, with_value
from protocol.motion import TAU

T = TypeVar("T")
Interval = tuple[float, float]
Place = Literal["inside", "on-anchor", "near-anchor", "rim", "collinear", "coincident", "mirrored"]
Heading = Literal["any", "radial", "tangential", "collinear"]
Start = tuple[float, float, float]

ALLOWED_ROUNDING = (1e-12, 1e-6)
"""The interval in m of the distance between anchor and start for `near-anchor`, log-uniform."""
OFF = (1e-16, 1e-3)
"""The interval of the deviation from a special heading, in rad, or from the rim, as a fraction of R.

Half of the draws have no deviation; in the other half it is log-uniform.
"""


class DrawTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [[draw]]: a `field` drawn from one of two distributions, scaled by other fields."""

    field: str
    """the path of the field that is drawn"""
    uniform: Interval | None = None
    """bounds of a uniform distribution"""
    log_uniform: Interval | None = None
    """bounds of a log-uniform distribution; a draw has either this or `uniform`"""
    times: list[str] = []
    """fields by whose values the draw is multiplied"""
    over: list[str] = []
    """fields by whose values the draw is divided"""


class StartsTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [starts]: kinds of place and heading, from which each robot draws with equal probability."""

    places: Annotated[tuple[Place, ...], Meta(min_length=1)] = ("inside",)
    """the kinds of start position"""
    headings: Annotated[tuple[Heading, ...], Meta(min_length=1)] = ("any",)
    """the kinds of start heading"""


class Draw(msgspec.Struct, frozen=True):
    """The distribution of a field that every trial draws: the validated form of a DrawTable."""

    field: str
    way: Steps
    """parsed path of the field"""
    interval: Interval
    logarithmic: bool
    """true for a log-uniform, false for a uniform distribution"""
    times: tuple[Steps, ...] = ()
    """parsed paths of the fields by whose values the draw is multiplied"""
    over: tuple[Steps, ...] = ()
    """parsed paths of the fields by whose values the draw is divided"""


class Draws(msgspec.Struct, frozen=True):
    """All draws of a trial of a sweep: first the fields, in order, then the starts."""

    fields: tuple[Draw, ...] = ()
    starts: StartsTable | None = None

    def __bool__(self) -> bool:
        return bool(self.fields) or self.starts is not None

    def table(self, base: Mapping[str, Any], seed: int) -> dict[str, Any]:
        """Return the scenario table `base` with the values drawn for the trial with `seed`."""
        table = dict(base)
        for draw in self.fields:
            value = _between(_stream(seed, draw.field), draw.interval, logarithmic=draw.logarithmic)
            value *= math.prod([value_at(table, way) for way in draw.times])
            value /= math.prod([value_at(table, way) for way in draw.over])
            table = with_value(table, draw.way, value)
        if self.starts is not None:
            for i, start in enumerate(_starts(self.starts, table, seed)):
                table = with_value(table, ("robot", i, "start"), list(start))
        return table

    def values(self, table: Mapping[str, Any]) -> dict[str, float]:
        """Return the values in `table` of the fields that are drawn, by field."""
        return {draw.field: value_at(table, draw.way) for draw in self.fields}


def _stream(seed: int, name: str) -> Callable[[], float]:
    """Return a function that draws numbers uniform in [0, 1); its stream is keyed by `seed` and `name`."""
    return random.Random(f"{seed}/draw/{name}").random


def _between(draw: Callable[[], float], interval: Interval, *, logarithmic: bool = True) -> float:
    """Draw a number from `interval`, log-uniform or uniform."""
    low, high = interval
    return low * (high / low) ** draw() if logarithmic else low + (high - low) * draw()


def _one_of(draw: Callable[[], float], kinds: Sequence[T]) -> T:
    """Draw one of `kinds` with equal probability."""
    return kinds[int(draw() * len(kinds))]


def _off(draw: Callable[[], float]) -> float:
    """Draw a deviation: zero with probability 1/2, else log-uniform in OFF with either sign."""
    return _one_of(draw, (0.0, 0.0, 1.0, -1.0)) * _between(draw, OFF)


def _starts(kinds: StartsTable, table: Mapping[str, Any], seed: int) -> list[Start]:
    """Return the start of every robot; that of the second of a pair may depend on that of the first."""
    reach = float(table["mission"]["sensing_range"])
    robots = table["robot"]
    ids = [robot["id"] for robot in robots]
    starts: list[Start] = []
    for i, robot in enumerate(robots):
        j = ids.index(robot["peer"]) if "peer" in robot else 1 - i
        first = starts[j] if j < i else None
        draw = _stream(seed, f"start/{robot['id']}")
        starts.append(_start(kinds, draw, robot["anchor"], robots[j]["anchor"], reach, first))
    return starts


def _start(
    kinds: StartsTable,
    draw: Callable[[], float],
    anchor: Sequence[float],
    other: Sequence[float],
    reach: float,
    first: Start | None,
) -> Start:
    """Return a start (x, y in m, heading in rad) at most `reach` m from `anchor`.

    `other` is the peer's anchor. `first` is the peer's start, or None if it is not drawn yet.
    """
    line = math.atan2(other[1] - anchor[1], other[0] - anchor[0])
    place, heading_kind = _one_of(draw, kinds.places), _one_of(draw, kinds.headings)
    rho, bearing = _polar(place, draw, line, reach)
    heading = TAU * draw()
    if first is not None and place == "coincident":
        bearing, heading = math.atan2(first[1] - anchor[1], first[0] - anchor[0]), first[2]
        rho = math.dist(first[:2], anchor)
        if rho <= reach and draw() < 0.5:
            return first
    if first is not None and place == "mirrored":
        rho = math.dist(first[:2], other)
        bearing = 2.0 * line + math.pi - math.atan2(first[1] - other[1], first[0] - other[0])
        heading = 2.0 * line + math.pi - first[2]
    match heading_kind:
        case "radial":
            heading = bearing + _one_of(draw, (0.0, math.pi)) + _off(draw)
        case "tangential":
            heading = bearing + _one_of(draw, (0.5, -0.5)) * math.pi + _off(draw)
        case "collinear":
            heading = line + _one_of(draw, (0.0, math.pi)) + _off(draw)
    return _within(anchor, min(rho, reach), bearing, heading, reach)


def _polar(place: Place, draw: Callable[[], float], line: float, reach: float) -> tuple[float, float]:
    """Return the distance in m and the bearing in rad of a start from its anchor.

    `line` is the bearing of the peer's anchor, and `reach` is R.
    """
    rho, bearing = reach * math.sqrt(draw()), TAU * draw()
    match place:
        case "on-anchor":
            return 0.0, bearing
        case "near-anchor":
            return _between(draw, ALLOWED_ROUNDING), bearing
        case "rim":
            return reach * (1.0 - abs(_off(draw))), bearing
        case "collinear":
            return rho, line + _one_of(draw, (0.0, math.pi)) + _off(draw)
        case _:
            return rho, bearing


def _within(anchor: Sequence[float], rho: float, bearing: float, heading: float, reach: float) -> Start:
    """Return the pose at `rho` and `bearing` from `anchor`.

    If rounding puts it outside `reach`, `rho` is reduced until it is inside.
    """
    less = 2.0**-53
    while True:
        x, y = anchor[0] + rho * math.cos(bearing), anchor[1] + rho * math.sin(bearing)
        if math.dist((x, y), anchor) <= reach:
            return x, y, heading
        rho, less = rho * (1.0 - less), 2.0 * less
