"""The way back to the own anchor, under noise: of a robot that has lost it, or has not met its peer."""

from __future__ import annotations

from msgspec.structs import replace

from agent.planning import drive
from agent.planning.state import RobotState
from agent.planning.strides import stride
from agent.planning.tasks import Homing, Straight
from protocol.motion import ORIGIN, Pose, inverse
from protocol.team_motion import next_on_spiral

LOST_AFTER = 3
"""The number of strides without an expected anchor detection after which the robot returns to its anchor."""


def onward(state: RobotState, task: Homing) -> RobotState:
    """Return `state` after a tick of `task` without a range: at the place, on a spiral or as at the start."""
    mission, tolerance = state.config.mission, state.estimator.pose_tolerance
    if drive.homing(task.place, state.odometry, mission, tolerance) is not None:
        return state
    if task.side is None:
        return state.doing(Straight("anchor", state.odometry, 0.0))
    x, y = next_on_spiral((task.place.x, task.place.y), task.side, mission)
    return state.doing(Homing(Pose(x, y, 0.0), task.side + 1))


def is_lost(state: RobotState, strides: int = LOST_AFTER) -> bool:
    """Return whether the robot has had no range to its anchor for so many `strides`."""
    return state.tick - state.log.ranges[-1].tick >= strides * stride(state.config.mission)


def begun(state: RobotState) -> RobotState:
    """Drive back to the place of the last anchor range, and discard all hypotheses."""
    last_range_tick = state.log.ranges[-1].tick
    place = state.log.pose(ORIGIN, last_range_tick, state.config.mission.period)
    own_anchor = replace(state.own_anchor, hypotheses=())
    attempt = replace(state.belief.attempt, returns=state.belief.attempt.returns + 1)
    belief = replace(state.belief, encounter_tick=None, pair=(), attempt=attempt)
    return replace(state, task=Homing(place), own_anchor=own_anchor, belief=belief)


def begun_again(state: RobotState, start: Pose) -> RobotState:
    """Drive to where the anchor should be if a started at `start` (see `Branch`), to measure phase 1 again.

    The place of the last range is on the rim of the anchor's range, which a robot misses more easily.
    """
    anchor = inverse(start)
    return begun(state).doing(Homing(Pose(anchor.x, anchor.y, 0.0), 0))
