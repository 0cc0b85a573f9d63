"""The appointments of a robot of a group, in their order: visits, retries, coverage, and its own anchor."""

from __future__ import annotations

import math

from msgspec.structs import replace

from agent.estimation.knowledge import MeetingPosterior
from agent.peer.peer_state import PeerState
from agent.planning import phase2_orbit, searching, travelling
from agent.planning.state import RobotState
from agent.planning.tasks import Asleep, Orbital, Travelling
from protocol.messages import Appointment, Member, Undecided, Verdict
from protocol.mission import Role
from protocol.motion import compose
from protocol.orbits import Rendezvous

PEER_LOST_AFTER = 200
"""The ticks in contact without a report after which a robot takes its peer for lost."""


def next_visit(state: RobotState) -> RobotState:
    """Return `state` on the way to the next robot; as it is if there is none.

    After the planned visits and its part of the area, it is the nearest one that should be localised by now,
    and has not reported it; of those that were not beside their anchors, the one for which that was longest
    ago. After all these, the robot covers the parts of others.
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
    seeks = searching.wanted(state)
    if seeks and state.parts == 0:
        return searching.next_part(state)
    here, tick = compose(state.frame, state.odometry), state.tick
    late = [
        (state.other(one.robot).missed, math.hypot(one.anchor.x - here.x, one.anchor.y - here.y), one.robot)
        for one in config.members
        if one.ends < tick and one.robot != config.robot and _is_late(state, one)  # few are
        if not seeks or state.other(one.robot).missed < state.part_tick  # one tour after each part
    ]
    if late:
        return on_visit(state, min(late)[2])
    return searching.next_part(state) if seeks else state


def _is_late(state: RobotState, member: Member) -> bool:
    """Return whether `member`, which should be localised by now, may still wait for a visitor.

    A robot that was not there is visited again after the time of the longest way: it may have been on its way
    back from its orbit.
    """
    other, config = state.other(member.robot), state.config
    apart = math.hypot(member.anchor.x - config.anchor.x, member.anchor.y - config.anchor.y)
    if other.localised or other.failed or apart < config.mission.orienting_distance:
        return False
    if other.missed < 0:
        return True
    mission = config.mission
    return (state.tick - other.missed) * mission.period * mission.max_speed > config.widest_distance


def on_visit(state: RobotState, peer: str) -> RobotState:
    """Return `state` of a localised robot that drives to `peer`."""
    state = _in_meeting(state, peer, "a")
    return replace(state, task=Travelling(travelling.stop(state)), visiting=True)


def at_anchor(state: RobotState) -> RobotState:
    """Return `state` of a robot that returns to its anchor, and waits for any visitor."""
    return replace(waiting(state, state.config.peer), alone=True)


def after_failure(state: RobotState) -> RobotState:
    """Return `state`, of a robot that is not localised: if its meeting has failed, it waits for another one.

    It gives up in the end, with the verdict of its latest meeting; at once if its own phase 1 has failed, or
    if its meetings with all others have.
    """
    config = state.config
    if state.own_anchor.done_tick is None:
        return replace(state, robot_verdict=state.verdict)
    now, others = state.elapsed, [one.robot for one in config.members if one.robot != config.robot]
    if now >= config.gives_up or (state.verdict is None and all(state.other(one).failed for one in others)):
        late = Undecided(f"not localised after {now:g} s")
        return replace(state, robot_verdict=state.verdict or state.failure or late)
    if state.verdict is not None:
        state = resumed(parted(state, state.verdict))
    elif _has_orbited(state) and (not state.in_contact or is_silent(state)):
        state = waiting(replace(state, until=None), config.peer)
    return _trying_again(state)


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
    config, number = state.config, state.retries
    if number >= len(config.retries) or state.elapsed < config.retries[number].begins:
        return state
    retry, state = config.retries[number], replace(state, retries=number + 1)
    # with its peer, which it has only been near so far, the robot meets in the roles of the retry
    peer = retry.peer_of(config.robot)
    begun = peer != config.peer or state.peer_state.latest >= 0
    if (begun and is_met(state)) or refused(state, peer):
        return state
    return _in_retry(state, retry)


def resumed(state: RobotState) -> RobotState:
    """Return `state` of a robot whose meeting has failed: in the retry that it has left, or waiting."""
    config = state.config
    if state.retries and state.fix is None:
        retry = config.retries[state.retries - 1]
        if not refused(state, retry.peer_of(config.robot)) and state.elapsed < retry.begins + retry.lasts:
            return _in_retry(state, retry)
    return waiting(state, config.peer)


def _in_retry(state: RobotState, retry: Appointment) -> RobotState:
    """Return `state` in the meeting of `retry`, which has begun."""
    if retry.visited == state.config.robot:
        return waiting(state, retry.visitor, retry.rendezvous)
    meeting = _in_meeting(state, retry.visited, "a", retry.rendezvous)
    return replace(_aligned(meeting), until=retry.begins + retry.lasts)


def waiting(state: RobotState, peer: str, orbits: Rendezvous | None = None) -> RobotState:
    """Return `state` of a robot that waits beside its anchor, in a meeting with `peer`."""
    before, state = state, _in_meeting(state, peer, "b", orbits)
    waits = before.config.role == "b" and before.config.orbit == state.config.orbit
    return state.doing(before.task) if waits and isinstance(before.task, Orbital) else _aligned(state)


def _aligned(state: RobotState) -> RobotState:
    """Return `state` on the way to its orbit or waiting place; a planner of the user drives there itself."""
    if state.own_state is not None:
        return state
    return phase2_orbit.continued(state)


def _in_meeting(state: RobotState, peer: str, role: Role, orbits: Rendezvous | None = None) -> RobotState:
    """Return `state` in a new meeting with `peer`, of which the robot knows only its ranges to it."""
    mutual = state.ranges.get(peer, ())
    return replace(
        state,
        config=state.config.in_meeting(peer, role, orbits),
        in_contact=bool(mutual) and mutual[-1].tick == state.tick,
        posterior=MeetingPosterior(earlier_ranges=len(mutual)),
        peer_state=PeerState(),
        task=Asleep(),
        plan=None,
        meeting=state.meeting + 1,
        alone=False,
        visiting=False,
        parting=0,
        silence=0,
    )


def parted(state: RobotState, failure: Verdict | None = None) -> RobotState:
    """Return `state` of a robot whose meeting has failed, by `failure`, and which meets its peer no more."""
    failed = state.with_other(state.config.peer, failed=True)
    return replace(failed, failure=failure) if failure is not None else failed


def withdrawn(state: RobotState, peer: str, failure: Verdict) -> RobotState:
    """Return `state` after `failure`: the pose is unknown again, and the meeting with `peer` has failed."""
    return replace(state.with_other(peer, failed=True), robot_verdict=None, fix=None, failure=failure)


def is_met(state: RobotState) -> bool:
    """Return whether this robot is in contact with its peer, in a meeting that may still localise it.

    With noise, one that has not done so by its bound may never do so. Of exact ranges, a few suffice.
    """
    config = state.config
    if not state.in_contact or is_silent(state) or refused(state, config.peer):
        return False
    until = state.until if state.until is not None else 0.0
    is_noisy, ends = state.estimator.corrects_poses, config.member(config.robot).ends
    return not is_noisy or state.tick <= ends or state.elapsed < until


def is_silent(state: RobotState) -> bool:
    """Return whether this robot takes its peer, which is in range, for lost."""
    return state.silence > PEER_LOST_AFTER


def refused(state: RobotState, robot: str) -> bool:
    """Return whether this robot, which waits for others, has had a meeting with `robot` that failed."""
    return state.waits and state.other(robot).failed
