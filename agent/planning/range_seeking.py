"""The ways to a range: the search for a second one (Section III.A.2), and the way back to the own anchor.

The search leads straight ahead, else on a circle. The beacon is the anchor in phase 1, and robot b in phase
3, where robot a takes its second mutual range. After the straight, a planner that drives backward also tries
the point straight behind before the circle: it is reached sooner than a point of the circle, and is mostly
in range. Under noise, a robot that has lost its anchor, or has not met its peer, drives back to its anchor.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.planning import drive, separation
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import stride
from agent.planning.tasks import Backing, Circling, Homing, Searching, Straight, Turning
from protocol.motion import ORIGIN, TAU, Pose, inverse, relative, travelled
from protocol.team_motion import next_on_spiral


def onward(state: RobotState, task: Searching, measured: bool, manoeuvres: Manoeuvres) -> Searching | None:
    """Return the task after a tick of `task`, or None once the second range is `measured`.

    A robot that another one blocks, at the safety distance, goes on with the next task.
    """
    pose, tolerance = state.odometry, state.estimator.pose_tolerance
    distance_tolerance = tolerance * state.config.mission.first_straight
    step = drive.step_length(task.beacon, task.rho0, state.config.mission)
    match task:
        case Straight(beacon, origin, rho0) | Backing(beacon, origin, rho0):
            ahead = isinstance(task, Straight)
            driven = travelled(origin, pose) if ahead else -relative(origin, pose).x
            is_short = driven < step - distance_tolerance
            if is_short and not is_blocked(state):
                return task
            if measured and not is_short:
                return None
            if ahead and -1.0 in manoeuvres.directions:
                return Backing(beacon, origin, rho0)
            side = 0.5 * math.pi if ahead else -0.5 * math.pi
            return Turning(beacon, origin, rho0, pose.heading + side)
        case Turning(beacon, origin, rho0, heading):
            return task if abs(heading - pose.heading) > tolerance else Circling(beacon, origin, rho0)
        case _:
            # where another robot has blocked all ways so far, a range beside the origin tells no direction
            has_moved = not separation.is_tight(travelled(task.origin, pose), state.config.mission)
            return None if measured and has_moved else task


def has_come_round(task: Searching, pose: Pose) -> bool:
    """Return whether the robot has driven its circle all around: it began 90 degrees to either side."""
    return isinstance(task, Circling) and pose.heading - task.origin.heading > 1.25 * TAU


def is_blocked(state: RobotState) -> bool:
    """Return whether the robot has hardly moved in the last tick, to keep the safety distance.

    One that drives away from another robot moves farther in each tick.
    """
    mission, runs = state.config.mission, state.log.runs
    if not (mission.safety_distance and runs):
        return False
    last, before = runs[-1], runs[-2].v if len(runs) > 1 else 0.0
    if not separation.is_tight(abs(last.v) * mission.period, mission):
        return False
    return last.ticks > 1 or (last.v * before > 0.0 and abs(last.v) <= abs(before))


# --- the way back, under noise ------------------------------------------------------------------------

LOST_AFTER = 3
"""The number of strides without an expected anchor detection after which the robot returns to its anchor."""


def homeward(state: RobotState, task: Homing) -> RobotState:
    """Return `state` after a tick of `task` without a range; at its place, with a spiral or a straight."""
    if drive.way_to(state, task.place) is not None:
        return state
    if task.side is None:
        return state.doing(Straight("anchor", state.odometry, 0.0))
    return state.doing(Homing(next_on_spiral(task.place, task.side, state.config.mission), task.side + 1))


def is_lost(state: RobotState, strides: int = LOST_AFTER) -> bool:
    """Return whether the robot has had no range to its anchor for so many `strides`."""
    return state.tick - state.log.ranges[-1].tick >= strides * stride(state.config.mission)


def turned_back(state: RobotState) -> RobotState:
    """Return `state` without hypotheses, on the way back to the place of the last anchor range."""
    last_range_tick = state.log.ranges[-1].tick
    place = state.log.pose(ORIGIN, last_range_tick, state.config.mission.period)
    own_anchor = replace(state.own_anchor, hypotheses=())
    attempt = replace(state.posterior.attempt, returns=state.posterior.attempt.returns + 1)
    posterior = replace(state.posterior, encounter_tick=None, pair=(), attempt=attempt)
    return replace(state, task=Homing((place.x, place.y)), own_anchor=own_anchor, posterior=posterior)


def begun_again(state: RobotState, start: Pose) -> RobotState:
    """Drive to where the anchor should be if a started at `start` (see `Branch`), to measure phase 1 again.

    The place of the last range is on the rim of the anchor's range, which a robot misses more easily.
    """
    anchor = inverse(start)
    return turned_back(state).doing(Homing((anchor.x, anchor.y), 0))
