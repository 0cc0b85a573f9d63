"""Outlines of what viewers draw: circles, error ellipses, and the box about the scene of a run."""

from __future__ import annotations

import math
from typing import NamedTuple

from compose.recording.run_setup import RunSetup
from protocol.mission import Anchor
from protocol.motion import Covariance, Pose, compose

CORNERS = 72
"""The number of corners of a polygon drawn for a circle."""
SIGMAS = 3.0
"""The size of an error ellipse, and the bound of an error, in standard deviations."""


def circle(centre: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """Return the points of a closed polygon with CORNERS corners, in m."""
    turns = [2.0 * math.pi * i / CORNERS for i in range(CORNERS + 1)]
    return [(centre[0] + radius * math.cos(turn), centre[1] + radius * math.sin(turn)) for turn in turns]


def ellipse(centre: Pose, covariance: Covariance) -> list[tuple[float, float]]:
    """Return the points of the error ellipse of a position, SIGMAS standard deviations large.

    Its axes follow from the eigenvalues of the position block of the covariance.
    """
    mean = (covariance.xx + covariance.yy) / 2.0
    spread = math.hypot((covariance.xx - covariance.yy) / 2.0, covariance.xy)
    axis = Pose(centre.x, centre.y, math.atan2(2.0 * covariance.xy, covariance.xx - covariance.yy) / 2.0)
    long, short = (SIGMAS * math.sqrt(max(0.0, one)) for one in (mean + spread, mean - spread))
    points = [compose(axis, Pose(long * x, short * y, 0.0)) for x, y in circle((0.0, 0.0), 1.0)]
    return [(point.x, point.y) for point in points]


class Box(NamedTuple):
    """A rectangle, in m."""

    x: float
    """The centre, like y."""
    y: float
    width: float
    height: float

    @property
    def extent(self) -> float:
        """The larger side."""
        return max(self.width, self.height)


def box(setup: RunSetup) -> Box:
    """Return the box about all sensing ranges and orbits, and the area of robots without an anchor."""
    reach = [(one.anchor, max(setup.mission.sensing_range, one.orbit.radius)) for one in setup.anchored]
    if (area := setup.sweep) is not None:
        reach += [(Anchor(area.x_min, area.y_min), 0.0), (Anchor(area.x_max, area.y_max), 0.0)]
    left, right = min(at.x - r for at, r in reach), max(at.x + r for at, r in reach)
    low, high = min(at.y - r for at, r in reach), max(at.y + r for at, r in reach)
    return Box((left + right) / 2.0, (low + high) / 2.0, right - left, high - low)
