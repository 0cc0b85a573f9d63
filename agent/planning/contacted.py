"""A robot without an anchor that determines its pose by a joint fit with the robot that has found it.

That robot, the finder, sends its pose at a reference tick with a covariance, and its odometry from then on.
Both drive loops in range of each other, and the ranges between them give the pose of this robot
(`contact_fit`). It claims it when one hypothesis is left, the fit is consistent, and the pose is as accurate
as the mission asks. A claim rests on the ranges to one finder since one reference tick.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from agent.estimation.gaussian.beacon_guesses import FEWEST_FOR_POSE
from agent.estimation.gaussian.contact_fit import ContactEstimate, contact_measurements, estimated
from agent.estimation.gaussian.mission_measurements import path_of
from agent.peer.motion_log import MotionLog
from agent.planning import coverage
from agent.planning.planner import Summary
from agent.planning.state import RobotState
from agent.planning.tasks import Awaiting, Covering, Done, Looping, Standing
from protocol.coverage_strips import OWN_SIDE
from protocol.coverage_ticks import contact_ticks
from protocol.messages import Estimate, Localised, Report
from protocol.motion import Covariance, Pose

ESTIMATED_EACH = 3
"""The number of further ranges, and of ticks, after which the pose is estimated again.

Each estimate is a search of all poses. With 1, claims would come two ticks earlier, at three times the time.
The ticks bound the time that a robot takes which reports another reference in each tick.
"""


class Finder(msgspec.Struct, frozen=True):
    """The localised robot that has found one without an anchor, as far as the latter knows it."""

    robot: str
    reference: int
    """The tick of `pose`."""
    pose: Pose
    """The pose of the finder at that tick in <W>, as it has estimated it."""
    covariance: Covariance
    """The covariance of the error of `pose`."""
    log: MotionLog
    """The manoeuvres of that robot from the reference tick on."""
    latest: int
    """The tick of its latest report."""


class Contacted(msgspec.Struct, frozen=True):
    """The robot that has found it, with the covariance of its pose, and the fit of the ranges to it."""

    finder: Finder | None = None
    """The robot that has found it; None while there is none."""
    fit: ContactEstimate | None = None
    """The latest estimate of the pose; None without one."""
    estimated_tick: int = -1
    """The tick of the latest estimate; -1 before the first."""
    ranges_at_estimate: int = 0
    """The number of ranges to the finder at the latest estimate."""
    failure: str = "no localised robot has found it"
    """The reason for which it has no claim yet."""

    def informed(self, state: RobotState, reports: Sequence[Report]) -> RobotState:
        """Return `state` with the data in `reports`, and with a verdict if they determine the own pose."""
        found = self
        for report in reports:
            if (prior := report.prior) is not None and prior.covariance is not None:
                log = MotionLog(through=prior.tick)
                finder = Finder(report.robot, prior.tick, prior.pose, prior.covariance, log, report.tick)
                found = _with_finder(state, found, finder, report)
            elif found.finder is None and report.state == Covering.name:
                why = f"{report.robot} has passed it, and does not know its own pose well enough"
                found = replace(found, failure=why)
        found, claim = _estimated(state, found)
        if claim is not None:
            return replace(state, task=Done(3, claim), found=found)
        return _moved_on(state, found)

    def answered(self, report: Report, peer: str) -> Report:
        """Return `report` to `peer`: it acknowledges the manoeuvres of the finder."""
        finder = self.finder
        return replace(report, heard=finder.log.through) if finder and finder.robot == peer else report

    def why_undecided(self, state: RobotState) -> str:
        """Return why the robot has not claimed a pose, for a user."""
        del state
        return self.failure

    def estimate(self, state: RobotState, of_tick: Estimate) -> Estimate:
        """Return `of_tick` with the hypotheses of the latest fit."""
        latest = self.fit
        if latest is None or (self.estimated_tick != state.tick and state.verdict is None):
            return of_tick
        return replace(
            of_tick, world=latest.poses, probabilities=latest.probabilities, covariance=latest.covariance
        )

    def summary(self, state: RobotState) -> Summary:
        """Return the number of hypotheses, and what prevents a claim."""
        latest = self.fit
        if latest is None:
            return Summary(blocking_reason=None if state.verdict is not None else self.failure)
        return Summary(
            hypotheses=len(latest.poses),
            probability=latest.probabilities[0],
            blocking_reason=None if isinstance(state.verdict, Localised) else self.failure,
            p_value=latest.p_value,
        )


def _kept(state: RobotState) -> int:
    """Return the ticks for which a range counts, and after which a silent finder is forgotten."""
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
        present, found = finder, replace(found, ranges_at_estimate=0, fit=None)
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
    first, last = max(finder.reference, state.tick - _kept(state) + 1), min(finder.log.through, state.tick)
    ranges = [
        (one.tick - finder.reference, one.range)
        for one in state.ranges.get(finder.robot, ())
        if first <= one.tick <= last
    ]
    if (
        len(ranges) < max(FEWEST_FOR_POSE, found.ranges_at_estimate + ESTIMATED_EACH)
        or state.tick < found.estimated_tick + ESTIMATED_EACH
    ):
        return found, None
    own = state.log.between(finder.reference, state.tick)
    paths = path_of(finder.log.runs, 0, finder.log.through, mission), path_of(own, 0, state.tick, mission)
    estimate = estimated(
        contact_measurements(finder.pose, finder.covariance, paths, ranges, mission), mission
    )
    found = replace(found, fit=estimate, estimated_tick=state.tick, ranges_at_estimate=len(ranges))
    if estimate is None:
        return replace(found, failure=f"no pose explains the ranges to {finder.robot}"), None
    if estimate.blocking_reason:
        return replace(found, failure=f"{finder.robot} has found it: {estimate.blocking_reason}"), None
    return found, Localised(estimate.poses[0], estimate.covariance)


def _moved_on(state: RobotState, found: Contacted) -> RobotState:
    """Return `state` after a tick: in a loop while an accurate finder reports, else standing."""
    finder, mission = found.finder, state.config.mission
    if finder is None:
        return replace(state, task=Awaiting(), found=found)
    if finder.latest <= state.tick - _kept(state):
        return replace(state, task=Awaiting(), found=replace(found, finder=None, fit=None))
    state = replace(state, found=found)
    if finder.covariance.position_sigma > mission.accuracy:
        return state.doing(Standing())
    if isinstance(state.task, Looping):
        moved = coverage.onward(state, state.task)
        if moved.places and isinstance(moved, Looping):
            return state.doing(moved)
    if finder.latest <= state.tick - contact_ticks(mission) // 2:
        return state.doing(Standing())
    side = OWN_SIDE * mission.sensing_range
    return state.doing(coverage.looping_both_ways(state, side, side, state.tick))
