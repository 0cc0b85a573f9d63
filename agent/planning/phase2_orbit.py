"""Phase 2: the way to the orbit about the own anchor, and the orbit until the robots meet (Section III.B).

A robot whose pose is corrected by ranges to its anchor follows its orbit by pursuit; b takes ranges as it
waits.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.gaussian.own_anchor import anchor_planning_hypotheses, followed, is_fit_due
from agent.planning import drive, range_seeking
from agent.planning.active_sensing import plan_alone
from agent.planning.drive import left_to_orbit
from agent.planning.range_seeking import LOST_AFTER
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick, stride
from agent.planning.tasks import Aligning, Orbital, Orbiting, Radial, Tangent
from protocol.motion import REST, Controls, Pose, wrap


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
                if state.config.orbit.v == 0.0:
                    return Orbiting()
                task = Tangent(heading + math.copysign(math.pi / 2, state.config.orbit.omega))
            case Tangent(target) if abs(target - heading) <= tolerance:
                return Orbiting()
            case _:
                return task


def aligning(state: RobotState) -> Aligning:
    """Return the first task of phase 2, from the present pose."""
    return Aligning(state.odometry.heading - orientation(state.local_pose))


def continued(state: RobotState, task: Orbital | None = None, ranged: bool = False) -> RobotState:
    """Continue phase 2 from `task`, or begin it. A robot whose pose is corrected drives by pursuit."""
    del ranged
    task = onward(state, task or aligning(state))
    if isinstance(task, Orbiting) and state.estimator.corrects_poses:
        task = Orbiting(drive.pursuit(state.local_pose, state.config.orbit, state.config.mission))
    return state.doing(task)


# --- the steps of `assured` under noise ---------------------------------------------------------------

JOINING_TURN = math.pi / 2
"""The angle in rad that a robot can turn in a tick if it joins its orbit without a turn on the spot.

A robot that turns more slowly would drive a wide arc on the way out, and overshoot its orbit.
"""

OFF_RADIUS = 0.5
"""The heading error in rad relative to the radius from which on the robot aligns again in phase 2."""


def surveyed(state: RobotState, task: Orbital | None = None, ranged: bool = False) -> RobotState:
    """Continue phase 2 from `task`, or begin it, with the latest anchor range if `ranged`."""
    task, planning = task or aligning(state), is_planning_tick(state)
    mission, orbit = state.config.mission, state.config.orbit
    waiting = isinstance(task, Orbiting) and orbit.v == 0.0
    due = ranged and planning and (not waiting or is_fit_due(state))
    if due and (found := followed(state)) is not None:
        state = replace(state, own_anchor=found)
        if isinstance(task, Radial) and abs(orientation(state.local_pose)) > OFF_RADIUS:
            return surveyed(state)
    if orbit.v != 0.0 and mission.max_turn_rate * mission.period >= JOINING_TURN:
        task = task if isinstance(task, Orbiting) else Orbiting()
    task = onward(state, task)
    if orbit.v == 0.0 and isinstance(task, Radial | Orbiting) and range_seeking.is_lost(state):
        return range_seeking.turned_back(state)
    if not isinstance(task, Orbiting):
        return state.doing(task)
    since = task.since or state.tick
    if orbit.v == 0.0:
        return state.doing(Orbiting(_while_waiting(state, task, planning, ranged), since))
    search = (orbit.radius / mission.max_speed + state.config.rendezvous.bound) / mission.period
    if state.tick - since > LOST_AFTER * stride(mission) + search and not state.in_contact:
        if state.config.begins_again:
            return range_seeking.begun_again(state, state.start)
        return range_seeking.turned_back(state)
    return state.doing(Orbiting(drive.pursuit(state.local_pose, orbit, mission), since))


def _while_waiting(state: RobotState, task: Orbiting, planning: bool, ranged: bool) -> Controls:
    """Return the controls of robot b, which waits beside its anchor and takes ranges to it."""
    if not planning:
        return task.command or REST
    if not ranged or not state.own_anchor.hypotheses:
        return REST
    return plan_alone(anchor_planning_hypotheses(state), state.config.mission, state.config.orbit.radius)
