"""The weights of ranges in a fit: the probability that each range is an inlier.

Like `smoother`, this is the text of a part of `smoother.c`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from agent.estimation.gaussian.noise_level import INLIER
from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_model import LARGEST_RATIO, STRAY_WIDTH
from agent.estimation.smoother import Vector
from protocol.noise import Noise

FAR = 32.0
"""The standard deviation of a range with the weight 0, in units of the longest range."""

BLIND = 1e-9
"""The least precision of a range's prediction, as a fraction of that with a known guess."""

MEDIAN = 0.6745
"""The median of the absolute value of a standard normal variable."""

SOFT = 0.1
"""The least smoothing of the ends of the outlier density, as a fraction of the least bias."""


class Weighing(NamedTuple):
    """The quantities on which the weights of N ranges depend, besides their residuals."""

    sigma: Array
    """the standard deviation of each range in m; (N,)"""
    holding: Places
    """1 for a range that is no outlier: it has no error but a white one (see `JointRanges.radio`); (N,)"""
    by_radio: Places
    """the ranges, those of each pair of radios together; (N,)"""
    longest: float
    """the longest range in m: the size of the geometry"""
    inlier: float
    """logarithm of the probability of inliers, and of their density at 0, in units of sigma"""
    outlier: float
    """logarithm of the probability of outliers; minus infinity: there are none"""
    stray: float
    """logarithm of the probability of strays, and of their density in units of sigma"""
    least: float
    """the least bias of an outlier in m"""
    most: float
    """its largest bias"""
    degrees: float
    """degrees of freedom of the prior of the noise level; 0: it is 1"""
    free: int
    """number of unknowns of the start poses that only the ranges determine"""
    robust: bool
    """true if a range may be an outlier"""
    noisy: bool
    """true if odometry may differ from the executed motion"""

    @staticmethod
    def of(
        noise: Noise,
        sigma: Array,
        holding: Places,
        by_radio: Places,
        longest: float,
        *,
        free: int,
        noisy: bool,
    ) -> Weighing:
        """Return what the weights depend on, with the shares and densities of `noise`."""
        return Weighing(
            sigma,
            holding,
            by_radio,
            longest,
            math.log1p(-noise.outliers - noise.strays) - 0.5 * math.log(2.0 * math.pi),
            math.log(noise.outliers) if noise.outliers else -math.inf,
            math.log(noise.strays / STRAY_WIDTH) if noise.strays else -math.inf,
            *noise.outlier_bias,
            noise.sigma_degrees,
            free,
            bool(noise.outliers or noise.strays),
            noisy,
        )


def weighted_variance(by: Weighing, weights: Vector) -> Vector:
    """Return the variance (m^2) of each range, which is large for a small weight; see FAR."""
    found = []
    for sigma, weight in zip(by.sigma.tolist(), weights, strict=True):
        least = sigma / (FAR * by.longest)
        found.append(sigma * sigma / max(weight, least * least))
    return found


def inlier_probabilities(
    multipliers: Vector, alone: Vector, explained: Vector, variance: Vector, by: Weighing
) -> Vector:
    """Return the probability that each range is an inlier, given the prediction from all other ranges.

    `multipliers` are the innovations times their inverse covariance, `alone` is the diagonal of that, and
    `explained` the part of it that the unknowns explain. `variance` is the own one of each range (m^2).
    """
    errors, spread = [], []
    for j, sigma in enumerate(by.sigma.tolist()):
        precision = max(alone[j] - explained[j], BLIND * alone[j])
        errors.append(multipliers[j] / precision)
        spread.append(math.sqrt(max(1.0 / precision - variance[j], 0.0) + sigma * sigma))
    return weights_by_errors(errors, spread, by)


def weights_by_errors(errors: Vector, sigma: Vector, by: Weighing) -> Vector:
    """Return the probability that each range is an inlier, if `errors` (m) have the scale of their median.

    Far from the minimum, all errors are large, and no range is an outlier because of that. At least about
    half of the ranges are therefore inliers.
    """
    if not by.robust or not errors:
        return [1.0] * len(errors)
    scale = 1.0
    if by.degrees:
        ratios = sorted([abs(error / spread) for error, spread in zip(errors, sigma, strict=True)])
        scale = max(1.0, ratios[len(ratios) // 2] / MEDIAN)
    return [
        1.0 if holds else _inlier_probability(error, scale * spread, by)
        for error, spread, holds in zip(errors, sigma, by.holding.tolist(), strict=True)
    ]


def _inlier_probability(error: float, sigma: float, by: Weighing) -> float:
    """Return the probability that a range with this error (m) is an inlier."""
    in_sigmas, width = error / sigma, by.most - by.least
    misfit = 0.5 * in_sigmas * in_sigmas
    beyond = (error - min(max(error, by.least), by.most)) / sigma
    wide = math.log(sigma / max(width, sigma)) + (by.outlier - by.inlier)
    ratio = log_sum(misfit - 0.5 * beyond * beyond + wide, misfit + (by.stray - by.inlier))
    return 1.0 / (1.0 + math.exp(min(ratio, LARGEST_RATIO)))


def log_sum(one: float, other: float) -> float:
    """Return the logarithm of the sum of the exponentials of both, of which one may be minus infinity."""
    larger, smaller = max(one, other), min(one, other)
    return larger + math.log1p(math.exp(smaller - larger))


def outlier_log_density(residuals: Vector, weights: Vector, by: Weighing) -> float:
    """Return the log-density of the residuals (m) of outliers and strays, and half their log-variances.

    The bias of an outlier is uniform, and the ends of its density are smoothed. A stray may be anywhere (see
    STRAY_WIDTH).
    """
    total, soft = 0.0, SOFT * by.least if by.outlier > -math.inf else 0.0
    for j, variance in enumerate(weighted_variance(by, weights)):
        if weights[j] > INLIER:
            continue
        sigma = max(float(by.sigma[j]), soft)
        beyond = max(by.least - residuals[j], residuals[j] - by.most, 0.0) / sigma
        wide = by.outlier - math.log(max(by.most - by.least, sigma))
        total += 0.5 * math.log(variance)
        total += log_sum(wide - 0.5 * beyond * beyond, by.stray - math.log(sigma))
    return total
