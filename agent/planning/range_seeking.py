"""How a robot takes a second range of a beacon (Section III.A.2): straight ahead, else about where it was.

In between, `assured` looks straight behind: sooner than round a circle, and mostly in range.

Phase 1 does it with the anchor, and a does it again in phase 3, with b in the anchor's place.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from agent.planning.separation import leeway
from protocol.mission import Mission, PlannerName
from protocol.motion import REST, TAU, Controls, Pose, wrap

ARRIVED = 1e-9
"""rad, and of A_0: nearer than this is there; the odometry knows the rest"""

CLOSE = 0.05
"""rad, and of A_0: nearer than this is there, where wheels are noisy"""

Beacon = Literal["anchor", "peer"]


class Straight(msgspec.Struct, frozen=True):
    """Drives A_0 ahead; then looks whether the beacon ranges it there."""

    beacon: Beacon
    origin: Pose
    rho0: float
    """m: the range at `origin`"""


class Backing(msgspec.Struct, frozen=True):
    """Has left the beacon's range ahead, and drives back to A_0 behind `origin`."""

    beacon: Beacon
    origin: Pose
    rho0: float


class Turning(msgspec.Struct, frozen=True):
    """Has left the beacon's range, and turns by pi / 2 on the spot, to have `origin` on its left."""

    beacon: Beacon
    origin: Pose
    rho0: float
    heading: float


class Circling(msgspec.Struct, frozen=True):
    """Drives a circle of radius A_0 about `origin`, until the beacon ranges it."""

    beacon: Beacon
    origin: Pose
    rho0: float


class Homing(msgspec.Struct, frozen=True):
    """Has lost its anchor, and drives back to where it was ranged last."""

    place: Pose


Seeking = Straight | Backing | Turning | Circling


def stretch(beacon: Beacon, rho0: float, mission: Mission) -> float:
    """m: how far a robot goes from where it ranged `beacon` at `rho0` m: A_0; less towards a peer nearby."""
    step = mission.first_straight
    return step if beacon == "anchor" else min(step, leeway(rho0, mission))


def arrived(mission: Mission) -> tuple[float, float]:
    """m and rad: how near is there."""
    share = ARRIVED if mission.noise.exact else CLOSE
    return share * mission.first_straight, share


def travelled(origin: Pose, pose: Pose) -> float:
    """m, as the crow flies."""
    return math.hypot(pose.x - origin.x, pose.y - origin.y)


def moved(origin: Pose, pose: Pose) -> bool:
    """Whether a manoeuvre begun at `origin` has been executed; in real time it may not have been."""
    return pose != origin


def ahead(origin: Pose, pose: Pose) -> float:
    """m from `origin` to `pose`, along the heading there; negative behind it."""
    return (pose.x - origin.x) * math.cos(origin.heading) + (pose.y - origin.y) * math.sin(origin.heading)


def onward(
    state: Seeking, pose: Pose, measured: bool, mission: Mission, planner_name: PlannerName
) -> Seeking | None:
    """The state after a tick that led to `pose`; None once there is a second range."""
    there, facing = arrived(mission)
    step = stretch(state.beacon, state.rho0, mission)
    match state:
        case Straight(beacon, origin, rho0):
            if travelled(origin, pose) < step - there:
                return state
            if measured:
                return None
            if planner_name == "assured":
                return Backing(beacon, origin, rho0)
            return Turning(beacon, origin, rho0, pose.heading + math.pi / 2)
        case Backing(beacon, origin, rho0):
            if ahead(origin, pose) > there - step:
                return state
            return None if measured else Turning(beacon, origin, rho0, pose.heading - math.pi / 2)
        case Turning(beacon, origin, rho0, heading):
            return state if abs(heading - pose.heading) > facing else Circling(beacon, origin, rho0)
        case Circling():
            return None if measured else state


def controls(state: Seeking, pose: Pose, mission: Mission) -> Controls:
    """What `state` drives from `pose`."""
    step = stretch(state.beacon, state.rho0, mission)
    match state:
        case Straight(_, origin):
            return straight(step - travelled(origin, pose), mission)
        case Backing(_, origin):
            return straight(-step - ahead(origin, pose), mission)
        case Turning(heading=heading):
            return turn(pose, heading, mission)
        case Circling(_, _, rho0):
            omega = min(
                mission.max_turn_rate,
                inside_arc(rho0, step, mission.sensing_range) / mission.period,
                mission.max_speed / step,
            )
            return Controls(omega * step, omega)


def homeward(state: Homing, pose: Pose, mission: Mission) -> Controls | None:
    """What leads on to its place, backwards where that is the shorter turn; None once there."""
    there, facing = arrived(mission)
    distance = travelled(pose, state.place)
    if distance <= there:
        return None
    askew = wrap(math.atan2(state.place.y - pose.y, state.place.x - pose.x) - pose.heading)
    forward = abs(askew) <= math.pi / 2
    left = askew if forward else wrap(askew + math.pi)
    if abs(left) > facing:
        return turn(pose, pose.heading + left, mission)
    return straight(distance if forward else -distance, mission)


def inside_arc(rho0: float, radius: float, reach: float) -> float:
    """2 pi - 2 eta in rad (Section III.A.2): how much of the circle of `radius`, about a point `rho0` from
    the beacon, is within its `reach`; all in m."""
    rho0 = min(rho0, reach)  # an outlier may be longer
    cosine = (reach * reach - rho0 * rho0 - radius * radius) / (2.0 * radius * rho0) if rho0 > 0.0 else 1.0
    return TAU - 2.0 * math.acos(min(1.0, max(-1.0, cosine)))


def turn(pose: Pose, heading: float, mission: Mission) -> Controls:
    """Towards `heading` on the spot, as far as one tick allows."""
    left = (heading - pose.heading) / mission.period
    if left == 0.0:
        return REST
    return Controls(0.0, math.copysign(min(abs(left), mission.max_turn_rate), left))


def straight(distance: float, mission: Mission) -> Controls:
    """Ahead by `distance` m, or back where it is negative, as far as one tick allows."""
    left = distance / mission.period
    return Controls(math.copysign(min(abs(left), mission.max_speed), left), 0.0)
