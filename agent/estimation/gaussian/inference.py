"""The inference of one robot with noisy sensors: its anchor's position, and both robots' poses."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.elementary import product
from agent.estimation.exact import Branch
from agent.estimation.fit import Fit, deviation
from agent.estimation.gaussian.evidence import anchor_evidence
from agent.estimation.gaussian.joint_ranges import JointMeasurements, Silence
from agent.estimation.gaussian.measured_rows import Listed, near_anchors
from agent.estimation.gaussian.odometry_noise import Array, Places, Track, track, variances
from agent.estimation.gaussian.own_sensors import Doubt, doubt
from agent.estimation.gaussian.placement_guesses import STARTS
from agent.estimation.gaussian.range_model import SIGMA_FLOOR
from agent.estimation.gaussian.search import of_anchor
from agent.estimation.knowledge import Belief, Knowledge
from agent.estimation.posterior import Hypothesis
from agent.peer.motion_log import MotionLog
from protocol.messages import Inconsistent, Localised, RobotConfig
from protocol.mission import Mission
from protocol.motion import Covariance, Pose, Segment, compose, inverse, relative, wrap
from protocol.noise import VelocityNoise


class PlanningHypothesis(msgspec.Struct, frozen=True, eq=False):
    """A hypothesis in the form that planning needs. What follows from one is computed once."""

    probability: float
    poses: Array
    """The poses in m and rad: (3,) of one robot relative to its anchor, or (6,) of a and b relative to M1."""
    covariance: Array
    """The covariance of the anchor's position, (2, 2), or of both poses, (6, 6)."""


def beginning(knowledge: Knowledge, through: int) -> int:
    """Return the tick up to `through` from which on the measurements of robot a count: 0, or a later one.

    A robot a that has failed (see `has_failed`) begins phase 1 again with its next range to its anchor.
    Earlier measurements hardly constrain its pose then: the error of its heading has grown to up to a radian,
    and over such an angle no fit is linear. Both robots compute the tick from data that both have: a's log
    and the ranges between them.
    """
    if not knowledge.config.begins_again:
        return 0
    log = knowledge.log if knowledge.config.role == "a" else knowledge.peer_state.peer
    ticks = [ranged.tick for ranged in log.ranges if ranged.tick <= through]
    return max([tick for before, tick in pairwise(ticks) if has_failed(knowledge, before, tick)], default=0)


def has_failed(knowledge: Knowledge, before: int, tick: int) -> bool:
    """Return whether a robot a without a range to its anchor from tick `before` until `tick` has failed.

    It has if it has not met b in more than T_max, or if MANY_MUTUAL_RANGES have not settled the poses. It has
    met b if there are LEAST_RANGES mutual ranges.
    """
    config, at = knowledge.config, attrgetter("tick")
    if (
        tick - before < MANY_MUTUAL_RANGES
        and (tick - before) * config.mission.period <= config.rendezvous.bound
    ):
        return False  # a tick has at most one range between the robots
    count = bisect_left(knowledge.mutual, tick, key=at) - bisect_left(knowledge.mutual, before, key=at)
    if count < LEAST_RANGES:
        return (tick - before) * config.mission.period > config.rendezvous.bound
    return count >= MANY_MUTUAL_RANGES


def path_of(log: MotionLog, first: int, through: int, mission: Mission) -> Track:
    """Return the odometry of `log` up to tick `through`, as if it had not moved until `first`."""
    return _path_of(log.runs, first, through, mission.period, mission.noise.odometry)


@lru_cache(maxsize=4)
def _path_of(
    runs: tuple[Segment, ...], first: int, through: int, period: float, noise: VelocityNoise
) -> Track:
    """Return the path of `path_of`, which robots ask for several times in a tick."""
    ticks = [run.ticks for run in runs]
    v, omega = (
        np.repeat(one, ticks)[:through] for one in ([run.v for run in runs], [run.omega for run in runs])
    )
    v[:first] = omega[:first] = 0.0
    # -0.0 and 0.0 are the same to the cache
    path = track(v + 0.0, omega + 0.0, period)
    if first == 0:
        return path
    extra = np.zeros((2, len(v)))
    extra[:, :first] = -variances(v[:first], omega[:first], noise)
    return path._replace(extra=extra)


def own_path(knowledge: Knowledge) -> Track:
    """Return the odometry of the robot up to now."""
    return path_of(knowledge.log, 0, knowledge.tick, knowledge.config.mission)


def _own_measurements(knowledge: Knowledge) -> JointMeasurements:
    """Return the odometry of the robot and its ranges to its anchor, without those that do not count."""
    mission, now = knowledge.config.mission, knowledge.tick
    first = beginning(knowledge, now) if knowledge.config.role == "a" else 0
    ranges = _ranges_within(knowledge.log, first, now)
    silent = Silence(0, -1, _missing(ranges, now + 1, first))
    own = near_anchors(
        [path_of(knowledge.log, first, now, mission)],
        *([ranges], [(0.0, 0.0)], mission.noise, mission.sensing_range),
        silent=(silent,),
    )
    return replace(own.alone(0), solver=knowledge.solver)


