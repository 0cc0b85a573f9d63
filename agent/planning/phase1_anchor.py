"""Phase 1: the branches about the own anchor, and the manoeuvre to a further range (Section III.A).

With noisy sensors, `assured` takes ranges until a better estimate is not worth the time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from msgspec.structs import replace

from agent.estimation.estimator import AnchorEstimate
from agent.estimation.exact import Branch
from agent.estimation.gaussian.mission_measurements import path_of
from agent.estimation.gaussian.own_anchor import anchor_planning_hypotheses, followed, is_anchor_known
from agent.planning import drive, phase2_orbit, range_seeking, tasks
from agent.planning.active_sensing import next_objective, plan_alone
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick
from protocol.messages import BranchKind
from protocol.mission import RANGE_MARGIN, Mission, third_point_turn_rate
from protocol.motion import Controls, Pose, chord, compose, rotated_back

PREFERENCE = 1e-9
"""The relative improvement, above rounding errors, that a later manoeuvre needs to replace an earlier one."""

SHORTEST_MANOEUVRE = 1e-9
"""The length of a manoeuvre, relative to A_0, up to which it counts as none."""

IN_RANGE_SIGMAS = 3.0
"""The distance inside R, in standard deviations of a range, at which a noisy point counts as in range."""


def third_point(
    poses: Sequence[Pose],
    mission: Mission,
    manoeuvres: Manoeuvres,
    *,
    margin: float = RANGE_MARGIN,
    pinning: bool = False,
) -> Controls | None:
    """Return the manoeuvre whose end point best distinguishes `poses` in the anchor's frame.

    If the branches mirror each other along the heading, eq. (4) gives the best turn rate. If they mirror each
    other across it, as after a circle, driving straight is best. Both are compared, each with the longest
    chord that keeps at least one branch in range (eq. (5)), in the directions of `manoeuvres`.

    `margin` is the distance inside R, in m, at which a point is certainly in range. With `pinning`, one
    branch is left, but the ranges do not determine its heading accurately enough. The best end point is then
    the one farthest from the line through the anchor and p_0, because a range depends most on the heading
    there.

    The result is None if no manoeuvre satisfies eq. (5).
    """
    best: Controls | None = None
    best_value = 0.0
    shortest = SHORTEST_MANOEUVRE * mission.first_straight
    rim = mission.sensing_range - max(margin, IN_RANGE_SIGMAS * mission.noise.anchor_sigma)
    turn_rate = third_point_turn_rate(mission)
    turn_rates = [side * turn_rate for side in manoeuvres.sides]
    # A single branch was found on a radius. A straight manoeuvre along that radius would check nothing.
    if len(poses) > 1 or pinning:
        turn_rates.append(0.0)
    for omega in turn_rates:
        unit = chord(1.0, omega, mission.period)
        longest = mission.max_speed * unit
        half = 0.5 * mission.period * omega
        for forward in manoeuvres.directions:
            outward = [_outward(pose, half, forward) for pose in poses]
            reach = max(_reach(along, across, rim) for along, across in outward)
            length = min(longest, reach)
            if pinning:
                value = max(
                    [abs(pose.y + forward * length * math.sin(pose.heading + half)) for pose in poses]
                )
            else:
                value = _separation(length, [along for along, _ in outward])
            if length > shortest and (best is None or value > best_value * (1.0 + PREFERENCE)):
                best, best_value = Controls(forward * min(length / unit, mission.max_speed), omega), value
    return best


def _outward(pose: Pose, half_turn: float, forward: float) -> tuple[float, float]:
    """Return the components in m of the position, relative to the anchor, along and across the next chord."""
    course = pose.heading + half_turn
    c, s = forward * math.cos(course), forward * math.sin(course)
    return rotated_back(c, s, pose.x, pose.y)


def _reach(along: float, across: float, rim: float) -> float:
    """Return how far in m the robot can drive before it leaves the circle of radius `rim` (eq. (5)).

    The result is negative if the robot is outside.
    """
    inside = rim * rim - across * across
    return math.sqrt(inside) - along if inside >= 0.0 else -math.inf


def _separation(length: float, along: Sequence[float]) -> float:
    """Return the smallest difference |d_+^2 - d_-^2| in m^2 of the squared ranges that the branches predict.

    For a single branch the result is `length`: there is nothing to distinguish, and the longest chord gives
    the best check.
    """
    if len(along) == 1:
        return length
    return 2.0 * length * min(abs(one - other) for one, other in combinations(along, 2))


def local(branches: Sequence[Branch], odometry: Pose) -> list[Pose]:
    """Return the robot's current pose in its anchor's frame for each of `branches`."""
    return [compose(branch.start, odometry) for branch in branches]


def unranged(state: RobotState) -> RobotState:
    """Return `state` of a robot that has not detected its anchor at the start, and cannot continue."""
    return state.undecided("the anchor is out of range at the start")


def begun(state: RobotState, rho0: float) -> RobotState:
    """Start phase 1 with the first anchor range `rho0` in m."""
    on_anchor = state.estimator.on_anchor(state, rho0)
    if on_anchor is not None:
        return _ended(state, on_anchor, "on-anchor")
    return state.doing(tasks.Straight("anchor", state.odometry, rho0))


def as_published(state: RobotState, manoeuvres: Manoeuvres) -> RobotState:
    """Continue phase 1 with the branches +alpha and -alpha that the ranges allow (eq. (2)).

    The third range is the last one. It selects the most probable branch, if there is one.
    """
    third = isinstance(state.task, tasks.ThirdPoint)
    state, estimate, kind = _with_branches(state)
    if kind is not None and estimate.best is not None and (third or len(estimate.branches) == 1):
        return _ended(state, estimate, kind)
    if estimate.branches and third:
        return state.undecided("the third range does not distinguish +alpha from -alpha")
    return _to_third_point(state, estimate, manoeuvres)


def until_accurate(state: RobotState, manoeuvres: Manoeuvres) -> RobotState:
    """Continue phase 1 with the branches +alpha and -alpha that the ranges allow (eq. (2)).

    Phase 1 ends when one branch is left, and the ranges determine the anchor's position as accurately as
    a claim needs.
    """
    state, estimate, kind = _with_branches(state)
    alone = len(estimate.branches) == 1
    if kind is not None and alone and estimate.enough:
        return _ended(state, estimate, kind)
    return _to_third_point(state, estimate, manoeuvres, pinning=alone)


def _with_branches(state: RobotState) -> tuple[RobotState, AnchorEstimate, BranchKind | None]:
    """Return `state` with the branches that its anchor ranges allow, these, and how phase 1 ends with one.

    The last is None if a further range has to check it. A third range that is missing is the paper's virtual
    measurement.
    """
    allowed: tuple[Branch, ...] = ()
    kind: BranchKind | None = None
    match state.task:
        case tasks.ThirdPoint(allowed):
            measured = state.log.ranges[-1].tick == state.tick
            kind = "three-ranges" if measured else "three-ranges-virtual"
        case tasks.Circling():
            kind = "circle"
    estimate = state.estimator.anchor(state, allowed)
    return replace(state, own_anchor=estimate.known), estimate, kind


def _to_third_point(
    state: RobotState, estimate: AnchorEstimate, manoeuvres: Manoeuvres, *, pinning: bool = False
) -> RobotState:
    """Plan the manoeuvre to the next measurement point of phase 1 (see `third_point`)."""
    if not estimate.branches:
        return state.undecided("no pose explains the anchor ranges")
    poses = local(estimate.branches, state.odometry)
    command = third_point(poses, state.config.mission, manoeuvres, margin=estimate.margin, pinning=pinning)
    if command is None:
        return state.undecided("eq. (5) allows no manoeuvre to a third range")
    return state.doing(tasks.ThirdPoint(estimate.branches, state.odometry, command))


def has_ended(state: RobotState, task: tasks.ThirdPoint, ranged: bool) -> bool:
    """Return whether the manoeuvre to the third point is over: at its end, or where another robot blocks it.

    A range on the way, of a robot that keeps the safety distance, ends it as well. In real time, it may not
    have begun.
    """
    if state.odometry == task.origin:
        return False
    mission = state.config.mission
    left = mission.period * abs(drive.left_of(task, state.odometry, mission).v)
    is_at_end = left <= SHORTEST_MANOEUVRE * mission.first_straight
    return ranged or is_at_end or not mission.safety_distance or range_seeking.is_blocked(state)


def _ended(state: RobotState, estimate: AnchorEstimate, kind: BranchKind) -> RobotState:
    """End phase 1: store the best branch and the anchor error of `estimate`, and start phase 2."""
    own_anchor = replace(
        estimate.known, branch=estimate.best, kind=kind, done_tick=state.tick, error=estimate.anchor_error
    )
    return phase2_orbit.continued(replace(state, own_anchor=own_anchor))


# --- the steps of `assured` under noise ---------------------------------------------------------------

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


def sensed(state: RobotState, task: tasks.Surveying | tasks.Homing, ranged: bool) -> RobotState:
    """Return `state` with the task that follows `task`; `ranged` if there is a new range to the anchor."""
    match task:
        case tasks.Homing() if not ranged:
            return range_seeking.homeward(state, task)
        case tasks.Surveying() if not is_planning_tick(state):
            return state
        case _:
            return surveyed(state)


def still_unranged(state: RobotState) -> RobotState:
    """Return `state` of a robot whose first ranges are drop-outs: it waits for one, or searches.

    If drop-outs hardly explain that it has none, R is smaller than told.
    """
    mission, p = state.config.mission, state.config.mission.noise.drop_outs
    if 0.0 < p < 1.0 and state.tick < math.ceil(math.log(UNLIKELY_DROP_OUTS) / math.log(p)):
        return state
    return state.doing(tasks.Straight("anchor", state.odometry, mission.sensing_range))


def surveyed(state: RobotState, manoeuvres: Manoeuvres | None = None) -> RobotState:
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
        return state.doing(tasks.Straight("anchor", state.odometry, latest.range))
    if is_anchor_known(state):
        first = state.tick if found.done_tick is None else found.done_tick
        ended = replace(found, kind="three-ranges", done_tick=first)
        return phase2_orbit.surveyed(replace(state, own_anchor=ended))
    since, objective = next_objective(state, "anchor", (path_of(state.log.runs, 0, state.tick, mission),))
    command = plan_alone(anchor_planning_hypotheses(state), mission, objective=objective)
    return state.doing(tasks.Surveying("anchor", command, since))


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
