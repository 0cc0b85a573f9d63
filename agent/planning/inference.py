"""What a mind makes of its logs under noise: where its anchor may be, and how the pair may lie in <W>."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.exact import Branch
from agent.estimation.gaussian.consistency import DOUBTFUL, FINISHED, Inconsistency, doubt
from agent.estimation.gaussian.hypotheses import ScoredHypothesis, missing, of_anchor
from agent.estimation.gaussian.least_squares import deviation, poses
from agent.estimation.gaussian.odometry_noise import Array, Track, track
from agent.estimation.gaussian.range_model import SIGMA_FLOOR, PairRanges, Ranges
from agent.peer.motion_log import MotionLog
from agent.planning.active_sensing import PlanningHypothesis
from agent.planning.state import RobotState
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Covariance, Pose, compose, inverse, wrap


def path_of(log: MotionLog, through: int, period: float) -> Track:
    """The odometry of a log up to tick `through`."""
    runs = log.runs
    ticks = [run.ticks for run in runs]
    v = np.repeat([run.v for run in runs], ticks)[:through]
    omega = np.repeat([run.omega for run in runs], ticks)[:through]
    return track(v, omega, period)


def own_anchor(state: RobotState) -> tuple[ScoredHypothesis, ...]:
    """Where the robot's anchor may lie in the frame of its odometry."""
    mission = state.config.mission
    path = path_of(state.log, state.tick, mission.period)
    ranges = Ranges.of_lists(_told(state.log, state.tick), (), (), mission.noise)
    possible = ranges.within(mission.sensing_range)
    if not len(possible.rho):
        return ()
    silent = missing(ranges.tick, state.tick + 1)
    return of_anchor(state.belief.own, path, possible, silent, mission.sensing_range, mission.noise)


def _told(log: MotionLog, through: int) -> list[tuple[int, float]]:
    return [(ranged.tick, ranged.range) for ranged in log.ranges if ranged.tick <= through]


def with_own(state: RobotState, scored: Sequence[ScoredHypothesis]) -> RobotState:
    """`state`, with these hypotheses of its anchor; where it stands now follows from the likeliest."""
    own = tuple([one.hypothesis for one in scored])
    branches = tuple([branch_of(state, one) for one in scored])
    return replace(state, belief=replace(state.belief, own=own, branches=branches, branch=branches[0]))


def branch_of(state: RobotState, scored: ScoredHypothesis) -> Branch:
    """The likeliest trajectory; its start is such that the odometry leads to where the robot is now."""
    mx, my = scored.hypothesis.guess[:2]
    path = scored.fit.paths[0]
    frame = math.atan2(-my, -mx)
    c, s = math.cos(frame), math.sin(frame)
    x, y = float(path.x[-1]) - mx, float(path.y[-1]) - my
    now = Pose(c * x + s * y, c * y - s * x, float(path.heading[-1]) - frame)
    start = compose(now, inverse(state.odometry))
    return Branch(wrap(-frame), start)


def held_alone(scored: Sequence[ScoredHypothesis]) -> list[PlanningHypothesis]:
    """For planning: the robot, relative to its anchor."""
    held = []
    for one in scored:
        mx, my = one.hypothesis.guess[:2]
        path = one.fit.paths[0]
        now = np.array((path.x[-1] - mx, path.y[-1] - my, path.heading[-1]))
        held.append(PlanningHypothesis(one.hypothesis.probability, now, one.fit.covariance))
    return held


def settled(scored: Sequence[ScoredHypothesis], mission: Mission) -> bool:
    """Whether what is left to know of the anchor is worth less than moving on."""
    best = scored[0]
    enough = ANCHOR_RANGES_WITH_OUTLIERS if mission.noise.outliers else ANCHOR_RANGES
    return (
        int(np.count_nonzero(best.fit.weights > 0.5)) >= enough
        and best.hypothesis.probability >= SURE_OF_BRANCH
        and deviation(float(np.trace(best.fit.covariance))) <= mission.foothold
    )


