"""The own pose of a robot with noisy sensors that sweeps an area: its estimates, and when it may report one.

The ranges to its anchor and to its beacon, the robot that it has visited last, are measurements of their
meeting like those before its claim. So the pose and its covariance follow from the fit of that meeting
(`GaussianEstimator`).
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec.structs import astuple, replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.claim_rivals import WRONG_SIGMAS, likeliest_rival
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, FINISHED, consistency_test
from agent.estimation.gaussian.contact_fit import is_definite
from agent.estimation.gaussian.hypotheses import Hypothesis, ScoredHypothesis, follow, search
from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.estimation.gaussian.pair_ranges import PairRanges
from agent.planning import sweep
from agent.planning.group_state import GroupState
from agent.planning.state import RobotState
from agent.planning.sweep import Looping, Sweeping
from protocol.messages import ReportedPose
from protocol.motion import Covariance, Pose, compose, inverse
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

NORMAL_RATIO = -0.5 * WRONG_SIGMAS**2
"""The log-likelihood ratio of a rival where the likelihood is normal."""

MOST_WIDENED = 2.5
"""The largest factor by which a covariance is multiplied, so that it covers the likelihood of its rivals.

In a group whose fit was right, it was 1.6. With less, fewer robots are found in the first sweep; with more,
the ellipse has little to do with the likelihood.
"""

SMALLEST_LOSS = 1e-6
"""The smallest difference of log-likelihoods by which another one is divided."""

MOST_FITS = 4
"""The most fits in a tick: after a long way, the steps of one fit do not suffice to correct the path."""


def updated(state: GroupState) -> GroupState:
    """Return `state` with a new estimate of the pose, if one is due."""
    pair, before = state.pair, state.own_pose.estimated_tick
    ranged = bool(pair.log.ranges) and pair.log.ranges[-1].tick == pair.tick
    ranged |= bool(pair.mutual) and pair.mutual[-1].tick == pair.tick
    if before is not None and pair.tick - before < (REFIT_WITH_RANGES if ranged else REFIT):
        return state
    return _with_estimate(state, _estimate(state, searched=False))


def searched(state: GroupState) -> tuple[GroupState, ReportedPose | None]:
    """Return `state` with an estimate from a search of the whole plane, and its pose if it may be reported.

    The conditions are those of a claim of a pair: one hypothesis is left, its fit has converged and is
    consistent. There are three more. Other robots would refuse a covariance that rounding has made
    indefinite. After a large sigma, the first few ranges leave more than an ellipse describes, so there must
    be RANGES_AGAIN. If poses many sigmas away are likelier than the ellipse says, the covariance is widened
    until it says as much, but at most by MOST_WIDENED.
    """
    estimate = _estimate(state, searched=True)
    state = _with_estimate(state, estimate)
    reference = _reference(state, estimate) if estimate is not None else None
    return replace(state, own_pose=replace(state.own_pose, searched_tick=state.pair.tick)), reference


def beacon_place(state: GroupState) -> Place:
    """Return the most probable position of the beacon in <W>, in m; its anchor if there is no hypothesis."""
    pair, measured = state.pair, _measured(state)
    scored = follow(pair.belief.pair, measured)
    if not scored:
        return pair.config.peer_anchor.x, pair.config.peer_anchor.y
    poses = inference.pair_planning_hypotheses(scored[:1])[0].poses
    first = 3 * (1 - _index(pair))
    x, y = poses[first : first + 2].tolist()
    return pair.config.m1.x + x, pair.config.m1.y + y


class _Fitted(NamedTuple):
    """The fits of all measurements of the latest meeting, later ones included."""

    scored: tuple[ScoredHypothesis, ...]
    measured: PairRanges
    p_value: float
    """The p-value of the consistency test of the most probable hypothesis; 0 if there is none."""


class _Estimate(NamedTuple):
    """The own pose under the most probable hypothesis."""

    fitted: _Fitted
    hypothesis: PlanningHypothesis
    pose: Pose
    """The pose in <W>."""
    covariance: Covariance


def _estimate(state: GroupState, *, searched: bool) -> _Estimate | None:
    """Return the estimate of the pose; None if no hypothesis explains the measurements."""
    pair, fitted = state.pair, _fitted(state, searched=searched)
    if not fitted.scored:
        return None
    hypothesis = inference.pair_planning_hypotheses(fitted.scored[:1])[0]
    local, covariance = inference.claim(hypothesis, _index(pair), fitted.measured)
    pose = Pose(pair.config.m1.x + local.x, pair.config.m1.y + local.y, local.heading)
    return _Estimate(fitted, hypothesis, pose, covariance)


def _fitted(state: GroupState, *, searched: bool) -> _Fitted:
    """Return the fits of the latest meeting.

    The whole plane is searched if the known hypotheses do not explain the measurements, or if `searched`.
    """
    pair, measured = state.pair, _measured(state)
    fitted = _followed(pair.belief.pair, measured, _index(pair))
    if not searched and fitted.p_value >= CLAIM_P_VALUE and fitted.scored[0].fit.last_step <= FINISHED:
        return fitted
    again = search(measured, _hypotheses(fitted))
    return _followed(tuple([one.hypothesis for one in again]), measured, _index(pair))


def _followed(hypotheses: tuple[Hypothesis, ...], measured: PairRanges, robot: int) -> _Fitted:
    """Return the fits that begin at `hypotheses`, until that of the most probable one converges."""
    scored: tuple[ScoredHypothesis, ...] = ()
    for _ in range(MOST_FITS):
        scored = follow(hypotheses, measured)
        hypotheses = tuple([one.hypothesis for one in scored])
        if not scored or scored[0].fit.last_step <= FINISHED:
            break
    p_value = consistency_test(scored[0].fit, measured, robot).p_value if scored else 0.0
    return _Fitted(scored, measured, p_value)


def _hypotheses(fitted: _Fitted) -> tuple[Hypothesis, ...]:
    return tuple([one.hypothesis for one in fitted.scored])


def _measured(state: GroupState) -> PairRanges:
    """Return the measurements of the latest meeting: all until its claim, and some of the later ranges."""
    measured = inference.pair_of(state.pair)
    claimed = state.located.tick if state.located is not None else -1
    return replace(measured, ranges=measured.ranges.thinned_after(claimed, MOST_WEIGHED))


def _index(pair: RobotState) -> int:
    """Return the index of this robot in the fits of its meeting: 0 in role a, 1 in role b."""
    return 0 if pair.config.role == "a" else 1


def _with_estimate(state: GroupState, estimate: _Estimate | None) -> GroupState:
    """Return `state` with `estimate`. The places to which the robot drives stay where they are in <W>."""
    pair, before = state.pair, state.own_pose
    if estimate is None:
        return replace(state, own_pose=replace(before, estimated_tick=pair.tick))
    framed = state.with_frame(estimate.pose)
    turn, mode = compose(inverse(framed.frame), state.frame), pair.mode
    if isinstance(mode, Sweeping):
        mode = Sweeping(sweep.transformed(turn, mode.places))
    elif isinstance(mode, Looping):
        mode = replace(mode, then=sweep.transformed(turn, mode.then))
    pair = replace(pair, belief=replace(pair.belief, pair=_hypotheses(estimate.fitted)), mode=mode)
    ranges = len(pair.log.ranges) + len(pair.mutual)
    was_lost = before.sigma > LOST_SIGMA * state.config.mission.sensing_range
    own_pose = replace(
        before,
        estimated_tick=pair.tick,
        ranges=ranges,
        sigma=estimate.covariance.position_sigma,
        ranges_when_lost=before.ranges if was_lost and ranges > before.ranges else before.ranges_when_lost,
    )
    return replace(framed, pair=pair, own_pose=own_pose)


def _reference(state: GroupState, estimate: _Estimate) -> ReportedPose | None:
    """Return the pose of `estimate` if the robot may report it (see `searched`); None if not."""
    pair, fitted, own_pose = state.pair, estimate.fitted, state.own_pose
    first, lost = fitted.scored[0], own_pose.ranges_when_lost
    is_sound = (
        first.hypothesis.probability >= state.config.mission.confidence
        and first.fit.last_step <= FINISHED
        and fitted.p_value >= CLAIM_P_VALUE
        and (lost is None or own_pose.ranges >= lost + RANGES_AGAIN)
        and is_definite(estimate.covariance)
    )
    if not is_sound:
        return None
    rival = likeliest_rival(first.fit, fitted.measured, estimate.hypothesis, (_index(pair),))
    widened = NORMAL_RATIO / min(rival.log_likelihood_ratio, -SMALLEST_LOSS)
    if widened > MOST_WIDENED:
        return None
    factor = max(widened, 1.0)
    covariance = Covariance(*[factor * one for one in astuple(estimate.covariance)])
    return ReportedPose(pair.tick, estimate.pose, covariance)
