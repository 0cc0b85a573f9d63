"""The noise level tau^2: the factor by which the variances of all ranges differ from the told ones.

Its prior is a scaled inverse chi-square, whose degrees of freedom say how well the sigmas are known. With the
level integrated out, the ranges have a Student t distribution.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from agent.estimation.gaussian.odometry_noise import Array
from protocol.noise import Noise

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

MOST_CORRELATED = 0.8
"""The largest correlation: the noise level grows by a factor of 9 at most."""


def noise_level(chi2: float, degrees: int, noise: Noise, correlation: float = 0.0) -> float:
    """Return the posterior mean of the factor tau^2 of all variances (scaled inverse chi-square).

    With the `correlation` r of neighbours, residuals are worth (1 - r) / (1 + r) of their number, for the
    level and for everything else that they tell. The level grows by as much.
    """
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return 1.0
    worth = (1.0 - correlation) / (1.0 + correlation)
    return max((nu + worth * chi2) / (nu + worth * n), LEAST_LEVEL) / worth


def residual_correlation(
    residuals: Array, weights: Array, sigma: Array, ends: Collection[int], level: float
) -> float:
    """Return the correlation of each residual with the one before, from 0 to MOST_CORRELATED.

    Both are of the same kind, and `ends` are the rows after the last one of each. The correlation is reduced
    by what chance may cause (see BY_CHANCE), and strays count as 0. `level` is the noise level without
    correlation.
    """
    scaled = (weights > INLIER) * (residuals / sigma)
    power, neighbours = float(scaled @ scaled), float(scaled[1:] @ scaled[:-1])
    for end in ends:
        if 0 < end < len(scaled):
            neighbours -= float(scaled[end] * scaled[end - 1])
    if not power > 0.0:
        return 0.0
    found = neighbours / power - BY_CHANCE * min(level, 1.0) / math.sqrt(len(scaled))
    return min(max(found, 0.0), MOST_CORRELATED)


def misfit_log_likelihood(chi2: float, degrees: int, noise: Noise) -> float:
    """Return the log-likelihood of a chi-square, with the noise level integrated out (Student's t)."""
    nu, n = noise.sigma_degrees, max(degrees, 0)
    if not nu:
        return -0.5 * chi2
    scale = math.lgamma(0.5 * (nu + n)) - math.lgamma(0.5 * nu) - 0.5 * n * math.log(0.5 * nu)
    return scale - 0.5 * (nu + n) * math.log1p(chi2 / nu)
