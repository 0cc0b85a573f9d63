"""Outlines of what viewers and figures draw: circles, where a robot may be, and the box about a run.

A robot that hardly knows its heading may be anywhere along an arc, which an ellipse does not show: with a
sigma of 10 m it would be two parallel lines. So the outline follows from the whole covariance of a pose. An
error of the heading turns the position about a fixed point; across that arc, the position has the covariance
that is left once the heading is known. If the angle is small, the outline is the ellipse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from compose.recording.run_setup import RunSetup
from protocol.mission import Anchor
from protocol.motion import Covariance, Pose, compose

CORNERS = 72
"""The number of corners of a polygon drawn for a circle."""
OUTLINE_SIGMAS = 3.0
"""The size of an error ellipse, and the bound of an error, in standard deviations."""
BENT_ARC = 0.5
"""The largest deviation of an arc from its tangent that an ellipse shows, in its lesser semi-axes."""
Point = tuple[float, float]
"""x and y in m."""


def circle(centre: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """Return the points of a closed polygon with CORNERS corners, in m."""
    turns = [2.0 * math.pi * i / CORNERS for i in range(CORNERS + 1)]
    return [(centre[0] + radius * math.cos(turn), centre[1] + radius * math.sin(turn)) for turn in turns]


def ellipse(centre: Pose, covariance: Covariance) -> list[tuple[float, float]]:
    """Return the points of the error ellipse of a position, OUTLINE_SIGMAS standard deviations large.

    Its axes follow from the eigenvalues of the position block of the covariance.
    """
    axis = Pose(centre.x, centre.y, math.atan2(2.0 * covariance.xy, covariance.xx - covariance.yy) / 2.0)
    long, short = (OUTLINE_SIGMAS * sigma for sigma in _sigmas(covariance))
    points = [compose(axis, Pose(long * x, short * y, 0.0)) for x, y in circle((0.0, 0.0), 1.0)]
    return [(point.x, point.y) for point in points]


def _sigmas(covariance: Covariance) -> tuple[float, float]:
    """Return the standard deviations of a position along the axes of its ellipse, the larger one first."""
    mean = (covariance.xx + covariance.yy) / 2.0
    spread = math.hypot((covariance.xx - covariance.yy) / 2.0, covariance.xy)
    return math.sqrt(max(0.0, mean + spread)), math.sqrt(max(0.0, mean - spread))


def arc(pose: Pose, covariance: Covariance) -> tuple[Point, ...]:
    """Return the outline of the arc along which a position lies; empty if its ellipse shows as much.

    It has OUTLINE_SIGMAS standard deviations.
    """
    if covariance.hh <= 0.0:
        return ()
    x, y = covariance.yh / covariance.hh, -covariance.xh / covariance.hh  # the position, from the centre
    radius, bearing, spread = math.hypot(x, y), math.atan2(y, x), OUTLINE_SIGMAS * covariance.heading_sigma
    largest = min(spread, math.pi)
    bend = radius * (1.0 - math.cos(largest))
    if not math.inf > bend > BENT_ARC * OUTLINE_SIGMAS * _sigmas(covariance)[1]:
        return ()
    along, up = math.cos(bearing), math.sin(bearing)
    xx, yy = covariance.xx - y * y * covariance.hh, covariance.yy - x * x * covariance.hh
    xy = covariance.xy + x * y * covariance.hh
    across = math.sqrt(max(0.0, along * along * xx + 2.0 * along * up * xy + up * up * yy))
    centre = pose.x - x, pose.y - y
    sides: tuple[list[Point], list[Point]] = ([], [])
    for i in range(CORNERS + 1):
        angle = largest * (2.0 * i / CORNERS - 1.0)
        wide = OUTLINE_SIGMAS * across * math.sqrt(max(0.0, 1.0 - (angle / spread) ** 2))
        for side, away in zip(sides, (radius + wide, max(0.0, radius - wide)), strict=True):
            course = bearing + angle
            side.append((centre[0] + away * math.cos(course), centre[1] + away * math.sin(course)))
    far, near = sides
    return tuple(far) if largest == math.pi and {*near} == {centre} else (*far, *reversed(near))


def outline(pose: Pose, covariance: Covariance) -> Sequence[Point]:
    """Return the closed outline of where a position is, OUTLINE_SIGMAS standard deviations large."""
    bent = arc(pose, covariance)
    return (*bent, bent[0]) if bent else ellipse(pose, covariance)


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
    """Return the box about all sensing ranges and orbits, and the area of robots without an anchor.

    Without an anchor, it is the box about where robots that range each other in a row may be.
    """
    far = setup.mission.sensing_range
    reach = [(one.anchor, max(far, one.orbit.radius)) for one in setup.anchored]
    reach += [(at, far) for one in setup.anchors if (at := one.place or one.position) is not None]
    if not reach:
        reach = [(Anchor(0.0, 0.0), far * math.sqrt(len(setup.robots)))]
    if (area := setup.sweep) is not None:
        reach += [(Anchor(area.x_min, area.y_min), 0.0), (Anchor(area.x_max, area.y_max), 0.0)]
    left, right = min(at.x - r for at, r in reach), max(at.x + r for at, r in reach)
    low, high = min(at.y - r for at, r in reach), max(at.y + r for at, r in reach)
    return Box((left + right) / 2.0, (low + high) / 2.0, right - left, high - low)
