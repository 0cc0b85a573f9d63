"""A robot of a group without an anchor, with noisy sensors: it waits until a localised robot finds it.

That robot, the finder, sends its pose at a reference tick with a covariance, and its odometry from then on.
Both drive loops in range of each other, and the ranges between them give the pose of this robot
(`contact_fit`). It claims it when one hypothesis is left, the fit is consistent, and the pose is as accurate
as the mission asks. A claim rests on the ranges to one finder since one reference tick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.claim import is_definite
from agent.estimation.compiled import library
from agent.estimation.gaussian.beacon_guesses import FEWEST_FOR_POSE
from agent.estimation.gaussian.contact_fit import ContactEstimate, ContactRanges, estimated
from agent.estimation.gaussian.gaussian_estimator import GAUSSIAN
from agent.estimation.gaussian.inference import path_of
from agent.estimation.judged import sufficient_mutual_ranges
from agent.peer import peer_state
from agent.peer.motion_log import MotionLog
from agent.planning import sweep
from agent.planning.phase3_last_manoeuvre import Standing
from agent.planning.planner import Planner, Summary
from agent.planning.state import MODE_NAMES
from agent.planning.sweep import Looping, Sweeping
from agent.planning.unanchored import WaitingState
from protocol.messages import (
    Command,
    Estimate,
    Localised,
    Observation,
    Ranged,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.mission import Mission
from protocol.motion import Covariance, Pose
from protocol.sweep_strips import OWN_SIDE
from protocol.sweep_ticks import contact_ticks

SWEEPING = MODE_NAMES[Sweeping]
"""The mode of a localised robot that looks for robots without an anchor."""

EACH = 3
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


class NoisyUnanchoredState(WaitingState, frozen=True):
    """The state of a robot without an anchor, with noisy sensors."""

    ranges: Mapping[str, tuple[Ranged, ...]] = {}
    """The latest ranges to each robot."""
    finder: Finder | None = None
    """The robot that has found it; None while there is none."""
    estimate: ContactEstimate | None = None
    """The latest estimate of the pose; None without one."""
    estimated_tick: int = -1
    """The tick of the latest estimate; -1 before the first."""
    ranges_at_estimate: int = 0
    """The number of ranges to the finder at the latest estimate."""
    failure: str = "no localised robot has found it"
    """The reason for which it has no claim yet."""

    @property
    def phase(self) -> int:
        """Return 2 until a localised robot has found it, then 3."""
        return 2 if self.finder is None else 3


class NoisyUnanchoredPlanner(Planner[NoisyUnanchoredState, Report]):
    """The planner of a robot without an anchor, with noisy sensors."""

    BODY = Report

    def start(self, config: RobotConfig) -> NoisyUnanchoredState:
        """Return the state of a robot that has measured nothing yet. Raises NoKernel."""
        library()  # it is needed when the robot is found, and would end the mission then
        return NoisyUnanchoredState(config)

    def observe(self, state: NoisyUnanchoredState, observation: Observation) -> NoisyUnanchoredState:
        """Return `state` with the odometry and the ranges of one tick."""
        state = state.after_odometry(observation)
        if state.verdict is not None:
            return state
        ranges = dict(state.ranges)
        for contact in observation.contacts:
            if contact.range is not None:
                first = observation.tick - _kept(state)
                recent = [each for each in ranges.get(contact.peer, ()) if each.tick > first]
                ranges[contact.peer] = (*recent, Ranged(observation.tick, contact.range))
        return replace(state, ranges=ranges)

    def report(self, state: NoisyUnanchoredState) -> Report:
        """Return the report to a robot that has not found it."""
        return state.report()

    def report_to(self, state: NoisyUnanchoredState, peer: str) -> Report:
        """Return the same report; to its finder, with the acknowledgement of the finder's manoeuvres."""
        report, finder = state.report(), state.finder
        return replace(report, heard=finder.log.through) if finder and finder.robot == peer else report

    def decide(self, state: NoisyUnanchoredState, reports: Sequence[Report] = ()) -> NoisyUnanchoredState:
        """Return `state` with the data in `reports`, and with a verdict if they determine the own pose."""
        if state.verdict is not None:
            return state
        if state.tick * state.config.mission.period >= state.config.gives_up:
            return replace(state, verdict=Undecided(state.failure))
        for report in reports:
            if (prior := report.prior) is not None and prior.covariance is not None:
                log = MotionLog(through=prior.tick)
                finder = Finder(report.robot, prior.tick, prior.pose, prior.covariance, log, report.tick)
                state = _with_finder(state, finder, report)
            elif state.finder is None and report.state == SWEEPING:
                why = f"{report.robot} has passed it, and does not know its own pose well enough"
                state = replace(state, failure=why)
        state = _estimated(state)
        return _moved_on(state) if state.verdict is None else state

    def command(self, state: NoisyUnanchoredState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return state.command(GAUSSIAN.pose_tolerance)

    def estimate(self, state: NoisyUnanchoredState) -> Estimate:
        """Return the poses in <W> that are possible in the tick of an estimate, the most probable first."""
        is_new = state.estimated_tick == state.tick or state.verdict is not None
        estimate = state.estimate if is_new else None
        return Estimate(
            tick=state.tick,
            robot=state.config.robot,
            local=(),
            world=estimate.poses if estimate is not None else (),
            localised=isinstance(state.verdict, Localised),
            probabilities=estimate.probabilities if estimate is not None else (),
            covariance=estimate.covariance if estimate is not None else None,
        )

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log or the pose in a report is malformed, or None."""
        if (prior := body.prior) is not None:
            if prior.tick > body.since:
                return f"a log from tick {body.since} on, before its pose at tick {prior.tick}"
            if prior.covariance is None or not is_definite(np.array(prior.covariance.matrix)):
                return "a covariance of a pose that is not positive definite"
        return peer_state.contradiction(body)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return sufficient_mutual_ranges(mission.noise)

    def summary(self, state: NoisyUnanchoredState) -> Summary:
        """Return the number of possible poses, the probability of the first, and what prevents a claim."""
        estimate = state.estimate
        if estimate is None:
            return Summary(blocking_reason=None if state.verdict is not None else state.failure)
        return Summary(
            hypotheses=len(estimate.poses),
            probability=estimate.probabilities[0],
            blocking_reason=None if isinstance(state.verdict, Localised) else state.failure,
            p_value=estimate.p_value,
        )


def _kept(state: NoisyUnanchoredState) -> int:
    """Return the ticks for which a range is kept, and after which a silent finder is forgotten."""
    return 2 * contact_ticks(state.config.mission)


def _with_finder(state: NoisyUnanchoredState, finder: Finder, report: Report) -> NoisyUnanchoredState:
    """Return `state` with the reference of `finder`, and the manoeuvres since then in its `report`.

    Another reference of the same finder counts if it is later, and another finder once the present one is
    silent or too inaccurate.
    """
    present = state.finder
    if present is not None and (present.robot, present.reference) != (finder.robot, finder.reference):
        accurate = present.covariance.position_sigma <= state.config.mission.accuracy
        if present.robot != finder.robot and accurate and present.latest > state.tick - _kept(state):
            return state
        if present.robot == finder.robot and present.reference > finder.reference:
            return state
        present = None
    if present is None:
        present, state = finder, replace(state, ranges_at_estimate=0, estimate=None)
    log = present.log.extended(report.since, 0, MotionLog(report.through, report.runs))
    return replace(state, finder=replace(present, log=log, latest=max(present.latest, report.tick)))


def _estimated(state: NoisyUnanchoredState) -> NoisyUnanchoredState:
    """Return `state` with an estimate if there are enough new ranges, and with a claim if it allows one."""
    finder, mission = state.finder, state.config.mission
    if finder is None:
        return state
    sigma = finder.covariance.position_sigma
    if sigma > mission.accuracy:
        why = f"{finder.robot} knows its position to {sigma:.3g} m, required {mission.accuracy:g}"
        return replace(state, failure=why)
    ends = finder.reference, min(finder.log.through, state.tick)
    ranges = tuple(
        [
            Ranged(one.tick - finder.reference, one.range)
            for one in state.ranges.get(finder.robot, ())
            if ends[0] <= one.tick <= ends[1]
        ]
    )
    if (
        len(ranges) < max(FEWEST_FOR_POSE, state.ranges_at_estimate + EACH)
        or state.tick < state.estimated_tick + EACH
    ):
        return state
    own = MotionLog(state.tick, state.log.between(finder.reference, state.tick))
    there, here = (path_of(log, 0, log.through, mission) for log in (finder.log, own))
    contact = ContactRanges(finder.pose, finder.covariance, there, here, ranges)
    estimate = estimated(contact, mission)
    state = replace(state, estimate=estimate, estimated_tick=state.tick, ranges_at_estimate=len(ranges))
    if estimate is None:
        return replace(state, failure=f"no pose explains the ranges to {finder.robot}")
    if estimate.blocking_reason:
        return replace(state, failure=f"{finder.robot} has found it: {estimate.blocking_reason}")
    return replace(state, verdict=Localised(estimate.poses[0], estimate.covariance))


def _moved_on(state: NoisyUnanchoredState) -> NoisyUnanchoredState:
    """Return `state` after a tick: in a loop while an accurate finder reports, else standing."""
    finder, mission = state.finder, state.config.mission
    if finder is None:
        return state
    if finder.latest <= state.tick - _kept(state):
        return replace(state, mode=Standing(), finder=None, estimate=None)
    if finder.covariance.position_sigma > mission.accuracy:
        return replace(state, mode=Standing())
    mode = state.mode
    if isinstance(mode, Looping):
        moved = sweep.onward(mode, state.odometry, mission, GAUSSIAN.pose_tolerance)
        if moved.places and isinstance(moved, Looping):
            return replace(state, mode=moved)
    if finder.latest <= state.tick - contact_ticks(mission) // 2:
        return replace(state, mode=Standing())
    side = OWN_SIDE * mission.sensing_range
    return replace(state, mode=sweep.looping_both_ways(state.odometry, side, side, state.tick))
