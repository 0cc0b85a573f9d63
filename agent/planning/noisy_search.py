"""A robot of a group with noisy sensors that looks for robots without an anchor.

The visitor of a last meeting sweeps a part of the area. The robot that it has visited stays where it is, and
is its beacon: before each two strips, the sweeping robot passes its own anchor and its beacon. The ranges to
both, and the odometry between them, are measurements of their meeting like those before its claim, so its
pose and the covariance of it follow from the fit of that meeting (`GaussianEstimator`). Where it comes into
range of a robot without an anchor, it reports its pose with the covariance, which stay fixed during the
contact, and its odometry from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import asdict, astuple, replace

from agent.estimation.gaussian import inference
from agent.estimation.gaussian.claim_agreement import difference
from agent.estimation.gaussian.claim_rivals import WRONG_SIGMAS, likeliest_rival
from agent.estimation.gaussian.consistency import CLAIM_P_VALUE, FINISHED, consistency_test
from agent.estimation.gaussian.contact_fit import is_definite
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.gaussian.hypotheses import Hypothesis, ScoredHypothesis, follow, search
from agent.estimation.gaussian.range_model import PairRanges
from agent.planning import exchange, group_transitions, sweep, sweep_transitions
from agent.planning.group import GroupPlanner, with_sender
from agent.planning.group_state import GroupState, Other, Reference
from agent.planning.state import Done, RobotState
from agent.planning.sweep import Looping, Sweeping
from protocol.messages import Localised, Report, ReportWithReference, RobotConfigWithSweep, Undecided
from protocol.motion import Covariance, Pose, compose, inverse
from protocol.sweep_strips import ALONG, ASIDE, NEAR, contact_ticks, surveyed_path

LINGER = 10
"""The ticks without a range to robots without an anchor after which a contact with them is over."""

WORTH = 0.9
"""The largest sigma of its position with which a robot stops for another one, in units of the accuracy.

The ranges between them add to it: with a larger one, the other robot can make no claim.
"""

REFIT = 20
"""The ticks after which the pose is estimated again without further ranges, by what is known of odometry."""

REFIT_WITH_RANGES = 3
"""The ticks after which it is estimated again with further ranges."""

LOOSE = 0.1
"""The sigma of the position, in units of R, from which on the next few ranges do not determine it."""

RANGES_AGAIN = 6
"""The number of ranges from which on they determine it again.

The two unknowns of the position need ranges from several sides of the anchor or the beacon.
"""

MOST_WEIGHED = 48
"""The most ranges of a kind after the claim of the meeting that a fit weighs; those before it all count.

Only in the meeting both robots moved. Without its ranges, the beacon and its mirror image about the line
between the anchors explain all others, and the pose is ambiguous again.

A beacon that stands still has hundreds, which tell nothing new. With fewer, passages of an anchor count less.
"""

NORMAL_RATIO = -0.5 * WRONG_SIGMAS**2
"""The log-likelihood ratio of a rival where the likelihood is normal."""

MOST_WIDENED = 2.5
"""The factor by which a covariance is widened at the most, so that it covers the likelihood of its rivals.

