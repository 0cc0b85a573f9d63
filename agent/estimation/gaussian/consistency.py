"""Consistency tests: whether the residuals of a fit are compatible with the noise and the known anchors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from agent.estimation.elementary import product
from agent.estimation.fit import Fit
from agent.estimation.gaussian.evidence import own_fit
from agent.estimation.gaussian.joint_ranges import JointMeasurements
from agent.estimation.gaussian.noise_level import INLIER
from protocol.messages import Inconsistent
from protocol.noise import Noise

CLAIM_P_VALUE = 1e-3
"""The p-value below which a robot does not claim a pose, but measures more ranges."""

EARLY_CLAIM_P_VALUE = 1e-2
"""The CLAIM_P_VALUE of a robot with fewer than twice the mutual ranges that a claim requires."""

INCONSISTENT_P_VALUE, INCONSISTENT_P_VALUE_UNTOLD = 2e-4, 3e-6
"""The p-values below which a search counts towards INCONSISTENT_SEARCHES.

The first is for a robot that was told its noise, the second for one that was not; see `rejecting_p_value`.
Most ranges of a search are those of the search before, so several in a row are little rarer by chance than
one. With 2e-4 for ranges of 0.05 m, 9 of 1 000 honest peers were rejected if 5 % of the ranges were too short
and nobody had told. With 1e-5 for ranges of 0.01 m, 2 to 5 of 100 more false reports were never rejected.
"""

INCONSISTENT_SEARCHES = 5
"""The number of consecutive inconsistent searches before a robot ends with `inconsistent`.

Each search covers the whole plane with more ranges than the last, because one search may miss the true
hypothesis.
"""


FINISHED = 0.1
"""The length in sigmas of the last step above which a fit has not reached its minimum."""

HIGHEST_LEVEL = 9.0
"""The largest noise level that the own ranges may show, in variances: sigmas three times as large as told.

Residuals that are larger still are a sign of something else. With no bound, no residual would be.
"""

STRAYS_BEFORE, RANGES_BEFORE = 0.05, 5.0
"""The prior of the rate of strays, as numbers of strays and of other ranges (a beta distribution).

