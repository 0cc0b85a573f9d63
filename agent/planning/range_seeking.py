"""The search for a second range to a beacon (Section III.A.2): straight ahead, else on a circle.

The beacon is the anchor in phase 1, and robot b in phase 3, where robot a takes its second mutual range.
After the straight, a planner that drives backward also tries the point straight behind before the circle: it
is reached sooner than a point of the circle, and is mostly in range.
"""

from __future__ import annotations

import math

from agent.planning.planner import Manoeuvres
from agent.planning.separation import leeway
from agent.planning.state import RobotState
from agent.planning.tasks import Backing, Beacon, Circling, Searching, Straight, Turning
from protocol.mission import Mission
from protocol.motion import TAU, relative, travelled


def step_length(beacon: Beacon, rho0: float, mission: Mission) -> float:
    """Return the length in m of the straight from a point with range `rho0` in m to `beacon`.

    The length is A_0, or less to keep a safety distance from the peer.
    """
    step = mission.first_straight
    return step if beacon == "anchor" else min(step, leeway(rho0, mission))


def onward(state: RobotState, task: Searching, measured: bool, manoeuvres: Manoeuvres) -> Searching | None:
    """Return the task after a tick of `task`, or None once the second range is `measured`."""
    pose, tolerance = state.odometry, state.estimator.pose_tolerance
    distance_tolerance = tolerance * state.config.mission.first_straight
    step = step_length(task.beacon, task.rho0, state.config.mission)
    match task:
        case Straight(beacon, origin, rho0):
            if travelled(origin, pose) < step - distance_tolerance:
                return task
            if measured:
                return None
            if manoeuvres.backward:
                return Backing(beacon, origin, rho0)
            return Turning(beacon, origin, rho0, pose.heading + math.pi / 2)
        case Backing(beacon, origin, rho0):
            if relative(origin, pose).x > distance_tolerance - step:
                return task
            return None if measured else Turning(beacon, origin, rho0, pose.heading - math.pi / 2)
        case Turning(beacon, origin, rho0, heading):
            return task if abs(heading - pose.heading) > tolerance else Circling(beacon, origin, rho0)
        case _:
            return None if measured else task


def inside_arc(rho0: float, radius: float, reach: float) -> float:
    """Return 2 pi - 2 eta in rad (Section III.A.2): the part of a circle that is in range of the beacon.

    The circle has the radius `radius` and its centre is `rho0` from the beacon, whose range is `reach`; all
    in m.
    """
    rho0 = min(rho0, reach)  # an outlier may be longer than R
    cosine = (reach * reach - rho0 * rho0 - radius * radius) / (2.0 * radius * rho0) if rho0 > 0.0 else 1.0
    return TAU - 2.0 * math.acos(min(1.0, max(-1.0, cosine)))