SURE_OF_BRANCH = 0.999
"""the probability at which a robot takes a branch for the right one and goes to meet its peer"""

ANCHOR_RANGES, ANCHOR_RANGES_WITH_OUTLIERS = 5, 7
"""to its anchor at the least, before a robot goes: two unknowns, and three that check them"""


def known_through(state: RobotState) -> int:
    """The last tick that both logs cover."""
    return min(state.tick, state.peer_state.peer.through, state.peer_state.ranges_through)


def answered(state: RobotState) -> bool:
    """Whether the peer has told of everything up to where this robot has come to rest, or is now."""
    return known_through(state) >= state.log.moved(state.config.mission.noise.standstill_bound)


def pair_of(state: RobotState) -> PairRanges:
    """All that both have measured: its own up to now, the peer's up to the last tick that both logs cover."""
    peer, config = state.peer_state.peer, state.config
    mission, last = config.mission, known_through(state)
    logs, ends = ((state.log, peer), (state.tick, last, last))
    if config.role == "b":
        logs, ends = ((peer, state.log), (last, state.tick, last))
    mutual = [(ranged.tick, ranged.range) for ranged in state.mutual if ranged.tick <= last]
    lists = [_told(log, end) for log, end in zip(logs, ends, strict=False)]
    ranges = Ranges.of_lists(lists[0], lists[1], mutual, mission.noise)
    silent = [missing(ranges.tick[ranges.rows(kind)], ends[kind] + 1) for kind in range(3)]
    ranges = ranges.within(mission.sensing_range)
    own, other = config.anchor, config.peer_anchor
    sign = 1.0 if config.role == "a" else -1.0
    return PairRanges(
        (path_of(logs[0], ends[0], mission.period), path_of(logs[1], ends[1], mission.period)),
        ranges,
        (silent[0], silent[1], silent[2]),
        (sign * (other.x - own.x), sign * (other.y - own.y)),
        mission.sensing_range,
        mission.noise,
    )


def held_together(scored: Sequence[ScoredHypothesis], pair: PairRanges) -> list[PlanningHypothesis]:
    """For planning: both poses relative to M1, and their covariance."""
    return [PlanningHypothesis(one.hypothesis.probability, *poses(one.fit, pair.apart)) for one in scored]


def missing_for(
    scored: Sequence[ScoredHypothesis],
    held: Sequence[PlanningHypothesis],
    against: Inconsistency | None,
    pair: PairRanges,
    mission: Mission,
) -> str | None:
    """What is lacking before a claim, there being ranges enough; None if it is nothing."""
    if against is None:
        return "no hypothesis explains the ranges"
    probability = scored[0].hypothesis.probability
    if probability < mission.confidence:
        return f"the likeliest of {len(scored)} hypotheses has the probability {probability:.6f}, of {mission.confidence:g}"
    if not against.p_value >= DOUBTFUL:
        return f"the likeliest hypothesis is in doubt: {against.what}"
    _, covariance = bent(held[0], pair.apart)
    for i, robot in ((0, "a"), (3, "b")):
        position = deviation(covariance[i, i] + covariance[i + 1, i + 1])
        if not position <= mission.accuracy:
            return f"{robot}'s position is known to {position:.3g} m, of {mission.accuracy:g}"
        heading = deviation(covariance[i + 2, i + 2])
        if not heading <= HEADING_ACCURACY:
            return f"{robot}'s heading is known to {heading:.3g} rad, of {HEADING_ACCURACY:g}"
    return None


def finished(state: RobotState, scored: Sequence[ScoredHypothesis]) -> RobotState:
    """`state`, which claims nothing by a fit that has not found its minimum."""
    if state.belief.blocking_reason is not None or scored[0].fit.last_step <= FINISHED:
        return state
    missing = f"the likeliest hypothesis still moves, by {scored[0].fit.last_step:.3g} sigmas"
    return replace(state, belief=replace(state.belief, blocking_reason=missing))


