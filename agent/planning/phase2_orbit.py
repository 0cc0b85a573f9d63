"""Phase 2: the way to the orbit about the own anchor, and the orbit until the robots meet (Section III.B)."""

from __future__ import annotations

import math

from agent.planning.tasks import Aligning, Orbital, Orbiting, Radial, Tangent
from protocol.mission import Mission
from protocol.motion import Pose, compose, wrap
from protocol.orbits import Orbit


def orientation(local: Pose) -> float:
    """Return mu in rad: the heading relative to the line from the anchor through the robot."""
    if local.x == 0.0 and local.y == 0.0:
        return 0.0
    return wrap(local.heading - math.atan2(local.y, local.x))


def onward(
    task: Orbital, odometry: Pose, start: Pose, orbit: Orbit, mission: Mission, tolerance: float
) -> Orbital:
    """Return the task that follows `task` at the pose `odometry`. Completed steps are skipped.

    `start` is the pose of tick 0 in the anchor's frame, and `tolerance` is `Estimator.pose_tolerance`.
    """
    distance_tolerance = tolerance * mission.first_straight
    while True:
        match task:
            case Aligning(heading) if abs(heading - odometry.heading) <= tolerance:
                task = Radial()
            case Radial() if abs(left_to_orbit(odometry, start, orbit)) <= distance_tolerance:
                if orbit.v == 0.0:
                    return Orbiting()
                task = Tangent(odometry.heading + math.copysign(math.pi / 2, orbit.omega))
            case Tangent(heading) if abs(heading - odometry.heading) <= tolerance:
                return Orbiting()
            case _:
                return task


def left_to_orbit(odometry: Pose, start: Pose, orbit: Orbit) -> float:
    """Return the distance in m from the robot outward to its orbit; negative outside the orbit."""
    local = compose(start, odometry)
    return orbit.radius - math.hypot(local.x, local.y)
