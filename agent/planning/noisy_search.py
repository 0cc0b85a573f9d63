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
from agent.planning import exchange, group_transitions, own_pose, sweep, sweep_transitions
from agent.planning.group import GroupPlanner, with_sender
from agent.planning.group_state import GroupState, Other
from agent.planning.state import Done
from agent.planning.sweep import Sweeping
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


class NoisyGroupPlanner(GroupPlanner):
    """The planner of a robot in a group with noisy sensors, in which some robots have no anchor."""

    def report_to(self, state: GroupState, peer: str) -> Report:
        """Return the report to `peer`: the log, the verdict, or a reference with the log since then."""
        if state.sweeps and peer == state.pair.config.peer:
            return exchange.report(state.pair)
        if not sweep_transitions.is_helped(state, peer):
            return super().report_to(state, peer)
        without_log = exchange.report_without_log(state.pair, state.verdict)
        reference = state.own_pose.reference
        if reference is None:
            return without_log
        since = max(reference.tick, min(state.other(peer).acknowledged, state.pair.log.through))
        part = state.pair.log.after(since, len(state.pair.log.ranges))
        return replace(without_log, since=since, through=part.through, runs=part.runs, prior=reference)

    def decide(self, state: GroupState, reports: Sequence[Report] = ()) -> GroupState:
        """Return `state` with the `reports` of others, and in the next meeting if this one has ended."""
        if not (state.sweeps or _is_beacon(state)):
            state = super().decide(state, reports)
            return _begun(state) if state.sweeps else state
        for report in reports:
            sender = with_sender(state, report).other(report.robot)
            sender = replace(sender, acknowledged=report.heard)  # if it is overtaken, more is sent again
            state = state.with_other(report.robot, sender)
        of_peer = [report for report in reports if report.has_log and report.robot == state.pair.config.peer]
        heard = exchange.with_reports(state.pair, of_peer)
        if heard.verdict == state.pair.verdict:
            state = replace(state, pair=heard)
        return _onward(own_pose.updated(state)) if state.sweeps else state


def _is_beacon(state: GroupState) -> bool:
    """Return whether this robot stays where it is: it sweeps no part, and its planned meetings are over."""
    config = state.config
    assert config.sweep is not None
    if config.part < config.sweep.parts or state.visits < len(config.visits):
        return False
    return isinstance(state.pair.verdict, Localised) and isinstance(state.verdict, Localised)


def _begun(state: GroupState) -> GroupState:
    """Return `state`, which begins a part of the sweep, on its way; or still, if it sweeps none."""
    config, pair = state.config, state.pair
    assert config.sweep is not None
    assert isinstance(state.verdict, Localised)
    if config.part >= config.sweep.parts:
        return replace(state, pair=replace(pair, mode=Done(3, state.verdict)))
    located = state.located
    assert located is not None
    # after a visit in vain, or one that contradicts what this robot knows
    if not pair.belief.pair or pair.config.peer != located.config.peer:
        same = {"tick": pair.tick, "odometry": pair.odometry, "log": pair.log, "leg": pair.leg}
        pair = replace(located, **same, mode=pair.mode)
    due = replace(state.own_pose, estimated_tick=None, reference=None)
    state = own_pose.updated(replace(state, pair=pair, own_pose=due))
    part, anchor = (config.part + state.parts - 1) % config.sweep.parts, config.anchor
    path = surveyed_path(
        config.sweep,
        part,
        config.mission.sensing_range,
        (anchor.x, anchor.y),
        own_pose.beacon_place(state),
    )
    mode = Sweeping(sweep.transformed(inverse(state.frame), path))
    return replace(state, pair=replace(state.pair, mode=mode))


# --- contacts -----------------------------------------------------------------------------------------


def _onward(state: GroupState) -> GroupState:
    """Return `state` after a tick of a sweep, or of a contact with robots without an anchor."""
    state = _with_contact(state)
    if not state.sweeps:  # it has withdrawn its claim
        return state
    mission, odometry, phase = state.config.mission, state.pair.odometry, state.pair.phase
    along, aside = ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    helped = [one for one in _helped(state) if _ticks_since(state, one) <= LINGER]
    state = sweep_transitions.moved_on(
        state,
        helped,
        lambda since, then: sweep.looping_both_ways(odometry, along, aside, since, then),
        stops=any(_stops_for(state, one) for one in helped),
        longest=contact_ticks(mission),
    )
    if not sweep_transitions.is_over(state):
        return state
    assert state.verdict is not None
    pair = replace(state.pair, mode=Done(phase, state.verdict))
    following = group_transitions.next_visit(replace(_with_reference(state, None), pair=pair))
    return _begun(following) if following.sweeps else following


def _with_contact(state: GroupState) -> GroupState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [_ticks_since(state, one) for one in _helped(state)]
    searched = state.own_pose.searched_tick
    if state.own_pose.reference is not None:
        return _with_reference(state, None) if all(since > LINGER for since in ticks) else state
    if 0 not in ticks or (searched is not None and state.pair.tick - searched <= LINGER):
        return state
    state, reference = own_pose.searched(state)
    return _agreed(state, reference) if reference is not None else state


def _with_reference(state: GroupState, reference: ReportedPose | None) -> GroupState:
    return replace(state, own_pose=replace(state.own_pose, reference=reference))


def _agreed(state: GroupState, reference: ReportedPose) -> GroupState:
    """Return `state` with `reference`, if the claim of this robot does not contradict it.

    The ranges since the claim may have ruled out the hypothesis on which it rests. A claim from a single
    meeting is then withdrawn. If several meetings agree on the claim, there is no reference.
    """
    fix, pair, mission = state.fix, state.pair, state.config.mission
    assert fix is not None
    now = Localised(reference.pose, reference.covariance)
    off = difference(fix.claim, fix.tick, now, reference.tick, pair.log, mission)
    if off.p_value >= 1.0 - mission.confidence:
        return _with_reference(state, reference)
    if len(fix.peers) > 1:
        return state
    why = f"its ranges since its claim contradict it by {off.position:.3g} m and {off.heading:.3g} rad"
    return group_transitions.withdrawn(state, Undecided(f"{why} (p = {off.p_value:.2g})"))


def _helped(state: GroupState) -> list[str]:
    """Return the robots without an anchor that are not localised, and with which no contact has failed."""
    return [
        one
        for one in state.config.unanchored
        if sweep_transitions.is_helped(state, one) and not state.other(one).failed
    ]


def _ticks_since(state: GroupState, robot: str) -> int:
    """Return the number of ticks since the latest range to `robot`; many if there is none."""
    mutual = state.other(robot).mutual
    return state.pair.tick - mutual[-1].tick if mutual else LINGER + 1


def _stops_for(state: GroupState, robot: str) -> bool:
    """Return whether this robot stops for `robot`: it has just passed it, and knows its own pose well."""
    reference, mission = state.own_pose.reference, state.config.mission
    covariance = reference.covariance if reference is not None else None
    if covariance is None or covariance.position_sigma > WORTH * mission.accuracy:
        return False
    return _has_passed(state.other(robot), state.pair.tick, STRIP_REACH * mission.sensing_range)


def _has_passed(other: Other, tick: int, near: float) -> bool:
    """Return whether the range to a robot has been at most `near` m, and increases or is out of reach."""
    latest = other.mutual[-1]
    if latest.tick < tick:
        return latest.range <= near
    before = [one.range for one in other.mutual[-2:-1] if one.tick == tick - 1]
    return bool(before) and min(before) <= near and before[0] <= latest.range
