"""A robot of a group without an anchor: it waits until a localised robot finds it, and believes its pose.

With exact sensors, the other robot drives a square while this one stands still; that determines this robot's
position. Then this one drives a square, too; that determines its heading. The pose rests on the ranges to one
other robot, in the order of their ticks, so it does not depend on the order in which reports arrive. With
noisy sensors, both drive loops (`noisy_unanchored`).

If f robots may report false data, it claims a pose on which f + 1 of them agree, at least one of which is
honest. Until then, it waits for the next one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation import resection
from agent.estimation.claim import is_definite
from agent.estimation.compiled import library
from agent.estimation.judged import sufficient_mutual_ranges
from agent.estimation.resection import RangedPlace
from agent.peer import peer_state
from agent.planning import drive, exchange, meetings, noisy_unanchored, sweep
from agent.planning.agenda import Contacted, Resected
from agent.planning.planner import Planner, Summary
from agent.planning.state import RobotState
from agent.planning.sweep import LOOPS_FOR
from agent.planning.tasks import UNCONFIRMED, Awaiting, Done, Looping, Standing, Sweeping
from protocol.messages import Command, Estimate, Localised, Observation, Report, RobotConfig
from protocol.mission import Mission
from protocol.motion import ORIGIN, Pose, compose, inverse, wrap
from protocol.rounding import SURE

LARGEST_MISFIT = 0.1 * SURE
"""The largest difference in m between a measured range and the one that a possible pose predicts.

It is far above the rounding errors of the poses of both robots, and far below what a wrong pose predicts.
"""

KEPT = 64
"""The number of ticks for which a range is kept until the report of that tick arrives."""

AGREE = SURE
"""The largest difference in m and rad between poses that two robots confirm.

