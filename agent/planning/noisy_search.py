"""A robot of a group with noisy sensors that looks for robots without an anchor.

The visitor of a last meeting sweeps a part of the area. The robot that it has visited stays where it is, and
is its beacon: before each two strips, the sweeping robot passes its own anchor and its beacon, so that it
knows its pose again (`own_pose`). Where it comes into range of a robot without an anchor, it reports its pose
with the covariance, which stay fixed during the contact, and its odometry from then on.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.claim_agreement import difference
from agent.planning import appointments, exchange, meetings, own_pose, sweep
from agent.planning.agenda import Other
from agent.planning.state import RobotState
from agent.planning.tasks import Done, Sweeping
from protocol.messages import Localised, Report, ReportedPose, Undecided
from protocol.motion import inverse
from protocol.sweep_strips import ALONG, ASIDE, STRIP_REACH, surveyed_path
from protocol.sweep_ticks import contact_ticks

LINGER = 10
"""The ticks without a range to robots without an anchor after which a contact with them is over."""

WORTH = 0.9
"""The largest sigma of its position with which a robot stops for another one, in units of the accuracy.

The ranges between them add to it: with a larger one, the other robot can make no claim.
"""


def applies(state: RobotState) -> bool:
    """Return whether robots without an anchor need the covariance of the pose that this one reports."""
    return bool(state.config.unanchored) and state.estimator.corrects_poses


def is_sweeping(state: RobotState) -> bool:
    """Return whether the robot looks for others with noisy sensors, or has stopped for one."""
    return state.sweeps and applies(state)


def is_apart(state: RobotState) -> bool:
    """Return whether the robot is in no meeting any more: it sweeps, or is the beacon of one that does.

    A beacon stays where it is: it sweeps no part, and its planned meetings are over.
    """
    config = state.config
    if not applies(state) or state.sweeps:
        return is_sweeping(state)
    assert config.sweep is not None
    if config.part < config.sweep.parts or state.agenda.visits < len(config.visits):
        return False
    return isinstance(state.verdict, Localised) and isinstance(state.agenda.robot_verdict, Localised)


def report(state: RobotState, peer: str) -> Report:
    """Return the report to `peer` without an anchor: the verdict, and the reference with the log since."""
    without_log = exchange.report_without_log(state, state.agenda.robot_verdict)
    reference = state.agenda.own_pose.reference
    if reference is None:
        return without_log
    since = max(reference.tick, min(state.other(peer).acknowledged, state.log.through))
    part = state.log.after(since, len(state.log.ranges))
    return replace(without_log, since=since, through=part.through, runs=part.runs, prior=reference)


def decided(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """Return `state` of a robot that is in no meeting, with the `reports` of others, and one tick on."""
    for one in reports:
        state = meetings.with_sender(state, one)
        state = state.with_other(one.robot, acknowledged=one.heard)  # if overtaken, more is sent again
    of_peer = [one for one in reports if one.has_log and one.robot == state.config.peer]
    heard = exchange.with_reports(state, of_peer)
    if heard.verdict == state.verdict:
        state = heard
    return _onward(own_pose.updated(state)) if state.sweeps else state


def begun(state: RobotState) -> RobotState:
    """Return `state`, which begins a part of the sweep, on its way; or still, if it sweeps none."""
    config, located = state.config, state.agenda.located
    assert config.sweep is not None
    assert isinstance(state.agenda.robot_verdict, Localised)
    if config.part >= config.sweep.parts:
        return state.doing(Done(3, state.agenda.robot_verdict))
    assert located is not None
    # after a visit in vain, or one that contradicts what this robot knows
    if not state.belief.pair or state.config.peer != located.config.peer:
        state = replace(
            state,
            config=located.config,
            mutual=located.mutual,
            belief=located.belief,
            peer_state=located.peer_state,
        )
    due = replace(state.agenda.own_pose, estimated_tick=None, reference=None)
    state = own_pose.updated(state.with_agenda(own_pose=due))
    part, anchor = (config.part + state.agenda.parts - 1) % config.sweep.parts, config.anchor
    path = surveyed_path(
        config.sweep,
        part,
        config.mission.sensing_range,
        (anchor.x, anchor.y),
        own_pose.beacon_place(state),
    )
    return state.doing(Sweeping(sweep.transformed(inverse(state.agenda.frame), path)))


# --- contacts -----------------------------------------------------------------------------------------


def _onward(state: RobotState) -> RobotState:
    """Return `state` after a tick of a sweep, or of a contact with robots without an anchor."""
    state = _with_contact(state)
    if not state.sweeps:  # it has withdrawn its claim
        return state
    mission, odometry, phase = state.config.mission, state.odometry, state.phase
    along, aside = ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    helped = [one for one in _helped(state) if _ticks_since(state, one) <= LINGER]
    state = sweep.moved_on(
        state,
        helped,
        lambda since, then: sweep.looping_both_ways(odometry, along, aside, since, then),
        stops=any(_stops_for(state, one) for one in helped),
        longest=contact_ticks(mission),
    )
    if not sweep.is_over(state):
        return state
    assert state.agenda.robot_verdict is not None
    state = _with_reference(state, None).doing(Done(phase, state.agenda.robot_verdict))
    following = appointments.next_visit(state)
    return begun(following) if following.sweeps else following


def _with_contact(state: RobotState) -> RobotState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [_ticks_since(state, one) for one in _helped(state)]
    searched = state.agenda.own_pose.searched_tick
    if state.agenda.own_pose.reference is not None:
        return _with_reference(state, None) if all(since > LINGER for since in ticks) else state
    if 0 not in ticks or (searched is not None and state.tick - searched <= LINGER):
        return state
    state, reference = own_pose.searched(state)
    return _agreed(state, reference) if reference is not None else state


def _with_reference(state: RobotState, reference: ReportedPose | None) -> RobotState:
    return state.with_agenda(own_pose=replace(state.agenda.own_pose, reference=reference))


def _agreed(state: RobotState, reference: ReportedPose) -> RobotState:
    """Return `state` with `reference`, if the claim of this robot does not contradict it.

    The ranges since the claim may have ruled out the hypothesis on which it rests. A claim from a single
    meeting is then withdrawn. If several meetings agree on the claim, there is no reference.
    """
    fix, mission = state.agenda.fix, state.config.mission
    assert fix is not None
    now = Localised(reference.pose, reference.covariance)
    off = difference(fix.claim, fix.tick, now, reference.tick, state.log, mission)
    if off.p_value >= 1.0 - mission.confidence:
        return _with_reference(state, reference)
    if len(fix.peers) > 1:
        return state
    why = f"its ranges since its claim contradict it by {off.position:.3g} m and {off.heading:.3g} rad"
    return meetings.withdrawn(state, Undecided(f"{why} (p = {off.p_value:.2g})"))


def _helped(state: RobotState) -> list[str]:
    """Return the robots without an anchor that are not localised, and with which no contact has failed."""
    return [
        one for one in state.config.unanchored if sweep.is_helped(state, one) and not state.other(one).failed
    ]


def _ticks_since(state: RobotState, robot: str) -> int:
    """Return the number of ticks since the latest range to `robot`; many if there is none."""
    mutual = state.other(robot).mutual
    return state.tick - mutual[-1].tick if mutual else LINGER + 1


def _stops_for(state: RobotState, robot: str) -> bool:
    """Return whether this robot stops for `robot`: it has just passed it, and knows its own pose well."""
    reference, mission = state.agenda.own_pose.reference, state.config.mission
    covariance = reference.covariance if reference is not None else None
    if covariance is None or covariance.position_sigma > WORTH * mission.accuracy:
        return False
    return _has_passed(state.other(robot), state.tick, STRIP_REACH * mission.sensing_range)


def _has_passed(other: Other, tick: int, near: float) -> bool:
    """Return whether the range to a robot has been at most `near` m, and increases or is out of reach."""
    latest = other.mutual[-1]
    if latest.tick < tick:
        return latest.range <= near
    before = [one.range for one in other.mutual[-2:-1] if one.tick == tick - 1]
    return bool(before) and min(before) <= near and before[0] <= latest.range
