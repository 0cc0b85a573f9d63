"""The planner of a robot in a group with noisy sensors, of which f robots may report false data.

The robot claims a pose only when its meetings with f + 1 peers agree. Before, it knows a pose by its latest
meeting, and drives by it. After its planned visits, it returns to its anchor. From there, it makes the visits
that confirm poses, and meets those that visit it. Beside its anchor, its own ranges determine its pose but
for a rotation about the anchor. Each meeting determines that rotation by itself. At least one of f + 1 peers
is honest, so a pose is right if its covariance covers the poses of f + 1 meetings.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from msgspec.structs import replace

from agent.estimation.gaussian.claim_agreement import agreement, covariance_union
from agent.planning import group_transitions
from agent.planning.group import TRAVELLING_MODE, GroupPlanner
from agent.planning.group_state import Fix, GroupState
from agent.planning.own_pose import later_pose
from agent.planning.state import UNCONFIRMED
from protocol.messages import Command, Localised, Report, Undecided
from protocol.mission import HEADING_ACCURACY

RANGES_AGAIN, SHARE_AGAIN = 6, 1.1
"""The further ranges to its anchor, and their factor, after which a robot compares its meetings again."""

BEGINS_WITHIN = 0.3
"""The fraction of the time of a visit within which it may begin, if the robot is not free at once."""

MEETING_OVER_AFTER = 8
"""The ticks in range without a log of a visitor after which a robot takes its meeting with it for over."""


class ConfirmingPlanner(GroupPlanner):
    """The planner of a robot whose claim needs several peers (`mission.tolerates`)."""

    def decide(self, state: GroupState, reports: Sequence[Report] = ()) -> GroupState:
        """Return `state` with the `reports` of others, on the visit that is due, or with its verdict."""
        return _with_verdict(_in_due_visit(super().decide(state, reports)))

    def report_to(self, state: GroupState, peer: str) -> Report:
        """Return the report to `peer`. Outside a meeting, its state says if the pose is unconfirmed."""
        report = super().report_to(state, peer)
        if report.has_log or state.fix is None or report.verdict is not None:
            return report
        return replace(report, state=UNCONFIRMED)

    def command(self, state: GroupState) -> Command:
        """Return the command for the next tick; its task says if a meeting gave an unconfirmed pose."""
        command = super().command(state)
        if state.verdict is None and isinstance(state.pair.verdict, Localised):
            return replace(command, task=UNCONFIRMED)
        return command

    def with_sender(self, state: GroupState, report: Report) -> GroupState:
        """Return `state` with what `report` says: a robot that travels need not have claimed its pose."""
        known = state.other(report.robot)
        claims = not report.has_log and isinstance(report.verdict, Localised)
        known = replace(known, travels=report.state == TRAVELLING_MODE, localised=known.localised or claims)
        return state.with_other(report.robot, known)

    def with_pose(self, state: GroupState, pose: Localised) -> GroupState:
        """Return `state` of a robot that knows its `pose` now, by the present meeting."""
        pair = state.pair
        others = [one for one in state.confirming.meetings if one.config.peer != pair.config.peer]
        return replace(
            state,
            fix=Fix(pair.tick, pose, (pair.config.peer,)),
            located=pair,
            confirming=replace(state.confirming, meetings=(*others, pair)),
        ).with_frame(pose.pose)


def _now(state: GroupState) -> float:
    """Return the time since tick 0 in s."""
    return state.pair.tick * state.config.mission.period


# --- visits -------------------------------------------------------------------------------------------


def _in_due_visit(state: GroupState) -> GroupState:
    """Return `state` on the visit whose time has come, or on the way back from one whose time is over."""
    config, confirming, elapsed = state.config, state.confirming, _now(state)
    if state.visiting and confirming.until is not None:
        if elapsed < confirming.until or state.pair.verdict is not None:
            return state
        return group_transitions.at_anchor(state)
    while confirming.visits < len(config.confirmations):
        visit = config.confirmations[confirming.visits]
        in_time = elapsed < visit.begins + BEGINS_WITHIN * visit.lasts
        if elapsed < visit.begins or (in_time and not _is_free(state)):
            break
        confirming = replace(confirming, visits=confirming.visits + 1)
        if in_time and _may_confirm(state, visit.visited):
            confirming = replace(confirming, until=visit.begins + visit.lasts)
            state = replace(_with_frame(state), confirming=confirming)
            return group_transitions.on_visit(state, visit.visited)
    return replace(state, confirming=confirming)


def _is_free(state: GroupState) -> bool:
    """Return whether this robot knows a pose, waits beside its anchor, and is in no meeting."""
    alone = state.alone or not state.pair.in_contact or state.silence > MEETING_OVER_AFTER
    return state.fix is not None and state.waits and alone


def _may_confirm(state: GroupState, peer: str) -> bool:
    """Return whether a meeting with `peer` may confirm the pose of one of the two robots."""
    other = state.other(peer)
    met = any(one.config.peer == peer for one in state.confirming.meetings)
    return not (met or other.failed or (other.localised and state.verdict is not None))


def _with_frame(state: GroupState) -> GroupState:
    """Return `state` with the frame that follows from one of its meetings and its measurements since then.

    With a claim, it is the latest meeting of those that confirm it. Without one, meetings take turns from one
    visit to the next, because one of them may have been with an attacker, and lead astray.
    """
    pair, confirming = state.pair, state.confirming
    poses = [pose for one in confirming.meetings if (pose := later_pose(one, pair)) is not None]
    if not poses:
        return state
    turn = 0 if state.verdict is not None else confirming.visits % len(poses)
    return state.with_frame(poses[-1 - turn].pose)


# --- the claim ----------------------------------------------------------------------------------------


def _with_verdict(state: GroupState) -> GroupState:
    """Return `state` with a claim if enough meetings agree, or Undecided if the robot gives up."""
    if state.verdict is not None or state.fix is None:
        return state
    config = state.config
    is_late = _now(state) >= config.gives_up
    if is_late or _is_comparison_due(state):
        state = _confirmed(state)
    if state.verdict is not None or not is_late:
        return state
    met = ", ".join([one.config.peer for one in state.confirming.meetings])
    why = f"{config.tolerates + 1} robots must agree on its pose; it knows one by: {met}"
    return replace(state, verdict=Undecided(why))


def _is_comparison_due(state: GroupState) -> bool:
    """Return whether the robot compares the poses of its meetings: after each, and beside its anchor."""
    pair, fix, ranges = state.pair, state.fix, state.pair.log.ranges
    if fix is not None and fix.tick == pair.tick:
        return True
    if not (state.waits and ranges and ranges[-1].tick == pair.tick):
        return False
    return len(ranges) >= SHARE_AGAIN * state.confirming.ranges + RANGES_AGAIN


def _confirmed(state: GroupState) -> GroupState:
    """Return `state` with a claim that covers the poses of enough meetings which agree, if it is accurate."""
    config, confirming, pair = state.config, state.confirming, state.pair
    needed = config.tolerates + 1
    if len(confirming.meetings) < needed:
        return state
    state = replace(state, confirming=replace(confirming, ranges=len(pair.log.ranges)))
    poses = {one.config.peer: later_pose(one, pair) for one in confirming.meetings}
    present_poses = [(peer, pose) for peer, pose in poses.items() if pose is not None]
    for chosen in combinations(present_poses, needed):
        claims = [pose for _, pose in chosen]
        if not all(agreement(*two) >= 1.0 - config.mission.confidence for two in combinations(claims, 2)):
            continue
        claim = covariance_union(claims)
        assert claim.covariance is not None
        position, heading = claim.covariance.position_sigma, claim.covariance.heading_sigma
        if position <= config.mission.accuracy and heading <= HEADING_ACCURACY:
            peers = [peer for peer, _ in chosen]
            meetings = sorted(confirming.meetings, key=lambda one: one.config.peer in peers)
            confirming = replace(state.confirming, meetings=tuple(meetings))
            return replace(state, verdict=claim, confirming=confirming).with_frame(claim.pose)
    return state
