"""Bounds on the errors of anchors and placements with exact sensors, from `protocol.rounding`.

Both robots of a pair compute the same bounds from the same logs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import FITTED, Branch, PairObservation, anchor_error, polished, turn_error
from agent.peer.motion_log import MotionLog
from agent.planning.state import RobotState
from protocol.mission import RANGE_MARGIN, Mission
from protocol.motion import ORIGIN, Pose, Segment, follow
from protocol.rounding import BETTER, OUT_AND_BACK, SAME, SURE, WELL, required_anchor_error, rounding


def size(state: RobotState) -> float:
    """Return D + R in m: the largest coordinate in the computations of the robots and the world."""
    return state.config.anchor_distance + state.config.mission.sensing_range


def range_rounding(state: RobotState, log: MotionLog, tick: int) -> float:
    """Return the bound in m on the rounding error of a range at `tick`, from the odometry of `log`."""
    return _path_rounding(size(state), log.until(tick), state.config.mission.period)


def _path_rounding(extent: float, runs: Sequence[Segment], period: float) -> float:
    """Return the bound in m on the rounding error of a range after `runs`; `extent` is `size`."""
    path = rotation = 0.0
    for run in runs:
        path += abs(run.v) * run.ticks
        rotation += abs(run.omega) * run.ticks
    return rounding(extent, len(runs), path * period, rotation * period)


def margin(mission: Mission, floor: float) -> float:
    """Return how far inside R, in m, a point of phase 1 must lie to be certainly in range.

    Two ranges A_0 apart on a radius, each with an error of `floor`, determine a heading to sqrt(2 floor /
    A_0) rad, and therefore the range of a point to R times that.
    """
    return max(RANGE_MARGIN, mission.sensing_range * math.sqrt(2.0 * floor / mission.first_straight))


class Known(msgspec.Struct, frozen=True):
    """The anchor error after the first of a robot's anchor ranges."""

    error: float
    """The bound in m on the error of the anchor's position."""
    ranges: int
    """The number of ranges that give this error."""
    enough: bool = False
    """True if phase 1 may end."""


def anchor(state: RobotState, start: Pose, log: MotionLog) -> Known:
    """Return the smallest anchor error of the robot of `log`, whose branch begins at `start`.

    Phase 1 may end in three cases:

    - The error is at most WELL times `required_anchor_error`.
    - The error is at most `required_anchor_error`, and the last range hardly reduced it (BETTER).
    - OUT_AND_BACK ranges did not reduce the error. The rounding error then grows faster than the information,
      and `pinned_down` decides in the encounter whether the anchor error is small enough.

    Later ranges are ignored, so that both robots of a pair, which have the same ranges, compute the same
    result.
    """
    mission, extent = state.config.mission, size(state)
    enough = required_anchor_error(extent, state.config.anchor_distance, mission.sensing_range)
    known = least = error = math.inf
    ranges = 0
    ranged: list[tuple[Pose, float, float]] = []
    for one in log.ranges:
        if one.tick > log.through:
            break
        runs = log.until(one.tick)
        floor = _path_rounding(extent, runs, mission.period)
        ranged.append((follow(ORIGIN, runs, mission.period), one.range, floor))
        if len(ranged) == 1 and start.x > enough:
            continue  # The range at the start does not depend on the heading.
        before, error = error, anchor_error(start, ranged)
        if error < least or len(ranged) <= FITTED:
            least, ranges = error, len(ranged)
        # Branches that `weigh_branches` merged later differ by its larger floor.
        known = least + SAME * (floor - ranged[ranges - 1][2])
        stalled = len(ranged) >= FITTED and error > BETTER * before
        spent = len(ranged) - ranges == OUT_AND_BACK
        if known <= WELL * enough or (stalled and known <= enough) or spent:
            return Known(known, ranges, enough=True)
    return Known(known, ranges)


NEXT_TO = 0.25
"""The fraction of the anchor error within which two branches that are fitted to all ranges are one.

Next to a double root, rounding may end the two fits on either side of it.
"""


def merged(state: RobotState, branches: tuple[Branch, ...]) -> tuple[Branch, ...]:
    """Return `branches` without those that no range distinguishes from the first (see NEXT_TO)."""
    if len(branches) < 2 or len(state.log.ranges) < FITTED:
        return branches
    first = branches[0]
    near = NEXT_TO * anchor(state, first.start, state.log).error
    return (first, *(other for other in branches[1:] if math.dist(other.anchor, first.anchor) >= near))


def fitted(state: RobotState, branch: Branch) -> tuple[Branch, Known]:
    """Return `branch` fitted to the ranges with the smallest anchor error, and that error."""
    known = anchor(state, branch.start, state.log)
    if known.ranges == len(state.log.ranges):
        return branch, known
    ranged = [(pose, rho) for pose, rho in state.seen() if rho is not None]
    branch = polished(branch, ranged[: known.ranges])
    return branch, replace(known, error=anchor(state, branch.start, state.log).error)


def peer_anchor(state: RobotState) -> float:
    """Return the anchor error of the peer in m."""
    assert state.peer_state.start is not None
    return anchor(state, state.peer_state.start, state.peer_state.peer).error


def odometry_rounding(state: RobotState, tick: int) -> float:
    """Return the bound in m on the sum of both odometries' rounding errors until `tick`."""
    return range_rounding(state, state.log, tick) + range_rounding(state, state.peer_state.peer, tick)


def combined_error(state: RobotState, rounding_error: float) -> float:
    """Return the bound in m on both anchor errors and both odometries' rounding errors.

    `rounding_error` is `odometry_rounding`.
    """
    own, peers = state.belief.own_anchor, state.belief.peer_anchor
    assert peers is not None
    return own + peers + rounding_error


def pinned_down(
    state: RobotState, placement: Placement, ranged: Sequence[PairObservation], error_bound: float
) -> bool:
    """Return whether the observations in `ranged` determine `placement` to SURE.

    `error_bound` is `combined_error`. Only rounding between the first and the last observation makes the
    errors of their ranges differ. Rounding before the first one shifts all ranges alike, as an anchor error
    does.
    """
    first, last = ranged[0].tick, ranged[-1].tick
    period, extent = state.config.mission.period, size(state)
    floor = 0.0
    for log in (state.log, state.peer_state.peer):
        floor += 0.5 * _path_rounding(extent, log.between(first, last), period)
    rotation_error = turn_error(
        placement, ranged, floor, combined_error(state, odometry_rounding(state, first))
    )
    return error_bound + rotation_error * max(1.0, extent) <= SURE
