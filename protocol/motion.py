"""What a manoeuvre does: the exact unicycle step of eq. (1a), and poses in SE(2).

The world moves the robots with `step`, and the robots dead-reckon with the same `step`: there is one
motion model, on scalars. (Arrays overtake it only from some fifteen robots on, and one pair is the rule.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

from protocol.units import Angle, AngularVelocity, Coordinate, Moment, TickCount, Velocity

TAU = 2.0 * math.pi


class Pose(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """A position and a heading in some frame; also the frame that has its origin and x-axis there."""

    x: Coordinate
    y: Coordinate
    heading: Angle
    """counter-clockwise from the x-axis, not wrapped"""


ORIGIN = Pose(0.0, 0.0, 0.0)


class Covariance(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """Of the error of a pose, in m^2, m rad and rad^2: the upper triangle, row by row."""

    xx: Moment
    xy: Moment
    xh: Moment
    yy: Moment
    yh: Moment
    hh: Moment

    @property
    def position_sigma(self) -> float:
        """m: the root of the trace of the position's part."""
        return math.sqrt(max(0.0, self.xx + self.yy))

    @property
    def heading_sigma(self) -> float:
        """rad"""
        return math.sqrt(max(0.0, self.hh))


class Segment(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """Equal manoeuvres, one after the other."""

    ticks: TickCount
    v: Velocity
    omega: AngularVelocity


class Controls(msgspec.Struct, frozen=True, array_like=True, gc=False, forbid_unknown_fields=True):
    """v_k and omega_k, held over one tick."""

    v: Velocity
    omega: AngularVelocity


REST = Controls(0.0, 0.0)


def chord(v: float, omega: float, period: float) -> float:
    """A_k of eq. (1a): the straight distance in m, signed like `v`, between the ends of one manoeuvre."""
    half = 0.5 * period * omega
    return v * period if half == 0.0 else v * period * (math.sin(half) / half)


def step(pose: Pose, v: float, omega: float, period: float) -> Pose:
    """The pose after driving (v, omega) for `period` seconds (eq. (1a), exact for any period)."""
    half = 0.5 * period * omega
    length = chord(v, omega, period)
    course = pose.heading + half
    return Pose(
        pose.x + length * math.cos(course), pose.y + length * math.sin(course), pose.heading + period * omega
    )


def arc(start: Pose, run: Segment, period: float) -> list[Pose]:
    """Return the pose after each tick of `run`: what `step` gives from `start`, over k times `period`."""
    v, omega = run.v, run.omega
    x, y, heading = start.x, start.y, start.heading
    sin, cos = math.sin, math.cos
    poses: list[Pose] = []
    for k in range(1, run.ticks + 1):
        lasting = k * period
        half = 0.5 * lasting * omega
        length = v * lasting if half == 0.0 else v * lasting * (sin(half) / half)
        course = heading + half
        poses.append(Pose(x + length * cos(course), y + length * sin(course), heading + lasting * omega))
    return poses


def follow(start: Pose, runs: Iterable[Segment], period: float) -> Pose:
    """The pose at the end of `runs`. Equal manoeuvres are one arc, so each run costs one step."""
    pose = start
    for run in runs:
        pose = step(pose, run.v, run.omega, run.ticks * period)
    return pose


def compose(frame: Pose, local: Pose) -> Pose:
    """`local`, given in `frame`, in the coordinates that `frame` itself is given in."""
    c, s = math.cos(frame.heading), math.sin(frame.heading)
    return Pose(
        frame.x + c * local.x - s * local.y,
        frame.y + s * local.x + c * local.y,
        frame.heading + local.heading,
    )


def inverse(pose: Pose) -> Pose:
    """The frame that `pose` is given in, as a pose in the frame that `pose` is."""
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return Pose(-c * pose.x - s * pose.y, s * pose.x - c * pose.y, -pose.heading)


def wrap(angle: float) -> float:
    """The same direction in (-pi, pi]."""
    wrapped = math.remainder(angle, TAU)
    return math.pi if wrapped <= -math.pi else wrapped
