"""A robot without an anchor that determines its pose by squares: first its finder's, then its own.

The finder drives a square while this robot stands still; that determines this robot's position. Then this one
drives a square, too; that determines its heading. The pose rests on the ranges to one other robot, in the
order of their ticks, so it does not depend on the order in which reports arrive.

If f robots may report false data, it claims a pose on which f + 1 of them agree, at least one of which is
honest. Until then, it waits for the next one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from agent.estimation import resection
from agent.estimation.resection import RangedPlace
from agent.planning import coverage
from agent.planning.coverage import LOOPS_FOR
from agent.planning.planner import Summary
from agent.planning.state import RobotState
from agent.planning.tasks import UNCONFIRMED, Awaiting, Done, Looping, Standing
from protocol.messages import Estimate, Localised, Report
from protocol.motion import ORIGIN, Pose, compose, inverse, wrap
from protocol.rounding import SURE

LARGEST_MISFIT = 0.1 * SURE
"""The largest difference in m between a measured range and the one that a hypothesis predicts.

It is far above the rounding errors of the poses of both robots, and far below what a wrong pose predicts.
"""

STILL = 0.1 * LARGEST_MISFIT
"""The distance in m from its place up to which a robot is there, in spite of rounding.

With 0, a range from the end of a square would tell the heading, which it does not, and any heading would fit.
"""

KEPT = 64
"""The number of ticks within which the report of the tick of a range has to arrive."""

AGREE = SURE
"""The largest difference in m and rad between poses that two robots confirm.

One of them is honest, so the error of both is smaller than the tolerance of a claim, 2 SURE.
"""


class Resected(msgspec.Struct, frozen=True):
    """The ranges to robots that report exact poses, and the poses that agree with them."""

    base: Pose = ORIGIN
    """The odometry at the place where it stands, or stood before its square."""
    since: int = -1
    """The tick after which its ranges count."""
    places: Mapping[tuple[str, int], RangedPlace] = {}
    """The ranges to robots that have reported their poses in those ticks, by robot and tick."""
    hypotheses: tuple[Pose, ...] = ()
    """The poses of `base` in <W> that agree with the ranges; empty before the heading can be determined."""
    unconfirmed: Mapping[str, Pose] = {}
    """The only hypothesis that the reports of each robot leave: the pose in <W> of the odometry's frame."""

    def informed(self, state: RobotState, reports: Sequence[Report]) -> RobotState:
        """Return `state` with the data in `reports`, and with a verdict if they determine the own pose."""
        places, found = dict(self.places), self
        if not isinstance(state.task, Looping):  # a robot that comes back may have corrected its pose
            places = {key: report for key, report in places.items() if key[1] > state.tick - LOOPS_FOR}
        for report in reports:
            if (prior := report.prior) is None or report.robot in self.unconfirmed:
                continue
            key = report.robot, prior.tick
            if key in places or prior.tick <= max(self.since, state.tick - KEPT):
                continue
            for one in state.ranges.get(report.robot, ())[-KEPT:]:
                if one.tick == prior.tick:
                    moved = _moved(state, self.base, one.tick)
                    places[key] = RangedPlace((prior.pose.x, prior.pose.y), moved, one.range)
        if places.keys() != self.places.keys():
            state, found = _resected(state, replace(self, places=places))
            state = replace(state, found=found)
        return _moved_on(state, found) if state.verdict is None else state

    def answered(self, report: Report, peer: str) -> Report:
        """Return `report` to `peer`: a robot by which it knows a pose does not stop any longer."""
        is_unconfirmed = report.verdict is None and peer in self.unconfirmed
        return replace(report, state=UNCONFIRMED) if is_unconfirmed else report

    def why_undecided(self, state: RobotState) -> str:
        """Return why the robot has not claimed a pose, for a user."""
        if not self.unconfirmed:
            return "no localised robot has found it"
        finders = ", ".join(sorted(self.unconfirmed))
        return f"{state.config.tolerates + 1} robots must agree on its pose; it is found by: {finders}"

    def estimate(self, state: RobotState, of_tick: Estimate) -> Estimate:
        """Return `of_tick` with the poses that agree with all ranges, or are not confirmed yet."""
        world = [_now(state, self, one) for one in self.hypotheses]
        if not world:
            world = [compose(self.unconfirmed[robot], state.odometry) for robot in sorted(self.unconfirmed)]
        return replace(of_tick, world=tuple(world))

    def summary(self, state: RobotState) -> Summary:
        """Return the number of hypotheses."""
        del state
        return Summary(hypotheses=len(self.hypotheses) or len(self.unconfirmed) or None)


