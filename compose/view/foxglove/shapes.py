"""What is drawn for viewers, in Foxglove's schemas: lines, arrows, words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from foxglove import messages as fox

from protocol.motion import Covariance, Pose, compose

CORNERS = 72
"""of what is drawn for a circle"""
SIGMAS = 3.0
"""of an ellipse"""


def timestamp(ns: int) -> fox.Timestamp:
    """Of simulated time."""
    return fox.Timestamp(*divmod(ns, 1_000_000_000))


def turned(heading: float) -> fox.Quaternion:
    """About the vertical, by rad."""
    return fox.Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2.0), w=math.cos(heading / 2.0))


def pose(at: Pose) -> fox.Pose:
    """On the ground."""
    return fox.Pose(position=fox.Vector3(x=at.x, y=at.y, z=0.0), orientation=turned(at.heading))


def colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> fox.Color:
    """Red, green and blue from 0 to 1."""
    return fox.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def point(x: float, y: float) -> fox.Point3:
    """On the ground."""
    return fox.Point3(x=x, y=y, z=0.0)


def strip(points: Sequence[tuple[float, float]], tint: fox.Color, width: float) -> fox.LinePrimitive:
    """A line through `points`, `width` pixels wide."""
    return line([point(x, y) for x, y in points], tint, width)


def line(points: Sequence[fox.Point3], tint: fox.Color, width: float) -> fox.LinePrimitive:
    """As `strip`, through points that are made already."""
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0)),
        thickness=width,
        scale_invariant=True,
        points=list(points),
        color=tint,
    )


def circle(centre: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """A closed line of CORNERS corners, in m."""
    turns = [2.0 * math.pi * i / CORNERS for i in range(CORNERS + 1)]
    return [(centre[0] + radius * math.cos(turn), centre[1] + radius * math.sin(turn)) for turn in turns]


def ellipse(centre: Pose, covariance: Covariance) -> list[tuple[float, float]]:
    """Of SIGMAS of the position, by the eigenvalues of its part of the covariance."""
    mean = (covariance.xx + covariance.yy) / 2.0
    spread = math.hypot((covariance.xx - covariance.yy) / 2.0, covariance.xy)
    axis = Pose(centre.x, centre.y, math.atan2(2.0 * covariance.xy, covariance.xx - covariance.yy) / 2.0)
    long, short = (SIGMAS * math.sqrt(max(0.0, one)) for one in (mean + spread, mean - spread))
    points = [compose(axis, Pose(long * x, short * y, 0.0)) for x, y in circle((0.0, 0.0), 1.0)]
    return [(point.x, point.y) for point in points]


def arrow(at: Pose, size: float, tint: fox.Color) -> fox.ArrowPrimitive:
    """A heading, `size` m long."""
    return fox.ArrowPrimitive(
        pose=pose(at),
        shaft_length=0.6 * size,
        shaft_diameter=0.3 * size,
        head_length=0.4 * size,
        head_diameter=0.6 * size,
        color=tint,
    )


def words(text: str, at: Pose, above: float, tint: fox.Color) -> fox.TextPrimitive:
    """A text `above` m above a place, that faces whoever looks."""
    place = fox.Pose(position=fox.Vector3(x=at.x, y=at.y + above, z=above), orientation=turned(0.0))
    return fox.TextPrimitive(
        pose=place, billboard=True, font_size=14.0, scale_invariant=True, color=tint, text=text
    )
