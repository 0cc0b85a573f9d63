"""The `paper` planner with noisy sensors: the paper's manoeuvres, evaluated by likelihood.

The planner continues with the most probable branch and claims a pose only if it meets the mission's
requirements. The few ranges that the paper's manoeuvres collect are mostly not enough, and never with
outliers. The verdict Undecided then states what is missing.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import Branch
from agent.estimation.gaussian.hypotheses import search
from agent.planning import inference, phase3_last_manoeuvre
from agent.planning.active_sensing import PlanningHypothesis
from agent.planning.assured import CHECKED_WITH_OUTLIERS, claim_pose
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Standing, Waiting
from agent.planning.state import MODE_NAMES, RobotState
from protocol.motion import ORIGIN, wrap

CHECKED = 3
"""The minimum number of mutual ranges before a claim, without outliers.

With outliers, the minimum is that of the `assured` planner, which the paper's manoeuvres do not reach.
"""

LIKELY = 0.05
"""The probability from which on a branch takes part in the planning of a manoeuvre."""


def with_branches(state: RobotState) -> tuple[RobotState, tuple[Branch, ...]]:
    """Return `state` with the most probable branch, and all branches of at least the probability LIKELY.

    The branches are sorted by probability, in descending order. The tuple is empty if there is no anchor
    range.
    """
    scored = inference.own_anchor(state)
    if not scored:
        return state, ()
    state = inference.with_own(state, scored)
    likely = zip(state.belief.branches, state.belief.own, strict=True)
    return state, tuple([branch for branch, one in likely if one.probability >= LIKELY])


def decide_phase3(state: RobotState) -> RobotState:
    """Evaluate phase 3 after a's second mutual range, and again after b's last manoeuvre.

    Return `state` with a claim, with the last manoeuvre of b, or with the verdict Undecided.
    """
    pair = inference.pair_of(state)
    mutual = pair.ranges.counts[2]
    if inference.known_through(state) < state.tick or mutual < CHECKED - 1:
        return state
    scored = search(pair)
    required_ranges = CHECKED_WITH_OUTLIERS if state.config.mission.noise.outliers else CHECKED
    state = inference.with_convergence_check(
        inference.with_pair(state, scored, pair, required_ranges), scored
    )
    blocking_reason = state.belief.blocking_reason
    if blocking_reason is None:
        return claim_pose(state)
    if state.belief.plan is not None or not scored:
        return state.undecided(f"the paper's manoeuvres give no further ranges: {blocking_reason}")
    if state.config.role == "a":
        return state
    placements = [
        _pose_in_b_frame(planning_hypothesis)
        for planning_hypothesis in inference.pair_planning_hypotheses(scored, pair)
    ]
    plan = phase3_last_manoeuvre.last_manoeuvre(
        "b", ORIGIN, ORIGIN, placements, state.config.mission, "paper"
    )
    if plan is None:
        return state.undecided("no manoeuvre keeps the safety distance")
    return replace(
        state,
        mode=LastManoeuvre(plan.command, state.odometry),
        belief=replace(state.belief, plan=plan),
    )


def awaits_second_range(state: RobotState) -> bool:
    """Return whether b has not yet received the report that a has its second mutual range."""
    return (
        isinstance(state.mode, Standing)
        and state.belief.plan is None
        and state.peer_state.state != MODE_NAMES[Waiting]
    )


def _pose_in_b_frame(planning_hypothesis: PlanningHypothesis) -> Placement:
    """Return the pose of a in the frame of b's current pose."""
    ax, ay, a_heading, bx, by, b_heading = planning_hypothesis.poses.tolist()
    c, s = math.cos(b_heading), math.sin(b_heading)
    dx, dy = ax - bx, ay - by
    return Placement(wrap(a_heading - b_heading), c * dx + s * dy, c * dy - s * dx)
