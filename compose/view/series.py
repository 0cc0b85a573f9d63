"""Series: the numbers of robots over time, with few enough points for a chart of a mission of any length."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

import msgspec
from msgspec import UNSET

from compose.recording.run_setup import RunSetup
from compose.view.numbers import Numbers
from compose.view.run_data import RunData, TickData
from compose.view.scene import held_poses, player_of

MOST_BINS = 500
"""The maximum number of bins of a series: with the minimum and the maximum of each, 1000 points."""


class Curve(msgspec.Struct, frozen=True):
    """One number of one robot in each bin of consecutive ticks; None where it is unknown in all of them."""

    low: tuple[float | None, ...]
    """The minimum in each bin."""
    high: tuple[float | None, ...]
    """The maximum in each bin."""


class RobotSeries(msgspec.Struct, frozen=True):
    """The numbers of one robot over time."""

    robot: str
    curves: dict[str, Curve]
    """The curves by the names of the fields of `Numbers`; those that are unknown in all ticks are absent."""


class Series(msgspec.Struct, frozen=True):
    """The numbers of robots over time."""

    first: int
    """The first tick."""
    last: int
    """The last tick."""
    step: int
    """The number of ticks in a bin; the last bin may have fewer."""
    exact: bool
    """True if the sensors are exact; then there is no `position_bound_m`."""
    robots: tuple[RobotSeries, ...]


def series(
    setup: RunSetup,
    known: RunData,
    robots: Collection[str] | None = None,
    check: Callable[[], None] = lambda: None,
) -> Series:
    """Return the series of `robots`, or of all if None, from the first known tick to the last.

    `check` is called for each tick and each bin, and may raise an exception to end the computation.
    """
    first = next(iter(known.ticks), 0)
    last = max(known.last, first)
    step = -(-(last - first + 1) // MOST_BINS)
    bins: list[list[tuple[RunSetup, TickData]]] = [[] for _ in range(first, last + 1, step)]
    for tick in known.between(first, last):
        check()
        bins[(tick - first) // step].append((known.setup_at(setup, tick), known.ticks[tick]))
    found = []
    for place, one in enumerate(setup.robots):
        if robots is None or one.id in robots:
            numbers = []
            for several in bins:
                check()
                numbers.append([_numbers(then, place, now) for then, now in several])
            curves = {name: _curve(name, numbers) for name in Numbers.__struct_fields__}
            known_ones = {name: curve for name, curve in curves.items() if {*curve.low} != {None}}
            found.append(RobotSeries(one.id, known_ones))
    return Series(first, last, step, setup.mission.noise.exact, tuple(found))


def _numbers(setup: RunSetup, place: int, now: TickData) -> Numbers:
    robot = setup.robots[place]
    return Numbers.of(player_of(robot, setup, now), robot, setup, lambda one: held_poses(one, now))


def _curve(name: str, bins: Iterable[Sequence[Numbers]]) -> Curve:
    values = [[value for one in several if (value := getattr(one, name)) is not UNSET] for several in bins]
    return Curve(
        tuple([min(one, default=None) for one in values]), tuple([max(one, default=None) for one in values])
    )