def _moved(state: RobotState, base: Pose, tick: int) -> Pose:
    """Return the pose of this robot at `tick` relative to `base`, both by dead reckoning."""
    moved = compose(inverse(base), state.log.pose(ORIGIN, tick, state.config.mission.period))
    return moved if math.hypot(moved.x, moved.y) > STILL else ORIGIN


def _now(state: RobotState, found: Resected, base: Pose) -> Pose:
    """Return the present pose in <W> if that of `found.base` is `base`."""
    return compose(base, compose(inverse(found.base), state.odometry))


def _resected(state: RobotState, found: Resected) -> tuple[RobotState, Resected]:
    """Return both with what follows from the ranges to each robot: a square to drive, or a verdict."""
    for robot in sorted({robot for robot, _ in found.places} - found.unconfirmed.keys()):
        ranged = [found.places[key] for key in sorted(found.places) if key[0] == robot]
        standing = [one for one in ranged if one.odometry == ORIGIN]
        moved = [one for one in ranged if one.odometry != ORIGIN]
        if not isinstance(state.task, Looping):
            positions = resection.positions(standing, LARGEST_MISFIT)
            if len(positions) == 1 and resection.is_fixed(standing, positions[0]):
                return state.doing(coverage.looping(state, state.tick)), found
        elif moved and (hypotheses := resection.poses(standing, moved, LARGEST_MISFIT)):
            found = replace(found, hypotheses=hypotheses)
            if resection.is_certain(standing, moved, hypotheses):
                state, found = _with_unconfirmed(state, found, robot)
                if state.verdict is not None:
                    break
    return state, found


def _with_unconfirmed(state: RobotState, found: Resected, robot: str) -> tuple[RobotState, Resected]:
    """Return both with the only hypothesis that the reports of `robot` leave.

    It is claimed if as many robots agree on it as are needed for one of them to be honest.
    """
    pose = _now(state, found, found.hypotheses[0])
    others = [compose(one, state.odometry) for by, one in found.unconfirmed.items() if by != robot]
    found = replace(found, unconfirmed={**found.unconfirmed, robot: compose(pose, inverse(state.odometry))})
    if 1 + sum([_agree(pose, other) for other in others]) > state.config.tolerates:
        state = state.doing(Done(3, Localised(pose))).with_frame(pose)
    return state, found


def _agree(one: Pose, other: Pose) -> bool:
    """Return whether two poses are the same to AGREE."""
    apart = math.hypot(one.x - other.x, one.y - other.y)
    return max(apart, abs(wrap(one.heading - other.heading))) <= AGREE


def _moved_on(state: RobotState, found: Resected) -> RobotState:
    """Return `state` after a tick of a square. The square is repeated until the pose is known.

    If nobody has reported a pose for KEPT ticks, except robots by which it knows a pose, the robot stands
    still again, and forgets all ranges: those to the next robot that comes begin where it is then.
    """
    if not isinstance(state.task, Looping):
        return state.doing(Standing() if found.places or found.unconfirmed else Awaiting())
    task = coverage.onward(state, state.task)
    if task.places:
        return state.doing(task)
    latest = max([tick for robot, tick in found.places if robot not in found.unconfirmed], default=-KEPT)
    if latest > state.tick - KEPT and state.task.since > state.tick - LOOPS_FOR:
        return state.doing(coverage.looping(state, state.task.since))
    found = Resected(state.odometry, state.tick, unconfirmed=found.unconfirmed)
    return replace(state, task=Standing() if found.unconfirmed else Awaiting(), found=found)