def own_anchor(knowledge: Knowledge) -> tuple[Hypothesis, ...]:
    """Return the hypotheses about the anchor in the frame of the odometry, the most probable first."""
    own = _own_measurements(knowledge)
    own = own.thinned(own.reach)
    return of_anchor(knowledge.belief.own, own) if len(own.ranges.rho) else ()


def _missing(ranges: Listed, end: int, first: int) -> Places:
    """Return the ticks from `first` on and before `end` without one of `ranges`."""
    silent = np.ones(end, bool)
    silent[:first] = False
    silent[[tick for tick, _ in ranges]] = False
    return np.flatnonzero(silent)


def _ranges_within(log: MotionLog, first: int, through: int) -> list[tuple[int, float]]:
    """Return tick and range in m of each anchor range of `log` over the ticks [first, through]."""
    return [(ranged.tick, ranged.range) for ranged in log.ranges if first <= ranged.tick <= through]


def sensor_doubt(knowledge: Knowledge) -> Doubt | None:
    """Return the profile that explains the contradiction for which the robot would blame its peer.

    It explains the own measurements better than the noise that the robot was told, or all without a
    contradiction.
    """
    own = _own_measurements(knowledge).thinned_after()
    return doubt(own, pair_of(knowledge), 0 if knowledge.config.role == "a" else 1)


def with_own(knowledge: Knowledge, scored: Sequence[Hypothesis]) -> Belief:
    """Return the belief with the hypotheses `scored` about its anchor, and with the most probable branch."""
    branches = tuple([branch_of(knowledge, one) for one in scored])
    fitted = len(knowledge.log.ranges)
    return replace(
        knowledge.belief, own=tuple(scored), branches=branches, branch=branches[0], ranges_at_last_fit=fitted
    )


def is_fit_due(knowledge: Knowledge) -> bool:
    """Return whether a robot that waits for its peer fits its anchor's hypotheses again."""
    belief, ranges = knowledge.belief, len(knowledge.log.ranges)
    if not belief.own or belief.own[0].probability < SURE_OF_BRANCH:
        return True
    return ranges - belief.ranges_at_last_fit >= min(FEW_MORE * belief.ranges_at_last_fit, MANY_MORE)


FEW_MORE, MANY_MORE = 0.25, 5
"""The number of new ranges for such a fit: a fraction of those fitted last, and at the most MANY_MORE.

A further range hardly moves a pose that follows from 20, and each search fits all of them. With more, a robot
whose odometry is noisy strays from its place; with less, the fits take most of the time of phase 2.
"""


def branch_of(knowledge: Knowledge, scored: Hypothesis) -> Branch:
    """Return the trajectory of `scored` as a branch, whose start and odometry lead to the present pose."""
    x, y, _ = scored.fit.start.poses[0].tolist()
    frame = math.atan2(y, x)
    now = relative(Pose(0.0, 0.0, frame), Pose(*scored.fit.poses[0].tolist()))
    start = compose(now, inverse(knowledge.odometry))
    return Branch(wrap(-frame), start)


def anchor_planning_hypotheses(knowledge: Knowledge) -> list[PlanningHypothesis]:
    """Return the hypotheses about the pose relative to the anchor, in the form that planning needs.

    Since their fits, the robot has moved by its odometry.
    """
    hypotheses = []
    for one, branch in zip(knowledge.belief.own, knowledge.belief.branches, strict=True):
        pose = compose(branch.start, knowledge.odometry)
        c, s = math.cos(branch.alpha), math.sin(branch.alpha)
        turn = np.array(((c, -s), (s, c)))
        covariance = product(product(turn, one.fit.of_start[:2, :2]), turn.T)
        now = np.array((pose.x, pose.y, pose.heading))
        hypotheses.append(PlanningHypothesis(one.probability, now, covariance))
    return hypotheses


def is_anchor_known(knowledge: Knowledge, scored: Sequence[Hypothesis]) -> bool:
    """Return whether the anchor's position is known well enough to end phase 1."""
    mission, best = knowledge.config.mission, scored[0]
    good = int(np.count_nonzero(best.fit.weights > 0.5))
    if good < LEAST_RANGES or best.probability < SURE_OF_BRANCH:
        return False
    share = SEARCHING_SIGMAS if knowledge.config.orbit.v != 0.0 else 1.0
    if _anchor_sigma(best.fit) > share * mission.required_anchor_sigma:
        return False
    if mission.noise.outliers or good >= ANCHOR_RANGES:
        return good >= (ANCHOR_RANGES_WITH_OUTLIERS if mission.noise.outliers else ANCHOR_RANGES)
    own = _own_measurements(knowledge)
    return anchor_evidence(best.fit, own.thinned(own.reach)) >= ANCHOR_EVIDENCE


