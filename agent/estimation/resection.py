"""The pose of a robot without an anchor, from exact ranges to a robot whose poses are known.

First the robot stands still while the other one moves: the ranges determine its position, without a mirror
image if the places of the other one are on no line. Then it moves itself, and the ranges determine its
heading, without a mirror image if its own places and their origin are on no line through the other robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from protocol.motion import Pose, compose, wrap

RESECTION_STEPS = 12
"""The maximum number of Gauss-Newton steps; most fits stop improving after one."""

REDUNDANT = 1
"""The number of ranges more than unknowns that a pose needs, so that a false report is found."""

LEAST_POSITION_INFORMATION = 0.02
"""The least root of the information about a position in its worst direction, for ranges with sigma 1 m.

From four corners of a square with a side of 0.03 R, 0.9 R away, it is 0.033; from a line, about 0.
"""

LEAST_HEADING_INFORMATION = 0.02
"""The least information about the heading, in units of the squared distance driven.

A range contains 1 if the robot has driven across the line to the other one, and 0 if along it.
"""

PARALLEL = 1e-9
"""The squared sine of the angle between two directions below which they are treated as parallel."""

Point = tuple[float, float]


class RangedPlace(NamedTuple):
    """A range in m to the other robot, which is at a known place, from a pose of this robot's odometry."""

    there: Point
    """The place of the other robot in <W>, in m."""
    odometry: Pose
    """The pose of this robot by dead reckoning; ORIGIN while it stands still."""
    range: float
    """The measured range, in m."""


def positions(standing: Sequence[RangedPlace], floor: float) -> tuple[Point, ...]:
    """Return the positions of a robot that stands still which agree with all ranges, to `floor` m.

    There are two, mirror images of each other, if the places are on one line. The result is empty with fewer
    than two places, and if the ranges contradict the places.
    """
    if len(standing) < 2:
        return ()
    first = standing[0]
    second = max(standing, key=lambda one: math.dist(one.there, first.there))
    (x, y), (far_x, far_y) = first.there, second.there
    base = math.hypot(far_x - x, far_y - y)
    if base <= floor:
        return ()
    # on the line through two places, rounding may leave the triangle of the ranges open
    along = (base * base + first.range**2 - second.range**2) / (2.0 * base)
    aside = math.sqrt(max(0.0, first.range**2 - along * along))
    ux, uy = (far_x - x) / base, (far_y - y) / base
    solutions: list[Point] = []
    for side in (aside, -aside):
        position = _fitted_position((x + along * ux - side * uy, y + along * uy + side * ux), standing)
        explained = all(abs(math.dist(position, one.there) - one.range) <= floor for one in standing)
        if explained and all(math.dist(position, other) > 2.0 * floor for other in solutions):
            solutions.append(position)
    return tuple(solutions)


def _fitted_position(position: Point, standing: Sequence[RangedPlace]) -> Point:
    """Return the position near `position` that fits all ranges best (Gauss-Newton)."""
    best, fitted = math.inf, position
    for _ in range(RESECTION_STEPS):
        cost = xx = xy = yy = gx = gy = 0.0
        for (x, y), _, rho in standing:
            dx, dy = position[0] - x, position[1] - y
            apart = math.hypot(dx, dy)
            if apart == 0.0:
                continue
            ux, uy, error = dx / apart, dy / apart, apart - rho
            cost += error * error
            xx, xy, yy = xx + ux * ux, xy + ux * uy, yy + uy * uy
            gx, gy = gx + ux * error, gy + uy * error
        determinant = xx * yy - xy * xy
        if cost >= best:
            break
        best, fitted = cost, position
        if determinant <= PARALLEL * xx * yy:
            break
        position = (
            position[0] - (yy * gx - xy * gy) / determinant,
            position[1] - (xx * gy - xy * gx) / determinant,
        )
    return fitted


def poses(standing: Sequence[RangedPlace], moved: Sequence[RangedPlace], floor: float) -> tuple[Pose, ...]:
    """Return the poses in <W> of the origin of the odometry that agree with all ranges, to `floor` m.

    `moved` are the ranges from other places of this robot. More than one pose is left if they do not
    determine the heading; there is none if the ranges contradict the reported places.
    """
    fits: list[Pose] = []
    for position in positions(standing, floor):
        headings = [_fitted_heading(position, one, moved) for one in _headings(position, moved)]
        around = [Pose(*position, heading) for heading in headings]
        ranked = sorted([(_misfit(pose, moved), k) for k, pose in enumerate(around)])
        for misfit, pose in [(misfit, around[k]) for misfit, k in ranked]:  # of one pose, the better fit
            turned = [abs(wrap(pose.heading - one.heading)) for one in fits if (one.x, one.y) == position]
            if misfit <= floor and all(angle * _reach(moved) > 2.0 * floor for angle in turned):
                fits.append(pose)
    return tuple(fits)


