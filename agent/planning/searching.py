"""A localised robot that looks for robots without an anchor: where it sweeps, and for whom it stops.

With noisy sensors, the visitor of a last meeting sweeps a part of the area. The robot that it has visited
stays where it is, and is its beacon: before each two strips, the sweeping robot passes its own anchor and its
beacon, so that it knows its pose again (`own_pose`). Where it comes into range of a robot without an anchor,
it reports its pose with the covariance, which stay fixed during the contact, and its odometry from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from msgspec.structs import replace

from agent.planning import exchange, own_pose, sweep
from agent.planning.agenda import Other
from agent.planning.state import RobotState
from agent.planning.tasks import Done, Looping, Sweeping, transformed
from protocol.messages import Localised, Report, ReportedPose
from protocol.motion import inverse
from protocol.sweep_strips import ALONG, ASIDE, STRIP_REACH, surveyed_path
from protocol.sweep_ticks import contact_ticks

LINGER = 10
"""The ticks without a range to robots without an anchor after which a contact with them is over."""

WORTH = 0.9
"""The largest sigma of its position with which a robot stops for another one, in units of the accuracy.

The ranges between them add to it: with a larger one, the other robot can make no claim.
"""

LOOPS_FOR = 200
"""The ticks after which robots stop driving squares that have localised nobody: the other one may be dead."""


def wanted(state: RobotState) -> bool:
    """Return whether there are robots without an anchor that this robot can still help."""
    return any(is_helped(state, robot) for robot in state.config.unanchored)


def is_helped(state: RobotState, robot: str) -> bool:
    """Return whether `robot` has no anchor, and still needs the poses of this robot, as far as it knows."""
    other = state.other(robot)
    finished = other.localised or other.served or robot == state.config.robot
    return robot in state.config.unanchored and not finished


def takes_part(state: RobotState) -> bool:
    """Return whether a robot without an anchor is localised, and looks for the others that have none."""
    return isinstance(state.agenda.robot_verdict, Localised) and sweep.shares(state)


def has_beacon(state: RobotState) -> bool:
    """Return whether the robot sweeps with its latest peer as a beacon, which goes on to get its log."""
    return state.sweeps and sweep.reports_covariance(state)


def is_apart(state: RobotState) -> bool:
    """Return whether the robot is in no meeting any more: it sweeps, or is the beacon of one that does.

    A beacon stays where it is: it sweeps no part, and its planned meetings are over.
    """
    config, agenda = state.config, state.agenda
    if state.sweeps or not sweep.reports_covariance(state):
        return state.sweeps
    assert config.sweep is not None
    if config.part < config.sweep.parts or agenda.visits < len(config.visits):
        return False
    return isinstance(state.verdict, Localised) and isinstance(agenda.robot_verdict, Localised)


def outside_meeting(state: RobotState, peer: str) -> Report:
    """Return the report to `peer` outside a meeting: this robot's verdict, and the strips that it sweeps.

    A robot without an anchor gets the pose of a localised one until it has determined its own by it: the
    present one, or with noisy sensors the reference of this contact, and the log since.
    """
    agenda = state.agenda
    report = replace(exchange.report_without_log(state, agenda.robot_verdict), strips=sweep.strips(state))
    if not (is_helped(state, peer) and isinstance(agenda.robot_verdict, Localised)):
        return report
    if not sweep.reports_covariance(state):
        return replace(report, prior=ReportedPose(state.tick, exchange.reported_pose(state, agenda.frame)))
    reference = agenda.own_pose.reference
    if reference is None:
        return report
    since = max(reference.tick, min(state.other(peer).acknowledged, state.log.through))
    part = state.log.after(since, len(state.log.ranges))
    return replace(report, since=since, through=part.through, runs=part.runs, prior=reference)


def next_part(state: RobotState) -> RobotState:
    """Return `state` of a localised robot that sweeps the next part of the area, its own one first.

    It stops again for robots that it has left before. A beacon sweeps no part, and stays where it is.
    """
    config = state.config
    assert config.sweep is not None
    for robot in config.unanchored:
        state = state.with_other(robot, failed=False)
    part = (config.part + state.agenda.parts) % config.sweep.parts
    state = state.with_agenda(part_tick=state.tick, visiting=False, unmet=0, silence=0)
    if not sweep.reports_covariance(state):
        return sweep.along(state, config.sweep.strips_of(part, config.mission.sensing_range))
    state = state.with_agenda(parts=state.agenda.parts + 1)
    if config.part >= config.sweep.parts:
        assert state.agenda.robot_verdict is not None
        return state.doing(Done(3, state.agenda.robot_verdict))
    located = state.agenda.located
    assert located is not None
    # after a visit in vain, or one that contradicts what this robot knows
    if not state.belief.pair or config.peer != located.config.peer:
        state = replace(
            state,
            config=located.config,
            mutual=located.mutual,
            own_anchor=located.own_anchor,
            belief=located.belief,
            peer_state=located.peer_state,
        )
    due = replace(state.agenda.own_pose, estimated_tick=None, reference=None)
    state = own_pose.updated(state.with_agenda(own_pose=due))
    anchor, beacon = state.config.anchor, own_pose.beacon_place(state)
    path = surveyed_path(config.sweep, part, config.mission.sensing_range, (anchor.x, anchor.y), beacon)
    return state.doing(Sweeping(transformed(inverse(state.agenda.frame), path)))


# --- contacts -----------------------------------------------------------------------------------------


def swept(state: RobotState) -> RobotState:
    """Return `state` after a tick of a sweep, or of a contact with robots without an anchor.

    With exact sensors, it stops for all that are near. With noisy ones, it stops where its own pose is known
    well enough; its verdict is Undecided if that contradicts its claim.
    """
    mission, helped = state.config.mission, _helped(state)
    if sweep.reports_covariance(state):
        state = _with_contact(own_pose.updated(state), helped)
        if state.verdict is not None:
            return state
        helped = [one for one in helped if _ticks_since(state, one) <= LINGER]
        sides = ALONG * mission.sensing_range, ASIDE * mission.sensing_range
        loop = partial(sweep.looping_both_ways, state, *sides)
        stops, longest = any(_stops_for(state, one) for one in helped), contact_ticks(mission)
    else:
        helped = [one for one in helped if _is_near(state, one)]
        loop, stops, longest = partial(sweep.looping, state), bool(helped), LOOPS_FOR
    state = sweep.moved_on(state, helped, loop, stops=stops, longest=longest)
    return _with_reference(state, None) if sweep.is_over(state) else state


def _with_contact(state: RobotState, helped: Sequence[str]) -> RobotState:
    """Return `state` with a reference if a contact has begun in this tick, and without one at its end."""
    ticks = [_ticks_since(state, one) for one in helped]
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


def _helped(state: RobotState) -> list[str]:
    """Return the robots without an anchor that are not localised, and with which no contact has failed."""
    return [one for one in state.config.unanchored if is_helped(state, one) and not state.other(one).failed]


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


def _is_near(state: RobotState, robot: str) -> bool:
    """Return whether this robot is near enough to `robot` to drive a square, or drives one already."""
    near = STRIP_REACH * state.config.mission.sensing_range
    if _ticks_since(state, robot) > 0:
        return False
    return isinstance(state.task, Looping) or state.other(robot).mutual[-1].range <= near