def _anchor_sigma(fit: Fit) -> float:
    """Return the sigma (m) of the anchor's position relative to the start, or to the robot now if it is less.

    With noisy odometry, ranges tell less and less of where a robot started.
    """
    return deviation(float(min(np.trace(one[:2, :2]) for one in (fit.of_start, fit.covariance))))


SURE_OF_BRANCH = 0.999
"""The probability from which on a robot accepts a branch and ends phase 1.

A wrong branch does not lead to a wrong claim: all branches take part in the search of phase 3.
"""

SEARCHING_SIGMAS = 1.5
"""The largest sigma of the anchor's position with which a robot ends phase 1 to search for its peer.

It is in units of `required_anchor_sigma`. On the way out, two or three further ranges follow, which correct
the orbit, and later the mutual ranges correct the pose.
"""

ANCHOR_EVIDENCE = 20.0
"""The evidence against chance that ends phase 1 with fewer than ANCHOR_RANGES, without outliers.

Set on sigmas of 1e-9 to 0.1 m. With 7, three ranges of sigma 0.001 m ended phase 1, and 1 of 12 missions took
an honest peer for inconsistent: few ranges make every later test depend on the error of one. With more,
exact ranges take as many as noisy ones.
"""

LEAST_RANGES = 3
"""The least number of ranges to an anchor, or between the robots, that may be enough.

Two have no redundancy. The third checks them, if it is accurate: by its evidence against chance.
"""

MANY_MUTUAL_RANGES = 60
"""The number of mutual ranges after which a lack of accuracy is due to too few ranges to the anchor.

Set on the sweep `noise`, whose missions need 10 to 40. With fewer, robots that would have claimed a few ticks
later drive back; with more, robots whose anchor is known too badly range in vain for longer. Missions with
little noise never come near it.
"""

ANCHOR_RANGES, ANCHOR_RANGES_WITH_OUTLIERS = 5, 6
"""The numbers of anchor ranges that end phase 1 without such evidence, without and with outliers.

Set on the sweep `noise`. With sigmas of R / 30 and more, ranges give little evidence: it would take twice as
many of them. With fewer, wrong branches reach phase 3, which takes longer; with more, phase 1 takes longer.
"""


def known_through(knowledge: Knowledge) -> int:
    """Return the last tick that both logs cover."""
    return min(knowledge.tick, knowledge.peer_state.peer.through, knowledge.peer_state.ranges_through)


def peer_log_suffices(knowledge: Knowledge) -> bool:
    """Return whether the peer's log reaches the tick of this robot's last motion."""
    return known_through(knowledge) >= knowledge.log.moved(knowledge.config.mission.noise.standstill_bound)


def pair_of(knowledge: Knowledge) -> JointMeasurements:
    """Return the ranges and odometry of both robots; the first is robot a, and M1 is the origin.

    The own data reach up to now, and the peer's up to the last tick that both logs cover.
    """
    peer, config = knowledge.peer_state.peer, knowledge.config
    mission, last = config.mission, known_through(knowledge)
    logs, ends = ((knowledge.log, peer), (knowledge.tick, last, last))
    if config.role == "b":
        logs, ends = ((peer, knowledge.log), (last, knowledge.tick, last))
    first = beginning(knowledge, last)
    firsts = (first, 0, first)
    own = [_ranges_within(log, *within) for log, *within in zip(logs, firsts, ends, strict=False)]
    mutual = [(one.tick, one.range) for one in knowledge.mutual if first <= one.tick <= last]
    silent = [
        Silence(*robots, _missing(ranges, end + 1, begin))
        for robots, ranges, end, begin in zip(
            ((0, -1), (1, -1), (0, 1)), (*own, mutual), ends, firsts, strict=True
        )
    ]
    measured = near_anchors(
        (path_of(logs[0], first, ends[0], mission), path_of(logs[1], 0, ends[1], mission)),
        *(own, ((0.0, 0.0), m2_of(config)), mission.noise, mission.sensing_range, mutual, tuple(silent)),
    )
    return replace(measured.thinned(mission.sensing_range), solver=knowledge.solver)


def m2_of(config: RobotConfig) -> tuple[float, float]:
    """Return the place (m) of M2 relative to M1."""
    m1, m2 = config.m1, config.peer_anchor if config.role == "a" else config.anchor
    return m2.x - m1.x, m2.y - m1.y  # the same bits for both robots


