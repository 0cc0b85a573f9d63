"""The paper to the letter where sensors are noisy: its manoeuvres and no others, weighed by likelihood.

It takes the branch that is likeliest, and claims only what the mission asks for: with the few ranges that the
letter takes it mostly cannot, with outliers never, and says what is missing.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.closed_forms import Placement
from agent.estimation.exact import Branch
from agent.estimation.gaussian.hypotheses import search
from agent.planning import inference, phase3_last_manoeuvre
from agent.planning.active_sensing import PlanningHypothesis
from agent.planning.assured import CHECKED_WITH_OUTLIERS, claimed
from agent.planning.phase3_last_manoeuvre import LastManoeuvre, Standing, Waiting
from agent.planning.state import MODE_NAMES, RobotState
from protocol.motion import ORIGIN, wrap

CHECKED = 3
"""mutual ranges before a claim; where there are outliers as many as in `survey`, and it takes fewer"""

LIKELY = 0.05
"""probability from which on a branch is worth a manoeuvre that tells it from others"""


def with_branches(state: RobotState) -> tuple[RobotState, tuple[Branch, ...]]:
    """The branches that are likely, the likeliest first; and `state`, which takes the first."""
    scored = inference.own_anchor(state)
    if not scored:
        return state, ()
    state = inference.with_own(state, scored)
    likely = zip(state.belief.branches, state.belief.own, strict=True)
    return state, tuple([branch for branch, one in likely if one.probability >= LIKELY])


def considered(state: RobotState) -> RobotState:
    """Phase 3, after a's second range and again after b's last manoeuvre."""
    pair = inference.pair_of(state)
    mutual = pair.ranges.counts[2]
    if inference.known_through(state) < state.tick or mutual < CHECKED - 1:
        return state
    scored = search(pair)
    checked = CHECKED_WITH_OUTLIERS if state.config.mission.noise.outliers else CHECKED
    state = inference.finished(inference.with_pair(state, scored, pair, checked), scored)
    missing = state.belief.blocking_reason
    if missing is None:
        return claimed(state)
    if state.belief.plan is not None or not scored:
        return state.undecided(f"the letter takes no more ranges: {missing}")
    if state.config.role == "a":
        return state
    placements = [_seen_from_b(held) for held in inference.held_together(scored, pair)]
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


def waits(state: RobotState) -> bool:
    """Whether b has yet to hear that a has its second range."""
    return (
        isinstance(state.mode, Standing)
        and state.belief.plan is None
        and state.peer_state.state != MODE_NAMES[Waiting]
    )


def _seen_from_b(held: PlanningHypothesis) -> Placement:
    """Where a is, and how it is turned, in b's own frame."""
    ax, ay, a_heading, bx, by, b_heading = held.poses.tolist()
    c, s = math.cos(b_heading), math.sin(b_heading)
    dx, dy = ax - bx, ay - by
    return Placement(wrap(a_heading - b_heading), c * dx + s * dy, c * dy - s * dx)
