"""Strips in which localised robots sweep an area, so that no robot that stands in it can be missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from protocol.mission import Mission

HALF_WIDTH = 0.8
"""The largest distance of a robot from the middle of its strip, as a fraction of R."""

STEP = 0.5
"""The largest distance driven in a tick of a sweep, as a fraction of R.

At HALF_WIDTH, 1.2 R of the middle line are in range, so at least two ticks are.
"""

Area = tuple[float, float, float, float]
"""x_min, y_min, x_max and y_max in m."""


class Strip(NamedTuple):
    """The middle line of a strip, in m in <W>."""

    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        """The length in m."""
        return math.dist(self.start, self.end)


def strips(area: Area, sensing_range: float) -> tuple[Strip, ...]:
    """Return parallel strips along the longer side of `area`, which cover it, driven to and fro.

    Every point of the area is within HALF_WIDTH R of the middle line of a strip.
    """
    x_min, y_min, x_max, y_max = area
    wide, high = x_max - x_min, y_max - y_min
    across, along = min(wide, high), max(wide, high)
    count = max(1, math.ceil(across / (2.0 * HALF_WIDTH * sensing_range)))
    found = []
    for i in range(count):
        aside, (first, last) = (i + 0.5) * across / count, (0.0, along) if i % 2 == 0 else (along, 0.0)
        ends = [(first, aside), (last, aside)] if wide >= high else [(aside, first), (aside, last)]
        start, end = [(x_min + x, y_min + y) for x, y in ends]
        found.append(Strip(start, end))
    return tuple(found)


def split(swept: Sequence[Strip], sweepers: int) -> tuple[tuple[Strip, ...], ...]:
    """Return the strips of each of `sweepers` robots: neighbours, their numbers differ by at most 1."""
    ends = [len(swept) * i // sweepers for i in range(sweepers + 1)]
    return tuple(tuple(swept[first:last]) for first, last in pairwise(ends))


def sweep_time(swept: Sequence[Strip], mission: Mission) -> float:
    """Return the bound in s of the time in which a robot drives along `swept`, from the first start.

    Each end costs a turn of at most pi, and a part of a tick.
    """
    speed = sweep_speed(mission)
    turn = (math.ceil(math.pi / (mission.max_turn_rate * mission.period)) + 1) * mission.period
    driven, here = 0.0, None
    for strip in swept:
        for place in strip:
            if here is not None:
                ticks = math.ceil(math.dist(here, place) / (speed * mission.period))
                driven += ticks * mission.period + turn
            here = place
    return driven


def sweep_speed(mission: Mission) -> float:
    """Return the speed in m/s of a sweep, with which no robot is passed between two ticks."""
    return min(mission.max_speed, STEP * mission.sensing_range / mission.period)