def pair_planning_hypotheses(scored: Sequence[Hypothesis]) -> tuple[PlanningHypothesis, ...]:
    """Return the hypotheses about both poses relative to M1, in the form that planning needs."""
    return tuple([_pair_planning_hypothesis(one.probability, one.fit) for one in scored])


@lru_cache(maxsize=STARTS)
def _pair_planning_hypothesis(probability: float, one: Fit) -> PlanningHypothesis:
    return PlanningHypothesis(probability, one.poses.ravel(), one.covariance)


def with_pair(
    knowledge: Knowledge,
    scored: Sequence[Hypothesis],
    inconsistency: Inconsistent | None,
    blocking_reason: str | None,
) -> Belief:
    """Return the belief with the hypotheses `scored` about both robots' poses in <W>.

    The others are what follows from the first one for a claim: the result of its consistency test, and what
    blocks the claim.
    """
    config = knowledge.config
    robot, m1 = 0 if config.role == "a" else 1, config.m1
    claims = [
        localised(to_second_order(one, m2_of(config)), robot, (m1.x, m1.y))
        for one in pair_planning_hypotheses(scored)
    ]
    first, _ = knowledge.belief.candidates or (len(scored), 0)
    return replace(
        knowledge.belief,
        pair=tuple(scored),
        poses=tuple([one.pose for one in claims]),
        odometry=knowledge.odometry,
        covariance=claims[0].covariance if claims else None,
        candidates=(first, len(scored)),
        inconsistency=inconsistency,
        blocking_reason=blocking_reason,
    )


def localised(hypothesis: PlanningHypothesis, robot: int, origin: tuple[float, float]) -> Localised:
    """Return the pose of a robot in <W> and its covariance; `hypothesis` is relative to `origin` (m)."""
    own = slice(3 * robot, 3 * robot + 3)
    x, y, heading = hypothesis.poses[own].tolist()
    return Localised(
        Pose(origin[0] + x, origin[1] + y, wrap(heading)), covariance_of(hypothesis.covariance[own, own])
    )


def covariance_of(matrix: Array) -> Covariance:
    """Return a covariance of x, y (m) and heading (rad), (3, 3), as messages have it."""
    return Covariance(*matrix[TRIANGLE].tolist())


TRIANGLE = np.triu_indices(3)
"""The places of the elements of a covariance, (3, 3), that messages have."""


@lru_cache(maxsize=STARTS)
def to_second_order(hypothesis: PlanningHypothesis, m2: tuple[float, float]) -> PlanningHypothesis:
    """Return `hypothesis` with the mean and covariance of both poses if ranges and bearings are Gaussian.

    These are the range and the bearing of b from M2, and those of a from b.

    Both are computed to second order. If ranges are much more accurate than bearings, the possible positions
    form an arc, which a first-order ellipse does not cover. `m2` is the position of M2 relative to M1.
    """
    mean, covariance = hypothesis.poses.copy(), hypothesis.covariance
    bx, by = mean[3] - m2[0], mean[4] - m2[1]
    ax, ay = mean[0] - mean[3], mean[1] - mean[4]
    # gradients of range and bearing of b, then of a from b, with respect to the poses
    rows = np.zeros((4, 6))
    for k, (x, y), plus, minus in ((0, (bx, by), 3, None), (2, (ax, ay), 0, 3)):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for row, (gx, gy) in ((k, (x / rho, y / rho)), (k + 1, (-y / rho**2, x / rho**2))):
            rows[row, plus : plus + 2] = gx, gy
            if minus is not None:
                rows[row, minus : minus + 2] = -gx, -gy
    polar = product(product(rows, covariance), rows.T)
    polar = _limited(polar)
    second = np.zeros((6, 4, 4))
    for k, (x, y), moved in ((0, (bx, by), (0, 3)), (2, (ax, ay), (0,))):
        rho = max(math.hypot(x, y), SIGMA_FLOOR)
        for i in moved:
            second[i, k + 1, k + 1] = -x
            second[i + 1, k + 1, k + 1] = -y
            second[i, k, k + 1] = second[i, k + 1, k] = -y / rho
            second[i + 1, k, k + 1] = second[i + 1, k + 1, k] = x / rho
    scaled_curvature = product(second, polar)
    mean += 0.5 * np.trace(scaled_curvature, axis1=1, axis2=2)
    covariance = covariance + 0.5 * product(
        scaled_curvature.reshape(6, 16), scaled_curvature.mT.reshape(6, 16).T
    )
    return PlanningHypothesis(hypothesis.probability, mean, covariance)


def _limited(polar: Array) -> Array:
    """Limit the variance of each bearing to 1 rad^2: the expansion holds for small angles only."""
    scale = np.ones(4)
    for k in (1, 3):
        scale[k] = min(1.0, 1.0 / math.sqrt(max(polar[k, k], 1e-300)))
    limited: Array = polar * scale[:, None] * scale
    return limited
