"""Phase 2: the way to the orbit about the own anchor, and the orbit until the robots meet (Section III.B)."""

from __future__ import annotations

import math

import msgspec

from agent.planning.range_seeking import straight, turn
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose, wrap
from protocol.orbits import Orbit, leg_end

ASIDE = 1e-9
"""The distance from the place of Travelling at which a straight may end beside it, as a fraction of A_0."""

LOOKAHEAD = 2.0
"""The distance of the pursued point ahead on the orbit, in ticks of the orbit's speed."""


class Aligning(msgspec.Struct, frozen=True):
    """The robot turns by -mu on the spot, until it heads radially away from its anchor."""

    heading: float
    """The target heading in rad, in the frame of the odometry."""


class Radial(msgspec.Struct, frozen=True):
    """The robot drives along the radius to its orbit, outward or inward."""


class Tangent(msgspec.Struct, frozen=True):
    """The robot turns from the radius to the tangent of its orbit: a by +90 degrees, b by -90 degrees."""

    heading: float
    """The target heading in rad, in the frame of the odometry."""


class Orbiting(msgspec.Struct, frozen=True):
    """The robot drives on its orbit (eq. (6)), or waits at its place if its orbit has no speed."""

    command: Controls | None = None
    """Noisy sensors: the controls of pure pursuit, or of active sensing while the robot waits."""
    since: int = 0
    """Noisy sensors: the tick in which the robot reached its orbit."""


class Travelling(msgspec.Struct, frozen=True):
    """A localised robot of a group drives to the next one, which waits beside its anchor.

    If noise has led it astray and the other robot is not in range there, it searches across its way.
    """

    place: tuple[float, float]
    """The end of the present straight, in m in the frame of the odometry."""
    leg: int = 0
    """The number of legs of the search up to this place; 0 on the way to the robot."""


Phase2Mode = Aligning | Radial | Tangent | Orbiting


def orientation(local: Pose) -> float:
    """Return mu in rad: the heading relative to the line from the anchor through the robot."""
    if local.x == 0.0 and local.y == 0.0:
        return 0.0
    return wrap(local.heading - math.atan2(local.y, local.x))


def onward(
    mode: Phase2Mode, odometry: Pose, start: Pose, orbit: Orbit, mission: Mission, tolerance: float
) -> Phase2Mode:
    """Return the mode that follows `mode` at the pose `odometry`. Completed steps are skipped.

    `start` is the pose of tick 0 in the anchor's frame, and `tolerance` is `Estimator.pose_tolerance`.
    """
    distance_tolerance = tolerance * mission.first_straight
    while True:
        match mode:
            case Aligning(heading) if abs(heading - odometry.heading) <= tolerance:
                mode = Radial()
            case Radial() if abs(left_to_orbit(odometry, start, orbit)) <= distance_tolerance:
                if orbit.v == 0.0:
                    return Orbiting()
                mode = Tangent(odometry.heading + math.copysign(math.pi / 2, orbit.omega))
            case Tangent(heading) if abs(heading - odometry.heading) <= tolerance:
                return Orbiting()
            case _:
                return mode


def left_to_orbit(odometry: Pose, start: Pose, orbit: Orbit) -> float:
    """Return the distance in m from the robot outward to its orbit; negative outside the orbit."""
    local = compose(start, odometry)
    return orbit.radius - math.hypot(local.x, local.y)


def controls(
    mode: Aligning | Radial | Tangent, odometry: Pose, start: Pose, orbit: Orbit, mission: Mission
) -> Controls:
    """Return the controls of `mode`, on the way to the orbit, at the pose `odometry`."""
    match mode:
        case Aligning(heading) | Tangent(heading):
            return turn(odometry, heading, mission)
        case Radial():
            return straight(left_to_orbit(odometry, start, orbit), mission)


def travel_controls(mode: Travelling, odometry: Pose, mission: Mission, tolerance: float) -> Controls | None:
    """Return the controls of `mode` at the pose `odometry`: a turn, then straight on; None on arrival.

    `tolerance` is `Estimator.pose_tolerance`.
    """
    dx, dy = mode.place[0] - odometry.x, mode.place[1] - odometry.y
    distance = math.hypot(dx, dy)
    if distance <= tolerance * mission.first_straight:
        return None
    bearing = wrap(math.atan2(dy, dx) - odometry.heading)
    # a tick of driving that begins with a small error of the heading ends beside the place by that error
    if abs(bearing) > max(tolerance, ASIDE * mission.first_straight / distance):
        return turn(odometry, odometry.heading + bearing, mission)
    return straight(distance, mission)


def arrived(mode: Travelling, odometry: Pose, mission: Mission, tolerance: float) -> bool:
    """Return whether the robot is at the end of the straight of `mode`; see `travel_controls`."""
    return travel_controls(mode, odometry, mission, tolerance) is None


def next_leg(
    mode: Travelling, begin: tuple[float, float], anchor: tuple[float, float], mission: Mission
) -> Travelling:
    """Return the leg after `mode` of the search for a robot that waits beside `anchor` (see `leg_end`).

    The robot knew its pose at `begin`. An error of its heading there turns the way about that place. So the
    legs end on the arc about it that leads through the anchor. Both places are in m in the frame of the
    odometry, in which the anchor is where it would be without that error.
    """
    leg, (dx, dy) = mode.leg + 1, (anchor[0] - begin[0], anchor[1] - begin[1])
    radius, aside = math.hypot(dx, dy), leg_end(leg) * mission.sensing_range
    turned = min(max(aside / radius, -math.pi), math.pi) if radius else 0.0
    bearing = math.atan2(dy, dx) + turned
    return Travelling((begin[0] + radius * math.cos(bearing), begin[1] + radius * math.sin(bearing)), leg)


def pursuit(local: Pose, orbit: Orbit, mission: Mission) -> Controls:
    """Return the controls that lead back to the orbit after odometry or actuation noise (pure pursuit).

    The robot drives an arc to the point of the orbit LOOKAHEAD ticks ahead. On the orbit, this is eq. (6).
    """
    ahead = math.atan2(local.y, local.x) + LOOKAHEAD * orbit.omega * mission.period
    x, y = orbit.radius * math.cos(ahead) - local.x, orbit.radius * math.sin(ahead) - local.y
    omega = 2.0 * wrap(math.atan2(y, x) - local.heading) / (LOOKAHEAD * mission.period)
    limit = mission.max_turn_rate
    return Controls(orbit.v, min(max(omega, -limit), limit))
