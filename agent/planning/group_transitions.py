"""The transitions of a robot in a group: from one meeting to the next, and on the way to a visit.

All functions are pure. `GroupPlanner` calls them; within a meeting, the planner of a pair decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.claim_agreement import difference
from agent.estimation.knowledge import Belief
from agent.peer.peer_state import PeerState
from agent.planning import passing, phase2_orbit, sweep, transitions, visit
from agent.planning.drive import towards
from agent.planning.group_knowledge import Fix
from agent.planning.state import RobotState
from agent.planning.tasks import UNCONFIRMED, Aligning, Asleep, Done, Orbiting, Radial, Travelling
from protocol.messages import Appointment, Contact, Localised, Member, Report, Undecided, Verdict
from protocol.mission import Role
from protocol.motion import compose
from protocol.orbits import Rendezvous

PARTED_AFTER = 8
"""The ticks out of range of a peer after which a robot whose meeting has ended goes on.

In range, it waits for the verdict of the peer. Out of range, it may have missed it; the peer, which has left,
has received that of this robot before.
"""

PEER_LOST_AFTER = 200
"""The ticks in contact without a report after which a robot takes its peer for lost."""

LINGERING = 6
"""The ticks in contact for which a visited robot waits for its visitor to leave, with a safety distance."""


# --- meetings -----------------------------------------------------------------------------------------


def with_sender(state: RobotState, report: Report) -> RobotState:
    """Return `state` with what `report` says about its sender: whether it travels, is localised or served.

    If poses have to be confirmed, a robot that travels need not have claimed its own.
    """
    known, travels, confirms = (
        state.other(report.robot),
        report.state == Travelling.name,
        state.config.confirms,
    )
    claims = not report.has_log and isinstance(report.verdict, Localised)
    localised = known.localised or claims or (travels and not confirms)
    served = known.served or (report.state == UNCONFIRMED and not confirms)
    if (travels, localised, served) == (known.travels, known.localised, known.served):
        return state
    return state.with_other(report.robot, replace(known, travels=travels, localised=localised, served=served))


def answering(state: RobotState, visitors: Sequence[str]) -> RobotState:
    """Return `state` in a meeting with one of `visitors`, which have come to it, if it waits for one."""
    if not state.waits or state.belief.phase1_done_tick is None:
        return state
    if state.config.peer in visitors and not (state.alone or refused(state, state.config.peer)):
        # a robot that searches for its peer must not wait for that one's manoeuvre while it waits for its own
        return _waiting(state, state.config.peer) if state.config.role == "a" else state
    if _is_met(state):
        return state
    for visitor in visitors:
        if not refused(state, visitor):
            return _waiting(state, visitor)
    return state


def _is_met(state: RobotState) -> bool:
    """Return whether this robot is in contact with its peer, in a meeting that may still localise it.

    With noise, one that has not done so by its bound may never do so. Of exact ranges, a few suffice.
    """
    config = state.config
    if not state.in_contact or _is_silent(state) or refused(state, config.peer):
        return False
    until = state.until if state.until is not None else 0.0
    is_noisy, ends = state.estimator.corrects_poses, config.member(config.robot).ends
    return not is_noisy or state.tick <= ends or state.elapsed < until


def _is_silent(state: RobotState) -> bool:
    """Return whether this robot takes its peer, which is in range, for lost."""
    return state.silence > PEER_LOST_AFTER


def refused(state: RobotState, robot: str) -> bool:
    """Return whether this robot, which waits for others, has had a meeting with `robot` that failed."""
    return state.waits and state.other(robot).failed


def with_pose(state: RobotState, claim: Localised) -> RobotState:
    """Return `state` of a robot that has determined its pose in the present meeting, and knows it now.

    It claims the pose, unless others have to confirm it. If this contradicts the pose that it knows, one of
    two peers has reported false data. A pose on which several meetings agree stays. One that follows from a
    single meeting is withdrawn, because nothing tells which of the two it was, and the robot waits for a
    third one. A planner of the user claims its pose once.
    """
    if state.own is not None and state.fix is not None:
        return state
    peer, fix, known = state.config.peer, state.fix, state.knowledge
    if state.config.confirms:
        earlier = [one for one in state.confirming.meetings if one.config.peer != peer]
        confirming = replace(state.confirming, meetings=(*earlier, known))
        fix = Fix(state.tick, claim, (peer,))
        return replace(state, fix=fix, located=known, confirming=confirming).with_frame(claim.pose)
    state = state.with_other(peer, replace(state.other(peer), localised=True))
    contradiction = _contradiction(state, claim)
    if contradiction is None:
        fix = Fix(state.tick, claim, (*(fix.peers if fix is not None else ()), peer))
        state = replace(state, fix=fix, located=known).with_frame(claim.pose)
        return state if state.robot_verdict is not None else replace(state, robot_verdict=claim)
    assert fix is not None
    if len(fix.peers) > 1:
        return _after_meeting(state)
    (other,) = fix.peers
    state = state.with_other(other, replace(state.other(other), failed=True))
    return replace(state, robot_verdict=None, fix=None, located=None, failure=contradiction)


def _contradiction(state: RobotState, claim: Localised) -> Undecided | None:
    """Return how `claim`, of the present meeting, contradicts the known pose; None if it does not.

    The claims of robots with exact sensors have no covariance, and are never wrong.
    """
    fix, mission = state.fix, state.config.mission
    if fix is None or claim.covariance is None:
        return None
    off = difference(fix.claim, fix.tick, claim, state.tick, state.log, mission)
    if off.p_value >= 1.0 - mission.confidence:
        return None
    return Undecided(
        f"{fix.peers[-1]} and {state.config.peer} contradict each other: by their reports, its pose differs "
        f"by {off.position:.3g} m and {off.heading:.3g} rad (p = {off.p_value:.2g})"
    )


def withdrawn(state: RobotState, failure: Undecided) -> RobotState:
    """Return `state` without a claim, because of `failure`: the robot waits for another one than its peer."""
    peer = state.config.peer
    state = replace(state, robot_verdict=None, fix=None, located=None, failure=failure, visiting=False)
    return _waiting(_after_meeting(state), peer)


def _is_withdrawn(state: RobotState) -> bool:
    """Return whether the present meeting contradicts an earlier one, so that the robot knows no pose."""
    return state.fix is None and state.robot_verdict is None and isinstance(state.verdict, Localised)


def after_refusal(state: RobotState) -> RobotState:
    """Return `state` of a robot whose peer has ended their meeting, because it contradicts what it knows."""
    if state.visiting:
        return next_visit(_after_meeting(state))
    failure = Undecided(f"{state.config.peer} does not go on with the meeting")
    if state.belief.phase1_done_tick is None:
        return without_peer(state, failure)
    return _resumed(_after_meeting(replace(state, failure=failure)))


def without_peer(state: RobotState, failure: Verdict) -> RobotState:
    """Return `state` of a robot in phase 1 that goes on with it, without its peer, because of `failure`."""
    return _after_meeting(replace(state, failure=failure))


def onward(state: RobotState, *, peer_has_left: bool = False) -> RobotState:
    """Return `state` in the next meeting if the present one is over.

    `peer_has_left` says that the peer has a result, and has reported it from outside the meeting.
    """
    peer = state.config.peer
    over = peer_has_left or _is_over(state)
    if _is_withdrawn(state):
        return _waiting(replace(_after_meeting(state), visiting=False), peer) if over else state
    if state.fix is None:
        return _after_failure(state)
    if state.sweeps:
        assert state.robot_verdict is not None
        swept = sweep.swept(state)
        done = Done(state.phase, state.robot_verdict)
        return swept or next_visit(replace(state, task=done))
    if state.visiting and state.verdict is None:
        if state.other(peer).localised and state.robot_verdict is not None:  # by another robot
            return next_visit(state)
        if visit.has_searched(state):
            other = replace(state.other(peer), missed=state.tick)
            return next_visit(state.with_other(peer, other))
        if _is_silent(state):
            return next_visit(_after_meeting(state))
        return state
    if not isinstance(state.task, Done) or _must_linger(state):
        return state
    if not isinstance(state.verdict, Localised):
        reported = state.lingering > 0 or not state.in_contact  # to the peer, before this robot leaves
        return next_visit(_after_meeting(state)) if reported else state
    return next_visit(state) if over else state


def _is_over(state: RobotState) -> bool:
    """Return whether the peer has a result in the present meeting, or is not there any more."""
    has_left = state.unmet >= PARTED_AFTER or _is_silent(state)
    return has_left or state.peer_state.verdict is not None


def rests(state: RobotState) -> bool:
    """Return whether the robot has its result, its meeting is over, and it has no robot to drive to."""
    if state.robot_verdict is None or not isinstance(state.task, Done) or _must_linger(state):
        return False
    return _is_over(state)


def _after_failure(state: RobotState) -> RobotState:
    """Return `state`, of a robot that is not localised: if its meeting has failed, it waits for another one.

    It gives up in the end, with the verdict of its latest meeting; at once if its own phase 1 has failed, or
    if its meetings with all others have.
    """
    config = state.config
    if state.belief.phase1_done_tick is None:
        return replace(state, robot_verdict=state.verdict)
    now = state.elapsed
    if now >= config.gives_up or (state.verdict is None and _has_nobody(state)):
        late = Undecided(f"not localised after {now:g} s")
        return replace(state, robot_verdict=state.verdict or state.failure or late)
    if state.verdict is not None:
        state = _resumed(_after_meeting(replace(state, failure=state.verdict)))
    elif _has_orbited(state) and (not state.in_contact or _is_silent(state)):
        state = _waiting(replace(state, until=None), config.peer)
    return _trying_again(state)


def _has_nobody(state: RobotState) -> bool:
    """Return whether the meetings of this robot with all others have failed."""
    own = state.config.robot
    return all(state.other(one.robot).failed for one in state.config.members if one.robot != own)


def _resumed(state: RobotState) -> RobotState:
    """Return `state` of a robot whose meeting has failed: in the retry that it has left, or waiting."""
    config = state.config
    if state.retries and state.fix is None:
        retry = config.retries[state.retries - 1]
        if not refused(state, retry.peer_of(config.robot)) and state.elapsed < retry.begins + retry.lasts:
            return _in_retry(state, retry)
    return _waiting(state, config.peer)


def _has_orbited(state: RobotState) -> bool:
    """Return whether this robot of role a searches for its peer in vain: the bound of their meeting is over.

    Beside its anchor, where it waits from then on, others find it.
    """
    config = state.config
    if config.role != "a":
        return False
    if state.until is not None:
        return state.elapsed >= state.until
    return state.tick > config.member(config.robot).ends


def _trying_again(state: RobotState) -> RobotState:
    """Return `state` of a robot that is not localised, in the retry whose time has come."""
    config = state.config
    if state.retries >= len(config.retries) or state.elapsed < config.retries[state.retries].begins:
        return state
    retry = config.retries[state.retries]
    state = replace(state, retries=state.retries + 1)
    # with its peer, which it has only been near so far, the robot meets in the roles of the retry
    peer = retry.peer_of(config.robot)
    begun = peer != config.peer or state.peer_state.latest >= 0
    if (begun and _is_met(state)) or refused(state, peer):
        return state
    return _in_retry(state, retry)


def _in_retry(state: RobotState, retry: Appointment) -> RobotState:
    """Return `state` in the meeting of `retry`, which has begun."""
    if retry.visited == state.config.robot:
        return _waiting(state, retry.visitor, retry.rendezvous)
    until = retry.begins + retry.lasts
    return replace(_aligned(_in_meeting(state, retry.visited, "a", retry.rendezvous)), until=until)


def _after_meeting(state: RobotState) -> RobotState:
    """Return `state` of a robot whose meeting has failed, and which does not meet its peer again."""
    peer = state.config.peer
    return state.with_other(peer, replace(state.other(peer), failed=True))


def _waiting(state: RobotState, peer: str, orbits: Rendezvous | None = None) -> RobotState:
    """Return `state` of a robot that waits beside its anchor, in a meeting with `peer`."""
    before, waits = state.task, state.config.role == "b"
    state = _in_meeting(state, peer, "b", orbits)
    if waits and isinstance(before, Orbiting | Aligning | Radial):
        return replace(state, task=before)
    return _aligned(state)


def _aligned(state: RobotState) -> RobotState:
    """Return `state` on the way to its orbit or waiting place; a planner of the user drives there itself."""
    if state.own is not None:
        return state
    mu = phase2_orbit.orientation(state.local_pose)
    return transitions.continue_phase2(state, Aligning(state.odometry.heading - mu))


def next_visit(state: RobotState) -> RobotState:
    """Return `state` on the way to the next robot; as it is if there is none.

    After the planned visits, and after its part of a sweep, it is the nearest one that should be localised by
    now, and has not reported it; of those that were not beside their anchors, the one for which that was
    longest ago. After all these, the robot sweeps the parts of others.
    """
    visits, config = state.visits, state.config
    while visits < len(config.visits):
        peer = config.visits[visits]
        visits += 1
        if not (state.other(peer).localised or state.other(peer).failed):
            return on_visit(replace(state, visits=visits), peer)
    state = replace(state, visits=visits)
    if config.confirms:
        return at_anchor(state)
    seeks = sweep.wanted(state)
    if seeks and state.parts == 0:
        return sweep.next_part(state)
    here, tick = compose(state.frame, state.odometry), state.tick
    late = [
        (_missed(state, one), math.hypot(one.anchor.x - here.x, one.anchor.y - here.y), one.robot)
        for one in config.members
        if one.ends < tick and one.robot != config.robot and _is_late(state, one)  # few are
        if not seeks or _missed(state, one) < state.part_tick  # one tour after each part
    ]
    if late:
        return on_visit(state, min(late)[2])
    return sweep.next_part(state) if seeks else state


def _missed(state: RobotState, member: Member) -> int:
    """Return the latest tick in which this robot has not found `member`; -1 if there is none."""
    missed = state.other(member.robot).missed
    return -1 if missed is None else missed


def _is_late(state: RobotState, member: Member) -> bool:
    """Return whether `member`, which should be localised by now, may still wait for a visitor.

    A robot that was not there is visited again after the time of the longest way: it may have been on its way
    back from its orbit.
    """
    other, config = state.other(member.robot), state.config
    apart = math.hypot(member.anchor.x - config.anchor.x, member.anchor.y - config.anchor.y)
    if other.localised or other.failed or apart < config.mission.orienting_distance:
        return False
    if other.missed is None:
        return True
    mission = config.mission
    return (state.tick - other.missed) * mission.period * mission.max_speed > config.widest_distance


def at_anchor(state: RobotState) -> RobotState:
    """Return `state` of a robot that returns to its anchor, and waits for any visitor."""
    return replace(_waiting(state, state.config.peer), alone=True)


def on_visit(state: RobotState, peer: str) -> RobotState:
    """Return `state` of a localised robot that drives to `peer`."""
    state = _in_meeting(state, peer, "a")
    return replace(state, task=Travelling(visit.stop(state)), visiting=True)


def _in_meeting(state: RobotState, peer: str, role: Role, orbits: Rendezvous | None = None) -> RobotState:
    """Return `state` in a new meeting with `peer`, of which the robot knows only its ranges to it."""
    state = state.with_other(state.config.peer, replace(state.other(state.config.peer), mutual=state.mutual))
    belief, mutual = state.belief, state.other(peer).mutual
    return replace(
        state,
        config=state.config.in_meeting(peer, role, orbits),
        mutual=mutual,
        in_contact=bool(mutual) and mutual[-1].tick == state.tick,
        belief=Belief(
            possible=belief.possible,
            branch=belief.branch,
            branch_kind=belief.branch_kind,
            phase1_done_tick=belief.phase1_done_tick,
            own_anchor=belief.own_anchor,
            own=belief.own,
            branches=belief.branches,
            ranges_at_last_fit=belief.ranges_at_last_fit,
            earlier_ranges=len(mutual),
        ),
        peer_state=PeerState(),
        task=Asleep(),
        plan=None,
        meeting=state.meeting + 1,
        alone=False,
        visiting=False,
        unmet=0,
        silence=0,
    )


def passing_others(state: RobotState, contacts: Sequence[Contact]) -> RobotState:
    """Return `state` on its way past the robots in contact that it does not meet, after a tick."""
    mission = state.config.mission
    if not mission.safety_distance:
        return state
    free = passing.leeway(contacts, state.config.peer if state.in_contact else None, mission)
    task = state.task
    if isinstance(task, Travelling) and passing.yielding(state.passing, _leading(state, contacts), mission):
        passed = replace(state.passing, leeway=0.0, blocked=0, yielded=state.passing.yielded + 1)
        return replace(state, passing=passed)
    passed = passing.passed(state.passing, task, state.odometry, free, mission)
    if isinstance(task, Travelling) and (passed.places or state.passing.places):
        places, tolerance = passed.places, state.estimator.pose_tolerance
        if places and towards(places[0], state.odometry, mission, tolerance) is None:
            places = places[1:]
        passed = replace(passed, places=places)
        task = Travelling(places[0] if places else visit.stop(state))
    return replace(state, task=task, passing=passed)


def _leading(state: RobotState, contacts: Sequence[Contact]) -> list[Contact]:
    """Return those of `contacts` that travel, too, and go first: those with smaller ids."""
    own = state.config.robot
    return [one for one in contacts if one.peer < own and state.other(one.peer).travels]


def _must_linger(state: RobotState) -> bool:
    """Return whether a robot whose meeting is over lets its peer leave first, as the visited one does.

    If both left at once, they could be in each other's way.
    """
    if not state.config.mission.safety_distance or state.config.role == "a" or not state.in_contact:
        return False
    if state.other(state.config.peer).travels:
        return state.lingering < PEER_LOST_AFTER
    return state.lingering < LINGERING
