"""The search for a second range to a beacon (Section III.A.2): straight ahead, else on a circle.

The beacon is the anchor in phase 1, and robot b in phase 3, where robot a takes its second mutual range.
After the straight, a planner that drives backward also tries the point straight behind before the circle: it
is reached sooner than a point of the circle, and is mostly in range.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from agent.planning.manoeuvres import Manoeuvres
from agent.planning.separation import leeway
from protocol.mission import Mission
from protocol.motion import REST, TAU, Controls, Pose, relative, travelled, wrap

Beacon = Literal["anchor", "peer"]


class Straight(msgspec.Struct, frozen=True):
    """The robot drives A_0 straight ahead from `origin`, and then checks for a range to the beacon."""

    beacon: Beacon
    origin: Pose
    rho0: float
    """The range to the beacon at `origin` in m."""


class Backing(msgspec.Struct, frozen=True):
    """The robot was out of range ahead. It drives back to the point A_0 behind `origin`."""

    beacon: Beacon
    origin: Pose
    rho0: float


class Turning(msgspec.Struct, frozen=True):
    """The robot is out of range. It turns by pi / 2 on the spot, so that `origin` is on its left."""

    beacon: Beacon
    origin: Pose
    rho0: float
    heading: float


class Circling(msgspec.Struct, frozen=True):
    """The robot drives a circle of radius A_0 about `origin` until it measures a range to the beacon."""

    beacon: Beacon
    origin: Pose
    rho0: float


class Homing(msgspec.Struct, frozen=True):
    """The robot drives back until it measures a range to its anchor, and searches if there is none.

    If it has lost its anchor, it drives to the place of the last range. If it has not met its peer, it drives
    to where its anchor should be, and searches on a square spiral.
    """

    place: Pose
    """The place, in the frame of the odometry."""
    side: int | None = None
    """The number of sides of the spiral up to this place; None without a spiral."""


Seeking = Straight | Backing | Turning | Circling


def step_length(beacon: Beacon, rho0: float, mission: Mission) -> float:
    """Return the length in m of the straight from a point with range `rho0` in m to `beacon`.

    The length is A_0, or less to keep a safety distance from the peer.
    """
    step = mission.first_straight
    return step if beacon == "anchor" else min(step, leeway(rho0, mission))


def moved(origin: Pose, pose: Pose) -> bool:
    """Return whether the manoeuvre that began at `origin` was executed; in real time it may not be."""
    return pose != origin


def distance_ahead(origin: Pose, pose: Pose) -> float:
    """Return the distance in m from `origin` to `pose` along the heading of `origin`; negative behind it."""
    return relative(origin, pose).x


def onward(
    state: Seeking, pose: Pose, measured: bool, mission: Mission, manoeuvres: Manoeuvres, tolerance: float
) -> Seeking | None:
    """Return the mode after a tick that led to `pose`, or None once the second range is measured.

    `tolerance` is `Estimator.pose_tolerance`.
    """
    distance_tolerance = tolerance * mission.first_straight
    step = step_length(state.beacon, state.rho0, mission)
    match state:
        case Straight(beacon, origin, rho0):
            if travelled(origin, pose) < step - distance_tolerance:
                return state
            if measured:
                return None
            if manoeuvres.backward:
                return Backing(beacon, origin, rho0)
            return Turning(beacon, origin, rho0, pose.heading + math.pi / 2)
        case Backing(beacon, origin, rho0):
            if distance_ahead(origin, pose) > distance_tolerance - step:
                return state
            return None if measured else Turning(beacon, origin, rho0, pose.heading - math.pi / 2)
        case Turning(beacon, origin, rho0, heading):
            return state if abs(heading - pose.heading) > tolerance else Circling(beacon, origin, rho0)
        case Circling():
            return None if measured else state


def controls(state: Seeking, pose: Pose, mission: Mission) -> Controls:
    """Return the controls of the mode `state` at `pose`."""
    step = step_length(state.beacon, state.rho0, mission)
    match state:
        case Straight(_, origin):
            return straight(step - travelled(origin, pose), mission)
        case Backing(_, origin):
            return straight(-step - distance_ahead(origin, pose), mission)
        case Turning(heading=heading):
            return turn(pose, heading, mission)
        case Circling(_, _, rho0):
            omega = min(
                mission.max_turn_rate,
                inside_arc(rho0, step, mission.sensing_range) / mission.period,
                mission.max_speed / step,
            )
            return Controls(omega * step, omega)


def homing_controls(state: Homing, pose: Pose, mission: Mission, tolerance: float) -> Controls | None:
    """Return the controls that lead to the place of `state`, or None once the robot is there.

    The robot drives backward if that needs the smaller turn. `tolerance` is `Estimator.pose_tolerance`.
    """
    distance = travelled(pose, state.place)
    if distance <= tolerance * mission.first_straight:
        return None
    bearing_error = wrap(math.atan2(state.place.y - pose.y, state.place.x - pose.x) - pose.heading)
    forward = abs(bearing_error) <= math.pi / 2
    remaining_turn = bearing_error if forward else wrap(bearing_error + math.pi)
    if abs(remaining_turn) > tolerance:
        return turn(pose, pose.heading + remaining_turn, mission)
    return straight(distance if forward else -distance, mission)


def next_on_spiral(place: tuple[float, float], side: int, mission: Mission) -> tuple[float, float]:
    """Return the end of the side after `side` of a square spiral, in m, if the latter ends at `place`.

    Each second side is longer, by R.
    """
    length = (side // 2 + 1) * mission.sensing_range
    along, sign = side % 2, 1.0 if side % 4 < 2 else -1.0
    x, y = place
    return (x, y + sign * length) if along else (x + sign * length, y)


def inside_arc(rho0: float, radius: float, reach: float) -> float:
    """Return 2 pi - 2 eta in rad (Section III.A.2): the part of a circle that is in range of the beacon.

    The circle has the radius `radius` and its centre is `rho0` from the beacon, whose range is `reach`; all
    in m.
    """
    rho0 = min(rho0, reach)  # an outlier may be longer than R
    cosine = (reach * reach - rho0 * rho0 - radius * radius) / (2.0 * radius * rho0) if rho0 > 0.0 else 1.0
    return TAU - 2.0 * math.acos(min(1.0, max(-1.0, cosine)))


def turn(pose: Pose, heading: float, mission: Mission) -> Controls:
    """Return the controls of a turn on the spot towards `heading`, limited to one tick."""
    rate = (heading - pose.heading) / mission.period
    if rate == 0.0:
        return REST
    return Controls(0.0, math.copysign(min(abs(rate), mission.max_turn_rate), rate))


def straight(distance: float, mission: Mission) -> Controls:
    """Return the controls of a straight by `distance` m (backward if negative), limited to one tick."""
    speed = distance / mission.period
    return Controls(math.copysign(min(abs(speed), mission.max_speed), speed), 0.0)
