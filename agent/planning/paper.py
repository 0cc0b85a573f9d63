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
from agent.planning.state import WORDS, RobotState
from protocol.motion import ORIGIN, wrap

CHECKED = 3
"""mutual ranges before a claim; where there are outliers as many as in `survey`, and it takes fewer"""

LIKELY = 0.05
"""odds from which on a branch is worth a manoeuvre that tells it from others"""


def with_branches(mind: RobotState) -> tuple[RobotState, tuple[Branch, ...]]:
    """The branches that are likely, the likeliest first; and `mind`, which takes the first."""
    weighed = inference.own_anchor(mind)
    if not weighed:
        return mind, ()
    mind = inference.with_own(mind, weighed)
    likely = zip(mind.findings.branches, mind.findings.own, strict=True)
    return mind, tuple([branch for branch, one in likely if one.odds >= LIKELY])


def considered(mind: RobotState) -> RobotState:
    """Phase 3, after a's second range and again after b's last manoeuvre."""
    pair = inference.pair_of(mind)
    mutual = pair.ranges.counts[2]
    if inference.known_through(mind) < mind.tick or mutual < CHECKED - 1:
        return mind
    weighed = search(pair)
    checked = CHECKED_WITH_OUTLIERS if mind.briefing.mission.noise.outliers else CHECKED
    mind = inference.finished(inference.with_pair(mind, weighed, pair, checked), weighed)
    missing = mind.findings.missing
    if missing is None:
        return claimed(mind)
    if mind.findings.plan is not None or not weighed:
        return mind.undecided(f"the letter takes no more ranges: {missing}")
    if mind.briefing.role == "a":
        return mind
    placements = [_seen_from_b(held) for held in inference.held_together(weighed, pair)]
    plan = phase3_last_manoeuvre.last_manoeuvre(
        "b", ORIGIN, ORIGIN, placements, mind.briefing.mission, "paper"
    )
    if plan is None:
        return mind.undecided("no manoeuvre keeps the safety distance")
    return replace(
        mind,
        state=LastManoeuvre(plan.drive, mind.odometry),
        findings=replace(mind.findings, plan=plan),
    )


def waits(mind: RobotState) -> bool:
    """Whether b has yet to hear that a has its second range."""
    return (
        isinstance(mind.state, Standing) and mind.findings.plan is None and mind.radio.state != WORDS[Waiting]
    )


def _seen_from_b(held: PlanningHypothesis) -> Placement:
    """Where a is, and how it is turned, in b's own frame."""
    ax, ay, a_heading, bx, by, b_heading = held.poses.tolist()
    c, s = math.cos(b_heading), math.sin(b_heading)
    dx, dy = ax - bx, ay - by
    return Placement(wrap(a_heading - b_heading), c * dx + s * dy, c * dy - s * dx)
