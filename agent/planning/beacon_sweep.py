"""The sweep of a robot with noisy sensors, which keeps its pose by its own anchor and by a beacon.

The visitor of a last meeting sweeps a part of the area. The robot that it has visited stays where it is, and
is its beacon: before each two strips, the sweeping robot passes its own anchor and its beacon, so that it
knows its pose again (`own_pose`). Where it comes into range of a robot without an anchor, it reports its pose
with the covariance, which stay fixed during the contact, and its odometry from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from msgspec.structs import replace

from agent.planning import own_pose, sweep
from agent.planning.agenda import Other
from agent.planning.state import RobotState
from agent.planning.sweep import LINGER, ticks_since
from agent.planning.tasks import Done, Sweeping, transformed
from protocol.messages import Localised, Report, ReportedPose
from protocol.motion import inverse
from protocol.sweep_strips import ALONG, ASIDE, STRIP_REACH, surveyed_path
from protocol.sweep_ticks import contact_ticks

WORTH = 0.9
"""The largest sigma of its position with which a robot stops for another one, in units of the accuracy.

The ranges between them add to it: with a larger one, the other robot can make no claim.
"""


def told(state: RobotState, peer: str, report: Report) -> Report:
    """Return `report` with the reference of this contact, if there is one, and the log since then."""
    reference = state.agenda.own_pose.reference
    if reference is None:
        return report
    since = max(reference.tick, min(state.other(peer).acknowledged, state.log.through))
    part = state.log.after(since, len(state.log.ranges))
    return replace(report, since=since, through=part.through, runs=part.runs, prior=reference)


def begun(state: RobotState, part: int) -> RobotState:
    """Return `state` at the begin of the sweep of a part. A beacon sweeps none, and stays where it is."""
    config, fix = state.config, state.agenda.fix
    assert config.sweep is not None
    if config.part >= config.sweep.parts:
        assert state.agenda.robot_verdict is not None
        return state.doing(Done(3, state.agenda.robot_verdict))
    assert fix is not None
    known = fix.known
    # after a visit in vain, or one that contradicts what this robot knows
    if not state.belief.pair or config.peer != known.config.peer:
        state = replace(
            state,
            config=known.config,
            mutual=known.mutual,
            own_anchor=known.own_anchor,
            belief=known.belief,
            peer_state=known.peer_state,
        )
    due = replace(state.agenda.own_pose, estimated_tick=None, reference=None)
    state = own_pose.updated(state.with_agenda(own_pose=due))
    anchor, beacon = state.config.anchor, own_pose.beacon_place(state)
    path = surveyed_path(config.sweep, part, config.mission.sensing_range, (anchor.x, anchor.y), beacon)
    return state.doing(Sweeping(transformed(inverse(state.agenda.frame), path)))


def after_tick(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` after a tick of a sweep, in which it stops where its own pose is known well enough.

    Its verdict is Undecided if that contradicts its claim. The robots `helped` have no anchor.
    """
    mission, state = state.config.mission, _with_contact(own_pose.updated(state), helped)
    if state.verdict is not None:
        return state
    helped = [one for one in helped if ticks_since(state, one) <= LINGER]
    stops = any(_stops_for(state, one) for one in helped)
    loop = partial(
        sweep.looping_both_ways, state, ALONG * mission.sensing_range, ASIDE * mission.sensing_range
    )
    state = sweep.moved_on(state, helped, loop, stops=stops, longest=contact_ticks(mission))
    return _with_reference(state, None) if sweep.is_over(state) else state


def _with_contact(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [ticks_since(state, one) for one in helped]
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
    fix = state.agenda.fix
    assert fix is not None
    off = own_pose.contradiction(state, Localised(reference.pose, reference.covariance))
    if off is None:
        return _with_reference(state, reference)
    if len(fix.peers) > 1:
        return state
    return state.undecided(f"its ranges since its claim contradict it by {off}")


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