One of them is honest, so the error of both is smaller than the tolerance of a claim, 2 SURE.
"""

FEWEST_PLACES = 5
"""The number of relative placements that a claim needs: three for a position, two for a heading."""


class UnanchoredPlanner(Planner[RobotState, Report]):
    """The planner of a robot without an anchor."""

    BODY = Report
    REQUIRED_PLACES = FEWEST_PLACES

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet. Raises NoKernel."""
        state = RobotState(config, task=Awaiting())
        if not state.estimator.corrects_poses:
            return state.with_agenda(found=Resected())
        library()  # it is needed when the robot is found, and would end the mission then
        return state.with_agenda(found=Contacted())

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the odometry and the ranges of one tick."""
        state = exchange.observed(state, observation)
        if state.agenda.robot_verdict is not None:
            return meetings.with_ranges(state, observation) if _searches(state) else state
        match state.agenda.found:
            case Contacted():
                return noisy_unanchored.ranged(state, observation)
            case Resected(base=base) as found:
                # where it stands, rounding must not look like a motion
                moved = compose(inverse(base), state.odometry) if state.odometry != base else ORIGIN
                new = {
                    (contact.peer, observation.tick): (contact.range, moved)
                    for contact in observation.contacts
                    if contact.range is not None
                }
                first = observation.tick - KEPT
                recent = {key: contact for key, contact in found.ranges.items() if key[1] > first}
                return state.with_agenda(found=replace(found, ranges={**recent, **new})) if new else state
        raise AssertionError

    def report(self, state: RobotState) -> Report:
        """Return the report to a robot that has not found it: without a log, as it is in no meeting."""
        return exchange.report_without_log(state, state.agenda.robot_verdict)

    def report_to(self, state: RobotState, peer: str) -> Report:
        """Return the report to `peer`: with noisy sensors, it acknowledges the manoeuvres of its finder.

        With exact sensors, a robot by which it knows a pose does not stop any longer. Once localised, it
        reports its pose to others without an anchor.
        """
        if _searches(state):
            return sweep.outside_meeting(state, peer)
        report = self.report(state)
        match state.agenda.found:
            case Contacted(finder) if finder is not None and finder.robot == peer:
                return replace(report, heard=finder.log.through)
            case Resected(candidates=candidates) if state.verdict is None and peer in candidates:
                return replace(report, state=UNCONFIRMED)
        return report

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the data in `reports`, and with a verdict if they determine the own pose.

        With exact sensors, a robot that is localised looks for the others without an anchor.
        """
        if state.agenda.robot_verdict is None:
            state = self._found(state, reports)
            state = state if state.verdict is None else state.with_agenda(robot_verdict=state.verdict)
        return _searching(state, reports) if _searches(state) else state

    def _found(self, state: RobotState, reports: Sequence[Report]) -> RobotState:
        """Return `state` of a robot that is not localised yet, with the data in `reports`."""
        match state.agenda.found:
            case Contacted() as found:
                if state.elapsed >= state.config.gives_up:
                    return state.undecided(found.failure)
                return noisy_unanchored.decided(state, reports)
            case Resected() as found:
                if state.elapsed >= state.config.gives_up:
                    return state.undecided(_why_undecided(state, found))
                return _decided(state, found, reports)
        raise AssertionError

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        command = exchange.command(state, drive.controls(state))
        return replace(command, peer=None, role=None, verdict=state.agenda.robot_verdict)

    def estimate(self, state: RobotState) -> Estimate:
        """Return the possible poses in <W>.

        With noisy sensors, they are those of the latest estimate; with exact ones, those that agree with all
        ranges, or that robots have not confirmed yet.
        """
        estimate = Estimate(
            tick=state.tick,
            robot=state.config.robot,
            local=(),
            world=(),
            localised=isinstance(state.agenda.robot_verdict, Localised),
        )
        match state.agenda.found:
            case Contacted(estimate=latest) as found:
                if latest is None or (found.estimated_tick != state.tick and state.verdict is None):
                    return estimate
                return replace(
                    estimate,
                    world=latest.poses,
                    probabilities=latest.probabilities,
                    covariance=latest.covariance,
                )
            case Resected(possible=possible, candidates=candidates) as found:
                world = [_now(state, found, one) for one in possible]
                if not world:
                    world = [compose(candidates[robot], state.odometry) for robot in sorted(candidates)]
                return replace(estimate, world=tuple(world))
        raise AssertionError

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log or the pose in a report is malformed, or None."""
        if (prior := body.prior) is not None and prior.covariance is not None:
            if prior.tick > body.since:
                return f"a log from tick {body.since} on, before its pose at tick {prior.tick}"
            if not is_definite(np.array(prior.covariance.matrix)):
                return "a covariance of a pose that is not positive definite"
        return peer_state.contradiction(body)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return sufficient_mutual_ranges(mission.noise)

    def summary(self, state: RobotState) -> Summary:
        """Return the number of possible poses; with noisy sensors also what prevents a claim."""
        match state.agenda.found:
            case Resected() as found:
                return Summary(hypotheses=len(found.possible) or len(found.candidates) or None)
            case Contacted(estimate=estimate) as found:
                if estimate is None:
                    return Summary(blocking_reason=None if state.verdict is not None else found.failure)
                return Summary(
                    hypotheses=len(estimate.poses),
                    probability=estimate.probabilities[0],
                    blocking_reason=None if isinstance(state.verdict, Localised) else found.failure,
                    p_value=estimate.p_value,
                )
        raise AssertionError


# --- exact sensors --------------------------------------------------------------------------------------


def _decided(state: RobotState, found: Resected, reports: Sequence[Report]) -> RobotState:
    """Return `state` with the poses in `reports`, and with what follows from them."""
    ranges, places = dict(found.ranges), dict(found.places)
    if not isinstance(state.task, Looping):  # a robot that comes back may have corrected its pose
        places = {key: report for key, report in places.items() if key[1] > state.tick - LOOPS_FOR}
    for report in reports:
        if (prior := report.prior) is None or report.robot in found.candidates:
            continue
        if (ranged := ranges.pop((report.robot, prior.tick), None)) is not None:
            distance, odometry = ranged
            places[report.robot, prior.tick] = RangedPlace((prior.pose.x, prior.pose.y), odometry, distance)
    if places.keys() != found.places.keys():
        state = _resected(state, replace(found, ranges=ranges, places=places))
    assert isinstance(state.agenda.found, Resected)
    return _moved_on(state, state.agenda.found) if state.verdict is None else state


def _now(state: RobotState, found: Resected, base: Pose) -> Pose:
    """Return the present pose in <W> if that of `found.base` is `base`."""
    return compose(base, compose(inverse(found.base), state.odometry))


def _resected(state: RobotState, found: Resected) -> RobotState:
    """Return `state` with what follows from the ranges to each robot: a square to drive, or a verdict."""
    for robot in sorted({robot for robot, _ in found.places} - found.candidates.keys()):
        ranged = [found.places[key] for key in sorted(found.places) if key[0] == robot]
        standing = [one for one in ranged if one.odometry == ORIGIN]
        moved = [one for one in ranged if one.odometry != ORIGIN]
        if not isinstance(state.task, Looping):
            positions = resection.positions(standing, LARGEST_MISFIT)
            if len(positions) == 1 and resection.is_fixed(standing, positions[0]):
                task = sweep.looping(state.odometry, state.config.mission, state.tick)
                return state.doing(task).with_agenda(found=found)
        elif moved and (possible := resection.poses(standing, moved, LARGEST_MISFIT)):
            found = replace(found, possible=possible)
            if resection.is_certain(standing, moved, possible):
                state, found = _with_candidate(state, found, robot)
                if state.verdict is not None:
                    break
    return state.with_agenda(found=found)


def _with_candidate(state: RobotState, found: Resected, robot: str) -> tuple[RobotState, Resected]:
    """Return both with the first possible pose, which follows from the reports of `robot`.

    It is claimed if as many robots agree on it as are needed for one of them to be honest.
    """
    pose = _now(state, found, found.possible[0])
    others = [compose(one, state.odometry) for by, one in found.candidates.items() if by != robot]
    found = replace(found, candidates={**found.candidates, robot: compose(pose, inverse(state.odometry))})
    if 1 + sum([_agree(pose, other) for other in others]) > state.config.tolerates:
        state = state.doing(Done(3, Localised(pose))).with_frame(pose)
    return state, found


def _searches(state: RobotState) -> bool:
    """Return whether the robot is localised and looks for others that have no anchor.

    With noisy sensors it cannot, because it has no anchor and no beacon that correct its odometry. If robots
    may report false data, its pose is not independent of those that have found it.
    """
    claimed = isinstance(state.agenda.robot_verdict, Localised)
    return claimed and not (state.estimator.corrects_poses or state.config.tolerates)


def _searching(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """Return `state` of a localised robot that looks for others, first in strips that its finder leaves it.

    It begins when its finder, in range, has heard that it is localised, and reports no pose any more.
    """
    for one in reports:
        state = meetings.with_sender(state, one)
    if state.agenda.parts == 0:
        offered = [one.strips for one in reports if one.strips is not None]
        state = sweep.second_half(state, offered[0]) if offered else state
    if any(one.prior is not None for one in reports) and not isinstance(state.task, Sweeping):
        return state
    if state.sweeps:
        swept = sweep.swept(state)
        if swept is not None:
            return swept
        assert state.agenda.robot_verdict is not None
        state = state.doing(Done(3, state.agenda.robot_verdict))
    return sweep.next_part(state) if sweep.wanted(state) else state


def _agree(one: Pose, other: Pose) -> bool:
    """Return whether two poses are the same to AGREE."""
    apart = math.hypot(one.x - other.x, one.y - other.y)
    return max(apart, abs(wrap(one.heading - other.heading))) <= AGREE


def _why_undecided(state: RobotState, found: Resected) -> str:
    """Return why the robot has not claimed a pose, for a user."""
    if not found.candidates:
        return "no localised robot has found it"
    finders = ", ".join(sorted(found.candidates))
    return f"{state.config.tolerates + 1} robots must agree on its pose; it is found by: {finders}"


def _moved_on(state: RobotState, found: Resected) -> RobotState:
    """Return `state` after a tick of a square. The square is repeated until the pose is known.

    If nobody has reported a pose for KEPT ticks, except robots by which it knows a pose, the robot stands
    still again, and forgets all ranges: those to the next robot that comes begin where it is then.
    """
    if not isinstance(state.task, Looping):
        return state.doing(Standing() if found.places or found.candidates else Awaiting())
    mission, since, tolerance = state.config.mission, state.task.since, state.estimator.pose_tolerance
    task = sweep.onward(state.task, state.odometry, mission, tolerance)
    if task.places:
        return state.doing(task)
    latest = max([tick for robot, tick in found.places if robot not in found.candidates], default=-KEPT)
    if latest > state.tick - KEPT and since > state.tick - LOOPS_FOR:
        return state.doing(sweep.looping(state.odometry, mission, since))
    found = Resected(state.odometry, candidates=found.candidates)
    return state.doing(Standing() if found.candidates else Awaiting()).with_agenda(found=found)
