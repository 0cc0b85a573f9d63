"""The motion model: the exact unicycle step of eq. (1a), and poses in SE(2).

The world moves the robots with `step`, and the robots dead-reckon with the same function. It works on
scalars: arrays are faster only from about fifteen robots on, and most missions have two.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import msgspec

from protocol.units import Angle, AngularVelocity, Coordinate, Moment, TickCount, Velocity

TAU = 2.0 * math.pi


class Pose(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A position and a heading in a frame. A pose also defines the frame with its origin and x-axis there."""

    x: Coordinate
    """The x coordinate, in m."""
    y: Coordinate
    """The y coordinate, in m."""
    heading: Angle
    """The heading theta in rad, counter-clockwise from the x-axis, not wrapped."""


ORIGIN = Pose(0.0, 0.0, 0.0)
"""The pose at the origin of a frame, heading along its x-axis."""


class Covariance(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """The covariance of the error of a pose (x, y, heading): the upper triangle, row by row."""

    xx: Moment
    """The variance of x, in m^2."""
    xy: Moment
    """The covariance of x and y, in m^2."""
    xh: Moment
    """The covariance of x and the heading, in m rad."""
    yy: Moment
    """The variance of y, in m^2."""
    yh: Moment
    """The covariance of y and the heading, in m rad."""
    hh: Moment
    """The variance of the heading, in rad^2."""

    @property
    def matrix(self) -> list[list[float]]:
        """The 3 x 3 matrix of x, y (m) and heading (rad)."""
        return [[self.xx, self.xy, self.xh], [self.xy, self.yy, self.yh], [self.xh, self.yh, self.hh]]

    @property
    def position_sigma(self) -> float:
        """The square root of the trace of the covariance of the position, in m."""
        return math.sqrt(max(0.0, self.xx + self.yy))

    @property
    def heading_sigma(self) -> float:
        """The standard deviation of the heading, in rad."""
        return math.sqrt(max(0.0, self.hh))


class Segment(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A sequence of equal manoeuvres in consecutive ticks, which form one arc."""

    ticks: TickCount
    """The number of ticks."""
    v: Velocity
    """The forward velocity, in m/s."""
    omega: AngularVelocity
    """The angular velocity, in rad/s."""


class Controls(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """The control inputs v_k and omega_k of eq. (1a), constant over one tick."""

    v: Velocity
    """The forward velocity, in m/s."""
    omega: AngularVelocity
    """The angular velocity, in rad/s."""


REST = Controls(0.0, 0.0)
"""The controls of a robot at rest."""


def chord(v: float, omega: float, period: float) -> float:
    """Return A_k of eq. (1a): the distance in m between the ends of a manoeuvre, with the sign of `v`."""
    half = 0.5 * period * omega
    return v * period if half == 0.0 else v * period * (math.sin(half) / half)


def step(pose: Pose, v: float, omega: float, period: float) -> Pose:
    """Return the pose after driving `v` m/s and `omega` rad/s for `period` s: eq. (1a), exact."""
    half = 0.5 * period * omega
    length = v * period if half == 0.0 else v * period * (math.sin(half) / half)  # as `chord`
    course = pose.heading + half
    return Pose(
        pose.x + length * math.cos(course), pose.y + length * math.sin(course), pose.heading + period * omega
    )


def arc(start: Pose, run: Segment, period: float, done: int = 0) -> list[Pose]:
    """Return the poses after each tick of `run` but the first `done`.

    They are those that `step` gives from `start` after k `period` s.
    """
    v, omega = run.v, run.omega
    x, y, heading = start.x, start.y, start.heading
    sin, cos = math.sin, math.cos
    if omega == 0.0:
        ahead = heading + omega
        c, s = cos(ahead), sin(ahead)
        lengths = [v * (k * period) for k in range(done + 1, run.ticks + 1)]
        return [Pose(x + length * c, y + length * s, ahead) for length in lengths]
    poses: list[Pose] = []
    for k in range(done + 1, run.ticks + 1):
        lasting = k * period
        half = 0.5 * lasting * omega
        length = v * lasting if half == 0.0 else v * lasting * (sin(half) / half)
        course = heading + half
        poses.append(Pose(x + length * cos(course), y + length * sin(course), heading + lasting * omega))
    return poses


def follow(start: Pose, runs: Iterable[Segment], period: float) -> Pose:
    """Return the pose after driving `runs` from `start`, with one step for each run."""
    pose = start
    for run in runs:
        pose = step(pose, run.v, run.omega, run.ticks * period)
    return pose


def compose(frame: Pose, local: Pose) -> Pose:
    """Return the pose `local`, given in `frame`, in the frame in which `frame` itself is given."""
    c, s = math.cos(frame.heading), math.sin(frame.heading)
    return Pose(
        frame.x + c * local.x - s * local.y,
        frame.y + s * local.x + c * local.y,
        frame.heading + local.heading,
    )


def inverse(pose: Pose) -> Pose:
    """Return the inverse transformation: `compose(pose, inverse(pose))` is ORIGIN."""
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return Pose(-c * pose.x - s * pose.y, s * pose.x - c * pose.y, -pose.heading)


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return `pose` in `frame`, both given in one frame: `compose(frame, relative(frame, p))` is `p`."""
    c, s = math.cos(frame.heading), math.sin(frame.heading)
    dx, dy = pose.x - frame.x, pose.y - frame.y
    return Pose(c * dx + s * dy, c * dy - s * dx, pose.heading - frame.heading)


def placed(frame: Pose, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the points with coordinates `x` and `y` (floats or arrays) in `frame`,
    as `compose` does poses."""
    c, s = math.cos(frame.heading), math.sin(frame.heading)
    return frame.x + c * x - s * y, frame.y + s * x + c * y


def rotated(c: Any, s: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return vectors turned by angles with cosine `c` and sine `s`. All are floats or arrays."""
    return c * x - s * y, s * x + c * y


def rotated_back(c: Any, s: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the vectors that `rotated` turns into these."""
    return c * x + s * y, c * y - s * x


def travelled(origin: Pose, pose: Pose) -> float:
    """Return the distance in m between two poses."""
    return math.hypot(pose.x - origin.x, pose.y - origin.y)


def heading_of(x: float, y: float, z: float, w: float) -> float:
    """Return the heading in rad, in (-pi, pi], of a robot with this orientation as a quaternion.

    The norm may differ from 1 by NORM. Raises ValueError if it does by more, or if the robot is not upright.
    """
    norm = math.hypot(x, y, z, w)
    if not abs(norm - 1.0) <= NORM:
        raise ValueError(f"an orientation with a norm of {norm:.6g}, expected 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    if (up := 1.0 - 2.0 * (x * x + y * y)) < UPRIGHT:
        tilt = math.degrees(math.acos(max(up, -1.0)))
        raise ValueError(f"an orientation tilted by {tilt:.0f} degrees, expected a robot in the plane, z up")
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


NORM = 0.1
"""The largest difference from 1 of the norm of an orientation.

Linear interpolation between two orientations shortens the quaternion by less, up to 100 degrees between them.
"""
UPRIGHT = 0.5
"""The least cosine of the angle between the robot's vertical axis and that of the frame; REP 103 has z up."""


def wrap(angle: float) -> float:
    """Return `angle`, in rad, wrapped to (-pi, pi]."""
    wrapped = math.remainder(angle, TAU)
    return math.pi if wrapped <= -math.pi else wrapped
