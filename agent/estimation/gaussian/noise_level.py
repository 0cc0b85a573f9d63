"""The noise level tau^2: the factor by which the variances of all ranges differ from the told ones.

Its prior is a scaled inverse chi-square, whose degrees of freedom say how well the sigmas are known. With the
level integrated out, the ranges have a Student t distribution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

INLIER = 0.5
"""The weight from which on a range counts as an inlier."""

BY_CHANCE = 2.0
"""The number of standard deviations 1 / sqrt(N) of the correlation of N white residuals that is disregarded.

With less, noise as told makes missions longer; with more, errors that are correlated over 20 ticks make
claims too confident. A noise level below 1 reduces it in proportion: slow errors look like a constant one and
leave small residuals, so these count as a sign of accurate ranges only as far as they are white.
"""

LEAST_LEVEL = 0.25
"""The least noise level, without correlation: sigmas of half the told ones."""

ROUNDED = 1e-12
"""The mean square of residuals, in their variances, up to which they are rounding, without correlation."""

MOST_CORRELATED = 0.8
"""The largest correlation: the noise level grows by a factor of 9 at most."""


def noise_level(chi2: float, degrees: int, nu: float, correlation: float = 0.0) -> float:
    """Return the posterior mean of the factor tau^2 of all variances (scaled inverse chi-square).

    Its prior has `nu` degrees of freedom; with 0, the level is 1. With the `correlation` r of neighbours,
    residuals are worth (1 - r) / (1 + r) of their number, for the level and for everything else that they
    tell. The level grows by as much.
    """
    if not nu:
        return 1.0
    worth = (1.0 - correlation) / (1.0 + correlation)
    return max((nu + worth * chi2) / (nu + worth * max(degrees, 0)), LEAST_LEVEL) / worth


def residual_correlation(
    residuals: Sequence[float],
    weights: Sequence[float],
    sigma: Sequence[float],
    radios: Sequence[int],
    level: float,
) -> float:
    """Return the correlation of each residual with the one before, from 0 to MOST_CORRELATED.

    Both are of the same pair of `radios`, whose residuals follow each other. The correlation is reduced by
    what chance may cause (see BY_CHANCE), and strays count as 0. `level` is the noise level without
    correlation.
    """
    power = neighbours = before = 0.0
    for j in range(len(residuals)):
        scaled = residuals[j] / sigma[j] if weights[j] > INLIER else 0.0
        power += scaled * scaled
        if j > 0 and radios[j] == radios[j - 1]:
            neighbours += scaled * before
        before = scaled
    if not power > ROUNDED * len(residuals):
        return 0.0
    found = neighbours / power - BY_CHANCE * min(level, 1.0) / math.sqrt(len(residuals))
    return min(max(found, 0.0), MOST_CORRELATED)


def misfit_log_likelihood(chi2: float, degrees: int, nu: float) -> float:
    """Return the log-likelihood of a chi-square, with the noise level integrated out (Student's t).

    `nu` is as in `noise_level`.
    """
    n = max(degrees, 0)
    if not nu:
        return -0.5 * chi2
    scale = math.lgamma(0.5 * (nu + n)) - math.lgamma(0.5 * nu) - 0.5 * n * math.log(0.5 * nu)
    return scale - 0.5 * (nu + n) * math.log1p(chi2 / nu)
