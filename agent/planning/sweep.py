"""The motion of a sweep: along the strips of an area, and in loops in range of another robot."""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

from agent.planning import phase2_orbit
from agent.planning.phase2_orbit import Travelling
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose
from protocol.sweep_strips import SIDE, Place
from protocol.sweep_ticks import sweep_speed

LOOPS_FOR = 200
"""The ticks after which robots stop driving squares that have localised nobody: the other one may be dead."""


class Sweeping(msgspec.Struct, frozen=True):
    """A localised robot of a group drives along the strips in which it looks for robots without an anchor."""

    places: tuple[Place, ...]
    """The ends of the straights that are left, in m in the frame of the odometry."""


class Looping(msgspec.Struct, frozen=True):
    """A robot drives a loop, so that a robot without an anchor is localised by the ranges between the two."""

    places: tuple[Place, ...]
    """The corners that are left, in m in the frame of the odometry. The last one is where it began."""
    then: tuple[Place, ...] = ()
    """The ends of the straights of a sweep that are left after it."""
    since: int = 0
    """The tick in which the first loop began; it is repeated until a robot is localised."""


def transformed(transform: Pose, places: Iterable[Place]) -> tuple[Place, ...]:
    """Return `places`, in m, in the frame in which their own frame has the pose `transform`."""
    moved = [compose(transform, Pose(x, y, 0.0)) for x, y in places]
    return tuple([(one.x, one.y) for one in moved])


def looping(odometry: Pose, mission: Mission, since: int, then: tuple[Place, ...] = ()) -> Looping:
    """Return a square that begins ahead of `odometry` and goes to the left, with these `since` and `then`."""
    side = SIDE * mission.sensing_range
    x, y = side * math.cos(odometry.heading), side * math.sin(odometry.heading)
    corners = [(0.0, 0.0), (x, y), (x - y, y + x), (-y, x)]
    places = [(odometry.x + dx, odometry.y + dy) for dx, dy in corners]
    return Looping((*places[1:], places[0]), then, since)


def looping_both_ways(
    odometry: Pose, along: float, aside: float, since: int, then: tuple[Place, ...] = ()
) -> Looping:
    """Return a rectangle behind `odometry`, to its left, and then the same to its right.

    Its sides are `along` and `aside`, in m. In both together, the robot turns as much to the left as to the
    right, so an error of the scale of its gyro does not add up.
    """
    corners = [
        (x, side * aside * y)
        for side in (1.0, -1.0)
        for x, y in ((0.0, 1.0), (-along, 1.0), (-along, 0.0), (0.0, 0.0))
    ]
    return Looping(transformed(odometry, corners), then, since)


def controls(mode: Sweeping | Looping, odometry: Pose, mission: Mission, tolerance: float) -> Controls | None:
    """Return the controls to the next place, at most with the speed of a sweep; None if there is no place.

    `tolerance` is `Estimator.pose_tolerance`.
    """
    if not mode.places:
        return None
    travelling = phase2_orbit.travel_controls(Travelling(mode.places[0]), odometry, mission, tolerance)
    if travelling is None:
        return None
    return Controls(min(travelling.v, sweep_speed(mission)), travelling.omega)


def onward(
    mode: Sweeping | Looping, odometry: Pose, mission: Mission, tolerance: float
) -> Sweeping | Looping:
    """Return `mode` without the places at which the robot has arrived."""
    while mode.places and controls(mode, odometry, mission, tolerance) is None:
        mode = msgspec.structs.replace(mode, places=mode.places[1:])
    return mode
