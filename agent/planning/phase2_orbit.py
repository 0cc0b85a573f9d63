"""Phase 2: the way to the orbit about the own anchor, and the orbit until the robots meet (Section III.B)."""

from __future__ import annotations

import math

from agent.planning.state import RobotState
from agent.planning.tasks import Aligning, Orbital, Orbiting, Radial, Tangent
from protocol.motion import Pose, wrap


def orientation(local: Pose) -> float:
    """Return mu in rad: the heading relative to the line from the anchor through the robot."""
    if local.x == 0.0 and local.y == 0.0:
        return 0.0
    return wrap(local.heading - math.atan2(local.y, local.x))


def onward(state: RobotState, task: Orbital) -> Orbital:
    """Return the task that follows `task` at the present pose. Completed steps are skipped."""
    heading, tolerance = state.odometry.heading, state.estimator.pose_tolerance
    while True:
        match task:
            case Aligning(target) if abs(target - heading) <= tolerance:
                task = Radial()
            case Radial() if abs(left_to_orbit(state)) <= tolerance * state.config.mission.first_straight:
                if state.orbit.v == 0.0:
                    return Orbiting()
                task = Tangent(heading + math.copysign(math.pi / 2, state.orbit.omega))
            case Tangent(target) if abs(target - heading) <= tolerance:
                return Orbiting()
            case _:
                return task


def left_to_orbit(state: RobotState) -> float:
    """Return the distance in m from the robot outward to its orbit; negative outside the orbit."""
    local = state.local_pose
    return state.orbit.radius - math.hypot(local.x, local.y)
