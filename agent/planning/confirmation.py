"""The visits and the claim of a robot in a group of which f robots may report false data.

The robot claims a pose only when its meetings with f + 1 peers agree. Before, it knows a pose by its latest
meeting, and drives by it. After its planned visits, it returns to its anchor. From there, it makes the visits
that confirm poses, and meets those that visit it. Beside its anchor, its own ranges determine its pose but
for a rotation about the anchor. Each meeting determines that rotation by itself. At least one of f + 1 peers
is honest, so a pose is right if its covariance covers the poses of f + 1 meetings.
"""

from __future__ import annotations

from msgspec.structs import replace

from agent.estimation.gaussian.claim_agreement import agreed
from agent.estimation.gaussian.followed_pair import later_pose
from agent.planning import appointments
from agent.planning.state import RobotState
from protocol.messages import Undecided

RANGES_AGAIN, SHARE_AGAIN = 6, 1.1
"""The further ranges to its anchor, and their factor, after which a robot compares its meetings again."""

BEGINS_WITHIN = 0.3
"""The fraction of the time of a visit within which it may begin, if the robot is not free at once."""

MEETING_OVER_AFTER = 8
"""The ticks in range without a log of a visitor after which a robot takes its meeting with it for over."""


def onward(state: RobotState) -> RobotState:
    """Return `state` on the visit that is due, or with its verdict."""
    return _with_verdict(_in_due_visit(state))


# --- visits -------------------------------------------------------------------------------------------


def _in_due_visit(state: RobotState) -> RobotState:
    """Return `state` on the visit whose time has come, or on the way back from one whose time is over."""
    config, confirming, elapsed = state.config, state.confirming, state.elapsed
    if state.visiting and confirming.until is not None:
        if elapsed < confirming.until or state.verdict is not None:
            return state
        return appointments.at_anchor(state)
    while confirming.visits < len(config.confirmations):
        visit = config.confirmations[confirming.visits]
        in_time = elapsed < visit.begins + BEGINS_WITHIN * visit.lasts
        if elapsed < visit.begins or (in_time and not _is_free(state)):
            break
        confirming = replace(confirming, visits=confirming.visits + 1)
        if in_time and _may_confirm(state, visit.visited):
            confirming = replace(confirming, until=visit.begins + visit.lasts)
            state = replace(_with_frame(state), confirming=confirming)
            return appointments.on_visit(state, visit.visited)
    return replace(state, confirming=confirming)


def _is_free(state: RobotState) -> bool:
    """Return whether this robot knows a pose, waits beside its anchor, and is in no meeting."""
    alone = state.alone or not state.in_contact or state.silence > MEETING_OVER_AFTER
    return state.fix is not None and state.waits and alone


def _may_confirm(state: RobotState, peer: str) -> bool:
    """Return whether a meeting with `peer` may confirm the pose of one of the two robots."""
    other = state.other(peer)
    met = any(one.config.peer == peer for one in state.confirming.meetings)
    return not (met or other.failed or (other.localised and state.robot_verdict is not None))


def _with_frame(state: RobotState) -> RobotState:
    """Return `state` with the frame that follows from one of its meetings and its measurements since then.

    With a claim, it is the latest meeting of those that confirm it. Without one, meetings take turns from one
    visit to the next, because one of them may have been with an attacker, and lead astray.
    """
    confirming = state.confirming
    poses = [pose for one in confirming.meetings if (pose := later_pose(one, state)) is not None]
    if not poses:
        return state
    turn = 0 if state.robot_verdict is not None else confirming.visits % len(poses)
    return state.with_frame(poses[-1 - turn].pose)


# --- the claim ----------------------------------------------------------------------------------------


def _with_verdict(state: RobotState) -> RobotState:
    """Return `state` with a claim if enough meetings agree, or Undecided if the robot gives up."""
    if state.robot_verdict is not None or state.fix is None:
        return state
    config = state.config
    is_late = state.elapsed >= config.gives_up
    if is_late or _is_comparison_due(state):
        state = _confirmed(state)
    if state.robot_verdict is not None or not is_late:
        return state
    met = ", ".join([one.config.peer for one in state.confirming.meetings])
    why = f"{config.tolerates + 1} robots must agree on its pose; it knows one by: {met}"
    return replace(state, robot_verdict=Undecided(why))


def _is_comparison_due(state: RobotState) -> bool:
    """Return whether the robot compares the poses of its meetings: after each, and beside its anchor."""
    fix, ranges = state.fix, state.log.ranges
    if fix is not None and fix.known.tick == state.tick:
        return True
    if not (state.waits and ranges and ranges[-1].tick == state.tick):
        return False
    return len(ranges) >= SHARE_AGAIN * state.confirming.ranges + RANGES_AGAIN


def _confirmed(state: RobotState) -> RobotState:
    """Return `state` with a claim that covers the poses of enough meetings which agree, if it is accurate."""
    config, confirming = state.config, state.confirming
    if len(confirming.meetings) <= config.tolerates:
        return state
    state = replace(state, confirming=replace(confirming, ranges=len(state.log.ranges)))
    poses = {one.config.peer: later_pose(one, state) for one in confirming.meetings}
    present_poses = {peer: pose for peer, pose in poses.items() if pose is not None}
    found = agreed([*present_poses.values()], config.tolerates, config.mission)
    if found is None:
        return state
    claim, chosen = found
    peers = [[*present_poses][k] for k in chosen]
    meetings = sorted(confirming.meetings, key=lambda one: one.config.peer in peers)
    confirming = replace(state.confirming, meetings=tuple(meetings))
    return replace(state, robot_verdict=claim, confirming=confirming).with_frame(claim.pose)
