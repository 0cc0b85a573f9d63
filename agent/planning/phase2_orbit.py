"""Phase 2: to the orbit about the own anchor, and round it until the peer is met (Section III.B)."""

from __future__ import annotations

import math

import msgspec

from agent.planning.range_seeking import arrived, straight, turn
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose, wrap
from protocol.orbits import Orbit


class Aligning(msgspec.Struct, frozen=True):
    """Turns by -mu, to head straight away from the anchor."""

    heading: float
    """rad, of the odometry, to turn to"""


class Radial(msgspec.Struct, frozen=True):
    """Drives along the radius until it is on the orbit: outward, or back."""


class Tangent(msgspec.Struct, frozen=True):
    """Turns from the radius onto the orbit: a by +90 degrees, b by -90."""

    heading: float
    """rad, of the odometry, to turn to"""


class Orbiting(msgspec.Struct, frozen=True):
    """Drives round its anchor, eq. (6); or waits there, where that is its part of the plan."""

    command: Controls | None = None
    """under noise: what leads back to the circle; or tells more, where it waits"""
    since: int = 0
    """under noise: the tick in which it got there"""


Meeting = Aligning | Radial | Tangent | Orbiting


def orientation(local: Pose) -> float:
    """mu in rad: the heading relative to the line from the anchor through the robot."""
    if local.x == 0.0 and local.y == 0.0:
        return 0.0
    return wrap(local.heading - math.atan2(local.y, local.x))


def onward(state: Meeting, odometry: Pose, start: Pose, orbit: Orbit, mission: Mission) -> Meeting:
    """The state at `odometry`, whose tick 0 is `start` in the anchor's frame: what is done is passed over."""
    there, facing = arrived(mission)
    while True:
        match state:
            case Aligning(heading) if abs(heading - odometry.heading) <= facing:
                state = Radial()
            case Radial() if abs(left_to_orbit(odometry, start, orbit)) <= there:
                if orbit.v == 0.0:
                    return Orbiting()
                state = Tangent(odometry.heading + math.copysign(math.pi / 2, orbit.omega))
            case Tangent(heading) if abs(heading - odometry.heading) <= facing:
                return Orbiting()
            case _:
                return state


def left_to_orbit(odometry: Pose, start: Pose, orbit: Orbit) -> float:
    """m: how much farther from the anchor the orbit is."""
    local = compose(start, odometry)
    return orbit.radius - math.hypot(local.x, local.y)


def off_anchor(local: Pose, orbit: Orbit) -> bool:
    """Whether b, at `local` in its anchor's frame, is far enough from its anchor to be met there.

    On its anchor, its ranges to a would not tell its heading: eq. (7) has a line of solutions. Half way
    to where it waits is far enough.
    """
    return math.hypot(local.x, local.y) >= 0.5 * orbit.radius


def controls(state: Meeting, odometry: Pose, start: Pose, orbit: Orbit, mission: Mission) -> Controls:
    """What `state` drives from `odometry`."""
    match state:
        case Aligning(heading) | Tangent(heading):
            return turn(odometry, heading, mission)
        case Radial():
            return straight(left_to_orbit(odometry, start, orbit), mission)
        case Orbiting(command):
            return command or Controls(orbit.v, orbit.omega)


def pursuit(local: Pose, orbit: Orbit, mission: Mission) -> Controls:
    """Round the anchor, back to the circle that noise has led away from (pure pursuit).

    Along the arc to the point of the circle that lies two ticks ahead; from the circle that is eq. (6).
    """
    ahead = math.atan2(local.y, local.x) + LOOKAHEAD * orbit.omega * mission.period
    x, y = orbit.radius * math.cos(ahead) - local.x, orbit.radius * math.sin(ahead) - local.y
    omega = 2.0 * wrap(math.atan2(y, x) - local.heading) / (LOOKAHEAD * mission.period)
    limit = mission.max_turn_rate
    return Controls(orbit.v, min(max(omega, -limit), limit))


LOOKAHEAD = 2.0
"""ticks"""