They hold for ranges with a sigma of UNTOLD_SIGMA or more. With more strays, two of twelve mutual ranges may
be strays though no range to the own anchor is one, and such strays make robots believe false reports. With
fewer, honest peers are suspected if 10 % of all ranges are outliers that nobody told. Whoever tells smaller
sigmas knows the rate better: see `Noise.untold_share`.
"""

LEAST_SHARE = 1e-3
"""The least share that counts: a robot never knows the rate better than from 5 000 ranges."""

TOLD_BEFORE = 200.0
"""The weight of the rate of outliers that was told, as a number of ranges."""


def rejecting_p_value(noise: Noise) -> float:
    """Return the p-value below which a search counts against the peer, by how well the noise was told."""
    share = noise.untold_share
    return float(INCONSISTENT_P_VALUE ** (1.0 - share) * INCONSISTENT_P_VALUE_UNTOLD**share)


def consistency_test(fitted: Fit, pair: JointMeasurements, robot: int) -> Inconsistent:
    """Return the least probable of three tests: all residuals, the strays, and the distance of the anchors.

    Its p-value is that of the three together if that is smaller: false data may be a little improbable in
    each.

    The motion of a robot between its anchor and the encounter affects no single range. It is tested only by
    the distance between the anchors that the fit implies, because this distance is known. The tests of the
    residuals and of the strays compare them with those of the own ranges of `robot` (0 or 1), on which the
    peer's reports have no influence.
    """
    count, free = len(fitted.residuals), max(fitted.inliers - 6, 1)
    misfit = _normal(fitted.chi2, free)
    p_value = 0.5 * math.erfc(misfit / math.sqrt(2.0))
    learned = pair.noise.sigma_degrees > 0.0 and p_value < LEARNED_P_VALUE
    own = None
    if learned or fitted.inliers < count:  # the own ranges, without the peer's reports
        own = own_fit(fitted, robot, pair)
        if own is None:
            return Inconsistent("ranges to one anchor that no motion explains", 0.0, 0.0)
    if learned and own is not None:
        p_value, misfit = _against_own(fitted, own, pair.noise)
    what = (
        "measurements and reports that contradict each other: "
        f"chi-square {fitted.chi2:.3g} for {free} degrees of freedom"
    )
    tests = [Inconsistent(what, max(misfit, 0.0), p_value)]
    if own is not None and fitted.inliers < count:
        tests.append(_strays_test(fitted, own, pair, robot))
    if fitted.last_step <= FINISHED:
        score = abs(_distance_score(fitted, pair))
        what = "motion that implies another distance between the anchors"
        tests.append(Inconsistent(what, score, math.erfc(score / math.sqrt(2.0))))
    least = min(tests, key=lambda one: one.p_value)
    return replace(least, p_value=min(least.p_value, fisher([one.p_value for one in tests])))


def constant_errors_p_value(fit: Fit) -> float:
    """Return the probability of constant errors at least as large as those of a fit, under their priors.

    What a fit learns of them has the covariance (I - P) (I + (L - 1) P), in their sigmas: P is what is left
    of their prior covariance I, and L the noise level of the white errors, which is no reason for larger
    constant ones. The sum of their squares is compared with a chi-square of the same mean and variance
    (Satterthwaite 1946), so those of which the ranges tell little do not count. Among the chi-square of
    hundreds of ranges, these few would hardly be seen.
    """
    constants, size = fit.constants, fit.start.poses.size
    left = fit.linear.step.inverse[size : size + len(constants), size : size + len(constants)]
    one = np.eye(len(constants))
    learned = product(one - left, one + max(fit.level - 1.0, 0.0) * left)
    mean, square = float(np.trace(learned)), float(np.sum(np.square(learned)))
    if not mean > 0.0:
        return 1.0
    return chi2_p_value(float(np.sum(np.square(constants))) * mean / square, mean * mean / square)


def fisher(p_values: Sequence[float]) -> float:
    """Return the p-value of several independent tests together (Fisher 1932)."""
    log_product = sum([math.log(max(one, LEAST_P_VALUE)) for one in p_values])
    term = total = 1.0
    for k in range(1, len(p_values)):
        term *= -log_product / k
        total += term
    return math.exp(log_product) * total


def _against_own(fitted: Fit, own: Fit, noise: Noise) -> tuple[float, float]:
    """Return the p-value and the sigmas of all residuals, by the noise of the own ranges.

    It is the test of nested models (F test): the ranges that depend on the peer against those of the robot to
    its own anchor.
    """
    own_free = max(own.inliers - 2, 0)
    more, more_free = max(fitted.chi2 - own.chi2, 0.0), max(fitted.inliers - 6 - own_free, 1)
    degrees = noise.sigma_degrees + own_free
    level = min((noise.sigma_degrees + own.chi2) / degrees, HIGHEST_LEVEL)
    p_value = f_tail(more / more_free / level, more_free, degrees)
    return min(p_value, chi2_p_value(more / HIGHEST_LEVEL, more_free)), _normal(more / level, more_free)


LEARNED_P_VALUE = 1e-2
"""The p-value under the told noise below which a robot asks how noisy its own ranges are."""


def _strays_test(fitted: Fit, own: Fit, pair: JointMeasurements, robot: int) -> Inconsistent:
    """Return the test of the number of strays among the ranges that depend on the peer.

    The rate of strays follows from the ranges to the own anchor and from what was told. The peer's ranges
    to its anchor and the mutual ranges are tested together and apart, and of each kind the earliest and the
    latest: a false hypothesis that drops a few of them may fit the rest, and every further range that fits
    would hide them. There is a test from either end for each stray, and both overlap, so the p-value is the
    least of all tests, times the number of strays: a test of the earliest ranges stays as it is, however many
    ranges follow, and among many strays some are close together by chance.
    """
    told, seen = pair.noise.strays + pair.noise.outliers, len(own.residuals) - own.inliers
    known = RANGES_BEFORE / max(pair.noise.untold_share, LEAST_SHARE) - RANGES_BEFORE
    known += TOLD_BEFORE if pair.noise.outliers else 0.0
    strays = STRAYS_BEFORE + known * told + seen
    ranges = RANGES_BEFORE + known * (1.0 - told) + own.inliers
    stray = fitted.weights <= INLIER
    tested = [(int(np.count_nonzero(stray)) - seen, len(stray) - len(own.residuals))]
    for rows in (pair.ranges.to_anchors(1 - robot), pair.ranges.mutual):
        tested += _from_either_end(stray[rows])
    p_value, count, total = min((beta_binomial_tail(k, n, strays, ranges), k, n) for k, n in tested)
    p_value = min(p_value * max(tested[0][0], 1), 1.0)
    what = f"measurements and reports of which {count} of {total} fit no other"
    return Inconsistent(what, sigmas(p_value), p_value)


def _from_either_end(stray: NDArray[np.bool]) -> list[tuple[int, int]]:
    """Return the numbers of strays and of ranges up to each stray, and from each stray on."""
    places, total = np.flatnonzero(stray).tolist(), len(stray)
    up_to = [(count, place + 1) for count, place in enumerate(places, 1)]
    return up_to + [(len(places) - count, total - place) for count, place in enumerate(places)]


def sigmas(p_value: float) -> float:
    """Return the standard normal variable, at least 0, that is exceeded with the probability `p_value`."""
    low, high = 0.0, MOST_SIGMAS
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if math.erfc(middle / math.sqrt(2.0)) > 2.0 * p_value else (low, middle)
    return low


MOST_SIGMAS = 37.0
"""The standard normal variable that is exceeded with LEAST_P_VALUE."""

HALVINGS = 50
"""The number of halvings of an interval that lead to the precision of a float."""

LEAST_P_VALUE = 1e-300
"""The smallest p-value that is distinguished from 0."""


def beta_binomial_tail(least: int, count: int, alpha: float, beta: float) -> float:
    """Return the probability of at least `least` of `count` events, whose rate has a beta distribution.

    `alpha` and `beta` are the parameters of this distribution.
    """
    if least <= 0:
        return 1.0
    log_norm = math.lgamma(alpha + beta) - math.lgamma(alpha) - math.lgamma(beta)
    log_norm += math.lgamma(count + 1.0) - math.lgamma(alpha + beta + count)
    total = 0.0
    for k in range(least, count + 1):
        log_term = math.lgamma(k + alpha) + math.lgamma(count - k + beta)
        total += math.exp(log_norm + log_term - math.lgamma(k + 1.0) - math.lgamma(count - k + 1.0))
    return min(total, 1.0)


def f_tail(ratio: float, over: float, under: float) -> float:
    """Return the probability of an F ratio above `ratio`, with the degrees of freedom `over` and `under`.

    It is the regularised incomplete beta function, by its continued fraction (Lentz).
    """
    if ratio <= 0.0:
        return 1.0
    x, a, b = under / (under + over * ratio), 0.5 * under, 0.5 * over
    front = math.exp(
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    )
    if x < (a + 1.0) / (a + b + 2.0):
        return front * _beta_fraction(x, a, b) / a
    return 1.0 - front * _beta_fraction(1.0 - x, b, a) / b


def _beta_fraction(x: float, a: float, b: float) -> float:
    """Return the continued fraction of the incomplete beta function at `x`, which is small."""
    tiny = 1e-300
    c, d = 1.0, 1.0 - (a + b) * x / (a + 1.0)
    d = 1.0 / (d if abs(d) > tiny else tiny)
    value = d
    for m in range(1, FRACTION_TERMS):
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)),
        ):
            d = 1.0 + term * d
            d = 1.0 / (d if abs(d) > tiny else tiny)
            c = 1.0 + term / c
            c = c if abs(c) > tiny else tiny
            value *= c * d
        if abs(c * d - 1.0) < 1e-12:
            break
    return value


FRACTION_TERMS = 500
"""The maximum number of terms of the fraction; it needs about the root of the degrees of freedom."""


def chi2_p_value(chi2: float, free: float) -> float:
    """Return the probability of a larger chi-square with `free` degrees of freedom (Wilson and Hilferty)."""
    return 0.5 * math.erfc(_normal(chi2, free) / math.sqrt(2.0))


def _normal(chi2: float, free: float) -> float:
    """Return a chi-square with `free` degrees of freedom as a standard normal variable (Wilson and Hilferty).

    Rounding may make the chi-square of a fit that has not reached its minimum negative (see
    FINISHED).
    """
    spread = 2.0 / (9.0 * free)
    return float(((max(chi2, 0.0) / free) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread))


@lru_cache(maxsize=2)  # both robots of one process ask for it
def _distance_score(fitted: Fit, pair: JointMeasurements) -> float:
    """Return by how many sigmas the ranges favour another distance of the anchors (score test, Rao 1948)."""
    of, walk = fitted.problem.measured, fitted.linear.walk
    x, y = walk.direction.T  # of a from b, which moves with M2
    apart = of.pivot[1] - of.pivot[0]
    along = (x * apart[0] + y * apart[1]) / math.hypot(*apart)
    score, information = fitted.linear.score(np.where(of.second >= 0, -along, 0.0))
    level = max(min(fitted.level, HIGHEST_LEVEL), 1.0)
    surveyed = 2.0 * pair.noise.priors.survey_error**2  # the variance of the known distance
    if not information * (apart[0] ** 2 + apart[1] ** 2) > LEAST_INFORMATION:
        return 0.0
    return score / math.sqrt(information * (level + surveyed * information))


LEAST_INFORMATION = 0.1
"""The information on the distance below which the ranges do not determine it, and the score is 0.

It is in units of that of a distance with a sigma of its own length.
"""
