"""The pose of a robot with noisy sensors after a meeting: its estimates, and when it may state it.

The ranges to its anchor and to its beacon, the robot that it has visited last, are measurements of their
meeting like those before its claim. So the pose and its covariance follow from the fit of that meeting
(`GaussianEstimator`).
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import astuple, replace

from agent.estimation.claim import NORMAL_RATIO, Blocked, claim
from agent.estimation.gaussian.claim_agreement import difference
from agent.estimation.gaussian.followed_pair import followed_later
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import pair_of
from agent.estimation.judged import Judged
from agent.estimation.posterior import PAIR, Hypothesis, Posterior, follow
from agent.planning.state import RobotState
from agent.planning.tasks import Looping, Sweeping, transformed
from protocol.messages import Localised, ReportedPose
from protocol.motion import Covariance, compose, inverse
from protocol.sweep_strips import Place

REFIT = 20
"""The ticks after which the pose is estimated again without further ranges, from the odometry alone."""

REFIT_WITH_RANGES = 3
"""The ticks after which it is estimated again with further ranges."""

LOST_SIGMA = 0.1
"""The sigma of the position, in units of R, from which on the next few ranges do not determine it."""

RANGES_AGAIN = 6
"""The number of further ranges that determine it then.

The two unknowns of the position need ranges from several sides of the anchor or the beacon.
"""

MOST_WEIGHED = 48
"""The most ranges of a kind after the claim of the meeting that a fit weighs; those before it all count.

Only in the meeting both robots moved. Without its ranges, the beacon and its mirror image about the line
between the anchors explain all others, and the pose is ambiguous again.

There are hundreds of ranges to a beacon that stands still, and they give nothing new. With fewer, passages of
an anchor count less.
"""

SMALLEST_LOSS = 1e-6
"""The smallest difference of log-likelihoods by which another one is divided."""


def updated(state: RobotState) -> RobotState:
    """Return `state` with a new estimate of the pose, if one is due."""
    before = state.agenda.own_pose.estimated_tick
    ranged = bool(state.log.ranges) and state.log.ranges[-1].tick == state.tick
    ranged |= bool(state.mutual) and state.mutual[-1].tick == state.tick
    if before is not None and state.tick - before < (REFIT_WITH_RANGES if ranged else REFIT):
        return state
    return _with_estimate(state, *followed_later("finder", state, _measured(state), searched=False))


def searched(state: RobotState) -> tuple[RobotState, ReportedPose | None]:
    """Return `state` with an estimate from a search of the whole plane, and its pose if it may be reported.

    The conditions are those of `claim`. After a large sigma, the first few ranges leave more than an ellipse
    describes, so there must be RANGES_AGAIN. If poses many sigmas away are likelier than the ellipse says,
    the covariance is widened until it says as much, but at most by MOST_WIDENED.
    """
    found, judged = followed_later("finder", state, _measured(state), searched=True)
    state = _with_estimate(state, found, judged)
    reference = _reference(state, judged)
    return state.with_agenda(own_pose=replace(state.agenda.own_pose, searched_tick=state.tick)), reference


def contradiction(state: RobotState, claim: Localised) -> str | None:
    """Return in words by how much the present `claim` contradicts the known pose; None if it does not.

    The claims of robots with exact sensors have no covariance, and are never wrong.
    """
    fix, mission = state.agenda.fix, state.config.mission
    if fix is None or claim.covariance is None:
        return None
    off = difference(fix.claim, fix.known.tick, claim, state.tick, state.log, mission)
    if off.p_value >= 1.0 - mission.confidence:
        return None
    return f"{off.position:.3g} m and {off.heading:.3g} rad (p = {off.p_value:.2g})"


def beacon_place(state: RobotState) -> Place:
    """Return the most probable position of the beacon in <W>, in m; its anchor if there is no hypothesis."""
    measured = _measured(state)
    found = follow(Posterior(PAIR, state.belief.pair), measured).hypotheses
    if not found:
        return state.config.peer_anchor.x, state.config.peer_anchor.y
    x, y, _ = found[0].fit.poses[1 if state.config.role == "a" else 0].tolist()
    return state.config.m1.x + x, state.config.m1.y + y


def _measured(state: RobotState) -> JointMeasurements:
    """Return the measurements of the latest meeting: all until its claim, and some of the later ranges."""
    measured = pair_of(state)
    claimed = state.agenda.fix.known.tick if state.agenda.fix is not None else -1
    return measured.thinned_after(claimed, MOST_WEIGHED)


def _with_estimate(state: RobotState, scored: Sequence[Hypothesis], judged: Judged | None) -> RobotState:
    """Return `state` with an estimate. The places to which the robot drives stay where they are in <W>."""
    before = state.agenda.own_pose
    if judged is None:
        return state.with_agenda(own_pose=replace(before, estimated_tick=state.tick))
    now = judged.localised
    assert now.covariance is not None
    framed = state.with_frame(now.pose)
    turn, task = compose(inverse(framed.agenda.frame), state.agenda.frame), state.task
    if isinstance(task, Sweeping):
        task = Sweeping(transformed(turn, task.places))
    elif isinstance(task, Looping):
        task = replace(task, then=transformed(turn, task.then))
    belief = replace(state.belief, pair=tuple(scored))
    ranges = len(state.log.ranges) + len(state.mutual)
    was_lost = before.sigma > LOST_SIGMA * state.config.mission.sensing_range
    own_pose = replace(
        before,
        estimated_tick=state.tick,
        ranges=ranges,
        sigma=now.covariance.position_sigma,
        ranges_when_lost=before.ranges if was_lost and ranges > before.ranges else before.ranges_when_lost,
    )
    return replace(framed, belief=belief, task=task).with_agenda(own_pose=own_pose)


def _reference(state: RobotState, judged: Judged | None) -> ReportedPose | None:
    """Return the pose that was `judged` if the robot may report it (see `searched`); None if not."""
    own_pose = state.agenda.own_pose
    if judged is not None and own_pose.ranges_when_lost is not None:
        required = own_pose.ranges_when_lost + RANGES_AGAIN
        judged = judged._replace(ranges=own_pose.ranges, required=required)
    found = claim(judged)
    if judged is None or isinstance(found, Blocked):
        return None
    assert found.covariance is not None
    factor = max(NORMAL_RATIO / min(judged.rival.log_likelihood_ratio, -SMALLEST_LOSS), 1.0)
    covariance = Covariance(*[factor * one for one in astuple(found.covariance)])
    return ReportedPose(state.tick, found.pose, covariance)
