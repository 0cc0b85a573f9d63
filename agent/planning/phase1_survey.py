"""Phase 1 with noisy sensors: ranges to the anchor until a better estimate is not worth the time."""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.gaussian.mission_measurements import path_of
from agent.estimation.gaussian.own_anchor import anchor_planning_hypotheses, followed, is_anchor_known
from agent.planning import phase2_orbit, range_seeking
from agent.planning.active_sensing import next_objective, plan_alone
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick
from agent.planning.tasks import Homing, Straight, Surveying

MISLEADING = -8.0
"""The smallest plausible log-likelihood of the ticks without detection.

If it is smaller even for the most probable hypothesis, the ranges are misleading and not just unlucky.
"""

CONVINCING_RANGES = 14
"""The number of anchor ranges from which on detections do not make them misleading.

It is more than twice the number that ends phase 1 with outliers. Without this bound, a robot whose ranges
are 0.35 m too long drove to and fro for ever, because it had ranges longer than R.
"""

DROP_OUT_SIGMAS = 3.0
"""The margin for the number of drop-outs, in standard deviations."""

UNLIKELY_DROP_OUTS = 1e-3
"""The probability of so many drop-outs in a row from which on a robot searches for its first range."""


def sensed(state: RobotState, task: Surveying | Homing, ranged: bool) -> RobotState:
    """Return `state` with the task that follows `task`; `ranged` if there is a new range to the anchor."""
    match task:
        case Homing() if not ranged:
            return range_seeking.homeward(state, task)
        case Surveying() if not is_planning_tick(state):
            return state
        case _:
            return continued(state)


def unranged(state: RobotState) -> RobotState:
    """Return `state` of a robot whose first ranges are drop-outs: it waits for one, or searches.

    If drop-outs hardly explain that it has none, R is smaller than told.
    """
    mission, p = state.config.mission, state.config.mission.noise.drop_outs
    if 0.0 < p < 1.0 and state.tick < math.ceil(math.log(UNLIKELY_DROP_OUTS) / math.log(p)):
        return state
    return state.doing(Straight("anchor", state.odometry, mission.sensing_range))


def continued(state: RobotState, manoeuvres: Manoeuvres | None = None) -> RobotState:
    """Continue phase 1: update the hypotheses about the anchor, and end phase 1 if they are accurate enough.

    If no hypothesis explains the ticks without detection, the ranges are misleading. The robot then takes
    further ranges around the place of the last one, as at the start. The `manoeuvres` are those of
    `active_sensing`.
    """
    del manoeuvres
    mission, found = state.config.mission, followed(state)
    if found is not None:
        state = replace(state, own_anchor=found)
    if range_seeking.is_lost(state):
        return range_seeking.turned_back(state)
    if found is None or _are_misleading(state):
        latest = state.log.ranges[-1]
        if latest.tick < state.tick:
            return range_seeking.turned_back(state)
        return state.doing(Straight("anchor", state.odometry, latest.range))
    if is_anchor_known(state):
        first = state.tick if found.done_tick is None else found.done_tick
        ended = replace(found, kind="three-ranges", done_tick=first)
        return phase2_orbit.surveyed(replace(state, own_anchor=ended))
    since, objective = next_objective(state, "anchor", (path_of(state.log, 0, state.tick, mission),))
    command = plan_alone(anchor_planning_hypotheses(state), mission, objective=objective)
    return state.doing(Surveying("anchor", command, since))


def _are_misleading(state: RobotState) -> bool:
    """Return whether the detections and the ticks without one contradict the most probable hypothesis.

    With CONVINCING_RANGES, ranges count more: R may not be as it was told. As many drop-outs as are to be
    expected at most contradict nothing.
    """
    if len(state.log.ranges) >= CONVINCING_RANGES:
        return False
    p = state.config.mission.noise.drop_outs
    expected = p * (state.tick + 1)
    most = expected + DROP_OUT_SIGMAS * math.sqrt(expected)
    return state.own_anchor.hypotheses[0].detections < MISLEADING + (most * math.log(p) if p else 0.0)
