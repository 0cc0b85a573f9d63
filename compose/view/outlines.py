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
from protocol.mission import Anchor, Mission
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


class Reach(NamedTuple):
    """The places where a robot can be by its contact with a peer."""

    places: Sequence[Point]
    """The possible positions of the peer."""
    length: float
    """The largest distance in m from the nearest one."""

    @staticmethod
    def of(mission: Mission, measured: float | None, peer: Pose, covariance: Covariance | None) -> Reach:
        """Return the reach of a robot in contact with a peer; `measured` is the range, if there is one."""
        length = (
            mission.sensing_range
            if measured is None
            else measured + OUTLINE_SIGMAS * mission.noise.mutual_sigma
        )
        turn = Turn.of(peer, covariance) if covariance is not None else None
        places = [(peer.x, peer.y)] if turn is None else [turn.at(angle) for angle in turn.angles]
        return Reach(places, length)


class Turn(NamedTuple):
    """The arc along which a position lies while its heading is uncertain."""

    x: float
    """The centre in m, like y."""
    y: float
    radius: float
    """The radius in m."""
    bearing: float
    """The direction in rad from the centre to the position."""
    heading_sigma: float
    """The standard deviation of the heading in rad."""
    across: float
    """The standard deviation across the arc, with a known heading, in m."""

    @staticmethod
    def of(pose: Pose, covariance: Covariance) -> Turn | None:
        """Return the arc of a pose; None if its ellipse shows as much."""
        if covariance.hh <= 0.0:
            return None
        x, y = covariance.yh / covariance.hh, -covariance.xh / covariance.hh  # the position, from the centre
        radius, bearing = math.hypot(x, y), math.atan2(y, x)
        along, up = math.cos(bearing), math.sin(bearing)
        xx, yy = covariance.xx - y * y * covariance.hh, covariance.yy - x * x * covariance.hh
        xy = covariance.xy + x * y * covariance.hh
        across = math.sqrt(max(0.0, along * along * xx + 2.0 * along * up * xy + up * up * yy))
        found = Turn(pose.x - x, pose.y - y, radius, bearing, covariance.heading_sigma, across)
        bend = radius * (1.0 - math.cos(found.largest))
        return found if math.inf > bend > BENT_ARC * OUTLINE_SIGMAS * _sigmas(covariance)[1] else None

    @property
    def largest(self) -> float:
        """The largest angle in rad by which the position is turned."""
        return min(OUTLINE_SIGMAS * self.heading_sigma, math.pi)

    @property
    def angles(self) -> list[float]:
        """Angles from the least to the largest, with 0 in the middle."""
        return [self.largest * (2.0 * i / CORNERS - 1.0) for i in range(CORNERS + 1)]

    def at(self, angle: float, beside: float = 0.0) -> Point:
        """Return the position that is turned by `angle`, `beside` m farther from the centre."""
        away, course = self.radius + beside, self.bearing + angle
        return self.x + away * math.cos(course), self.y + away * math.sin(course)

    def within(self, reach: Reach | None) -> list[float]:
        """Return the angles around 0 at which the position is within `reach`; all of them if 0 is not."""
        angles = self.angles
        kept = [
            reach is None or min(math.dist(self.at(one), place) for place in reach.places) <= reach.length
            for one in angles
        ]
        first = last = CORNERS // 2
        if not kept[first]:
            return angles
        while first > 0 and kept[first - 1]:
            first -= 1
        while last < CORNERS and kept[last + 1]:
            last += 1
        return angles[first : last + 1]


def arc(pose: Pose, covariance: Covariance, reach: Reach | None = None) -> tuple[Point, ...]:
    """Return the outline of the arc along which a position lies; empty if its ellipse shows as much.

    It has OUTLINE_SIGMAS standard deviations, as far as the position is within `reach`.
    """
    turn = Turn.of(pose, covariance)
    if turn is None:
        return ()
    far: list[Point] = []
    near: list[Point] = []
    angles = turn.within(reach)
    for angle in angles:
        left = 1.0 - (angle / (OUTLINE_SIGMAS * turn.heading_sigma)) ** 2
        wide = OUTLINE_SIGMAS * turn.across * math.sqrt(max(0.0, left))
        far.append(turn.at(angle, wide))
        near.append(turn.at(angle, -wide) if wide < turn.radius else (turn.x, turn.y))
    if angles[-1] - angles[0] == 2.0 * math.pi and set(near) == {(turn.x, turn.y)}:
        return tuple(far)
    return (*far, *reversed(near))


def outline(pose: Pose, covariance: Covariance, reach: Reach | None = None) -> Sequence[Point]:
    """Return the closed outline of where a position is, OUTLINE_SIGMAS standard deviations large."""
    bent = arc(pose, covariance, reach)
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
    """Return the box about all sensing ranges and orbits, and the area of robots without an anchor."""
    reach = [(one.anchor, max(setup.mission.sensing_range, one.orbit.radius)) for one in setup.anchored]
    if (area := setup.sweep) is not None:
        reach += [(Anchor(area.x_min, area.y_min), 0.0), (Anchor(area.x_max, area.y_max), 0.0)]
    left, right = min(at.x - r for at, r in reach), max(at.x + r for at, r in reach)
    low, high = min(at.y - r for at, r in reach), max(at.y + r for at, r in reach)
    return Box((left + right) / 2.0, (low + high) / 2.0, right - left, high - low)