In a group whose fit was right, it was 1.6. With less, fewer robots are found in the first sweep; with more,
the ellipse has little to do with the likelihood.
"""

TINY = 1e-6
"""The least difference of log-likelihoods that divides another one."""

MOST_FITS = 4
"""The most fits in a tick: after a long way, the steps of one fit do not suffice to correct the path."""


class NoisyGroupPlanner(GroupPlanner):
    """The planner of a robot in a group with noisy sensors, in which some robots have no anchor."""

    def report_to(self, state: GroupState, peer: str) -> Report:
        """Return the report to `peer`: the log, the verdict, or a reference with the log since then."""
        if state.sweeps and peer == state.pair.config.peer:
            return exchange.report(state.pair)
        if not sweep_transitions.is_helped(state, peer):
            return super().report_to(state, peer)
        without_log = exchange.report_without_log(state.pair, state.verdict)
        reference = state.reference
        if reference is None:
            return without_log
        since = max(reference.tick, min(state.other(peer).acknowledged, state.pair.log.through))
        part = state.pair.log.after(since, len(state.pair.log.ranges))
        fields = asdict(without_log) | {"since": since, "through": part.through, "runs": part.runs}
        return ReportWithReference(
            **fields, reference=reference.tick, pose=reference.pose, covariance=reference.covariance
        )

    def decide(self, state: GroupState, reports: Sequence[Report] = ()) -> GroupState:
        """Return `state` with the `reports` of others, and in the next meeting if this one has ended."""
        if not (state.sweeps or _is_beacon(state)):
            state = super().decide(state, reports)
            return _begun(state) if state.sweeps else state
        for one in reports:
            known = with_sender(state, one).other(one.robot)
            known = replace(known, acknowledged=max(known.acknowledged, one.heard))
            state = state.with_other(one.robot, known)
        of_peer = [one for one in reports if one.has_log and one.robot == state.pair.config.peer]
        heard = exchange.with_reports(state.pair, of_peer)
        if heard.verdict == state.pair.verdict:
            state = replace(state, pair=heard)
        return _onward(_located(state)) if state.sweeps else state


def _is_beacon(state: GroupState) -> bool:
    """Return whether this robot stays where it is: it sweeps no part, and its planned meetings are over."""
    config = state.config
    assert isinstance(config, RobotConfigWithSweep)
    if config.part < config.sweep.parts or state.visits < len(config.visits):
        return False
    return isinstance(state.pair.verdict, Localised) and isinstance(state.verdict, Localised)


def _begun(state: GroupState) -> GroupState:
    """Return `state`, which begins a part of the sweep, on its way; or still, if it sweeps none."""
    config, pair = state.config, state.pair
    assert isinstance(config, RobotConfigWithSweep)
    assert isinstance(state.verdict, Localised)
    if config.part >= config.sweep.parts:
        return replace(state, pair=replace(pair, mode=Done(3, state.verdict)))
    located = state.located
    assert located is not None
    # after a visit in vain, or one that contradicts what this robot knows
    if not pair.belief.pair or pair.config.peer != located.config.peer:
        same = {"tick": pair.tick, "odometry": pair.odometry, "log": pair.log, "leg": pair.leg}
        pair = replace(located, **same, mode=pair.mode)
    state = _located(replace(state, pair=pair, fitted=-1))
    pair = state.pair
    part = (config.part + state.parts - 1) % config.sweep.parts
    anchor = pair.config.anchor
    beacon = _place_of_peer(state)
    path = surveyed_path(
        config.sweep, part, config.mission.sensing_range, (anchor.x, anchor.y), (beacon.x, beacon.y)
    )
    into = inverse(state.frame)
    ends = [compose(into, Pose(x, y, 0.0)) for x, y in path]
    mode = Sweeping(tuple([(end.x, end.y) for end in ends]))
    return replace(state, pair=replace(pair, mode=mode), reference=None)


# --- the own pose -------------------------------------------------------------------------------------


def _located(state: GroupState) -> GroupState:
    """Return `state` with the frame and the hypotheses of a new estimate of the pose, if one is due."""
    pair = state.pair
    since = pair.tick - state.fitted
    ranged = bool(pair.log.ranges) and pair.log.ranges[-1].tick == pair.tick
    ranged |= bool(pair.mutual) and pair.mutual[-1].tick == pair.tick
    if state.fitted >= 0 and since < (REFIT_WITH_RANGES if ranged else REFIT):
        return state
    return _estimated(state)[0]


class _Fitted(NamedTuple):
    """The pose of a sweeping robot from all measurements of its latest meeting, later ones included."""

    scored: tuple[ScoredHypothesis, ...]
    measured: PairRanges
    p_value: float
    """The p-value of the consistency test of the most probable hypothesis; 0 if there is none."""


def _fitted(state: GroupState, *, searched: bool) -> _Fitted:
    """Return the fit of the latest meeting.

    The whole plane is searched if the known hypotheses do not explain the measurements, or if `searched`.
    """
    pair, measured = state.pair, _measured(state)
    found = _followed(pair.belief.pair, measured, _place(pair))
    if not searched and found.p_value >= CLAIM_P_VALUE and found.scored[0].fit.last_step <= FINISHED:
        return found
    known = tuple([one.hypothesis for one in found.scored])
    again = tuple([one.hypothesis for one in search(measured, known)])
    return _followed(again, measured, _place(pair))


def _followed(known: tuple[Hypothesis, ...], measured: PairRanges, own: int) -> _Fitted:
    """Return the fits that begin at the hypotheses `known`, until that of the most probable one converges."""
    scored: tuple[ScoredHypothesis, ...] = ()
    for _ in range(MOST_FITS):
        scored = follow(known, measured)
        known = tuple([one.hypothesis for one in scored])
        if not scored or scored[0].fit.last_step <= FINISHED:
            break
    p_value = consistency_test(scored[0].fit, measured, own).p_value if scored else 0.0
    return _Fitted(scored, measured, p_value)


def _measured(state: GroupState) -> PairRanges:
    """Return the measurements of the latest meeting: all until its claim, and some of the later ranges."""
    measured = inference.pair_of(state.pair)
    claimed = state.located.tick if state.located is not None else -1
    return replace(measured, ranges=measured.ranges.thinned_after(claimed, MOST_WEIGHED))


def _place(pair: RobotState) -> int:
    """Return the place of this robot in the fits of its meeting: 0 in role a, 1 in role b."""
    return 0 if pair.config.role == "a" else 1


def _estimated(state: GroupState, *, searched: bool = False) -> tuple[GroupState, Reference | None]:
    """Return `state` with a new estimate of the pose, and the pose if a claim of it would be right.

    The conditions are those of pairs: one hypothesis is left, its fit has converged and is consistent. Where
    rounding makes the covariance indefinite, other robots would refuse it, and the pose does not count. After
    a large sigma, the first few ranges leave more than an ellipse describes: the pose does not count until
    there are RANGES_AGAIN. If poses many sigmas away are likelier than the ellipse says, it is widened until
    it says as much; if they are far likelier, the pose does not count either.
    """
    pair, mission = state.pair, state.config.mission
    fitted = _fitted(state, searched=searched)
    scored, measured = fitted.scored, fitted.measured
    state = replace(state, fitted=pair.tick)
    if not scored:
        return state, None
    hypothesis = inference.pair_planning_hypotheses(scored[:1], measured)[0]
    m1 = pair.config.anchor if pair.config.role == "a" else pair.config.peer_anchor
    pose, covariance = inference.claim(hypothesis, _place(pair), measured)
    pose = Pose(m1.x + pose.x, m1.y + pose.y, pose.heading)
    frame = compose(pose, inverse(pair.odometry))
    mode = pair.mode
    turn = compose(inverse(frame), state.frame)
    if isinstance(mode, Sweeping):
        mode = Sweeping(tuple([_moved(turn, place) for place in mode.places]))
    elif isinstance(mode, Looping):
        mode = replace(mode, then=tuple([_moved(turn, place) for place in mode.then]))
    known = tuple([one.hypothesis for one in scored])
    pair = replace(pair, belief=replace(pair.belief, pair=known), mode=mode)
    count, wide = len(pair.log.ranges) + len(pair.mutual), covariance.position_sigma
    loose = (
        state.ranges if count > state.ranges and state.wide > LOOSE * mission.sensing_range else state.loose
    )
    state = replace(state, pair=pair, frame=frame, loose=loose, ranges=count, wide=wide)
    sound = (
        searched
        and scored[0].hypothesis.probability >= mission.confidence
        and scored[0].fit.last_step <= FINISHED
        and fitted.p_value >= CLAIM_P_VALUE
        and count >= loose + RANGES_AGAIN
        and is_definite(covariance)
    )
    if not sound:
        return state, None
    rival = likeliest_rival(scored[0].fit, measured, hypothesis, (_place(pair),))
    widened = NORMAL_RATIO / min(rival.log_likelihood_ratio, -TINY)
    if widened > MOST_WIDENED:
        return state, None
    return state, Reference(pair.tick, pose, _times(covariance, max(widened, 1.0)))


def _times(covariance: Covariance, factor: float) -> Covariance:
    """Return `covariance` with all elements multiplied by `factor`."""
    return Covariance(*[factor * one for one in astuple(covariance)])


def _moved(turn: Pose, place: tuple[float, float]) -> tuple[float, float]:
    moved = compose(turn, Pose(*place, 0.0))
    return moved.x, moved.y


def _place_of_peer(state: GroupState) -> Pose:
    """Return the pose in <W> of the peer under the most probable hypothesis."""
    pair, measured = state.pair, _measured(state)
    scored = follow(pair.belief.pair, measured)
    peer = 1 - _place(pair)
    m1 = pair.config.anchor if pair.config.role == "a" else pair.config.peer_anchor
    if not scored:
        return Pose(pair.config.peer_anchor.x, pair.config.peer_anchor.y, 0.0)
    x, y, heading = (
        inference.pair_planning_hypotheses(scored[:1], measured)[0].poses[3 * peer : 3 * peer + 3].tolist()
    )
    return Pose(m1.x + x, m1.y + y, heading)


# --- contacts -----------------------------------------------------------------------------------------


def _onward(state: GroupState) -> GroupState:
    """Return `state` after a tick of a sweep, or of a contact with robots without an anchor."""
    state = _with_contact(state)
    if not state.sweeps:  # it has withdrawn its claim
        return state
    pair, mission = state.pair, state.config.mission
    mode = pair.mode
    assert isinstance(mode, Sweeping | Looping)
    mode = sweep.onward(mode, pair.odometry, mission, GAUSSIAN.pose_tolerance)
    found = [one for one in _helped(state) if _ticks_since(state, one) <= LINGER]
    if isinstance(mode, Looping) and pair.tick - mode.since > contact_ticks(mission):
        for robot in found:
            state = state.with_other(robot, replace(state.other(robot), failed=True))
        found = []
    along, aside = ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    match mode:
        case Sweeping(places) if any(_stops_for(state, one) for one in found):
            here = (pair.odometry.x, pair.odometry.y)
            mode = sweep.looping_both_ways(pair.odometry, along, aside, pair.tick, (here, *places))
        case Looping((), then, since) if found:
            mode = sweep.looping_both_ways(pair.odometry, along, aside, since, then)
        case Looping(_, then) if not found:
            mode = sweep.onward(Sweeping(then), pair.odometry, mission, GAUSSIAN.pose_tolerance)
    if isinstance(mode, Sweeping) and not mode.places:
        assert state.verdict is not None
        ended = replace(state, reference=None, pair=replace(pair, mode=Done(pair.phase, state.verdict)))
        following = group_transitions.next_visit(ended)
        return _begun(following) if following.sweeps else following
    return replace(state, pair=replace(pair, mode=mode))


def _with_contact(state: GroupState) -> GroupState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [_ticks_since(state, one) for one in _helped(state)]
    if state.reference is None and 0 in ticks and state.pair.tick - state.searched > LINGER:
        state, reference = _estimated(state, searched=True)
        state = replace(state, searched=state.pair.tick)
        return _agreed(state, reference) if reference is not None else state
    if state.reference is not None and all(since > LINGER for since in ticks):
        return replace(state, reference=None)
    return state


def _agreed(state: GroupState, reference: Reference) -> GroupState:
    """Return `state` with `reference`, if the claim of this robot does not contradict it.

    The ranges since the claim may have ruled out the hypothesis on which it rests. A claim from a single
    meeting is then withdrawn. If several meetings agree on the claim, there is no reference.
    """
    fix, pair, mission = state.fix, state.pair, state.config.mission
    assert fix is not None
    now = Localised(reference.pose, reference.covariance)
    off = difference(fix.claim, fix.tick, now, reference.tick, pair.log, mission)
    if off.p_value >= 1.0 - mission.confidence:
        return replace(state, reference=reference)
    if len(fix.peers) > 1:
        return state
    why = f"its ranges since its claim contradict it by {off.position:.3g} m and {off.heading:.3g} rad"
    return group_transitions.withdrawn(state, Undecided(f"{why} (p = {off.p_value:.2g})"))


def _helped(state: GroupState) -> list[str]:
    """Return the robots without an anchor that are not localised, and with which no contact has failed."""
    config = state.config
    assert isinstance(config, RobotConfigWithSweep)
    return [
        one
        for one in config.unanchored
        if sweep_transitions.is_helped(state, one) and not state.other(one).failed
    ]


def _ticks_since(state: GroupState, robot: str) -> int:
    """Return the number of ticks since the latest range to `robot`; many if there is none."""
    mutual = state.other(robot).mutual
    return state.pair.tick - mutual[-1].tick if mutual else LINGER + 1


def _stops_for(state: GroupState, robot: str) -> bool:
    """Return whether this robot stops for `robot`: it has just passed it, and knows its own pose well."""
    reference, mission = state.reference, state.config.mission
    if reference is None or reference.covariance.position_sigma > WORTH * mission.accuracy:
        return False
    return _has_passed(state.other(robot), state.pair.tick, NEAR * mission.sensing_range)


def _has_passed(known: Other, tick: int, near: float) -> bool:
    """Return whether the range to a robot has been at most `near` m, and increases or is out of reach."""
    latest = known.mutual[-1]
    if latest.tick < tick:
        return latest.range <= near
    before = [one.range for one in known.mutual[-2:-1] if one.tick == tick - 1]
    return bool(before) and min(before) <= near and before[0] <= latest.range
