"""The coverage of an area with noisy sensors: the robot keeps its pose by its own anchor and by a beacon.

The visitor of a last meeting covers a part of the area. The robot that it has visited stays where it is, and
is its beacon: before each two strips, the covering robot passes its own anchor and its beacon, so that it
knows its pose again. Ranges to both are measurements of their meeting like those before its claim. Where it
comes into range of a robot without an anchor, it reports its pose with the covariance, which stay fixed
during the contact, and its odometry from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from msgspec.structs import astuple, replace

from agent.estimation.claim import NORMAL_RATIO, blocked
from agent.estimation.gaussian.followed_pair import followed_later
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.mission_measurements import pair_of
from agent.estimation.judged import Judged
from agent.estimation.posterior import PAIR, Hypothesis, Posterior, follow
from agent.planning import coverage
from agent.planning.coverage import LINGER, ticks_since
from agent.planning.state import RobotState
from agent.planning.tasks import Covering, Done, Looping, transformed
from protocol.coverage_strips import ALONG, ASIDE, STRIP_REACH, Place, surveyed_path
from protocol.coverage_ticks import contact_ticks
from protocol.messages import Localised, Ranged, Report, ReportedPose
from protocol.motion import Covariance, compose, inverse

WORTH = 0.9
"""The largest sigma of its position with which a robot stops for another one, in units of the accuracy.

The ranges between them add to it: with a larger one, the other robot can make no claim.
"""

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


def with_pose(state: RobotState, peer: str, report: Report) -> Report:
    """Return `report` with the pose at the begin of this contact, if there is one, and the log since then."""
    reference = state.own_pose.reference
    if reference is None:
        return report
    since = max(reference.tick, min(state.other(peer).acknowledged, state.log.through))
    part = state.log.after(since, len(state.log.ranges))
    return replace(report, since=since, through=part.through, runs=part.runs, prior=reference)


def beacon(state: RobotState) -> str | None:
    """Return the peer of a robot that covers an area, or this robot if it is a beacon; None if there is none.

    A beacon stays where it is: it covers no part, and its planned meetings are over.
    """
    config = state.config
    if state.covers:
        return config.peer
    if config.sweep is None or config.part < config.sweep.parts or state.visits < len(config.visits):
        return None
    is_known = isinstance(state.verdict, Localised) and isinstance(state.robot_verdict, Localised)
    return config.robot if is_known else None


def begun(state: RobotState, part: int) -> RobotState:
    """Return `state` at the begin of the coverage of a part. A beacon covers none, and stays where it is."""
    config, fix = state.config, state.fix
    assert config.sweep is not None
    if config.part >= config.sweep.parts:
        assert state.robot_verdict is not None
        return state.doing(Done(3, state.robot_verdict))
    assert fix is not None
    known = fix.known
    # after a visit in vain, or one that contradicts what this robot knows
    if not state.posterior.pair or config.peer != known.config.peer:
        state = replace(
            state,
            config=known.config,
            ranges={**state.ranges, known.config.peer: known.mutual},
            own_anchor=known.own_anchor,
            posterior=known.posterior,
            peer_state=known.peer_state,
        )
    due = replace(state.own_pose, estimated_tick=None, reference=None)
    state = updated(replace(state, own_pose=due))
    anchor, beacon = state.config.anchor, beacon_place(state)
    path = surveyed_path(config.sweep, part, config.mission.sensing_range, (anchor.x, anchor.y), beacon)
    return state.doing(Covering(transformed(inverse(state.frame), path)))


def after_tick(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` after a tick of the coverage: it stops where its own pose is known well enough.

    Its verdict is Undecided if that contradicts its claim. The robots `helped` have no anchor.
    """
    mission, state = state.config.mission, _with_contact(updated(state), helped)
    if state.verdict is not None:
        return state
    helped = [one for one in helped if ticks_since(state, one) <= LINGER]
    stops = any(_stops_for(state, one) for one in helped)
    loop = partial(
        coverage.looping_both_ways, state, ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    )
    state = coverage.moved_on(state, helped, loop, stops=stops, longest=contact_ticks(mission))
    return _with_reference(state, None) if coverage.is_over(state) else state


