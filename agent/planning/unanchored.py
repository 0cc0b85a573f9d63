"""A robot of a group without an anchor: it waits until a localised robot finds it, and believes its pose.

The other robot drives a square while this one stands still; that determines this robot's position. Then this
one drives a square, too; that determines its heading. The pose rests on the ranges to one other robot, in the
order of their ticks, so it does not depend on the order in which reports arrive.

If f robots may report false data, it claims a pose on which f + 1 of them agree, at least one of which is
honest. Until then, it waits for the next one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Self

import msgspec
from msgspec.structs import replace

from agent.estimation import resection
from agent.estimation.exact_estimator import EXACT_ESTIMATOR
from agent.estimation.resection import RangedPlace
from agent.peer.motion_log import MotionLog
from agent.planning import exchange, sweep
from agent.planning.phase3_last_manoeuvre import Standing
from agent.planning.planner import Planner, Summary
from agent.planning.state import MODE_NAMES, UNCONFIRMED
from agent.planning.sweep import LOOPS_FOR, Looping
from protocol.messages import (
    Command,
    Estimate,
    Localised,
    Observation,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.mission import Mission
from protocol.motion import ORIGIN, REST, Pose, compose, inverse, wrap
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


class WaitingState(msgspec.Struct, frozen=True):
    """The state of a robot without an anchor, with exact and with noisy sensors."""

    config: RobotConfig
    tick: int = -1
    odometry: Pose = ORIGIN
    """The pose by dead reckoning, in the frame of the pose at tick 0."""
    leg: Pose = ORIGIN
    """The odometry at the beginning of the last segment of `log`."""
    log: MotionLog = MotionLog()
    mode: Standing | Looping = Standing()
    verdict: Localised | Undecided | None = None

    @property
    def phase(self) -> int:
        """Return 2 until a localised robot has found it, then 3."""
        raise NotImplementedError

    @property
    def mode_name(self) -> str:
        """Return the name of the mode that reports, commands and recordings use."""
        match self.verdict:
            case Localised():
                return "localised"
            case Undecided():
                return "undecided"
        return MODE_NAMES[type(self.mode)]

    def after_odometry(self, observation: Observation) -> Self:
        """Return this state in the tick of `observation`, with its odometry."""
        log, odometry, leg = exchange.dead_reckoned(
            self.log, self.odometry, self.leg, observation.executed, self.config.mission.period
        )
        return replace(self, tick=observation.tick, odometry=odometry, leg=leg, log=log)

    def report(self) -> Report:
        """Return a report without a log: a robot without an anchor is in no meeting."""
        return Report(self.tick, self.config.robot, self.phase, self.mode_name, verdict=self.verdict)

    def command(self, tolerance: float) -> Command:
        """Return the command for the next tick; a place counts as reached within `tolerance` m."""
        controls = None
        if isinstance(self.mode, Looping) and self.verdict is None:
            controls = sweep.controls(self.mode, self.odometry, self.config.mission, tolerance)
        driven = controls or REST
        return Command(
            self.tick,
            self.config.robot,
            driven.v,
            driven.omega,
            self.phase,
            self.mode_name,
            self.verdict,
            rests=self.verdict is not None,
        )


class UnanchoredState(WaitingState, frozen=True):
    """The state of a robot without an anchor, with exact sensors."""

    base: Pose = ORIGIN
    """The odometry at the place where it stands, or stood before its square."""
    ranges: Mapping[tuple[str, int], tuple[float, Pose]] = {}
    """The ranges without a reported pose yet, with the own pose relative to `base`, by robot and tick."""
    places: Mapping[tuple[str, int], RangedPlace] = {}
    """The ranges to robots that have reported their poses in those ticks, by robot and tick."""
    possible: tuple[Pose, ...] = ()
    """The poses of `base` in <W> that agree with the ranges; empty before the heading can be determined."""
    candidates: Mapping[str, Pose] = {}
    """The pose in <W> of the frame of the odometry, by the robot from whose reports it follows."""

    @property
    def phase(self) -> int:
        """Return 2 until the first range to a localised robot, then 3."""
        return 3 if self.places or self.candidates else 2


class UnanchoredPlanner(Planner[UnanchoredState, Report]):
    """The planner of a robot without an anchor, with exact sensors."""

    BODY = Report
    REQUIRED_PLACES = FEWEST_PLACES

    def start(self, config: RobotConfig) -> UnanchoredState:
        """Return the state of a robot that has measured nothing yet."""
        return UnanchoredState(config)

    def observe(self, state: UnanchoredState, observation: Observation) -> UnanchoredState:
        """Return `state` with the odometry and the ranges of one tick."""
        state = state.after_odometry(observation)
        if state.verdict is not None:
            return state
        # where it stands, rounding must not look like a motion
        moved = ORIGIN
        if state.odometry != state.base:
            moved = compose(inverse(state.base), state.odometry)
        new = {
            (contact.peer, observation.tick): (contact.range, moved)
            for contact in observation.contacts
            if contact.range is not None
        }
        if not new:
            return state
        recent = {key: contact for key, contact in state.ranges.items() if key[1] > observation.tick - KEPT}
        return replace(state, ranges={**recent, **new})

    def report(self, state: UnanchoredState) -> Report:
        """Return the report to a robot that has not found it."""
        return state.report()

    def report_to(self, state: UnanchoredState, peer: str) -> Report:
        """Return the report to `peer`, which does not stop any longer once this robot knows a pose by it."""
        unconfirmed = state.verdict is None and peer in state.candidates
        return replace(state.report(), state=UNCONFIRMED) if unconfirmed else state.report()

    def decide(self, state: UnanchoredState, reports: Sequence[Report] = ()) -> UnanchoredState:
        """Return `state` with the poses in `reports`, and with a verdict if they determine the own pose."""
        if state.verdict is not None:
            return state
        if state.tick * state.config.mission.period >= state.config.gives_up:
            return replace(state, verdict=Undecided(_why_undecided(state)))
        ranges, places = dict(state.ranges), dict(state.places)
        if isinstance(state.mode, Standing):  # a robot that comes back may have corrected its pose
            places = {key: report for key, report in places.items() if key[1] > state.tick - LOOPS_FOR}
        for report in reports:
            if (prior := report.prior) is None or report.robot in state.candidates:
                continue
            if (ranged := ranges.pop((report.robot, prior.tick), None)) is not None:
                distance, odometry = ranged
                places[report.robot, prior.tick] = RangedPlace(
                    (prior.pose.x, prior.pose.y), odometry, distance
                )
        if places.keys() != state.places.keys():
            state = _resected(replace(state, ranges=ranges, places=places))
        return _moved_on(state) if isinstance(state.mode, Looping) and state.verdict is None else state

    def command(self, state: UnanchoredState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return state.command(EXACT_ESTIMATOR.pose_tolerance)

    def estimate(self, state: UnanchoredState) -> Estimate:
        """Return the poses in <W> that agree with all ranges, or those that robots have not confirmed yet."""
        world = [_now(state, one) for one in state.possible]
        if not world:
            world = [compose(state.candidates[robot], state.odometry) for robot in sorted(state.candidates)]
        return Estimate(
            tick=state.tick,
            robot=state.config.robot,
            local=(),
            world=tuple(world),
            localised=isinstance(state.verdict, Localised),
        )

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return 0: not the number of exact ranges counts, but redundant ones."""
        del mission
        return 0

    def summary(self, state: UnanchoredState) -> Summary:
        """Return the number of possible poses."""
        return Summary(hypotheses=len(state.possible) or len(state.candidates) or None)


