"""The agreement of poses of one robot that it has determined in different meetings, and their union."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from agent.estimation.elementary import eigh, inverted, product, quadratic, solve
from agent.estimation.gaussian.mission_measurements import path_of
from agent.estimation.gaussian.odometry_noise import (
    Array,
    Track,
    constant_errors,
    effect_covariance,
    expected_variances,
    is_noisy,
    pose_effects,
)
from agent.estimation.gaussian.planning_hypotheses import covariance_of
from agent.estimation.smoother import Singular
from agent.peer.motion_log import MotionLog
from protocol.messages import Localised
from protocol.mission import HEADING_ACCURACY, Mission
from protocol.motion import Pose, compose, inverse, rotated, wrap
from protocol.noise import Noise
from protocol.rounding import TOLERANCE


class ClaimDifference(NamedTuple):
    """The difference of a pose from the one that follows from an earlier claim and the odometry since."""

    position: float
    """The distance of the positions in m."""
    heading: float
    """The difference of the headings in rad, not negative."""
    p_value: float
    """The probability of a difference that is as improbable, if both claims are right (chi-square test)."""


AGREEMENT_STEPS = 8
"""The Gauss-Newton steps to the pose that both claims suggest. Three suffice for errors of 0.3 rad."""


def difference(
    earlier: Localised, since: int, now: Localised, through: int, log: MotionLog, mission: Mission
) -> ClaimDifference:
    """Return the difference of the claim `now`, of tick `through`, from the claim `earlier`, of tick `since`.

    Chi-square is that of the pose at `since` which suits both best, because an error of the heading moves a
    far pose on an arc. The errors of the two claims and of the odometry between them are taken as
    independent. Claims share the ranges to the robot's own anchor, so they differ by less, and the p-value is
    too large rather than too small. It is 0 if a covariance is singular, which explains no difference.
    """
    path = path_of(log.runs, 0, through, mission)
    here, there = (
        Pose(float(path.x[tick]), float(path.y[tick]), float(path.heading[tick])) for tick in (since, through)
    )
    way = compose(inverse(here), there)
    off = minus(now.pose, compose(earlier.pose, way))
    try:
        chi2 = _least_chi2(earlier, since, now, way, path, mission.noise)
    except Singular:
        chi2 = math.inf
    return ClaimDifference(math.hypot(off[0], off[1]), abs(float(off[2])), _p_value(chi2))


def _least_chi2(
    earlier: Localised, since: int, now: Localised, way: Pose, path: Track, noise: Noise
) -> float:
    """Return the chi-square of the pose at `since` which suits `earlier` and `now`, `way` after it, best.

    Raises Singular if a covariance is singular.
    """
    heading = float(path.heading[since])
    first = inverted(matrix(earlier))
    best, chi2 = earlier.pose, math.inf
    for _ in range(AGREEMENT_STEPS):
        begin, end = minus(best, earlier.pose), compose(best, way)
        left = minus(end, now.pose)
        of_odometry = _odometry_covariance(path, since, best.heading - heading, noise)
        second = inverted(matrix(now) + of_odometry)
        chi2 = quadratic(first, begin) + quadratic(second, left)
        by_begin = np.eye(3)
        by_begin[0, 2], by_begin[1, 2] = best.y - end.y, end.x - best.x
        weighted = product(by_begin.T, second)
        gradient = product(first, begin[:, None]) + product(weighted, left[:, None])
        move = solve(first + product(weighted, by_begin), gradient)[:, 0]
        best = Pose(*(np.array((best.x, best.y, best.heading)) - move).tolist())
    return chi2


def agreement(one: Localised, other: Localised) -> float:
    """Return the p-value of the difference of two poses of one tick, if both are right (chi-square test).

    Their errors are taken as independent, so the p-value is too large rather than too small. Both have
    positive definite covariances.
    """
    off = minus(one.pose, other.pose)
    return _p_value(quadratic(inverted(matrix(one) + matrix(other)), off))


def covariance_union(claims: Sequence[Localised]) -> Localised:
    """Return the last of `claims`, of one robot and tick, with a covariance that covers all of them.

    If one of them is right, and nobody knows which, the error of the last one is its own, or that of the
    right one and the difference of the two. So the covariance is at least C_i + d_i d_i^T for each claim i,
    where d_i is its difference from the last one (covariance union; Uhlmann 2003).
    """
    best = claims[-1]
    union = matrix(best)
    for one in claims[:-1]:
        off = minus(one.pose, best.pose)
        union = _larger(union, matrix(one) + np.outer(off, off))
    return Localised(best.pose, covariance_of(union))


def agreed(
    claims: Sequence[Localised], tolerates: int, mission: Mission
) -> tuple[Localised, tuple[int, ...]] | None:
    """Return the claim that covers `tolerates` + 1 of `claims`, and their indices; None if none does.

    They are of one robot and tick, by different peers. If at most `tolerates` of these report false data, one
    of the claims is right.
    """
    for chosen in combinations(range(len(claims)), tolerates + 1):
        claim = united([claims[k] for k in chosen], mission)
        if claim is not None:
            return claim, chosen
    return None


def united(claims: Sequence[Localised], mission: Mission) -> Localised | None:
    """Return the claim that covers all of `claims`, of one robot and tick; None if it is none.

    It is none if two of them differ by more than they do with probability `mission.confidence` if both are
    right (with exact sensors, by a tenth of TOLERANCE), or if it is not accurate enough.
    """
    if claims[-1].covariance is None:
        off = [abs(minus(one.pose, claims[-1].pose)).max() for one in claims]
        return claims[-1] if max(off) <= 0.1 * TOLERANCE else None
    if not all(agreement(*two) >= 1.0 - mission.confidence for two in combinations(claims, 2)):
        return None
    claim = covariance_union(claims)
    assert claim.covariance is not None
    position, heading = claim.covariance.position_sigma, claim.covariance.heading_sigma
    return claim if position <= mission.accuracy and heading <= HEADING_ACCURACY else None


def _larger(one: Array, other: Array) -> Array:
    """Return the smallest matrix that is at least as large as both, which are positive definite."""
    variances, axes = eigh(one)
    sigmas = np.sqrt(variances)
    whitening = axes / sigmas
    values, vectors = eigh(product(product(whitening.T, other), whitening))
    turned = product(axes * sigmas, vectors)
    return product(turned * np.maximum(values, 1.0), turned.T)


def matrix(claim: Localised) -> Array:
    """Return the covariance of a pose under noise, in x, y (m) and heading (rad), (3, 3)."""
    assert claim.covariance is not None
    return np.array(claim.covariance.matrix)


def minus(one: Pose, other: Pose) -> Array:
    """Return the difference of two poses in x, y and heading, (3,)."""
    return np.array((one.x - other.x, one.y - other.y, wrap(one.heading - other.heading)))


def _odometry_covariance(path: Track, since: int, turn: float, noise: Noise) -> Array:
    """Return the covariance of the pose at the end of `path`, rotated by `turn`, by noise after `since`."""
    if not is_noisy(noise):
        return np.zeros((3, 3))
    patterns = constant_errors(path.v, path.omega, noise)
    white = expected_variances(path.v, path.omega, noise, path.period)
    effects, (c, s) = pose_effects(path, since, len(path.v)), (math.cos(turn), math.sin(turn))
    effects[0], effects[1] = rotated(c, s, effects[0], effects[1])
    return effect_covariance(effects, white, patterns)


def _p_value(chi2: float) -> float:
    """Return the probability of a chi-square above `chi2` with three degrees of freedom, exactly."""
    root = math.sqrt(0.5 * min(max(chi2, 0.0), CERTAIN))
    return math.erfc(root) + 2.0 / math.sqrt(math.pi) * root * math.exp(-root * root)


CERTAIN = 4000.0
"""A chi-square whose p-value is 0 as a float, like those of all larger ones."""
