"""Phase 2: the way to the orbit about the own anchor, and the orbit until the robots meet (Section III.B)."""

from __future__ import annotations

import math

from agent.planning import drive
from agent.planning.drive import left_to_orbit
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


def begun(state: RobotState) -> RobotState:
    """Return `state` at the beginning of phase 2, from the present pose."""
    return continued(state, aligning(state))


def aligning(state: RobotState) -> Aligning:
    """Return the first task of phase 2, from the present pose."""
    return Aligning(state.odometry.heading - orientation(state.local_pose))


def continued(state: RobotState, task: Orbital, ranged: bool = False) -> RobotState:
    """Continue phase 2 from `task`, `ranged` or not. A robot whose pose is corrected follows by pursuit."""
    del ranged
    task = onward(state, task)
    if isinstance(task, Orbiting) and state.estimator.corrects_poses:
        task = Orbiting(drive.pursuit(state.local_pose, state.orbit, state.config.mission))
    return state.doing(task)