def with_pair(
    state: RobotState, scored: Sequence[ScoredHypothesis], pair: PairRanges, mutual: int
) -> RobotState:
    """`state`, with these hypotheses of how both lie in <W>; a claim needs `mutual` mutual ranges."""
    config = state.config
    robot, m1 = (0, config.anchor) if config.role == "a" else (1, config.peer_anchor)
    held = held_together(scored, pair)
    enough = len(pair.places) >= mutual
    against = doubt(scored[0].fit, pair) if enough and scored else None
    missing = missing_for(scored, held, against, pair, config.mission)
    claims = [claim(one, robot, pair) for one in held]
    first, _ = state.belief.candidates or (len(scored), 0)
    findings = replace(
        state.belief,
        pair=tuple(one.hypothesis for one in scored),
        poses=tuple(Pose(m1.x + pose.x, m1.y + pose.y, pose.heading) for pose, _ in claims),
        covariance=claims[0][1] if claims else None,
        candidates=(first, len(scored)),
        against=against,
        blocking_reason=missing if enough else f"{len(pair.places)} mutual ranges, of {mutual}",
    )
    return replace(state, belief=findings)


def claim(held: PlanningHypothesis, robot: int, pair: PairRanges) -> tuple[Pose, Covariance]:
    """The pose of one robot, relative to M1, as the mean and the covariance of what is left of the best
    hypothesis. Ranges confine a robot to an arc, so both are taken to second order (see `bent`)."""
    mean, covariance = bent(held, pair.apart)
    i = 3 * robot
    x, y, heading = mean[i : i + 3].tolist()
    block = covariance[i : i + 3, i : i + 3]
    return Pose(x, y, wrap(heading)), Covariance(
        *[float(block[j, k]) for j, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    )


def bent(held: PlanningHypothesis, m2: tuple[float, float]) -> tuple[Array, Array]:
    """Mean and covariance of both poses, where it is range and bearing that are Gaussian: b's from M2, a's
    from b.

    To second order: where ranges are far better known than bearings, what is possible is an arc, which an
    ellipse of first order does not reach.
    """
    mean, covariance = held.poses.copy(), held.covariance
    bx, by = mean[3] - m2[0], mean[4] - m2[1]
    ax, ay = mean[0] - mean[3], mean[1] - mean[4]
    # by (range, bearing) of b, then of a from b: gradients by the poses
    rows = np.zeros((4, 6))
    for k, (x, y), plus, minus in ((0, (bx, by), 3, None), (2, (ax, ay), 0, 3)):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for row, (gx, gy) in ((k, (x / rho, y / rho)), (k + 1, (-y / rho**2, x / rho**2))):
            rows[row, plus : plus + 2] = gx, gy
            if minus is not None:
                rows[row, minus : minus + 2] = -gx, -gy
    polar = rows @ covariance @ rows.T
    polar = _limited(polar)
    second = np.zeros((6, 4, 4))
    for k, (x, y), moved in ((0, (bx, by), (0, 3)), (2, (ax, ay), (0,))):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for i in moved:
            second[i, k + 1, k + 1] = -x
            second[i + 1, k + 1, k + 1] = -y
            second[i, k, k + 1] = second[i, k + 1, k] = -y / rho
            second[i + 1, k, k + 1] = second[i + 1, k + 1, k] = x / rho
    turned = second @ polar
    mean += 0.5 * np.trace(turned, axis1=1, axis2=2)
    covariance = covariance + 0.5 * np.einsum("iab,jba->ij", turned, turned)
    return mean, covariance


def _limited(polar: Array) -> Array:
    """A bearing that is hardly known is no small angle: its variance counts up to one radian's."""
    scale = np.ones(4)
    for k in (1, 3):
        scale[k] = min(1.0, 1.0 / math.sqrt(max(polar[k, k], 1e-300)))
    limited: Array = polar * scale[:, None] * scale
    return limited