def _now(state: UnanchoredState, base: Pose) -> Pose:
    """Return the present pose in <W> if that of `state.base` is `base`."""
    return compose(base, compose(inverse(state.base), state.odometry))


def _resected(state: UnanchoredState) -> UnanchoredState:
    """Return `state` with what follows from its ranges to each robot: a square to drive, or a verdict."""
    for robot in sorted({robot for robot, _ in state.places} - state.candidates.keys()):
        ranged = [state.places[key] for key in sorted(state.places) if key[0] == robot]
        standing = [one for one in ranged if one.odometry == ORIGIN]
        moved = [one for one in ranged if one.odometry != ORIGIN]
        if isinstance(state.mode, Standing):
            positions = resection.positions(standing, LARGEST_MISFIT)
            if len(positions) == 1 and resection.is_fixed(standing, positions[0]):
                return replace(state, mode=sweep.looping(state.odometry, state.config.mission, state.tick))
        elif moved and (possible := resection.poses(standing, moved, LARGEST_MISFIT)):
            state = replace(state, possible=possible)
            if resection.is_certain(standing, moved, possible):
                state = _with_candidate(state, robot, _now(state, possible[0]))
                if state.verdict is not None:
                    return state
    return state


def _with_candidate(state: UnanchoredState, robot: str, pose: Pose) -> UnanchoredState:
    """Return `state` with the present `pose`, which follows from the reports of `robot`.

    It is claimed if as many robots agree on it as are needed for one of them to be honest.
    """
    candidates = {**state.candidates, robot: compose(pose, inverse(state.odometry))}
    others = [compose(one, state.odometry) for by, one in state.candidates.items() if by != robot]
    agreeing = 1 + sum([_agree(pose, other) for other in others])
    verdict = Localised(pose) if agreeing > state.config.tolerates else None
    return replace(state, candidates=candidates, verdict=verdict)


def _agree(one: Pose, other: Pose) -> bool:
    """Return whether two poses are the same to AGREE."""
    apart = math.hypot(one.x - other.x, one.y - other.y)
    return max(apart, abs(wrap(one.heading - other.heading))) <= AGREE


def _why_undecided(state: UnanchoredState) -> str:
    """Return why the robot has not claimed a pose, for a user."""
    if not state.candidates:
        return "no localised robot has found it"
    finders = ", ".join(sorted(state.candidates))
    return f"{state.config.tolerates + 1} robots must agree on its pose; it is found by: {finders}"


def _moved_on(state: UnanchoredState) -> UnanchoredState:
    """Return `state` after a tick of a square. The square is repeated until the pose is known.

    If nobody has reported a pose for KEPT ticks, except robots by which it knows a pose, the robot stands
    still again, and forgets all ranges: those to the next robot that comes begin where it is then.
    """
    assert isinstance(state.mode, Looping)
    mission, since = state.config.mission, state.mode.since
    mode = sweep.onward(state.mode, state.odometry, mission, EXACT_ESTIMATOR.pose_tolerance)
    if mode.places:
        return replace(state, mode=mode)
    latest = max([tick for robot, tick in state.places if robot not in state.candidates], default=-KEPT)
    if latest > state.tick - KEPT and since > state.tick - LOOPS_FOR:
        return replace(state, mode=sweep.looping(state.odometry, mission, since))
    return replace(state, mode=Standing(), base=state.odometry, ranges={}, places={}, possible=())
