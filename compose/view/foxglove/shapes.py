"""Drawing primitives in Foxglove's schemas: lines, arrows and texts."""

from __future__ import annotations

import math
from collections.abc import Sequence

from foxglove import messages as fox

from protocol.motion import Pose

ORIGIN_POSE = fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0))
"""The pose of the reference frame in itself."""


def timestamp(ns: int) -> fox.Timestamp:
    """Return the timestamp of a simulated time in ns."""
    return fox.Timestamp(*divmod(ns, 1_000_000_000))


def turned(heading: float) -> fox.Quaternion:
    """Return the rotation about the vertical axis by `heading` rad."""
    return fox.Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2.0), w=math.cos(heading / 2.0))


def pose(at: Pose) -> fox.Pose:
    """Return a pose on the ground plane."""
    return fox.Pose(position=fox.Vector3(x=at.x, y=at.y, z=0.0), orientation=turned(at.heading))


def colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> fox.Color:
    """Return a colour from red, green, blue and alpha, each from 0 to 1."""
    return fox.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def point(x: float, y: float) -> fox.Point3:
    """Return a point on the ground plane."""
    return fox.Point3(x=x, y=y, z=0.0)


def middle(ends: Sequence[tuple[float, float]]) -> Pose:
    """Return the middle between two points."""
    (x, y), (to_x, to_y) = ends
    return Pose((x + to_x) / 2, (y + to_y) / 2, 0.0)


def strip(points: Sequence[tuple[float, float]], tint: fox.Color, width: float) -> fox.LinePrimitive:
    """Return a line through `points`, `width` pixels wide."""
    return line([point(x, y) for x, y in points], tint, width)


def line(points: Sequence[fox.Point3], tint: fox.Color, width: float) -> fox.LinePrimitive:
    """Return a line through Foxglove points, `width` pixels wide."""
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=ORIGIN_POSE,
        thickness=width,
        scale_invariant=True,
        points=list(points),
        color=tint,
    )


def arrow(at: Pose, size: float, tint: fox.Color) -> fox.ArrowPrimitive:
    """Return an arrow of `size` m along the heading of a pose."""
    return fox.ArrowPrimitive(
        pose=pose(at),
        shaft_length=0.6 * size,
        shaft_diameter=0.3 * size,
        head_length=0.4 * size,
        head_diameter=0.6 * size,
        color=tint,
    )


def words(text: str, at: Pose, above: float, tint: fox.Color) -> fox.TextPrimitive:
    """Return a text `above` m above a position, always facing the viewer."""
    place = fox.Pose(position=fox.Vector3(x=at.x, y=at.y + above, z=above), orientation=turned(0.0))
    return fox.TextPrimitive(
        pose=place, billboard=True, font_size=14.0, scale_invariant=True, color=tint, text=text
    )
