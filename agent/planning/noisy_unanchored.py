"""A robot of a group without an anchor, with noisy sensors: it waits until a localised robot finds it.

That robot, the finder, sends its pose at a reference tick with a covariance, and its odometry from then on.
Both drive loops in range of each other, and the ranges between them give the pose of this robot
(`contact_fit`). It claims it when one hypothesis is left, the fit is consistent, and the pose is as accurate
as the mission asks. A claim rests on the ranges to one finder since one reference tick.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.beacon_guesses import FEWEST_FOR_POSE
from agent.estimation.gaussian.contact_fit import ContactRanges, estimated
from agent.estimation.gaussian.inference import path_of
from agent.peer.motion_log import MotionLog
from agent.planning import sweep
from agent.planning.agenda import Contacted, Finder
from agent.planning.state import RobotState
from agent.planning.tasks import Awaiting, Done, Looping, Standing, Sweeping
from protocol.messages import Localised, Observation, Ranged, Report
from protocol.sweep_strips import OWN_SIDE
from protocol.sweep_ticks import contact_ticks

EACH = 3
"""The number of further ranges, and of ticks, after which the pose is estimated again.

Each estimate is a search of all poses. With 1, claims would come two ticks earlier, at three times the time.
The ticks bound the time that a robot takes which reports another reference in each tick.
"""


def ranged(state: RobotState, observation: Observation) -> RobotState:
    """Return `state` with the ranges of `observation`, without those that are too old."""
    for contact in observation.contacts:
        if contact.range is not None:
            other, first = state.other(contact.peer), observation.tick - _kept(state)
            recent = [each for each in other.mutual if each.tick > first]
            mutual = (*recent, Ranged(observation.tick, contact.range))
            state = state.with_other(contact.peer, mutual=mutual)
    return state


def decided(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """Return `state` with the data in `reports`, and with a verdict if they determine the own pose."""
    found = state.agenda.found
    assert isinstance(found, Contacted)
    for report in reports:
        if (prior := report.prior) is not None and prior.covariance is not None:
            log = MotionLog(through=prior.tick)
            finder = Finder(report.robot, prior.tick, prior.pose, prior.covariance, log, report.tick)
            found = _with_finder(state, found, finder, report)
        elif found.finder is None and report.state == Sweeping.name:
            why = f"{report.robot} has passed it, and does not know its own pose well enough"
            found = replace(found, failure=why)
    found, claim = _estimated(state, found)
    if claim is not None:
        return state.doing(Done(3, claim)).with_agenda(found=found)
    return _moved_on(state, found)


def _kept(state: RobotState) -> int:
    """Return the ticks for which a range is kept, and after which a silent finder is forgotten."""
    return 2 * contact_ticks(state.config.mission)


def _with_finder(state: RobotState, found: Contacted, finder: Finder, report: Report) -> Contacted:
    """Return `found` with the reference of `finder`, and the manoeuvres since then in its `report`.

    Another reference of the same finder counts if it is later, and another finder once the present one is
    silent or too inaccurate.
    """
    present = found.finder
    if present is not None and (present.robot, present.reference) != (finder.robot, finder.reference):
        accurate = present.covariance.position_sigma <= state.config.mission.accuracy
        if present.robot != finder.robot and accurate and present.latest > state.tick - _kept(state):
            return found
        if present.robot == finder.robot and present.reference > finder.reference:
            return found
        present = None
    if present is None:
        present, found = finder, replace(found, ranges_at_estimate=0, estimate=None)
    log = present.log.extended(report.since, 0, MotionLog(report.through, report.runs))
    return replace(found, finder=replace(present, log=log, latest=max(present.latest, report.tick)))


def _estimated(state: RobotState, found: Contacted) -> tuple[Contacted, Localised | None]:
    """Return `found` with an estimate if there are enough new ranges, and the claim if it allows one."""
    finder, mission = found.finder, state.config.mission
    if finder is None:
        return found, None
    sigma = finder.covariance.position_sigma
    if sigma > mission.accuracy:
        why = f"{finder.robot} knows its position to {sigma:.3g} m, required {mission.accuracy:g}"
        return replace(found, failure=why), None
    ends = finder.reference, min(finder.log.through, state.tick)
    ranges = tuple(
        [
            Ranged(one.tick - finder.reference, one.range)
            for one in state.other(finder.robot).mutual
            if ends[0] <= one.tick <= ends[1]
        ]
    )
    if (
        len(ranges) < max(FEWEST_FOR_POSE, found.ranges_at_estimate + EACH)
        or state.tick < found.estimated_tick + EACH
    ):
        return found, None
    own = MotionLog(state.tick, state.log.between(finder.reference, state.tick))
    there, here = (path_of(log, 0, log.through, mission) for log in (finder.log, own))
    estimate = estimated(ContactRanges(finder.pose, finder.covariance, there, here, ranges), mission)
    found = replace(found, estimate=estimate, estimated_tick=state.tick, ranges_at_estimate=len(ranges))
    if estimate is None:
        return replace(found, failure=f"no pose explains the ranges to {finder.robot}"), None
    if estimate.blocking_reason:
        return replace(found, failure=f"{finder.robot} has found it: {estimate.blocking_reason}"), None
    return found, Localised(estimate.poses[0], estimate.covariance)


def _moved_on(state: RobotState, found: Contacted) -> RobotState:
    """Return `state` after a tick: in a loop while an accurate finder reports, else standing."""
    finder, mission = found.finder, state.config.mission
    if finder is None:
        return state.doing(Awaiting()).with_agenda(found=found)
    if finder.latest <= state.tick - _kept(state):
        return state.doing(Awaiting()).with_agenda(found=replace(found, finder=None, estimate=None))
    state = state.with_agenda(found=found)
    if finder.covariance.position_sigma > mission.accuracy:
        return state.doing(Standing())
    if isinstance(state.task, Looping):
        moved = sweep.onward(state.task, state.odometry, mission, state.estimator.pose_tolerance)
        if moved.places and isinstance(moved, Looping):
            return state.doing(moved)
    if finder.latest <= state.tick - contact_ticks(mission) // 2:
        return state.doing(Standing())
    side = OWN_SIDE * mission.sensing_range
    return state.doing(sweep.looping_both_ways(state.odometry, side, side, state.tick))
