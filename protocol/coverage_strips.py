"""Strips in which localised robots cover an area, so that no robot that stands in it is missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import Annotated

import msgspec
from msgspec import Meta

from protocol.units import Coordinate

Place = tuple[float, float]
"""A position in <W>, in m."""

HALF_WIDTH = 0.8
"""The largest distance of a robot from the middle of its strip, as a fraction of R."""

STRIP_REACH = 0.9
"""The largest range at which a covering robot stops for another one, as a fraction of R."""

STEP = 0.5
"""The largest distance driven in a tick of the coverage, as a fraction of R.

A robot at HALF_WIDTH, on a square of its own, is at most 0.84 R from the middle line, and 0.63 R of the line
are within STRIP_REACH R of it. That is more than STEP, so a tick ends there. At the end of a strip it is half
as much, and contains the end, where a tick ends because robots turn.
"""

SIDE = 0.03
"""The side of the square that a robot drives in range of another one, as a fraction of R.

If both drive one, their range grows from STRIP_REACH R by at most the two diagonals, and stays within R.
"""

NOISY_HALF_WIDTH = 0.65
"""HALF_WIDTH under noise: the strips are narrower, because a robot may drive 0.25 R beside its strip."""

ALONG, ASIDE = 0.6, 0.2
"""The sides of the rectangles that a robot drives in range of another one under noise, in units of R.

The first is along its strip: the ranges from both ends tell where the other robot is, but not on which side
of the strip. The second tells that.
"""

OWN_SIDE = 0.2
"""The side of the squares of a robot without an anchor under noise, in units of R."""

STRIPS_OF_ROUND = 2
"""The number of strips after which a robot with noisy sensors passes anchor and beacon again.

Between them, its pose becomes less accurate. With more, it is too inaccurate at the ends of the strips; with
less, most of the way leads to the anchor and back.
"""

BESIDE, AROUND = 0.5, 0.6
"""The distance at which a robot passes beside its anchor or beacon, and the half length of that way, in R."""

PLACES_PASSED = 6
"""The number of places on the way past the anchor and the beacon: three each."""

PLACES_OF_ROUND = PLACES_PASSED + 2 * STRIPS_OF_ROUND
"""The number of places of a round: those, and the ends of its strips."""


class SweptArea(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The parts of an area that robots cover, one each."""

    x_min: Coordinate
    """The smallest x of the area, in m."""
    y_min: Coordinate
    """The smallest y of the area, in m."""
    x_max: Coordinate
    """The largest x of the area, in m."""
    y_max: Coordinate
    """The largest y of the area, in m."""
    parts: Annotated[int, Meta(ge=1, le=1000)]
    """The number of parts."""

    def contains(self, x: float, y: float) -> bool:
        """Return whether the area contains the place (x, y), in m."""
        return self.x_min <= x <= self.x_max and self.y_min <= y <= self.y_max

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The area as x_min, y_min, x_max, y_max, in m, as scenario files have it."""
        return self.x_min, self.y_min, self.x_max, self.y_max

    @property
    def corners(self) -> tuple[Place, ...]:
        """The corners of the area, in m in <W>."""
        return tuple([(x, y) for x in (self.x_min, self.x_max) for y in (self.y_min, self.y_max)])

    @property
    def across(self) -> int:
        """The axis across the strips: 0 for x, 1 for y."""
        return 1 if self.x_max - self.x_min >= self.y_max - self.y_min else 0

    def strips(self, sensing_range: float, half_width: float = HALF_WIDTH) -> int:
        """Return the number of strips: every point is within `half_width` R of the middle line of one."""
        low, high = (self.x_min, self.y_min)[self.across], (self.x_max, self.y_max)[self.across]
        return max(1, math.ceil((high - low) / (2.0 * half_width * sensing_range)))

    def strips_of(self, part: int, sensing_range: float, half_width: float = HALF_WIDTH) -> tuple[int, int]:
        """Return the first strip of a part, and the one after its last.

        The numbers of strips of two parts differ by at most 1; a part may have none.
        """
        count = self.strips(sensing_range, half_width)
        return count * part // self.parts, count * (part + 1) // self.parts

    def path(
        self, strips: tuple[int, int], sensing_range: float, half_width: float = HALF_WIDTH
    ) -> tuple[Place, ...]:
        """Return the ends of strips in m in <W>, in the order in which they are driven.

        `strips` is the first of them, and the one after the last.
        """
        low, high = (self.x_min, self.y_min), (self.x_max, self.y_max)
        aside, along = self.across, 1 - self.across
        width, count = high[aside] - low[aside], self.strips(sensing_range, half_width)
        places: list[Place] = []
        for i in range(*strips):
            middle = low[aside] + (i + 0.5) * width / count
            ends = (low[along], high[along]) if i % 2 == 0 else (high[along], low[along])
            places += [(end, middle) if along == 0 else (middle, end) for end in ends]
        return tuple(places)

    def part_of(self, strip: int, sensing_range: float) -> int:
        """Return the part that has `strip`."""
        return next(k for k in range(self.parts) if strip < self.strips_of(k, sensing_range)[1])


def surveyed_path(
    area: SweptArea, part: int, sensing_range: float, anchor: Place, beacon: Place
) -> tuple[Place, ...]:
    """Return the way of a robot with noisy sensors through a part of `area`, in m in <W>.

    It passes its `anchor` and a robot that stands at `beacon` before each STRIPS_OF_ROUND strips: from the
    ranges to both, it knows its pose again. The strips nearest to its anchor come first, because its pose
    becomes more accurate with each round.
    """
    own = area.strips_of(part, sensing_range, NOISY_HALF_WIDTH)
    strips = area.path(own, sensing_range, NOISY_HALF_WIDTH)
    passing = (
        *_passed(anchor, anchor, beacon, sensing_range),
        *_passed(beacon, anchor, beacon, sensing_range),
    )
    rounds = [
        strips[begin : begin + 2 * STRIPS_OF_ROUND] for begin in range(0, len(strips), 2 * STRIPS_OF_ROUND)
    ]
    axis = area.across
    rounds.sort(key=lambda ends: abs(ends[0][axis] - anchor[axis]))
    return tuple([place for ends in rounds for place in (*passing, *ends)])


def ways_between_passages(path: Sequence[Place]) -> list[Sequence[Place]]:
    """Return the ways along the strips of a `surveyed_path`, each from the last place of a passage on."""
    return [
        path[begin + PLACES_PASSED - 1 : begin + PLACES_OF_ROUND]
        for begin in range(0, len(path), PLACES_OF_ROUND)
    ]


@lru_cache(maxsize=8)  # all robots of a group ask for the same
def widest_distance(places: tuple[Place, ...]) -> float:
    """Return the largest distance in m between two of `places`; 0 if there are fewer than two."""
    return max([math.dist(*two) for two in combinations(places, 2)], default=0.0)


def _passed(place: Place, begin: Place, end: Place, sensing_range: float) -> tuple[Place, ...]:
    """Return the places of a bent way past `place`, in the direction from `begin` to `end`."""
    apart = math.dist(begin, end)
    ux, uy = ((end[0] - begin[0]) / apart, (end[1] - begin[1]) / apart) if apart > 0.0 else (1.0, 0.0)
    ways = ((-AROUND, 0.0), (0.0, BESIDE), (AROUND, 0.0))
    return tuple(
        [
            (
                place[0] + sensing_range * (along * ux - aside * uy),
                place[1] + sensing_range * (along * uy + aside * ux),
            )
            for along, aside in ways
        ]
    )