def _with_contact(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [ticks_since(state, one) for one in helped]
    latest = state.own_pose.searched_tick
    if state.own_pose.reference is not None:
        return _with_reference(state, None) if all(since > LINGER for since in ticks) else state
    if 0 not in ticks or (latest is not None and state.tick - latest <= LINGER):
        return state
    state, reference = searched(state)
    return _agreed(state, reference) if reference is not None else state


def _with_reference(state: RobotState, reference: ReportedPose | None) -> RobotState:
    return replace(state, own_pose=replace(state.own_pose, reference=reference))


def _agreed(state: RobotState, reference: ReportedPose) -> RobotState:
    """Return `state` with `reference`, if the claim of this robot does not contradict it.

    The ranges since the claim may have ruled out the hypothesis on which it rests. A claim from a single
    meeting is then withdrawn. If several meetings agree on the claim, there is no reference.
    """
    fix = state.fix
    assert fix is not None
    off = fix.contradiction(Localised(reference.pose, reference.covariance), state)
    if off is None:
        return _with_reference(state, reference)
    if len(fix.peers) > 1:
        return state
    return state.undecided(f"its ranges since its claim contradict it by {off}")


def _stops_for(state: RobotState, robot: str) -> bool:
    """Return whether this robot stops for `robot`: it has just passed it, and knows its own pose well."""
    reference, mission = state.own_pose.reference, state.config.mission
    covariance = reference.covariance if reference is not None else None
    if covariance is None or covariance.position_sigma > WORTH * mission.accuracy:
        return False
    return _has_passed(state.ranges[robot], state.tick, STRIP_REACH * mission.sensing_range)


def _has_passed(ranges: Sequence[Ranged], tick: int, near: float) -> bool:
    """Return whether the range to a robot has been at most `near` m, and increases or is out of reach."""
    latest = ranges[-1]
    if latest.tick < tick:
        return latest.range <= near
    before = [one.range for one in ranges[-2:-1] if one.tick == tick - 1]
    return bool(before) and min(before) <= near and before[0] <= latest.range


# --- its pose ---


def updated(state: RobotState) -> RobotState:
    """Return `state` with a new estimate of the pose, if one is due."""
    before = state.own_pose.estimated_tick
    ranged = bool(state.log.ranges) and state.log.ranges[-1].tick == state.tick
    ranged |= bool(state.mutual) and state.mutual[-1].tick == state.tick
    if before is not None and state.tick - before < (REFIT_WITH_RANGES if ranged else REFIT):
        return state
    return _with_estimate(state, *followed_later("finder", state, _measured(state), searched=False))


def searched(state: RobotState) -> tuple[RobotState, ReportedPose | None]:
    """Return `state` with an estimate from a search of the whole plane, and its pose if it may be reported.

    The conditions are those of `claim`. After a large sigma, the first few ranges leave more than an ellipse
    describes, so there must be RANGES_AGAIN. If poses many sigmas away are likelier than the ellipse says,
    the covariance is widened until it says as much, but at most by `claim.MOST_WIDENED`.
    """
    found, judged = followed_later("finder", state, _measured(state), searched=True)
    state = _with_estimate(state, found, judged)
    reference = _reference(state, judged)
    return replace(state, own_pose=replace(state.own_pose, searched_tick=state.tick)), reference


def beacon_place(state: RobotState) -> Place:
    """Return the most probable position of the beacon in <W>, in m; its anchor if there is no hypothesis."""
    measured = _measured(state)
    found = follow(Posterior(PAIR, state.posterior.pair), measured).hypotheses
    if not found:
        return state.config.peer_anchor.x, state.config.peer_anchor.y
    x, y, _ = found[0].fit.poses[1 if state.config.role == "a" else 0].tolist()
    return state.config.m1.x + x, state.config.m1.y + y


def _measured(state: RobotState) -> JointMeasurements:
    """Return the measurements of the latest meeting: all until its claim, and some of the later ranges."""
    measured = pair_of(state)
    claimed = state.fix.known.tick if state.fix is not None else -1
    return measured.thinned(measured.reach, claimed, MOST_WEIGHED)


def _with_estimate(state: RobotState, scored: Sequence[Hypothesis], judged: Judged | None) -> RobotState:
    """Return `state` with an estimate. The places to which the robot drives stay where they are in <W>."""
    before = state.own_pose
    if judged is None:
        return replace(state, own_pose=replace(before, estimated_tick=state.tick))
    now = judged.localised
    assert now.covariance is not None
    framed = state.with_frame(now.pose)
    turn, task = compose(inverse(framed.frame), state.frame), state.task
    if isinstance(task, Covering):
        task = Covering(transformed(turn, task.places))
    elif isinstance(task, Looping):
        task = replace(task, then=transformed(turn, task.then))
    posterior = replace(state.posterior, pair=tuple(scored))
    ranges = len(state.log.ranges) + len(state.mutual)
    was_lost = before.sigma > LOST_SIGMA * state.config.mission.sensing_range
    own_pose = replace(
        before,
        estimated_tick=state.tick,
        ranges=ranges,
        sigma=now.covariance.position_sigma,
        ranges_when_lost=before.ranges if was_lost and ranges > before.ranges else before.ranges_when_lost,
    )
    return replace(framed, posterior=posterior, task=task, own_pose=own_pose)


def _reference(state: RobotState, judged: Judged | None) -> ReportedPose | None:
    """Return the pose that was `judged` if the robot may report it (see `searched`); None if not."""
    own_pose = state.own_pose
    if judged is not None and own_pose.ranges_when_lost is not None:
        required = own_pose.ranges_when_lost + RANGES_AGAIN
        judged = judged._replace(ranges=own_pose.ranges, required=required)
    if judged is None or blocked(judged) is not None:
        return None
    found = judged.localised
    assert found.covariance is not None
    factor = max(NORMAL_RATIO / min(judged.rival.log_likelihood_ratio, -SMALLEST_LOSS), 1.0)
    covariance = Covariance(*[factor * one for one in astuple(found.covariance)])
    return ReportedPose(state.tick, found.pose, covariance)