def is_certain(standing: Sequence[RangedPlace], moved: Sequence[RangedPlace], fits: Sequence[Pose]) -> bool:
    """Return whether one pose is left that redundant ranges have confirmed, and that they determine well.

    A rounding error of the ranges is amplified by at most 1 / LEAST_POSITION_INFORMATION, in position and
    heading.
    """
    if len(fits) != 1 or len(moved) < 1 + REDUNDANT or not is_fixed(standing, (fits[0].x, fits[0].y)):
        return False
    least = math.sqrt(LEAST_HEADING_INFORMATION) * _reach(moved)
    return sum([_slope(fits[0], one) ** 2 for one in moved]) >= least * least


def is_fixed(standing: Sequence[RangedPlace], position: Point) -> bool:
    """Return whether redundant ranges determine `position` well."""
    if len(standing) < 2 + REDUNDANT:
        return False
    xx, xy, yy = _information(position, standing)
    least = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
    return least >= LEAST_POSITION_INFORMATION * LEAST_POSITION_INFORMATION


def _information(position: Point, standing: Sequence[RangedPlace]) -> tuple[float, float, float]:
    """Return the sum of u u^T over the directions u from the other robot to `position`: xx, xy and yy."""
    xx = xy = yy = 0.0
    for (x, y), _, _ in standing:
        dx, dy = position[0] - x, position[1] - y
        squared = dx * dx + dy * dy
        if squared > 0.0:
            xx, xy, yy = xx + dx * dx / squared, xy + dx * dy / squared, yy + dy * dy / squared
    return xx, xy, yy


def _slope(pose: Pose, ranged: RangedPlace) -> float:
    """Return the derivative in m / rad of the range of `ranged` by the heading of `pose`."""
    here = compose(pose, ranged.odometry)
    x, y = here.x - ranged.there[0], here.y - ranged.there[1]
    apart = math.hypot(x, y)
    return (y * (here.x - pose.x) - x * (here.y - pose.y)) / apart if apart > 0.0 else 0.0


def _headings(position: Point, moved: Sequence[RangedPlace]) -> tuple[float, ...]:
    """Return the headings of the odometry's frame that agree with one range, with this robot at `position`.

    It is the range that was measured farthest from the origin of the odometry.
    """
    if not moved:
        return ()
    farthest = max(moved, key=lambda each: math.hypot(each.odometry.x, each.odometry.y))
    x, y = farthest.there[0] - position[0], farthest.there[1] - position[1]
    apart, driven = math.hypot(x, y), math.hypot(farthest.odometry.x, farthest.odometry.y)
    if apart == 0.0 or driven == 0.0:
        return ()
    cosine = (apart * apart + driven * driven - farthest.range * farthest.range) / (2.0 * apart * driven)
    angle = math.acos(min(1.0, max(-1.0, cosine)))
    direct = math.atan2(y, x) - math.atan2(farthest.odometry.y, farthest.odometry.x)
    return direct + angle, direct - angle


def _fitted_heading(position: Point, heading: float, moved: Sequence[RangedPlace]) -> float:
    """Return the heading near `heading` that fits all ranges best (Gauss-Newton)."""
    best, fitted = math.inf, heading
    for _ in range(RESECTION_STEPS):
        cost = gradient = curvature = 0.0
        for ranged in moved:
            here = compose(Pose(*position, heading), ranged.odometry)
            x, y = here.x - ranged.there[0], here.y - ranged.there[1]
            apart = math.hypot(x, y)
            if apart == 0.0:
                continue
            slope = (y * (here.x - position[0]) - x * (here.y - position[1])) / apart
            error = apart - ranged.range
            cost += error * error
            gradient, curvature = gradient + slope * error, curvature + slope * slope
        if cost >= best:
            break
        best, fitted = cost, heading
        if curvature == 0.0:
            break
        heading -= gradient / curvature
    return wrap(fitted)


def _misfit(pose: Pose, moved: Sequence[RangedPlace]) -> float:
    """Return the largest difference in m between a range and the one that `pose` predicts."""
    here = [(compose(pose, one.odometry), one) for one in moved]
    return max([abs(math.dist((at.x, at.y), one.there) - one.range) for at, one in here])


def _reach(moved: Sequence[RangedPlace]) -> float:
    """Return the largest distance in m of this robot from the origin of its odometry."""
    return max(math.hypot(one.odometry.x, one.odometry.y) for one in moved)
