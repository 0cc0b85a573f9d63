"""Consistency tests: whether the residuals of a fit are compatible with the noise and the known anchors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.least_squares import Fit, fit
from agent.estimation.gaussian.range_model import PairRanges
from protocol.messages import Inconsistent

CLAIM_P_VALUE = 1e-3
"""The p-value below which a robot does not claim a pose, but measures more ranges."""

EARLY_CLAIM_P_VALUE = 1e-2
"""The CLAIM_P_VALUE of a robot with fewer than twice the mutual ranges that a claim requires."""

INCONSISTENT_P_VALUE = 2e-4
"""The p-value below which a search counts towards INCONSISTENT_SEARCHES.

It is so small that chance alone does not cause this many such searches in a row.
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

MOST_STRAYS = 0.15
"""The largest fraction of ranges that may be strays, in addition to the outliers that were told.

With the told rate (1e-3), 10 % outliers that nobody told would make honest peers suspect; with more than a
quarter, strays may agree with each other.
"""


class Inconsistency(NamedTuple):
    """The least favourable test of a fit: a description, its sigmas and its p-value."""

    what: str
    sigmas: float
    p_value: float

    @property
    def verdict(self) -> Inconsistent:
        """Return the verdict on the peer for this result."""
        return Inconsistent(self.what, self.sigmas, self.p_value)


def consistency_test(fitted: Fit, pair: PairRanges, robot: int) -> Inconsistency:
    """Return the least probable of three tests: all residuals, the strays, and the distance of the anchors.

    The motion of a robot between its anchor and the encounter affects no single range. It is tested only by
    the distance between the anchors that the fit implies, because this distance is known. The test of the
    residuals knows how noisy the own ranges of `robot` (0 or 1) are, without the peer's reports.
    """
    least = min(_residuals_test(fitted, pair, robot), _strays_test(fitted, pair), key=lambda one: one.p_value)
    score = abs(_distance_score(fitted, pair)) if fitted.last_step <= FINISHED else 0.0
    p_distance = math.erfc(score / math.sqrt(2.0))
    if p_distance < least.p_value:
        return Inconsistency("motion that implies another distance between the anchors", score, p_distance)
    return least


def _residuals_test(fitted: Fit, pair: PairRanges, robot: int) -> Inconsistency:
    """Return the test of all residuals: by the told noise, and if they are larger, by that of the own ranges.

    The second is the test of nested models (F test): the ranges that depend on the peer against those of
    `robot` to its own anchor.
    """
    free = max(fitted.inliers - 6, 1)
    sigmas = _normal(fitted.chi2, free)
    p_value, noise = 0.5 * math.erfc(sigmas / math.sqrt(2.0)), pair.noise
    if p_value < LEARNED_P_VALUE and noise.sigma_degrees:
        guess = np.array([*fitted.guess[3 * robot : 3 * robot + 2], 0.0])
        begun = fitted.errors[robot : robot + 1]
        own = fit(guess, [pair.paths[robot]], pair.ranges.only(robot), noise, begun=begun)
        own_free = max(own.inliers - 2, 0)
        more, more_free = max(fitted.chi2 - own.chi2, 0.0), max(free - own_free, 1)
        degrees = noise.sigma_degrees + own_free
        level = min((noise.sigma_degrees + own.chi2) / degrees, HIGHEST_LEVEL)
        p_value = max(p_value, f_tail(more / more_free / level, more_free, degrees))
        p_value = min(p_value, 0.5 * math.erfc(_normal(more / HIGHEST_LEVEL, more_free) / math.sqrt(2.0)))
        sigmas = _normal(more / level, more_free)
    what = (
        "measurements and reports that contradict each other: "
        f"chi-square {fitted.chi2:.3g} for {free} degrees of freedom"
    )
    return Inconsistency(what, max(sigmas, 0.0), p_value)


LEARNED_P_VALUE = 1e-2
"""The p-value under the told noise below which a robot asks how noisy its own ranges are."""


def _strays_test(fitted: Fit, pair: PairRanges) -> Inconsistency:
    """Return the test of the number of ranges that fit no hypothesis; the outliers that were told count."""
    count = len(fitted.residuals)
    strays = count - fitted.inliers
    rate = min(MOST_STRAYS + pair.noise.outliers, 0.5)
    excess = (strays - 0.5 - rate * count) / math.sqrt(rate * (1.0 - rate) * max(count, 1))
    p_value = 0.5 * math.erfc(excess / math.sqrt(2.0))
    what = f"measurements and reports of which {strays} of {count} fit no other"
    return Inconsistency(what, max(excess, 0.0), p_value)


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


def _normal(chi2: float, free: int) -> float:
    """Return a chi-square with `free` degrees of freedom as a standard normal variable (Wilson and Hilferty).

    Rounding may make the chi-square of a fit that has not reached its minimum negative (see
    FINISHED).
    """
    spread = 2.0 / (9.0 * free)
    return float(((max(chi2, 0.0) / free) ** (1.0 / 3.0) - (1.0 - spread)) / math.sqrt(spread))


def _distance_score(fitted: Fit, pair: PairRanges) -> float:
    """Return by how many sigmas the ranges favour another distance of the anchors (score test, Rao 1948)."""
    mutual = pair.ranges.rows(2)
    length = math.hypot(*pair.apart)
    c, s = math.cos(fitted.guess[2]), math.sin(fitted.guess[2])
    ux, uy = fitted.directions[0][:, mutual]  # from b to a, in the frame of a's odometry
    by_distance = np.zeros(len(fitted.residuals))
    by_distance[mutual] = -((c * ux - s * uy) * pair.apart[0] + (s * ux + c * uy) * pair.apart[1]) / length
    system = fitted.system
    weighted = system.covariance.solve(by_distance[:, None])[:, 0]
    explained = system.jacobian.T @ weighted
    information = float(by_distance @ weighted - explained @ system.of_guess @ explained)
    score = float(by_distance @ system.multipliers)
    level = min(fitted.level, HIGHEST_LEVEL)
    return score / math.sqrt(information * max(level, 1.0)) if information > LEAST else 0.0


LEAST = 1e-3
"""The information (1 / m^2) below which the ranges do not determine the distance, and the score is 0."""
