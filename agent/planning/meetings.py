"""The meetings of a robot of a group: how they begin and end, and the pose that the robot knows by them."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.planning import appointments, coverage, searching, travelling
from agent.planning.state import Fix, RobotState
from agent.planning.tasks import UNCONFIRMED, Done, Travelling
from protocol.messages import Localised, Report, Undecided

PARTED_AFTER = 8
"""The ticks out of range of a peer after which a robot whose meeting has ended goes on.

In range, it waits for the verdict of the peer. Out of range, it may have missed it; the peer, which has left,
has received that of this robot before.
"""

LINGERING = 6
"""The ticks in contact for which a visited robot waits for its visitor to leave, with a safety distance."""


def with_sender(state: RobotState, report: Report) -> RobotState:
    """Return `state` with what `report` says about its sender: whether it travels, is localised or served.

    If poses have to be confirmed, a robot that travels need not have claimed its own. Strips that the sender
    covers are not covered by this robot.
    """
    state = coverage.without_strips(state, report.strips)
    known, confirms = state.other(report.robot), state.config.confirms
    travels = report.state == Travelling.name
    claims = not report.has_log and isinstance(report.verdict, Localised)
    localised = known.localised or claims or (travels and not confirms)
    served = known.served or (report.state == UNCONFIRMED and not confirms)
    if (travels, localised, served) == (known.travels, known.localised, known.served):
        return state
    return state.with_other(report.robot, travels=travels, localised=localised, served=served)


def answering(state: RobotState, visitors: Sequence[str]) -> RobotState:
    """Return `state` in a meeting with one of `visitors`, which have come to it, if it waits for one."""
    if not state.waits or state.own_anchor.done_tick is None:
        return state
    peer = state.config.peer
    if peer in visitors and not (state.alone or appointments.refused(state, peer)):
        # a robot that searches for its peer must not wait for that one's manoeuvre while it waits for its own
        return appointments.waiting(state, peer) if state.config.role == "a" else state
    if appointments.is_met(state):
        return state
    for visitor in visitors:
        if not appointments.refused(state, visitor):
            return appointments.waiting(state, visitor)
    return state


def with_pose(state: RobotState, claim: Localised) -> RobotState:
    """Return `state` of a robot that has determined its pose in the present meeting, and knows it now.

    It claims the pose, unless others have to confirm it. If this contradicts the pose that it knows, one of
    two peers has reported false data. A pose on which several meetings agree stays. One that follows from a
    single meeting is withdrawn, because nothing tells which of the two it was, and the robot waits for a
    third one. A planner of the user claims its pose once.
    """
    fix, peer, known = state.fix, state.config.peer, state.knowledge
    if state.own_state is not None and fix is not None:
        return state
    if state.config.confirms:
        earlier = [one for one in state.confirming.meetings if one.config.peer != peer]
        confirming = replace(state.confirming, meetings=(*earlier, known))
        fix = Fix(known, claim, (peer,))
        return replace(state, fix=fix, confirming=confirming).with_frame(claim.pose)
    state = state.with_other(peer, localised=True)
    off = fix.contradiction(claim, state) if fix is not None else None
    if off is None:
        fix = Fix(known, claim, (*(fix.peers if fix is not None else ()), peer))
        return replace(state, fix=fix, robot_verdict=state.robot_verdict or claim).with_frame(claim.pose)
    assert fix is not None
    if len(fix.peers) > 1:
        return appointments.parted(state)
    (other,) = fix.peers
    why = f"{other} and {peer} contradict each other: by their reports, its pose differs by {off}"
    return appointments.withdrawn(state, other, Undecided(why))


def _while_covering(state: RobotState) -> RobotState:
    """Return `state` after a tick of the coverage: on the next visit at its end, or without its claim.

    Without it, the robot waits for another one than its peer.
    """
    assert state.robot_verdict is not None
    peer, done = state.config.peer, Done(state.phase, state.robot_verdict)
    covered = searching.after_tick(state)
    if covered.verdict is None:
        return appointments.next_visit(covered.doing(done)) if coverage.is_over(covered) else covered
    return appointments.waiting(appointments.withdrawn(covered, peer, covered.verdict), peer)


def after_refusal(state: RobotState) -> RobotState:
    """Return `state` of a robot whose peer has ended their meeting, because it contradicts what it knows."""
    if state.visiting:
        return appointments.next_visit(appointments.parted(state))
    why = Undecided(f"{state.config.peer} does not go on with the meeting")
    failed = appointments.parted(state, why)
    return failed if state.own_anchor.done_tick is None else appointments.resumed(failed)


def onward(state: RobotState, *, peer_has_left: bool = False) -> RobotState:
    """Return `state` in the next meeting if the present one is over.

    `peer_has_left` says that the peer has a result, and has reported it from outside the meeting.
    """
    peer = state.config.peer
    over = peer_has_left or _is_over(state)
    if state.fix is None and state.robot_verdict is None and isinstance(state.verdict, Localised):
        # it contradicts an earlier meeting
        parted = replace(appointments.parted(state), visiting=False)
        return appointments.waiting(parted, peer) if over else state
    if state.fix is None:
        return appointments.after_failure(state)
    if state.covers:
        return _while_covering(state)
    if state.visiting and state.verdict is None:
        if state.other(peer).localised and state.robot_verdict is not None:  # by another robot
            return appointments.next_visit(state)
        if travelling.has_searched(state):
            return appointments.next_visit(state.with_other(peer, missed=state.tick))
        if appointments.is_silent(state):
            return appointments.next_visit(appointments.parted(state))
        return state
    if not isinstance(state.task, Done) or _must_linger(state):
        return state
    if not isinstance(state.verdict, Localised):
        reported = state.parting > 0 or not state.in_contact  # to the peer, before this robot leaves
        return appointments.next_visit(appointments.parted(state)) if reported else state
    return appointments.next_visit(state) if over else state


def _is_over(state: RobotState) -> bool:
    """Return whether the peer has a result in the present meeting, or is not there any more."""
    has_left = state.parting >= PARTED_AFTER and not state.in_contact
    return has_left or appointments.is_silent(state) or state.peer_state.verdict is not None


def rests(state: RobotState) -> bool:
    """Return whether the robot has its result, its meeting is over, and it has no robot to drive to."""
    if state.robot_verdict is None or not isinstance(state.task, Done) or _must_linger(state):
        return False
    return state.alone or _is_over(state)


def _must_linger(state: RobotState) -> bool:
    """Return whether a robot whose meeting is over lets its peer leave first, as the visited one does.

    If both left at once, they could be in each other's way.
    """
    if not state.config.mission.safety_distance or state.config.role == "a" or not state.in_contact:
        return False
    travels = state.other(state.config.peer).travels
    return state.parting < (appointments.PEER_LOST_AFTER if travels else LINGERING)
