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
from agent.estimation.knowledge import Knowledge
from agent.peer.motion_log import MotionLog
from protocol.mission import RANGE_MARGIN, Mission
from protocol.motion import ORIGIN, Pose, Segment, follow
from protocol.rounding import BETTER, OUT_AND_BACK, SAME_ANCHORS, SURE, WELL, required_anchor_error, rounding


def size(knowledge: Knowledge) -> float:
    """Return D + R in m: the largest coordinate in the computations of the robots and the world.

    In a group, D is the largest distance of two anchors.
    """
    return knowledge.config.widest_distance + knowledge.config.mission.sensing_range


def range_rounding(knowledge: Knowledge, log: MotionLog, tick: int) -> float:
    """Return the bound in m on the rounding error of a range at `tick`, from the odometry of `log`."""
    return _path_rounding(size(knowledge), log.until(tick), knowledge.config.mission.period)


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


class AnchorAccuracy(msgspec.Struct, frozen=True):
    """The smallest error of a robot's anchor by any number of its first ranges to it, and that number."""

    error: float
    """The bound in m on the error of the anchor's position."""
    ranges: int
    """The number of first ranges that give this error."""
    enough: bool = False
    """True if phase 1 may end."""


def anchor(knowledge: Knowledge, start: Pose, log: MotionLog) -> AnchorAccuracy:
    """Return the smallest anchor error of the robot of `log`, whose branch begins at `start`.

    Phase 1 may end in three cases:

    - The error is at most WELL times `required_anchor_error`.
    - The error is at most `required_anchor_error`, and the last range hardly reduced it (BETTER).
    - OUT_AND_BACK ranges did not reduce the error. The rounding error then grows faster than the information,
      and `pinned_down` decides in the encounter whether the anchor error is small enough.

    Later ranges are ignored, so that both robots of a pair, which have the same ranges, compute the same
    result.
    """
    mission, extent = knowledge.config.mission, size(knowledge)
    enough = required_anchor_error(extent, knowledge.config.widest_distance, mission.sensing_range)
    bound = least = error = math.inf
    ranges = used = 0
    least_floor = 0.0
    ranged: list[tuple[Pose, float, float]] = []
    for count, measurement in enumerate(log.ranges, 1):
        if measurement.tick > log.through:
            break
        runs = log.until(measurement.tick)
        pose, floor = follow(ORIGIN, runs, mission.period), _path_rounding(extent, runs, mission.period)
        if ranged and (pose, measurement.range) == ranged[-1][:2]:
            continue  # The robot has not moved, as after a missed deadline.
        ranged.append((pose, measurement.range, floor))
        if len(ranged) == 1 and start.x > enough:
            continue  # The range at the start does not depend on the heading.
        before, error = error, anchor_error(start, ranged)
        if error < least or len(ranged) <= FITTED:
            least, ranges, used, least_floor = error, count, len(ranged), floor
        # Branches that `weigh_branches` merged later differ by its larger floor.
        bound = least + SAME_ANCHORS * (floor - least_floor)
        stalled = len(ranged) >= FITTED and error > BETTER * before
        spent = len(ranged) - used == OUT_AND_BACK
        if bound <= WELL * enough or (stalled and bound <= enough) or spent:
            return AnchorAccuracy(bound, ranges, enough=True)
    return AnchorAccuracy(bound, ranges)


NEXT_TO = 0.25
"""The fraction of the anchor error within which two branches that are fitted to all ranges are one.

Next to a double root, rounding may end the two fits on either side of it.
"""


def merged(knowledge: Knowledge, branches: tuple[Branch, ...]) -> tuple[Branch, ...]:
    """Return `branches` without those that no range distinguishes from the first (see NEXT_TO)."""
    if len(branches) < 2 or len(knowledge.log.ranges) < FITTED:
        return branches
    first = branches[0]
    near = NEXT_TO * anchor(knowledge, first.start, knowledge.log).error
    return (first, *(other for other in branches[1:] if math.dist(other.anchor, first.anchor) >= near))


def fitted(knowledge: Knowledge, branch: Branch) -> tuple[Branch, AnchorAccuracy]:
    """Return `branch` fitted to the ranges with the smallest anchor error, and that error."""
    accuracy = anchor(knowledge, branch.start, knowledge.log)
    if accuracy.ranges == len(knowledge.log.ranges):
        return branch, accuracy
    ranged = [(pose, rho) for pose, rho in knowledge.seen() if rho is not None]
    branch = polished(branch, ranged[: accuracy.ranges])
    return branch, replace(accuracy, error=anchor(knowledge, branch.start, knowledge.log).error)


def peer_anchor(knowledge: Knowledge) -> float:
    """Return the anchor error of the peer in m."""
    assert knowledge.peer_state.start is not None
    return anchor(knowledge, knowledge.peer_state.start, knowledge.peer_state.peer).error


def odometry_rounding(knowledge: Knowledge, tick: int) -> float:
    """Return the bound in m on the sum of both odometries' rounding errors until `tick`."""
    return range_rounding(knowledge, knowledge.log, tick) + range_rounding(
        knowledge, knowledge.peer_state.peer, tick
    )


def pinned_down(
    knowledge: Knowledge,
    placement: Placement,
    ranged: Sequence[PairObservation],
    anchor_errors: float,
    error_bound: float,
) -> bool:
    """Return whether the observations in `ranged` determine `placement` to SURE.

    `anchor_errors` is the bound in m on the errors of both anchors, and `error_bound` that on them and on the
    rounding errors of both odometries. Only rounding between the first and the last observation makes the
    errors of their ranges differ. Rounding before the first one shifts all ranges alike, as an anchor error
    does.
    """
    first, last = ranged[0].tick, ranged[-1].tick
    period, extent = knowledge.config.mission.period, size(knowledge)
    floor = 0.0
    for log in (knowledge.log, knowledge.peer_state.peer):
        floor += 0.5 * _path_rounding(extent, log.between(first, last), period)
    rotation_error = turn_error(placement, ranged, floor, anchor_errors + odometry_rounding(knowledge, first))
    return error_bound + rotation_error * max(1.0, extent) <= SURE
